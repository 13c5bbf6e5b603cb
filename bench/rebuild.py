"""Measure rebuilds: the rate, the cost of an event in a large log, and the delay of concurrent recorders and readers.

    python -m bench.rebuild                        100,000 and 1,000,000 events, SQLite
    python -m bench.rebuild --postgresql           the same on a new server
    python -m bench.rebuild --events 100000 10000000
    python -m bench.rebuild --in FOLDER            keep the logs in FOLDER, and reuse those of an earlier run (SQLite)
    python -m bench.rebuild --workers 1 2          with one process and with two
    python -m bench.rebuild --quick                2,000 and 10,000 events

Every rebuild runs in a new process. Each size is rebuilt twice, and the cheaper rebuild counts. Then the largest log is
rebuilt while two processes record and two processes query without a pause; a reader fails if it ever sees fewer rows
than before. The script prints a table on stderr, and one JSON line: for each size events a second, µs of wall and CPU
time for an event (without the CPU time of a PostgreSQL server), and MB of the largest process; cost of an event and MB
in the largest log relative to the smallest; and the number and the longest duration of the other processes' operations,
before and during the rebuild.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.material.concurrent_processes import ConcurrentProcesses
from bench.material.runs import options
from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import server_in
from tests.projections.rebuild_cases import TYPES, picking

_NODES = 124
"""Nodes in an episode, which then has 253 events; a typical successful plan has some hundred events."""
_APPEND_EPISODES = 40
_CALM_S = 5.0

Figures = dict[str, float]


async def fill(url: str, events: int) -> None:
    """Append complete episodes until the log contains `events` events; only the first one is folded into the tables."""
    episode_records = picking(1, nodes=_NODES).records
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    episodes_stored = await log.episodes()
    count, number = sum(each.head for each in episodes_stored), len(episodes_stored)
    while count < events:
        records: list[Record] = list(TYPES) if number == 0 else []
        for _ in range(_APPEND_EPISODES if number else 1):
            if count >= events:
                break
            number += 1
            episode = EpisodeId(bytes([*bytes(6), 0x70, 0, 0x80, 0, 0, 0, *number.to_bytes(4, "big")]))
            records += [each._replace(episode=episode) for each in episode_records]
            count += len(episode_records)
        assert await log.append(records) == {}
        if number == 1:
            projector = Projector(log)
            await projector.open()
            await projector.catch_up()
    await log.close()


def rebuild(url: str, workers: int) -> Figures:
    """Run a rebuild in a new process, and return its figures."""
    command = [sys.executable, "-m", "bench.rebuild", "--of", url, "--workers", str(workers)]
    result: Figures = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    return result


def rebuild_and_print(url: str, workers: int) -> None:
    collect_seldom()  # as in `pycrorm rebuild`
    began = _cpu_s()
    report = asyncio.run(rebuild_memory(url, workers=workers))
    mb = (
        max(resource.getrusage(usage_of).ru_maxrss for usage_of in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        / 1024
    )
    print(json.dumps({"events": report.events, "seconds": report.seconds, "cpu_s": _cpu_s() - began, "mb": mb}))


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def figures(usage: Figures) -> Figures:
    return {
        "events": usage["events"],
        "events_per_s": round(usage["events"] / usage["seconds"]),
        "us_per_event": round(usage["seconds"] / usage["events"] * 1e6, 2),
        "cpu_us_per_event": round(usage["cpu_s"] / usage["events"] * 1e6, 2),
        "mb": round(usage["mb"], 1),
    }


def growth(smallest: Figures, largest: Figures) -> Figures:
    """Return the cost of an event in the largest log relative to the smallest, and the additional MB."""
    costs = {name: round(largest[name] / smallest[name], 2) for name in ("us_per_event", "cpu_us_per_event")}
    return costs | {"mb": round(largest["mb"] - smallest["mb"], 1)}


def rebuild_with_others(url: str, spool: Path, *, calm_s: float) -> dict[str, object]:
    """Rebuild with one process, as the command does on a busy machine, while other processes record and query."""
    with ExitStack() as stack:
        others = ConcurrentProcesses(stack, url, spool, recorders=2, readers=2)
        time.sleep(calm_s)
        others.rebuild_begins()
        usage = rebuild(url, 1)
        waits = others.stop()
    return {"rebuild": figures(usage), **waits}


def table(database: str, by_workers: dict[str, list[Figures]]) -> Table:
    rich_table = Table(title=f"rebuild, {database}")
    for name in ("events", "workers", "events/s", "µs/event", "CPU µs/event", "MB"):
        rich_table.add_column(name, justify="right")
    for workers, by_size in by_workers.items():
        for each in by_size:
            rich_table.add_row(f"{each['events']:,}", workers, *(f"{each[name]:,}" for name in list(each)[1:]))
    return rich_table


def main() -> None:
    parser = options(__doc__, quick="2,000 and 10,000 events")
    parser.add_argument("--postgresql", action="store_true", help="use a new PostgreSQL server")
    parser.add_argument("--events", type=int, nargs="+", metavar="N", help="sizes of the logs")
    parser.add_argument("--workers", type=int, nargs="+", default=[1], metavar="N", help="numbers of folding processes")
    parser.add_argument("--in", dest="folder", type=Path, metavar="FOLDER", help="folder in which SQLite logs are kept")
    parser.add_argument("--no-company", action="store_true", help="without concurrent processes")
    parser.add_argument("--of", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.of:
        rebuild_and_print(arguments.of, *arguments.workers)
        return
    sizes = sorted(arguments.events or ([2_000, 10_000] if arguments.quick else [100_000, 1_000_000]))
    database = "postgresql" if arguments.postgresql else "sqlite"
    result: dict[str, object] = {"bench": "rebuild", "database": database}
    with ExitStack() as stack:
        folder = arguments.folder or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
        folder.mkdir(parents=True, exist_ok=True)
        server = stack.enter_context(server_in(folder / "pg")) if arguments.postgresql else None
        urls = [server.new_database() if server else f"sqlite:///{folder}/{each}.db" for each in sizes]
        by_workers: dict[str, list[Figures]] = {str(workers): [] for workers in arguments.workers}
        for size, url in zip(sizes, urls, strict=True):
            asyncio.run(fill(url, size))
            for workers, by_size in by_workers.items():
                rebuilds = [figures(rebuild(url, int(workers))) for _ in range(1 if arguments.quick else 2)]
                by_size.append(min(rebuilds, key=lambda each: each["cpu_us_per_event"]))
        result["by_workers"] = by_workers
        result["growth"] = {workers: growth(by_size[0], by_size[-1]) for workers, by_size in by_workers.items()}
        if not arguments.no_company:
            spool = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="s")))
            result["beside_others"] = rebuild_with_others(urls[-1], spool, calm_s=0.5 if arguments.quick else _CALM_S)
    Console(stderr=True).print(table(database, by_workers))
    print(json.dumps(result))


if __name__ == "__main__":
    main()
