"""What happens after a memory has closed, or in a forked child, is not recorded: one warning and a count say so."""

from __future__ import annotations

import asyncio
import contextvars
import logging
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.errors import CallerError
from pycrorm_async.plan import ActionAbstract
from tests.databases import ask, put_memory


@dataclass
class StepActionPerformable(ActionAbstract):
    number: int
    dtype: int = 8  # the user's own field, as any other

    async def perform(self) -> None:
        """Succeed without doing anything."""


def warnings_in(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [each.getMessage() for each in caplog.records if each.levelno >= logging.WARNING]


async def test_performs_after_the_memory_has_closed_are_counted_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    is_closed = threading.Event()

    async def steps() -> None:
        await asyncio.to_thread(is_closed.wait, 10)
        for number in range(3):
            await StepActionPerformable(number).perform()

    async with Memory.open(put_memory(tmp_path / "memory.db")) as memory:
        context = contextvars.copy_context()
        late = threading.Thread(target=context.run, args=(asyncio.run, steps()))
        late.start()
    assert (memory.status.unrecorded, memory.is_open) == (0, False)
    is_closed.set()
    await asyncio.to_thread(late.join)
    assert memory.status.unrecorded == 3
    [warning] = warnings_in(caplog)
    assert warning.startswith("StepAction leaves no record, because the memory is closed (")
    assert ask(tmp_path / "memory.db", "SELECT * FROM action") == []


def test_an_executive_that_goes_on_after_the_memory_has_closed_is_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Memory.sync(put_memory(tmp_path / "memory.db")) as memory:
        recording = memory.recording
        step, episode = recording.type("action", "Step"), recording.episode(description="left open")
        episode.start(1, step)
    assert memory.status.stored == memory.status.written > 0
    assert memory.status.faults.total == memory.status.missing.total == 0
    episode.end(1)
    episode.close()  # both were written when the memory closed
    assert (memory.status.unrecorded, warnings_in(caplog)) == (0, [])
    episode.start(2, step)
    episode.observe("force", 5)
    recording.episode(description="late").start(3, step)
    assert memory.status.unrecorded == 4
    [warning] = warnings_in(caplog)
    assert warning.startswith("a call of `start` leaves no record, because the memory is closed (")


@pytest.mark.parametrize("writer", ["thread", "daemon", pytest.param("process", marks=pytest.mark.slow)])
async def test_the_status_of_a_closed_memory_is_its_last(tmp_path: Path, writer: Any) -> None:
    memory = Memory.open(put_memory(tmp_path / "memory.db"), writer=writer)
    with pytest.raises(CallerError, match="not open"):
        _ = memory.status
    async with memory:
        await StepActionPerformable(1).perform()
        written = memory.status.written
    status = memory.status
    assert (status.written, status.synced) == (written, written)
    assert status.stored == (0 if writer == "daemon" else written)


async def test_a_list_that_lags_says_how_many_episodes_are_being_folded(tmp_path: Path) -> None:
    url = put_memory(tmp_path / "memory.db")
    async with Memory.open(url, settings=Settings(fold="at_end")) as memory:
        await StepActionPerformable(1).perform()
        await memory.flush()
        assert "folded" not in repr(await memory.episodes())
        for number in range(2):
            await StepActionPerformable(number).perform()
        while memory.status.stored < memory.status.written:  # noqa: ASYNC110  another thread stores them
            await asyncio.sleep(0.01)
        lagging = await memory.episodes()
        sentence = "2 episodes are being folded: `await memory.flush()` waits for that"
        assert (len(lagging), lagging.folding) == (1, 2)
        assert repr(lagging).endswith(f"\n{sentence}")
        assert sentence in lagging._repr_html_()
        assert sentence in await asyncio.to_thread(memory._repr_html_)
        await memory.flush()
        assert (len(await memory.episodes()), (await memory.episodes()).folding) == (3, 0)
