"""How fast tables are made anew from the log, whether an event costs more in a large log, and who feels it meanwhile.

    python -m bench.rebuild                        100,000 and 1,000,000 events, SQLite
    python -m bench.rebuild --postgresql           the same on a server of its own
    python -m bench.rebuild --events 100000 10000000
    python -m bench.rebuild --in FOLDER            keeps the logs there, and goes on with those it finds (SQLite)
    python -m bench.rebuild --workers 1 2          by one process and by two
    python -m bench.rebuild --quick                2,000 and 10,000

Every rebuild is a process of its own, and each size is rebuilt twice, of which the cheaper one counts. Then the largest
log is rebuilt beside two processes that record and two that ask all the time, each of which ends with an error if it
ever sees less than before. Prints a table for people on stderr, and one JSON line: by size events a second, µs an event
by the clock and by the processor (on PostgreSQL without the server's), and MB of the largest process; how much more an
event costs in the largest log than in the smallest, and how many MB more are taken; and how often the others did what
they do and how long they waited at most, calm and beside the rebuild.
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

from bench.rebuild_beside import Company
from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import server_in
from tests.projections.rebuild_cases import TYPES, picking

_NODES = 124
"""So that an episode has 253 events; those of a plan that ends well have some hundred."""
_APPEND_EPISODES = 40
_CALM_S = 5.0

Figures = dict[str, float]


async def fill(url: str, events: int) -> None:
    """Appends whole episodes until the log holds so many events; what shows in the tables are those of the first."""
    one = picking(1, nodes=_NODES).records
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    there = await log.episodes()
    count, number = sum(each.head for each in there), len(there)
    while count < events:
        records: list[Record] = list(TYPES) if number == 0 else []
        for _ in range(_APPEND_EPISODES if number else 1):
            if count >= events:
                break
            number += 1
            episode = EpisodeId(bytes([*bytes(6), 0x70, 0, 0x80, 0, 0, 0, *number.to_bytes(4, "big")]))
            records += [each._replace(episode=episode) for each in one]
            count += len(one)
        assert await log.append(records) == {}
        if number == 1:
            projector = Projector(log)
            await projector.open()
            await projector.catch_up()
    await log.close()


def rebuilt(url: str, workers: int) -> Figures:
    """What a process of its own says of its rebuild."""
    command = [sys.executable, "-m", "bench.rebuild", "--of", url, "--workers", str(workers)]
    said: Figures = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    return said


def rebuild_and_say(url: str, workers: int) -> None:
    collect_seldom()  # as the command does
    began = _cpu_s()
    done = asyncio.run(rebuild_memory(url, workers=workers))
    mb = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024
    print(json.dumps({"events": done.events, "seconds": done.seconds, "cpu_s": _cpu_s() - began, "mb": mb}))


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def figures(found: Figures) -> Figures:
    return {
        "events": found["events"],
        "events_per_s": round(found["events"] / found["seconds"]),
        "us_per_event": round(found["seconds"] / found["events"] * 1e6, 2),
        "cpu_us_per_event": round(found["cpu_s"] / found["events"] * 1e6, 2),
        "mb": round(found["mb"], 1),
    }


def growth(smallest: Figures, largest: Figures) -> Figures:
    """How much more the largest takes, by event; and in MB."""
    costs = {name: round(largest[name] / smallest[name], 2) for name in ("us_per_event", "cpu_us_per_event")}
    return costs | {"mb": round(largest["mb"] - smallest["mb"], 1)}


def beside_others(url: str, spool: Path, *, calm_s: float) -> dict[str, object]:
    """What those found who went on while it was rebuilt by one process, as the command does it beside busy ones."""
    with ExitStack() as stack:
        company = Company(stack, url, spool, recorders=2, readers=2)
        time.sleep(calm_s)
        company.rebuilding()
        found = rebuilt(url, 1)
        said = company.end()
    return {"rebuild": figures(found), **said}


def table(database: str, by_workers: dict[str, list[Figures]]) -> Table:
    shown = Table(title=f"rebuild, {database}")
    for name in ("events", "workers", "events/s", "µs/event", "CPU µs/event", "MB"):
        shown.add_column(name, justify="right")
    for workers, by_size in by_workers.items():
        for each in by_size:
            shown.add_row(f"{each['events']:,}", workers, *(f"{each[name]:,}" for name in list(each)[1:]))
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--postgresql", action="store_true", help="on a server of its own")
    parser.add_argument("--quick", action="store_true", help="2,000 and 10,000 events")
    parser.add_argument("--events", type=int, nargs="+", metavar="N", help="sizes of the logs")
    parser.add_argument("--workers", type=int, nargs="+", default=[1], metavar="N", help="how many fold at once")
    parser.add_argument("--in", dest="folder", type=Path, metavar="FOLDER", help="where logs of SQLite are kept")
    parser.add_argument("--no-company", action="store_true", help="without others beside it")
    parser.add_argument("--of", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.of:
        rebuild_and_say(asked.of, *asked.workers)
        return
    sizes = sorted(asked.events or ([2_000, 10_000] if asked.quick else [100_000, 1_000_000]))
    database = "postgresql" if asked.postgresql else "sqlite"
    answer: dict[str, object] = {"bench": "rebuild", "database": database}
    with ExitStack() as stack:
        folder = asked.folder or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
        folder.mkdir(parents=True, exist_ok=True)
        server = stack.enter_context(server_in(folder / "pg")) if asked.postgresql else None
        urls = [server.new_database() if server else f"sqlite:///{folder}/{each}.db" for each in sizes]
        by_workers: dict[str, list[Figures]] = {str(workers): [] for workers in asked.workers}
        for size, url in zip(sizes, urls, strict=True):
            asyncio.run(fill(url, size))
            for workers, found in by_workers.items():
                both = [figures(rebuilt(url, int(workers))) for _ in range(1 if asked.quick else 2)]
                found.append(min(both, key=lambda each: each["cpu_us_per_event"]))
        answer["by_workers"] = by_workers
        answer["growth"] = {workers: growth(found[0], found[-1]) for workers, found in by_workers.items()}
        if not asked.no_company:
            spool = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="s")))
            answer["beside_others"] = beside_others(urls[-1], spool, calm_s=0.5 if asked.quick else _CALM_S)
    Console(stderr=True).print(table(database, by_workers))
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
