"""Inject each fault many times, and compare the events that exist afterwards with the acknowledged ones.

    python -m bench.faults               the long version: 10,000 kills, 500 power cuts on a real disk, …
    python -m bench.faults --quick       a few rounds of every fault
    python -m bench.faults --only power  the faults whose names contain this word
    python -m bench.faults --report faults.md --seed 7     write a table to faults.md and a line for each slice to
                                                           faults.md.jsonl; repeated, the command continues from them

The script prints one JSON line for each fault; progress and the table are on stderr. The exit code is 1 if an event
was lost, duplicated, misordered or corrupted, and 130 if the run was interrupted.

A long run consists of slices, each with its own random numbers: `--only NAME --slice 7 --seed S` repeats one slice.
The report keeps the outcome of each slice.
"""

from __future__ import annotations

import argparse
import json
import random
import shlex
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from bench.breaking import databases, disks, files, processes, restores
from bench.breaking import databases as declarations
from bench.breaking import disks as machine
from bench.breaking import files as crafted_frames
from bench.breaking import files as simulation
from bench.breaking import processes as robots
from bench.breaking import processes as workers
from bench.breaking import restores as deletions
from bench.breaking.outcome import Outcome, Report, Slice, Step, summed
from pycrorm_async.store.address import usual_place
from tests.databases import Server, server_in

Inject = Callable[[int, random.Random, Path, Step], Outcome]


class Fault(NamedTuple):
    """A fault, its injecting function, and its rounds in the quick version, in the long version, and in one slice."""

    name: str
    inject: Inject
    quick: int
    long: int
    slice: int


def faults_on(server: Server) -> list[Fault]:
    """Return all faults. Some of them kill `server`."""

    def on_the_server(_: Path) -> str:
        return server.new_database()

    def on_a_file(folder: Path) -> str:
        return f"sqlite:///{folder}/killed.db"

    return [
        Fault("kill -9 of a recorder", processes.killed_recorders, 40, 10_000, 500),
        Fault("kill -9 of an appender, SQLite", processes.killed_appenders(on_a_file), 8, 500, 50),
        Fault("kill -9 of an appender, PostgreSQL", processes.killed_appenders(on_the_server), 6, 300, 50),
        Fault("kill -9 of a plan and its writer", robots.killed_plans, 6, 500, 50),
        Fault("kill -9 of the daemon, SQLite", robots.killed_daemons(None), 3, 200, 20),
        Fault("kill -9 of the daemon, PostgreSQL", robots.killed_daemons(server), 3, 200, 20),
        Fault("killed fold workers, SQLite", workers.faulty_workers(None, signal.SIGKILL), 2, 200, 20),
        Fault("killed fold workers, PostgreSQL", workers.faulty_workers(server, signal.SIGKILL), 2, 200, 20),
        Fault("torn write at every byte", files.torn_writes, 300, 20_000, 2_000),
        Fault("flipped bit", files.flipped_bits, 150, 80_000, 80_000),
        Fault("power cut, simulated disk", files.power_cuts, 60, 5_000, 500),
        Fault("power cut, real disk", machine.power_cuts, 4, 500, 25),
        Fault("failed sync", files.failed_syncs, 20, 1_000, 1_000),
        Fault("disk full, spool", files.full_disk, 3, 100, 100),
        Fault("disk full, ext4", disks.FullDisksOn("ext4"), 2, 200, 50),
        Fault("disk full, XFS", disks.FullDisksOn("xfs"), 2, 200, 50),
        Fault("disk full, btrfs", disks.FullDisksOn("btrfs"), 2, 200, 50),
        Fault("crafted frames", crafted_frames.crafted_folders, 2, 300, 50),
        Fault("deleted database", deletions.deleted_databases, 3, 200, 20),
        Fault("disk full, database", databases.full_disks, 5, 500, 100),
        Fault("clock jumps", files.clock_jumps, 20, 1_000, 1_000),
        Fault("fork", processes.forks, 10, 500, 500),
        Fault("exit with a full queue", processes.exits_with_a_full_queue, 6, 300, 100),
        Fault("second opener", processes.second_openers, 4, 200, 100),
        Fault("lost COMMIT reply", databases.lost_replies(server), 40, 2_000, 500),
        Fault("cut connection", databases.cut_connections(server), 25, 1_000, 250),
        Fault("cancelled append", databases.cancelled_appends(server), 30, 2_000, 500),
        Fault("locked database", databases.locked_files, 10, 500, 100),
        Fault("stopped server", databases.ended_servers(server, killed=False), 2, 50, 10),
        Fault("killed server", databases.ended_servers(server, killed=True), 2, 50, 10),
        Fault("foreign declarations, SQLite", declarations.foreign_declarations(on_a_file), 3, 200, 20),
        Fault("foreign declarations, PostgreSQL", declarations.foreign_declarations(on_the_server), 3, 200, 20),
        Fault("failover to an asynchronous replica", restores.failovers(synchronous=False), 2, 200, 20),
        Fault("failover to a synchronous replica", restores.failovers(synchronous=True), 2, 200, 20),
        Fault("failover by Patroni", restores.failovers_by_patroni, 2, 20, 10),
        Fault("restored PostgreSQL", restores.restored_servers, 2, 200, 50),
        Fault("restored SQLite file", restores.restored_files, 3, 300, 50),
        Fault("all of it at random, simulated", simulation.simulated, 15, 1_000, 100),
    ]


def slices_of(fault: Fault, *, quick: bool) -> Iterator[tuple[int, int]]:
    """Yield number and rounds of each slice."""
    total = fault.quick if quick else fault.long
    for number, first in enumerate(range(0, total, fault.slice), start=1):
        yield number, min(fault.slice, total - first)


class _Termination:
    """End the program on SIGTERM by SystemExit, so that it stops its server and deletes its folders.

    Python drops an exception that a signal handler raises inside a weakref callback or a finalizer. The program then
    ends at the next `check`, that is after the current round.
    """

    def __init__(self) -> None:
        self._requested = False

    def request(self, *_: object) -> None:
        self._requested = True
        sys.exit(143)

    def check(self) -> None:
        if self._requested:
            sys.exit(143)


def main() -> int:
    arguments = _arguments()
    termination = _Termination()
    signal.signal(signal.SIGTERM, termination.request)
    seed = arguments.seed if arguments.seed is not None else random.SystemRandom().randrange(2**31)
    console = Console(stderr=True)
    if not console.is_terminal:
        console = Console(stderr=True, width=160)
    command = shlex.join(["python", "-m", "bench.faults", *sys.argv[1:]])
    console.print(f"seed {seed}")
    outcomes: dict[str, Outcome] = {}
    try:
        with (
            tempfile.TemporaryDirectory(prefix="pg") as place,
            server_in(Path(place)) as server,
            tempfile.TemporaryDirectory(prefix="faults", dir=usual_place()) as folder,
            _progress(console) as progress,
        ):
            faults = faults_on(server)
            order = [each.name for each in faults]
            report = Report(arguments.report, seed=seed, quick=arguments.quick, command=command, order=order)
            for fault in faults:
                if not arguments.only or any(word in fault.name for word in arguments.only):
                    slices = _outcomes(fault, arguments, report, Path(folder), progress, termination)
                    outcomes[fault.name] = summed(slices)
                    print(json.dumps(Slice(fault.name, 0, outcomes[fault.name]).line(seed)), flush=True)
                    if not console.is_terminal:
                        _print_summary(console, fault.name, outcomes[fault.name])
    except KeyboardInterrupt:
        console.print(f"interrupted; continue with --seed {seed}" + ("" if arguments.report else " and --report FILE"))
        return 130
    console.print(_table(outcomes, seed))
    return 0 if all(outcome.clean for outcome in outcomes.values()) else 1


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="a few rounds of every fault")
    parser.add_argument("--seed", type=int, default=None, help="seed of all random choices; every line contains it")
    parser.add_argument("--only", action="append", help="faults whose names contain this word; can be repeated")
    parser.add_argument("--slice", type=int, default=None, help="run only the slice with this number")
    parser.add_argument("--report", type=Path, default=None, help="file for the table; the lines are in FILE.jsonl")
    return parser.parse_args()


def _outcomes(
    fault: Fault,
    arguments: argparse.Namespace,
    report: Report,
    folder: Path,
    progress: Progress,
    termination: _Termination,
) -> list[Outcome]:
    """Run the slices of a fault that the report does not contain; return the outcomes of all its slices."""
    slices = [
        (number, rounds)
        for number, rounds in slices_of(fault, quick=arguments.quick)
        if arguments.slice in (None, number)
    ]
    bar = progress.add_task(fault.name, total=sum(rounds for _, rounds in slices))

    def step() -> None:
        termination.check()
        progress.advance(bar)

    outcomes: list[Outcome] = []
    for number, rounds in slices:
        outcome = report.finished(fault.name, number)
        if outcome is None:
            # Each slice has its own random numbers, so that it can be repeated without the others.
            rng = random.Random(f"{report.seed} {fault.name} {number}")
            outcome = _slice(fault, rounds, rng, folder, step)
            report.add(Slice(fault.name, number, outcome))
        outcomes.append(outcome)
        progress.update(bar, completed=sum(each for other, each in slices if other <= number))
    return outcomes


def _slice(fault: Fault, rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    began = time.perf_counter()
    with tempfile.TemporaryDirectory(dir=folder) as place:
        try:
            outcome = fault.inject(rounds, rng, Path(place), step)
        except Exception as error:  # noqa: BLE001  the table shows the error; the other faults must still run
            traceback.print_exc()
            outcome = Outcome(error=f"{type(error).__name__}: {error}")
    outcome.took_s = round(time.perf_counter() - began, 1)
    return outcome


def _progress(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def _print_summary(console: Console, name: str, outcome: Outcome) -> None:
    losses = f"lost {outcome.lost}, duplicated {outcome.duplicated}, misordered {outcome.misordered}"
    console.print(
        f"{name}: {outcome.rounds:,} rounds, {losses}, corrupted {outcome.corrupted} ({outcome.took_s:.0f} s)"
    )


def _table(outcomes: dict[str, Outcome], seed: int) -> Table:
    table = Table(title=f"Injected faults (seed {seed})", title_justify="left")
    for name in ("fault", *Outcome.COUNTS, "note"):
        is_text = name in ("fault", "note")
        table.add_column(
            name, justify="left" if is_text else "right", no_wrap=name != "note", ratio=1 if is_text else None
        )
    for name, outcome in outcomes.items():
        style = "" if outcome.clean else "bold red"
        table.add_row(name, *(f"{each:,}" for each in outcome.counts), outcome.error or outcome.note, style=style)
    return table


if __name__ == "__main__":
    sys.exit(main())
