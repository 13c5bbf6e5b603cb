"""A database on a full disk is unavailable: events stay in the source, and are stored when there is space again."""

from __future__ import annotations

import asyncio
import sqlite3
from typing import Any

import pytest
from sqlalchemy import event
from sqlalchemy.ext.asyncio import AsyncEngine

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.settings import Settings
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.sqlite_engine import translate_error
from pycrorm_async.writer.drain import Backoff, Drain
from tests.databases import ask
from tests.store.factories import episode, record
from tests.writer.fakes import KeptSource


class SmallDisk:
    """A limit on SQLite's pages, which fails as a full disk does."""

    def __init__(self, engine: AsyncEngine) -> None:
        self._pages = 256
        event.listen(engine.sync_engine, "checkout", self._limit_pages)

    def free_space(self) -> None:
        self._pages = 2**20

    def _limit_pages(self, connection: Any, *_: object) -> None:
        cursor = connection.cursor()
        cursor.execute(f"PRAGMA max_page_count = {self._pages}")
        cursor.close()


@pytest.mark.parametrize("code", [sqlite3.SQLITE_IOERR_SHMSIZE, sqlite3.SQLITE_IOERR_WRITE])
def test_a_disk_without_room_for_the_files_of_sqlite_is_named_as_the_cause(code: int) -> None:
    fault = sqlite3.OperationalError("disk I/O error")
    fault.sqlite_errorcode = code
    error = translate_error(fault, "sqlite:///memory.db")
    assert isinstance(error, DatabaseUnavailable)
    assert str(error).startswith("sqlite:///memory.db: disk I/O error: the disk may be full; SQLite needs some space")


async def test_a_database_on_a_full_disk_is_unavailable_and_stores_everything_once_when_there_is_space(
    file_log: EventLog,
) -> None:
    log, file = file_log, file_log.address.path
    records = [record(episode(1), sequence, payload=b'"%s"' % (b"x" * 1000)) for sequence in range(1, 1001)]
    disk = SmallDisk(log.engine)
    source = KeptSource(records, closed=True)
    backoff = Backoff(first_s=0.005, longest_s=0.02)
    drain = Drain(source, log.append, settings=Settings(batch_events_max=50), backoff=backoff)
    running = asyncio.create_task(drain.run())
    while drain.state.retries < 5 and not running.done():  # noqa: ASYNC110
        await asyncio.sleep(0.001)
    assert not running.done(), "the drain ended instead of waiting for space"
    assert "database or disk is full" in (drain.state.unavailable or "")
    assert 0 < len(source.kept) < 1000
    with pytest.raises(DatabaseUnavailable, match="full"):
        await log.append(records)
    disk.free_space()
    await asyncio.wait_for(running, 60)
    assert source.kept == []
    assert ask(file, "SELECT count(*), min(sequence), max(sequence) FROM event") == [(1000, 1, 1000)]
    assert ask(file, "PRAGMA integrity_check") == [("ok",)]
