"""Connections are closed once and with their engine, and may be slow or break."""

from __future__ import annotations

import asyncio
import sqlite3
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.sqlite_engine import USE_WAL, StoppableConnection, _connect, make_engine
from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from tests.databases import Server, ask
from tests.projections.rebuild_cases import TYPES, picking
from tests.store.factories import cancel_at_await

# === connection pool ==========================================================================================
#
# Connections are closed with their engine, also those that a task returns afterwards.


async def driver_of(connection: AsyncConnection) -> StoppableConnection:
    driver = (await connection.get_raw_connection()).driver_connection
    assert isinstance(driver, StoppableConnection)
    return driver


async def test_a_connection_that_is_returned_after_its_engine_was_disposed_of_is_closed(tmp_path: Path) -> None:
    (tmp_path / "memory.db").touch()
    engine = make_engine(tmp_path / "memory.db", read_only=False, busy_timeout_s=1)
    async with engine.connect() as first:
        kept = await driver_of(first)
    async with engine.connect() as second, engine.connect() as third:
        used = [await driver_of(second), await driver_of(third)]
        assert used[0] is kept
        await engine.dispose()
        assert all(each._connection is not None for each in used)
    assert [each._connection for each in used] == [None, None]
    for each in used:
        each._thread.join(30)  # it reports its end just before it ends
    assert [each._thread.is_alive() for each in used] == [False, False]


def test_a_task_cancelled_at_any_await_leaves_no_connection_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python would close it some time later, and warn in whatever runs then."""
    connections: list[sqlite3.Connection] = []

    def connect(*arguments: Any, **options: Any) -> sqlite3.Connection:
        time.sleep(0.002)  # so that a task can be cancelled while the thread opens the file
        connections.append(sqlite3_connect(*arguments, **options))
        return connections[-1]

    sqlite3_connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", connect)

    async def read_and_cancel(at: int) -> bool:
        engine = make_engine(tmp_path / "memory.db", read_only=False, busy_timeout_s=1)

        async def read() -> None:
            async with engine.connect() as connection:
                await connection.execute(text("SELECT 1"))

        reading = asyncio.create_task(read())
        await cancel_at_await(reading, at)
        await engine.dispose()
        return reading.cancelled()

    (tmp_path / "memory.db").touch()
    cancelled = 0
    while asyncio.run(read_and_cancel(cancelled + 1)):
        cancelled += 1
        assert [at for at, each in enumerate(connections) if is_open(each)] == [], f"cancelled at await {cancelled}"
    assert cancelled > 3
    assert len(connections) > 3


@pytest.mark.parametrize("is_started", [True, False], ids=["its start is known", "its start is not known yet"])
def test_ctrl_c_while_the_thread_of_a_connection_starts_is_raised_and_the_thread_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_started: bool
) -> None:
    (tmp_path / "memory.db").touch()
    start = threading.Thread.start
    threads: list[threading.Thread] = []
    raised: list[BaseException] = []

    def start_interrupted(thread: threading.Thread) -> None:
        def start_later() -> None:
            time.sleep(0.02)
            start(thread)

        threads.append(thread)
        start(thread if is_started else threading.Thread(target=start_later))
        raise KeyboardInterrupt

    async def connect() -> None:
        engine = make_engine(tmp_path / "memory.db", read_only=False, busy_timeout_s=1)
        monkeypatch.setattr(threading.Thread, "start", start_interrupted)
        async with engine.connect():
            pass

    def run() -> None:
        try:
            asyncio.run(connect())
        except BaseException as error:  # noqa: BLE001  KeyboardInterrupt, which a thread cannot pass on
            raised.append(error)
        finally:
            monkeypatch.undo()

    running = threading.Thread(target=run, daemon=True)
    running.start()
    running.join(20)
    assert not running.is_alive(), "opening the connection hangs"
    assert [type(each) for each in raised] == [KeyboardInterrupt]
    assert [each.is_alive() for each in threads] == [False]


def is_open(connection: sqlite3.Connection) -> bool:
    try:
        _ = connection.total_changes
    except sqlite3.ProgrammingError:
        return False
    return True


# === closing ==================================================================================================
#
# A connection to SQLite is closed once, whichever thread asks and when, and leaves no transaction open.


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file in WAL mode, like every memory: in others a connection that polls can make a COMMIT fail."""
    made = tmp_path / "memory.db"
    with closing(sqlite3.connect(made)) as connection:
        connection.execute(USE_WAL)
    return made


async def test_a_close_ends_although_its_thread_was_stopped_meanwhile(file: Path) -> None:
    """SQLAlchemy does this when a close is cancelled: the close continues, and its thread is stopped as well."""
    connection = await _connect(f"{file.as_uri()}?mode=rw", 1.0)
    close = asyncio.create_task(connection.close())
    await asyncio.sleep(0)
    connection.stop()
    time.sleep(0.2)  # noqa: ASYNC251  the thread ends its work before this loop is notified
    await asyncio.wait_for(close, 10)


async def test_a_rollback_follows_a_begin_whose_task_was_cancelled_while_it_waited(file: Path) -> None:
    connection = await _connect(f"{file.as_uri()}?mode=rw", 10.0)
    with closing(sqlite3.connect(file, isolation_level=None, timeout=0)) as other:
        other.execute("BEGIN IMMEDIATE")
        beginning = asyncio.create_task(connection.cursor().execute("BEGIN IMMEDIATE"))
        await asyncio.sleep(0.05)
        beginning.cancel()
        await asyncio.wait([beginning])
        other.execute("COMMIT")
        await connection.rollback()  # the thread gets the lock first
        await asyncio.sleep(0.05)
        other.execute("BEGIN IMMEDIATE")
    await connection.close()


async def test_a_reading_transaction_begins_with_its_first_statement_and_sees_one_moment(file: Path) -> None:
    connection = await _connect(f"{file.as_uri()}?mode=rw", 1.0)
    with closing(sqlite3.connect(file, isolation_level=None, timeout=0)) as other:
        for statement in ("CREATE TABLE node (id)", "INSERT INTO node VALUES (1)"):
            other.execute(statement)
        for end in (connection.commit, connection.rollback):
            connection.begin_to_read()
            counts = []
            for _ in range(2):
                cursor = await connection.cursor().execute("SELECT count(*) FROM node")
                counts.append(await cursor.fetchone())
                other.execute("INSERT INTO node VALUES (2)")
            assert counts[0] == counts[1]
            await end()
            connection.begin_to_read()  # and no statement
            await end()
        cursor = await connection.cursor().execute("SELECT count(*) FROM node")
        assert await cursor.fetchone() == (5,)
        other.execute("DROP TABLE node")  # the last statement was in no transaction
    await connection.close()


# === slow network =============================================================================================
#
# A memory on a server behind a connection that is slow, or breaks.

MADE = """
    SELECT count(*) FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
    WHERE nspname IN ('pycrorm', 'memory_tables', 'memory') AND relkind IN ('r', 'i', 'v')
"""


async def opened(proxy: Proxy, url: str) -> EventLog:
    return await EventLog.open(DatabaseAddress.parse(proxy.url(urlsplit(url).path[1:])), create=True)


@pytest.mark.slow
async def test_making_a_memory_takes_far_fewer_messages_than_it_has_tables(server: Server) -> None:
    url = server.new_database()
    async with proxy_before(server.folder) as proxy:
        log = await opened(proxy, url)
        await Projector(log).open()
        await log.close()
    [[statements]] = ask(url, MADE)
    assert statements > 200
    assert proxy.requests < statements / 2  # each message takes the delay of the line in both directions


@pytest.mark.slow
async def test_a_connection_that_breaks_while_cases_are_written_is_reported_as_such(server: Server) -> None:
    async with proxy_before(server.folder) as proxy:
        log = await opened(proxy, server.new_memory())
        projector = Projector(log, installed=own_projections())
        await projector.open()
        await log.append([*TYPES, *picking(1).records])
        await projector.catch_up()
        await log.append(picking(2).records)
        proxy.cut_before(b"SAVEPOINT")
        with pytest.raises(DatabaseUnavailable):
            await projector.catch_up()
        assert proxy.faults == 1
        assert await projector.catch_up() > 0
        await log.close()
