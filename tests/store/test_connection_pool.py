"""Connections are closed with their engine, also those that a task returns afterwards."""

from __future__ import annotations

import asyncio
import sqlite3
import time
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.store.sqlite.engine import Connection, make_engine
from tests.store.faults import cancel_at_await


async def driver_of(connection: AsyncConnection) -> Connection:
    driver = (await connection.get_raw_connection()).driver_connection
    assert isinstance(driver, Connection)
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


def is_open(connection: sqlite3.Connection) -> bool:
    try:
        _ = connection.total_changes
    except sqlite3.ProgrammingError:
        return False
    return True
