"""A perform that was called and never awaited is noticed and named, and differs from a cancelled one."""

from __future__ import annotations

import asyncio
import gc
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pycrorm_async import Memory
from tests.memory.note_actions import NoteActionPerformable, texts, url_of

pytestmark = pytest.mark.slow

SENTENCE = "NoteAction.perform() was called and never awaited, so it did not run: write `await`"
FAULT = "NoteAction.perform() was called and never awaited"


@contextmanager
def quiet() -> Iterator[None]:
    """Ignore Python's own warning: the test is about the package's."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield
        gc.collect()


async def test_a_perform_that_is_not_awaited_is_a_fault_of_its_episode(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode() as episode:
            with quiet():
                NoteActionPerformable("lost").perform()  # type: ignore[unused-coroutine]  # the fault here
                NoteActionPerformable("lost again").perform()  # type: ignore[unused-coroutine]  # the fault here
            await NoteActionPerformable("kept").perform()
            assert episode.faults == (FAULT,)
        async with memory.episode() as other:
            await NoteActionPerformable("fine").perform()
        assert other.faults == ()
        assert memory.status.faults == (2, SENTENCE)
        assert memory.status.unawaited == (SENTENCE,)
        await memory.flush()
        assert await texts(memory) == ["kept", "fine"]


async def test_one_that_still_exists_at_the_end_of_its_episode_is_noticed_then_and_once(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode() as episode:
            forgotten = NoteActionPerformable("forgotten").perform()
        assert episode.faults == (FAULT,)
        with quiet():
            del forgotten
        assert memory.status.faults.total == 1


async def test_outside_any_episode_it_is_a_fault_of_the_memory(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        with quiet():
            NoteActionPerformable("lost").perform()  # type: ignore[unused-coroutine]  # the fault here
        assert memory.status.unawaited == (SENTENCE,)


@pytest.mark.skipif(sys.version_info >= (3, 12), reason="Python keeps the frame of a coroutine closed before its start")
async def test_a_perform_that_was_closed_before_its_start_is_no_fault(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode() as episode:
            closed = NoteActionPerformable("closed").perform()
            closed.close()
            del closed
            gc.collect()
        assert episode.faults == ()
        assert memory.status.faults.total == 0


async def test_a_perform_that_was_cancelled_before_its_start_or_starts_later_is_no_fault(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode() as episode:
            cancelled = asyncio.create_task(NoteActionPerformable("cancelled").perform())
            cancelled.cancel()
            with pytest.raises(asyncio.CancelledError):
                await cancelled
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(NoteActionPerformable("too late").perform(), 0)
            later = asyncio.create_task(NoteActionPerformable("later").perform())
            del cancelled
            gc.collect()
        await later
        assert episode.faults == ()
        assert memory.status.faults.total == 0
