"""A process that exits with a full queue, and a wall clock that is set back while a plan runs."""

from __future__ import annotations

import asyncio
import itertools
import os
import sys
import time
from pathlib import Path

import pytest

from pycrorm_async import Memory, Reading, Settings, recover
from pycrorm_async.clock import Clock
from pycrorm_async.errors import SpoolFull
from tests.crash.forked_processes import ForkedProcess
from tests.databases import ask
from tests.memory.note_actions import NoteActionPerformable, texts

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""

SMALL = Settings(
    sync_interval_ms=5,
    segment_bytes=2**14,
    record_bytes_max=2**12,
    spool_bytes_max=2**17,
    spool_reserve_bytes=2**15,
    on_full="fail",
)
HOUR_NS = 3600 * 10**9


def fill_and_leave(url: str, spool: str, how: str) -> None:
    """Record notes until the spool is full, and exit in the middle of the episode."""
    asyncio.run(_fill(url, Path(spool), how))


async def _fill(url: str, spool: Path, how: str) -> None:
    opened = Memory.open(url, spool=spool, writer="daemon", settings=SMALL)
    async with opened as memory, memory.episode(description="until it is full"):
        try:
            for number in itertools.count():
                await NoteActionPerformable(f"{number}").perform()
                os.write(1, b"%d\n" % number)
        except SpoolFull:
            if how == "exit":
                sys.exit(3)
            if how == "_exit":
                os._exit(3)
            raise


@pytest.mark.parametrize("how", ["exit", "_exit", "raise"])
async def test_a_process_that_exits_with_a_full_queue_loses_nothing(
    database_url: str, tmp_path: Path, how: str
) -> None:
    spool = tmp_path / "spool"
    leaving = ForkedProcess(fill_and_leave, database_url, str(spool), how)
    assert await asyncio.to_thread(leaving.wait) == (1 if how == "raise" else 3)
    lines = leaving.lines
    assert lines == [str(number) for number in range(len(lines))]
    assert len(lines) > 50
    report = await recover(database_url, spool=spool)
    assert report.failed == {}
    async with Reading.open(database_url) as reading:
        assert await texts(reading) == lines
        [episode] = await reading.episodes()
    # Events that end an episode use space that is reserved for them.
    assert episode.status == {"exit": "ERROR", "raise": "ERROR", "_exit": "LOST"}[how]
    assert [path for path in spool.iterdir() if path.is_dir() and path.name != "stored"] == []


async def test_a_clock_that_is_set_back_an_hour_repeatedly_changes_no_order(database_url: str, tmp_path: Path) -> None:
    back_ns = 0
    clock = Clock(wall_ns=lambda: time.time_ns() - back_ns, monotonic_ns=time.monotonic_ns)
    words = list("abcdefg")
    patient = Settings(connect_timeout_s=300)
    async with Memory.open(database_url, spool=tmp_path / "spool", clock=clock, settings=patient) as memory:
        for description in ("first", "second"):
            async with memory.episode(description=description):
                for word in words:
                    await NoteActionPerformable(f"{description} {word}").perform()
                    back_ns += HOUR_NS
                    if word == "d":
                        await memory.flush()
        await memory.flush()
        assert await texts(memory) == [f"{description} {word}" for description in ("first", "second") for word in words]
        assert [each.status for each in await memory.reading.episodes()] == ["SUCCEEDED", "SUCCEEDED"]
    times = ask(database_url, "SELECT wall_ns, event.monotonic_ns FROM event ORDER BY episode, sequence")
    assert times[0][0] - times[-1][0] > 12 * HOUR_NS
    assert [monotonic for _, monotonic in times] == sorted(monotonic for _, monotonic in times)
    took = ask(database_url, "SELECT end_ns - start_ns FROM task_tree_node")
    assert all(0 <= ns < HOUR_NS for (ns,) in took)
