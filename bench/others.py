"""Store the same events with this package, with other libraries, and with plain SQL.

    python -m bench.others             100,000 events into SQLite and PostgreSQL; three turns each
    python -m bench.others --quick     1,000 events, one turn

One process commits all events. This package reads them from the spool of a dead recorder; for the libraries they are
objects in memory, passed in the batches that were fastest: 1,000 a call for `eventsource-py`, 5,000 for `eventsourcing`
(1,000 on PostgreSQL). Plain SQL writes the rows of our log, 10,000 a transaction, by `executemany`, `json_each` and
COPY. `bench.rivals` compares putting events one by one.

All contenders take turns. A library that is not installed is reported as missing (`pip install '.[bench]'`). The script
prints one JSON line: events a second (median, minimum, maximum), and our rate divided by theirs.
"""

from __future__ import annotations

import asyncio
import importlib
import itertools
import json
import shutil
import signal
import sqlite3
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import asyncpg
import msgspec
from rich.table import Table
from sqlalchemy.engine import make_url
from sqlalchemy.ext.asyncio import create_async_engine

from bench.material.rollouts import spool_tree, tree
from bench.material.runs import options, place, read_all
from bench.reporting.figures import MISSING, console, spread, table_of
from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import Record
from pycrorm_async.operations.destination import open_destination
from pycrorm_async.queue import Spool, open_dead
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import Drain

# === contenders ===============================================================================================
#
# Store the same events with this package, with other libraries, and with plain SQL: one function for each way.

_RAW_BATCH = 10_000
_INSERT = "INSERT INTO event (episode, sequence, type, version, wall_ns, monotonic_ns, payload) VALUES (?,?,?,?,?,?,?)"
_INSERT_AS_JSON = """
INSERT INTO event (episode, sequence, type, version, wall_ns, monotonic_ns, payload)
SELECT value->>0, value->>1, value->>2, value->>3, value->>4, value->>5, value->>6 FROM json_each(?)"""
_COLUMNS = ("episode", "sequence", "type", "version", "wall_ns", "monotonic_ns", "payload")


class Material(NamedTuple):
    """The events, the spool that contains them, and a folder for the files of the contenders."""

    records: list[Record]
    spool: Path
    folder: Path

    @property
    def rows(self) -> list[tuple[Any, ...]]:
        return [(1, *each[2:7], each.payload.decode()) for each in self.records]


Contender = Callable[[Material, str], float]
"""Store all events at this URL, and return the seconds this took."""


def _batches(values: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    return (values[first : first + size] for first in range(0, len(values), size))


def ours(material: Material, url: str) -> float:
    spool = Path(tempfile.mkdtemp(dir=material.folder)) / "spool"
    shutil.copytree(material.spool, spool)
    return asyncio.run(_drain_spool(spool, url))


async def _drain_spool(spool: Path, url: str) -> float:
    spool_folder, settings = Spool(spool), Settings()
    async with open_destination(DatabaseAddress.parse(url), spool_folder, clock=SYSTEM_CLOCK) as destination:
        [folder] = spool_folder.recorders()
        began = time.perf_counter()
        queue = open_dead(folder.path)
        assert queue is not None
        await Drain(queue, destination.append, settings=settings).run()
        took = time.perf_counter() - began
        queue.release()
    return took


def eventsource_py(material: Material, url: str) -> float:
    eventsource = importlib.import_module("eventsource")

    class Happened(eventsource.DomainEvent):  # type: ignore[misc, name-defined]
        aggregate_type: str = "Episode"
        body: str

    aggregate = uuid.uuid4()
    events = [Happened(aggregate_id=aggregate, body=each.payload.decode()) for each in material.records]

    async def append_all() -> float:
        if url.startswith("postgresql:"):
            engine = create_async_engine(url.replace("postgresql:", "postgresql+asyncpg:"))
            store = eventsource.PostgreSQLEventStore(engine, create_schema=True, owns_engine=True)
        else:
            store = eventsource.SQLiteEventStore(url.removeprefix("sqlite:///"))
        stream, any_version = eventsource.StreamId(aggregate, "Episode"), eventsource.ExpectedVersion.any_()
        await store.append(eventsource.StreamId(uuid.uuid4(), "Warm"), [_warm_up_event(Happened)], any_version)
        began = time.perf_counter()
        for batch in _batches(events, 1_000):
            await store.append(stream, batch, any_version)
        took = time.perf_counter() - began
        await store.close()
        return took

    return asyncio.run(append_all())


def _warm_up_event(kind: Any) -> Any:
    """Return an event to store first, so that connecting and creating tables is not measured."""
    return kind(aggregate_id=uuid.uuid4(), body="{}")


def eventsourcing(material: Material, url: str) -> float:
    persistence = importlib.import_module("eventsourcing.persistence")
    if url.startswith("postgresql:"):
        importlib.import_module("eventsourcing.postgres")
        address = make_url(url)
        environment = {
            "PERSISTENCE_MODULE": "eventsourcing.postgres",
            "POSTGRES_DBNAME": str(address.database),
            "POSTGRES_HOST": str(address.query["host"]),
            "POSTGRES_PORT": "5432",
            "POSTGRES_USER": "postgres",
            "POSTGRES_PASSWORD": "none",
        }
    else:
        path = url.removeprefix("sqlite:///")
        environment = {"PERSISTENCE_MODULE": "eventsourcing.sqlite", "SQLITE_DBNAME": path}
    factory = persistence.InfrastructureFactory.construct(persistence.Environment("bench", environment))
    recorder = factory.application_recorder()
    name, warm_up = uuid.uuid4(), persistence.StoredEvent(uuid.uuid4(), 1, "warm", b"{}")
    events = [
        persistence.StoredEvent(name, number, each.type, each.payload)
        for number, each in enumerate(material.records, 1)
    ]
    recorder.insert_events([warm_up])
    began = time.perf_counter()
    # With 5,000 a call psycopg and the server deadlock.
    for batch in _batches(events, 1_000 if url.startswith("postgresql:") else 5_000):
        recorder.insert_events(batch)
    took = time.perf_counter() - began
    factory.close()
    return took


def raw_executemany(material: Material, url: str) -> float:
    def insert(connection: sqlite3.Connection, batch: Sequence[tuple[Any, ...]]) -> None:
        connection.executemany(_INSERT, batch)

    return _raw_sqlite(material, url, insert)


def raw_json_each(material: Material, url: str) -> float:
    def insert(connection: sqlite3.Connection, batch: Sequence[tuple[Any, ...]]) -> None:
        connection.execute(_INSERT_AS_JSON, (msgspec.json.encode(batch).decode(),))

    return _raw_sqlite(material, url, insert)


def _raw_sqlite(material: Material, url: str, insert: Callable[[sqlite3.Connection, Any], None]) -> float:
    rows = material.rows
    _create_log(url)
    connection = sqlite3.connect(url.removeprefix("sqlite:///"), isolation_level=None)
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA wal_autocheckpoint = 4000")
    began = time.perf_counter()
    for batch in _batches(rows, _RAW_BATCH):
        connection.execute("BEGIN IMMEDIATE")
        insert(connection, batch)
        connection.execute("COMMIT")
    took = time.perf_counter() - began
    connection.close()
    return took


def raw_copy(material: Material, url: str) -> float:
    async def copy_all() -> float:
        connection = await asyncpg.connect(url)
        began = time.perf_counter()
        for batch in _batches(rows, _RAW_BATCH):
            await connection.copy_records_to_table("event", schema_name="pycrorm", columns=_COLUMNS, records=batch)
        took = time.perf_counter() - began
        await connection.close()
        return took

    rows = material.rows
    _create_log(url)
    return asyncio.run(copy_all())


def raw_executemany_postgresql(material: Material, url: str) -> float:
    async def insert_all() -> float:
        connection = await asyncpg.connect(url)
        statement = f"INSERT INTO pycrorm.event ({', '.join(_COLUMNS)}) VALUES ($1, $2, $3, $4, $5, $6, $7)"
        began = time.perf_counter()
        for batch in _batches(rows, _RAW_BATCH):
            await connection.executemany(statement, batch)
        took = time.perf_counter() - began
        await connection.close()
        return took

    rows = material.rows
    _create_log(url)
    return asyncio.run(insert_all())


def _create_log(url: str) -> None:
    """Create the table of our log, with its key and its triggers."""

    async def create() -> None:
        await (await EventLog.open(DatabaseAddress.parse(url), create=True)).close()

    asyncio.run(create())


# --- all contenders -------------------------------------------------------------------------------------------------

CONTENDERS: dict[str, dict[str, Contender]] = {
    "sqlite": {
        "ours": ours,
        "executemany": raw_executemany,
        "json_each": raw_json_each,
        "eventsource-py": eventsource_py,
        "eventsourcing": eventsourcing,
    },
    "postgresql": {
        "ours": ours,
        "COPY": raw_copy,
        "executemany": raw_executemany_postgresql,
        "eventsource-py": eventsource_py,
        "eventsourcing": eventsourcing,
    },
}


# === others ===================================================================================================

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
    return Material([each for each in asyncio.run(read_all(copy)) if each.episode is not None], spool, folder)


def _version(package: str) -> str | None:
    with suppress(PackageNotFoundError):
        return version(package)
    return None


def main() -> None:
    parser = options(__doc__, quick="1,000 events, one turn")
    parser.add_argument("--events", type=int, default=100_000)
    parser.add_argument("--turns", type=int, default=3)
    arguments = parser.parse_args()
    events, turns = (1_000, 1) if arguments.quick else (arguments.events, arguments.turns)
    packages = ("eventsource-py", "eventsourcing", "asyncpg", "psycopg")
    collect_seldom()  # as in `pycrorm writer`; applies to all contenders
    signal.signal(signal.SIGALRM, _raise_timeout)
    result: dict[str, Any] = {
        "bench": "others",
        "turns": turns,
        "versions": {each: _version(each) for each in packages},
    }
    for target, contenders in CONTENDERS.items():
        console().print(target)
        with place(target) as here:
            material, numbers = material_of(events, here.folder), itertools.count()
            rates = measure(contenders, material, turns, lambda: here.new_url(f"{next(numbers)}"))  # noqa: B023
            result[target] = {"events": len(material.records), **rates}
    print(json.dumps(result))
    console().print(_table(result))


def _raise_timeout(*_: object) -> None:
    raise TimeoutError


def _table(result: dict[str, Any]) -> Table:
    table = table_of("Events stored by each contender", "into: | contender: | events/s | least | most | ours / theirs")
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
