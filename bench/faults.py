"""What faults cost: each is made again and again, and what is found is compared with what was acknowledged.

    python -m bench.faults               the long version: 10,000 kills, 2,000 power cuts, … about two hours
    python -m bench.faults --quick       less than a minute
    python -m bench.faults --only power  the faults whose name holds this word

Prints one JSON line a fault; the table is on stderr. Exit code 1 if anything was lost, doubled, misordered or changed.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from bench.breaking import databases, files, processes, simulation
from bench.breaking.outcome import Outcome, Step
from pycrorm_async.store.private import usual_place
from tests.databases import Server, server_in

Make = Callable[[int, random.Random, Path, Step], Outcome]


class Fault(NamedTuple):
    """A fault, how to make it, and how often: in the quick version and in the long one."""

    name: str
    make: Make
    quick: int
    long: int


def faults_on(server: Server, folder: Path) -> list[Fault]:
    """All of them; `server` is killed by one."""
    return [
        Fault("kill -9 of a recorder", processes.killed_recorders, 25, 10_000),
        Fault("kill -9 of an appender, SQLite", processes.killed_appenders(f"sqlite:///{folder}/killed.db"), 8, 500),
        Fault(
            "kill -9 of an appender, PostgreSQL",
            processes.killed_appenders(server.new_database()),
            6,
            300,
        ),
        Fault("torn write at every byte", files.torn_writes, 300, 10**9),
        Fault("flipped bit", files.flipped_bits, 150, 10**9),
        Fault("power cut", files.power_cuts, 60, 2_000),
        Fault("failed sync", files.failed_syncs, 20, 1_000),
        Fault("disk full", files.full_disk, 3, 100),
        Fault("clock jumps", files.clock_jumps, 20, 1_000),
        Fault("fork", processes.forks, 10, 500),
        Fault("exit with a full queue", processes.exits_with_a_full_queue, 6, 300),
        Fault("second opener", processes.second_openers, 4, 200),
        Fault("lost COMMIT reply", databases.lost_replies(server), 40, 2_000),
        Fault("cut connection", databases.cut_connections(server), 25, 1_000),
        Fault("cancelled append", databases.cancelled_appends(server), 30, 2_000),
        Fault("killed server", databases.killed_servers(server), 2, 50),
        Fault("all of it at random, simulated", simulation.simulated, 15, 2_000),
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="less than a minute")
    parser.add_argument("--seed", type=int, default=None, help="of all random choices; printed in every line")
    parser.add_argument("--only", default="", help="the faults whose name holds this word")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the server and the folders go then too
    seed = arguments.seed if arguments.seed is not None else random.SystemRandom().randrange(2**31)
    console = Console(stderr=True)
    if not console.is_terminal:
        console = Console(stderr=True, width=160)
    outcomes: dict[str, tuple[Outcome, float]] = {}
    with (
        tempfile.TemporaryDirectory(prefix="pg") as place,
        server_in(Path(place)) as server,
        tempfile.TemporaryDirectory(prefix="faults", dir=usual_place()) as folder,
        _progress(console) as progress,
    ):
        for fault in faults_on(server, Path(folder)):
            if arguments.only in fault.name:
                rounds = fault.quick if arguments.quick else fault.long
                outcomes[fault.name] = _made(fault, rounds, seed, Path(folder), progress)
                _tell(fault.name, seed, *outcomes[fault.name])
    console.print(_table(outcomes, seed))
    return 0 if all(outcome.clean for outcome, _ in outcomes.values()) else 1


def _made(fault: Fault, rounds: int, seed: int, folder: Path, progress: Progress) -> tuple[Outcome, float]:
    bar = progress.add_task(fault.name, total=rounds if rounds < 10**9 else None)
    place = Path(tempfile.mkdtemp(dir=folder))
    began = time.perf_counter()
    # Each with its own numbers, so that one fault alone goes as it did among the others.
    try:
        outcome = fault.make(rounds, random.Random(f"{seed} {fault.name}"), place, lambda: progress.advance(bar))
    except Exception as error:  # noqa: BLE001  what a fault may bring out is for the table, and the others go on
        traceback.print_exc()
        outcome = Outcome(broke=f"{type(error).__name__}: {error}")
    took_s = time.perf_counter() - began
    progress.update(bar, total=outcome.rounds, completed=outcome.rounds)
    return outcome, took_s


def _tell(name: str, seed: int, outcome: Outcome, took_s: float) -> None:
    line = {
        "bench": "faults",
        "fault": name,
        "seed": seed,
        "rounds": outcome.rounds,
        "events": outcome.events,
        "lost": outcome.lost,
        "duplicated": outcome.duplicated,
        "misordered": outcome.misordered,
        "changed": outcome.changed,
        "told": outcome.told,
        "broke": outcome.broke,
        "rounds_failed": outcome.rounds_failed[:20],
        "took_s": round(took_s, 1),
        "note": outcome.note,
    }
    print(json.dumps(line), flush=True)


def _progress(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def _table(outcomes: dict[str, tuple[Outcome, float]], seed: int) -> Table:
    table = Table(title=f"What faults cost (seed {seed})", title_justify="left")
    for name in ("fault", "rounds", "events", "lost", "duplicated", "misordered", "changed", "given up, told", "note"):
        words = name in ("fault", "note")
        table.add_column(name, justify="left" if words else "right", no_wrap=name != "note", ratio=1 if words else None)
    for name, (outcome, _) in outcomes.items():
        bad = "" if outcome.clean else "bold red"
        numbers = (
            outcome.rounds,
            outcome.events,
            outcome.lost,
            outcome.duplicated,
            outcome.misordered,
            outcome.changed,
            outcome.told,
        )
        table.add_row(name, *(f"{each:,}" for each in numbers), outcome.broke or outcome.note, style=bad)
    return table


if __name__ == "__main__":
    sys.exit(main())
