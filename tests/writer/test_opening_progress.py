"""Opening a database fails when it makes no progress, not when it takes long, as on a busy machine."""

import asyncio
import sqlite3
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.settings import Settings
from pycrorm_async.store import sqlite_engine
from pycrorm_async.writer.drain import Destination
from pycrorm_async.writer.plan_writer import WriterThread
from tests.writer.fakes import KeptSource


def thread_with(opening: Callable[[], AbstractAsyncContextManager[Destination]], limit_s: float) -> WriterThread:
    settings = Settings(connect_timeout_s=limit_s)
    return WriterThread(source=KeptSource(), open_destination=opening, adopt=lambda: (), settings=settings)


async def test_a_new_sqlite_file_is_opened_whatever_the_time_it_takes(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=Settings(connect_timeout_s=1e-9)) as memory:
        await memory.flush()


@pytest.mark.slow
async def test_a_server_that_answers_again_and_again_is_waited_for_longer_than_the_limit() -> None:
    answers = []

    @asynccontextmanager
    async def opening() -> AsyncIterator[Destination]:
        for number in range(30):
            await asyncio.sleep(0.1)
            answers.append(number)
        raise DatabaseUnavailable("the end of this opening")
        yield

    with pytest.raises(DatabaseUnavailable, match="the end of this opening"):
        await thread_with(opening, 2.0).start()
    assert len(answers) == 30


async def test_a_server_that_never_answers_is_given_up_and_the_opening_is_cancelled() -> None:
    ended = []

    @asynccontextmanager
    async def opening() -> AsyncIterator[Destination]:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(True)
        yield  # type: ignore[misc]

    with pytest.raises(DatabaseUnavailable, match=r"did not answer within 0\.05 s"):
        await thread_with(opening, 0.05).start()
    assert ended == [True]


def test_the_wait_for_the_write_lock_ends_after_a_number_of_attempts_not_after_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    holder, waiting = (sqlite3.connect(tmp_path / "memory.db", isolation_level=None) for _ in range(2))
    holder.execute("BEGIN IMMEDIATE")
    attempts, now_s = [], [0.0]

    def sleep(seconds: float) -> None:
        """Let a minute pass, as if the machine had run other processes; the holder is ready after 50."""
        attempts.append(seconds)
        now_s[0] += 60.0
        if len(attempts) == 50:
            holder.execute("COMMIT")

    monkeypatch.setattr(sqlite_engine, "time", SimpleNamespace(sleep=sleep, monotonic=lambda: now_s[0]))
    sqlite_engine._wait_for_turn(waiting, "BEGIN IMMEDIATE", 0.2)
    assert len(attempts) == 50
    waiting.execute("COMMIT")

    holder.execute("BEGIN IMMEDIATE")
    with pytest.raises(sqlite3.OperationalError, match="locked"):
        sqlite_engine._wait_for_turn(waiting, "BEGIN IMMEDIATE", 0.2)
    assert len(attempts) == 250
    holder.close()
    waiting.close()
