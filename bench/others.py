"""The same events by what people would pick instead, and by the raw limits.

    python -m bench.others             100,000 events into SQLite and PostgreSQL, 20,000 into queues; three turns each
    python -m bench.others --quick     1,000

*Into the database*: events that lie ready (ours in the spool of a recorder that is gone, read from there; theirs as
objects in memory) until all are committed, by one process. The libraries get them in batches, as they are quickest:
`eventsource-py` 1,000 a call, `eventsourcing` 5,000 (PostgreSQL: 1,000). The raw ways write our very rows, 10,000 a
transaction: `executemany`, `json_each` and COPY.

*Into a durable queue*: one event after the other, until putting it has returned and it survives the death of the
process; beside it the raw cost of encoding, checksum and memory copy, without which there is no queue.

A library that is not installed is said to be missing (`pip install '.[bench]'`). Who is measured takes turns. Prints
one JSON line: events a second (median, least, most), and how often that is of ours.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib
import itertools
import json
import mmap
import os
import shutil
import signal
import sqlite3
import tempfile
import time
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import asyncpg
import msgspec
from rich.table import Table
from sqlalchemy.engine import make_url
from sqlalchemy.ext.asyncio import create_async_engine

from bench.material.rollouts import tree
from bench.material.spooled import Recording, spool_tree
from bench.reporting.figures import MISSING, console, spread
from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import decode, encode
from pycrorm_async.events.envelope import Heading, Record
from pycrorm_async.events.types import Happening
from pycrorm_async.operations.destination import open_destination
from pycrorm_async.queue import Spool, open_dead
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import Drain
from tests.databases import Server, server_in

_RAW_BATCH = 10_000
_PATIENCE_S = 600
_INSERT = "INSERT INTO event (episode, sequence, type, version, wall_ns, monotonic_ns, payload) VALUES (?,?,?,?,?,?,?)"
_INSERT_AS_JSON = """
INSERT INTO event (episode, sequence, type, version, wall_ns, monotonic_ns, payload)
SELECT value->>0, value->>1, value->>2, value->>3, value->>4, value->>5, value->>6 FROM json_each(?)"""
_COLUMNS = ("episode", "sequence", "type", "version", "wall_ns", "monotonic_ns", "payload")


class Material(NamedTuple):
    """The events, and the spool that holds them; `folder` is for whatever a contender makes."""

    records: list[Record]
    spool: Path
    folder: Path

    @property
    def rows(self) -> list[tuple[Any, ...]]:
        return [(1, *each[2:7], each.payload.decode()) for each in self.records]


Contender = Callable[[Material, str], float]
"""Stores all of it at this URL, and says how many seconds that took."""


def _batches(values: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    return (values[first : first + size] for first in range(0, len(values), size))


# --- into the database ----------------------------------------------------------------------------------------------


def ours(material: Material, url: str) -> float:
    spool = Path(tempfile.mkdtemp(dir=material.folder)) / "spool"
    shutil.copytree(material.spool, spool)
    return asyncio.run(_drained(spool, url))


async def _drained(spool: Path, url: str) -> float:
    place, settings = Spool(spool), Settings()
    async with open_destination(DatabaseAddress.parse(url), place, clock=SYSTEM_CLOCK) as destination:
        [folder] = place.recorders()
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

    async def appended() -> float:
        if url.startswith("postgresql:"):
            engine = create_async_engine(url.replace("postgresql:", "postgresql+asyncpg:"))
            store = eventsource.PostgreSQLEventStore(engine, create_schema=True, owns_engine=True)
        else:
            store = eventsource.SQLiteEventStore(url.removeprefix("sqlite:///"))
        stream, anything = eventsource.StreamId(aggregate, "Episode"), eventsource.ExpectedVersion.any_()
        await store.append(eventsource.StreamId(uuid.uuid4(), "Warm"), [_warming(Happened)], anything)
        began = time.perf_counter()
        for batch in _batches(events, 1_000):
            await store.append(stream, batch, anything)
        took = time.perf_counter() - began
        await store.close()
        return took

    return asyncio.run(appended())


def _warming(kind: Any) -> Any:
    """Something to store first, so that connecting and making tables is not measured."""
    return kind(aggregate_id=uuid.uuid4(), body="{}")


def eventsourcing(material: Material, url: str) -> float:
    persistence = importlib.import_module("eventsourcing.persistence")
    if url.startswith("postgresql:"):
        importlib.import_module("eventsourcing.postgres")
        place = make_url(url)
        environment = {
            "PERSISTENCE_MODULE": "eventsourcing.postgres",
            "POSTGRES_DBNAME": str(place.database),
            "POSTGRES_HOST": str(place.query["host"]),
            "POSTGRES_PORT": "5432",
            "POSTGRES_USER": "postgres",
            "POSTGRES_PASSWORD": "none",
        }
    else:
        path = url.removeprefix("sqlite:///")
        environment = {"PERSISTENCE_MODULE": "eventsourcing.sqlite", "SQLITE_DBNAME": path}
    factory = persistence.InfrastructureFactory.construct(persistence.Environment("bench", environment))
    recorder = factory.application_recorder()
    name, warm = uuid.uuid4(), persistence.StoredEvent(uuid.uuid4(), 1, "warm", b"{}")
    events = [
        persistence.StoredEvent(name, number, each.type, each.payload)
        for number, each in enumerate(material.records, 1)
    ]
    recorder.insert_events([warm])
    began = time.perf_counter()
    # With 5,000 a call psycopg and the server wait for each other for ever.
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
    _make_log(url)
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
    async def copied() -> float:
        connection = await asyncpg.connect(url)
        began = time.perf_counter()
        for batch in _batches(rows, _RAW_BATCH):
            await connection.copy_records_to_table("event", schema_name="pycrorm", columns=_COLUMNS, records=batch)
        took = time.perf_counter() - began
        await connection.close()
        return took

    rows = material.rows
    _make_log(url)
    return asyncio.run(copied())


def raw_executemany_postgresql(material: Material, url: str) -> float:
    async def inserted() -> float:
        connection = await asyncpg.connect(url)
        statement = f"INSERT INTO pycrorm.event ({', '.join(_COLUMNS)}) VALUES ($1, $2, $3, $4, $5, $6, $7)"
        began = time.perf_counter()
        for batch in _batches(rows, _RAW_BATCH):
            await connection.executemany(statement, batch)
        took = time.perf_counter() - began
        await connection.close()
        return took

    rows = material.rows
    _make_log(url)
    return asyncio.run(inserted())


def _make_log(url: str) -> None:
    """Our own table, with its key and its triggers."""

    async def made() -> None:
        await (await EventLog.open(DatabaseAddress.parse(url), create=True)).close()

    asyncio.run(made())


# --- into a durable queue -------------------------------------------------------------------------------------------


def our_queue(material: Material, _url: str) -> float:
    recording = Recording(Path(tempfile.mkdtemp(dir=material.folder)) / "spool", live=True)
    began = time.perf_counter()
    put = recording.queue.put_nowait
    for each in material.records:
        put(Heading(each.episode, each.type, each.version), each.payload)
    took = time.perf_counter() - began
    recording.leave()
    return took


def encode_checksum_and_copy(material: Material, _url: str) -> float:
    """From the value to its bytes in a mapped file, with a checksum: what no queue on disk is without."""
    events: list[Happening] = [decode(each.type, each.payload, each.version) for each in material.records]
    size = sum(len(each.payload) + 8 for each in material.records)
    with (material.folder / "raw").open("w+b") as file:
        os.posix_fallocate(file.fileno(), 0, size)
        with mmap.mmap(file.fileno(), size) as there:
            began = time.perf_counter()
            at = 0
            for event in events:
                payload = encode(event)
                end = at + 8 + len(payload)
                there[at:end] = zlib.crc32(payload).to_bytes(8, "little") + payload
                at = end
            return time.perf_counter() - began


def persist_queue_sqlite(material: Material, _url: str) -> float:
    persistqueue = importlib.import_module("persistqueue")
    queue = persistqueue.SQLiteQueue(tempfile.mkdtemp(dir=material.folder), auto_commit=True)
    return _put_all(queue.put, material.records)


def persist_queue_file(material: Material, _url: str) -> float:
    persistqueue = importlib.import_module("persistqueue")
    queue = persistqueue.Queue(tempfile.mkdtemp(dir=material.folder))
    return _put_all(queue.put, material.records)


def sqlite_autocommit(material: Material, _url: str) -> float:
    """WAL with synchronous NORMAL: a commit survives the process, and the machine only after a checkpoint."""
    connection = sqlite3.connect(f"{tempfile.mkdtemp(dir=material.folder)}/queue.db", isolation_level=None)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")
    connection.execute("CREATE TABLE queue (id INTEGER PRIMARY KEY, type TEXT, payload BLOB)")

    def put(record: tuple[str, bytes]) -> None:
        connection.execute("INSERT INTO queue (type, payload) VALUES (?, ?)", record)

    return _put_all(put, material.records)


def _put_all(put: Callable[[tuple[str, bytes]], Any], records: Iterable[Record]) -> float:
    values = [(each.type, each.payload) for each in records]
    began = time.perf_counter()
    for value in values:
        put(value)
    return time.perf_counter() - began


# --- all of them ----------------------------------------------------------------------------------------------------

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
    "queue": {
        "ours": our_queue,
        "encode + checksum + copy": encode_checksum_and_copy,
        "persist-queue, SQLite": persist_queue_sqlite,
        "persist-queue, file": persist_queue_file,
        "sqlite3 autocommit": sqlite_autocommit,
    },
}


def measured(contenders: dict[str, Contender], material: Material, turns: int, new_url: Callable[[], str]) -> Any:
    """Each as often as there are turns, in turns; events a second and its share of ours."""
    rates: dict[str, list[float]] = {}
    missing: dict[str, str] = {}
    for turn, (name, contender) in itertools.product(range(turns), contenders.items()):
        if name in missing:
            continue
        console().print(f"  {name}, turn {turn + 1}")
        try:
            signal.alarm(_PATIENCE_S)
            rates.setdefault(name, []).append(len(material.records) / contender(material, new_url()))
        except ModuleNotFoundError:
            missing[name] = MISSING
        except TimeoutError:
            missing[name] = f"not done after {_PATIENCE_S} s"
        finally:
            signal.alarm(0)
    own = rates["ours"]  # ours is never missing
    return {
        name: missing.get(name)
        or {
            "events_per_s": spread(rates[name]),
            "ours_is": spread([one / other for one, other in zip(own, rates[name], strict=True)]),
        }
        for name in contenders
    }


def material_of(events: int, folder: Path) -> Material:
    """About so many events of one episode, from `EpisodeStarted` to `EpisodeEnded`."""
    spool = folder / "spooled"
    spool_tree(tree(events // 2, seed=69), spool)
    again = folder / "read"
    shutil.copytree(spool, again)
    return Material([each for each in asyncio.run(_read(again)) if each.episode is not None], spool, folder)


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
    asked = parser.parse_args()
    events, queued, turns = (1_000, 1_000, 1) if asked.quick else (asked.events, asked.queued, asked.turns)
    packages = ("eventsource-py", "eventsourcing", "persist-queue", "asyncpg", "psycopg")
    collect_seldom()  # as `pycrorm writer` does; for all of them
    signal.signal(signal.SIGALRM, _give_up)
    answer: dict[str, Any] = {
        "bench": "others",
        "turns": turns,
        "versions": {each: _version(each) for each in packages},
    }
    for place, contenders in CONTENDERS.items():
        console().print(place)
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
            server = stack.enter_context(server_in(folder / "pg")) if place == "postgresql" else None
            material = material_of(queued if place == "queue" else events, folder)
            numbers = itertools.count()
            found = measured(contenders, material, turns, partial(_new_url, folder, server, numbers))
            answer[place] = {"events": len(material.records), **found}
    print(json.dumps(answer))
    console().print(_table(answer))


def _give_up(*_: object) -> None:
    raise TimeoutError


def _new_url(folder: Path, server: Server | None, numbers: Iterator[int]) -> str:
    return server.new_database() if server else f"sqlite:///{folder}/{next(numbers)}.db"


def _table(answer: dict[str, Any]) -> Table:
    table = Table(title="The same events, by others", title_justify="left")
    for name in ("into", "by", "events/s", "least", "most", "ours is"):
        table.add_column(name, justify="left" if name in ("into", "by") else "right")
    for place, contenders in CONTENDERS.items():
        for name in contenders:
            found = answer[place][name]
            if isinstance(found, str):
                table.add_row(place, name, found)
                continue
            rate = found["events_per_s"]
            figures = (rate["median"], rate["least"], rate["most"], found["ours_is"]["median"])
            table.add_row(place, name, *(f"{each:,}" for each in figures))
    return table


if __name__ == "__main__":
    main()
