"""A connection to SQLite is closed once, whichever thread asks and when, and leaves no transaction open."""

import asyncio
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import pytest

from pycrorm_async.store.sqlite_engine import USE_WAL, _connect


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
