"""Store the same events with this package, with other libraries, and with plain SQL.

    python -m bench.others             100,000 events into SQLite and PostgreSQL, 20,000 into queues; three turns each
    python -m bench.others --quick     1,000 events, one turn

*Into the database*: one process commits all events. This package reads them from the spool of a dead recorder; for the
libraries they are objects in memory, passed in the batches that were fastest: 1,000 a call for `eventsource-py`, 5,000
for `eventsourcing` (1,000 on PostgreSQL). Plain SQL writes the rows of our log, 10,000 a transaction, by `executemany`,
`json_each` and COPY.

*Into a durable queue*: events are put one by one, each until it survives the death of the process. The cost of
encoding, checksum and memory copy alone is a lower bound for every queue.

All contenders take turns. A library that is not installed is reported as missing (`pip install '.[bench]'`). The script
prints one JSON line: events a second (median, minimum, maximum), and our rate divided by theirs.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rich.table import Table

from bench.material.contenders import CONTENDERS, Contender, Material
from bench.material.rollouts import tree
from bench.material.spool_recording import spool_tree
from bench.reporting.figures import MISSING, console, spread
from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.events.codec import Record
from pycrorm_async.queue import Spool, open_dead
from tests.databases import Server, server_in

_SECONDS_MAX = 600


def measure(contenders: dict[str, Contender], material: Material, turns: int, new_url: Callable[[], str]) -> Any:
    """Run every contender once in each turn; return events a second, and our rate divided by that."""
    rates: dict[str, list[float]] = {}
    missing: dict[str, str] = {}
    for turn, (name, contender) in itertools.product(range(turns), contenders.items()):
        if name in missing:
            continue
        console().print(f"  {name}, turn {turn + 1}")
        try:
            signal.alarm(_SECONDS_MAX)
            rates.setdefault(name, []).append(len(material.records) / contender(material, new_url()))
        except ModuleNotFoundError:
            missing[name] = MISSING
        except TimeoutError:
            missing[name] = f"not finished after {_SECONDS_MAX} s"
        finally:
            signal.alarm(0)
    our_rates = rates["ours"]  # ours needs no other library
    return {
        name: missing.get(name)
        or {
            "events_per_s": spread(rates[name]),
            "ours_is": spread([one / other for one, other in zip(our_rates, rates[name], strict=True)]),
        }
        for name in contenders
    }


def material_of(events: int, folder: Path) -> Material:
    """Spool about `events` events of one episode, from `EpisodeStarted` to `EpisodeEnded`."""
    spool = folder / "spooled"
    spool_tree(tree(events // 2, seed=69), spool)
    copy = folder / "read"
    shutil.copytree(spool, copy)
    return Material([each for each in asyncio.run(_read(copy)) if each.episode is not None], spool, folder)


async def _read(spool: Path) -> list[Record]:
    [folder] = Spool(spool).recorders()
    queue = open_dead(folder.path)
    assert queue is not None
    records: list[Record] = []
    while batch := await queue.get_batch(events_max=10_000, bytes_max=2**22, age_s_max=0.0):
        records += batch
    queue.release()
    return records


def _version(package: str) -> str | None:
    with suppress(PackageNotFoundError):
        return version(package)
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="1,000 events, one turn")
    parser.add_argument("--events", type=int, default=100_000)
    parser.add_argument("--queued", type=int, default=20_000)
    parser.add_argument("--turns", type=int, default=3)
    arguments = parser.parse_args()
    events, queued, turns = (
        (1_000, 1_000, 1) if arguments.quick else (arguments.events, arguments.queued, arguments.turns)
    )
    packages = ("eventsource-py", "eventsourcing", "persist-queue", "asyncpg", "psycopg")
    collect_seldom()  # as in `pycrorm writer`; applies to all contenders
    signal.signal(signal.SIGALRM, _raise_timeout)
    result: dict[str, Any] = {
        "bench": "others",
        "turns": turns,
        "versions": {each: _version(each) for each in packages},
    }
    for target, contenders in CONTENDERS.items():
        console().print(target)
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
            server = stack.enter_context(server_in(folder / "pg")) if target == "postgresql" else None
            material = material_of(queued if target == "queue" else events, folder)
            numbers = itertools.count()
            rates = measure(contenders, material, turns, partial(_new_url, folder, server, numbers))
            result[target] = {"events": len(material.records), **rates}
    print(json.dumps(result))
    console().print(_table(result))


def _raise_timeout(*_: object) -> None:
    raise TimeoutError


def _new_url(folder: Path, server: Server | None, numbers: Iterator[int]) -> str:
    return server.new_database() if server else f"sqlite:///{folder}/{next(numbers)}.db"


def _table(result: dict[str, Any]) -> Table:
    table = Table(title="Events stored by each contender", title_justify="left")
    for name in ("into", "contender", "events/s", "least", "most", "ours / theirs"):
        table.add_column(name, justify="left" if name in ("into", "contender") else "right")
    for target, contenders in CONTENDERS.items():
        for name in contenders:
            figures = result[target][name]
            if isinstance(figures, str):
                table.add_row(target, name, figures)
                continue
            rate = figures["events_per_s"]
            cells = (rate["median"], rate["least"], rate["most"], figures["ours_is"]["median"])
            table.add_row(target, name, *(f"{each:,}" for each in cells))
    return table


if __name__ == "__main__":
    main()
