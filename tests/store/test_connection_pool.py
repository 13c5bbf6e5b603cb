"""Connections are closed with their engine, also those that a task returns afterwards."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.store.sqlite.engine import Connection, make_engine


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
    assert [each._thread.is_alive() for each in used] == [False, False]
