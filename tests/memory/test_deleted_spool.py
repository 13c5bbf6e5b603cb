"""A spool that is deleted under a running plan: the plan continues, and the log, `status` and `flush` report the
loss.
"""

import asyncio
import logging
import shutil
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.queue import Spool
from pycrorm_async.settings import Writer
from tests.databases import ask
from tests.memory.daemon_in_loop import QUICK, Daemon
from tests.memory.note_actions import NoteActionPerformable, texts

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""

GONE = "was deleted or replaced"


@asynccontextmanager
async def drained_by(writer: Writer, url: str, spool: Path) -> AsyncIterator[None]:
    daemon = Daemon(url, spool) if writer == "daemon" else None
    yield
    if daemon is not None:
        await daemon.stop()


async def until_noticed(memory: Memory) -> None:
    """Wait until the queue has moved; a sync that waited meanwhile raised."""
    async with asyncio.timeout(60):
        while "continues in" not in (memory.status.spool_fault or ""):
            await asyncio.sleep(0)  # `synced` need not suspend, so that no timeout could end this loop
            with suppress(SpoolUnavailable):
                await memory.synced()


@pytest.mark.parametrize("writer", ["thread", "daemon"])
async def test_the_plan_continues_in_a_new_spool_and_everything_is_stored(
    database_url: str, tmp_path: Path, writer: Writer, caplog: pytest.LogCaptureFixture
) -> None:
    spool = tmp_path / "spool"
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(drained_by(writer, database_url, spool))
        memory = await stack.enter_async_context(Memory.open(database_url, spool=spool, writer=writer, settings=QUICK))
        async with memory.episode(description="e"):
            await NoteActionPerformable("a").perform()
            await memory.synced()
            assert memory.status.spool_fault is None
            [recorder] = Spool(spool).recorders()
            shutil.rmtree(recorder.path, ignore_errors=True)
            await NoteActionPerformable("b").perform()
            await until_noticed(memory)
            await NoteActionPerformable("c").perform()
        while True:
            try:
                await memory.flush()
            except SpoolUnavailable:
                continue
            break
        assert await texts(memory) == ["a", "b", "c"]
        status = memory.status
        assert (status.faults.total, status.spool_lost) == (0, ())
        assert "no record is lost" in (status.spool_fault or "")
        [again] = [each for each in Spool(spool).recorders() if each.alive]
        assert again.name != recorder.name
        log_id = Spool(spool).log_id()
        assert log_id is not None
    assert Spool(spool).recorders() == []
    assert Spool(spool).log_id() == log_id
    errors = [each.getMessage() for each in caplog.records if each.levelno == logging.ERROR]
    assert [GONE in each for each in errors] == [True, True]
    assert ask(database_url, "SELECT count(*) FROM event")[0][0] > 6


async def test_a_spool_whose_root_is_deleted_is_bound_to_its_database_again(tmp_path: Path) -> None:
    url, spool = f"sqlite:///{tmp_path / 'memory.db'}", tmp_path / "spool"
    async with Memory.open(url, spool=spool, settings=QUICK) as memory:
        await NoteActionPerformable("a").perform()
        await memory.flush()
        log_id = Spool(spool).log_id()
        spool.rename(tmp_path / "taken away")
        await NoteActionPerformable("b").perform()
        await until_noticed(memory)
        await memory.synced()
        await memory.flush()
        assert await texts(memory) == ["a", "b"]
        assert Spool(spool).log_id() == log_id
