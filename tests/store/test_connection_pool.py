"""Connections are closed with their engine, also those that a task returns afterwards."""

from __future__ import annotations

import asyncio
import sqlite3
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.store.sqlite_engine import Connection, make_engine
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
