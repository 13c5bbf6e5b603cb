"""A full spool: files never exceed the limit, reserved records have their reserve, freed space wakes producers."""

import asyncio
import errno
import os
from dataclasses import replace
from pathlib import Path

import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import CallerError, SpoolClosed, SpoolFull, SpoolStuck
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.queue.appender import Appender, Capacity
from pycrorm_async.queue.format import Segment
from pycrorm_async.queue.gc_safe_lock import GcSafeLock
from pycrorm_async.settings import Settings
from tests.queue.factories import (
    ALL,
    ORDINARY,
    PAYLOAD,
    SMALL,
    FolderWriter,
    drain,
    fill,
    make,
    node,
    started,
)

# === full spool ===============================================================================================
#
# A full spool: ordinary records stop at the reserve, reserved ones at the end, and freed space wakes the producers.


@pytest.fixture
def filled(queue: RecorderQueue) -> RecorderQueue:
    queue.put_nowait(started(), b"{}")
    assert fill(queue) == ORDINARY
    return queue


async def drain_all(queue: RecorderQueue) -> None:
    await queue.synced_to()
    records = await queue.get_batch(events_max=1000, bytes_max=2**22, age_s_max=0.0)
    await queue.acknowledge(records[-1].position)


def test_the_files_never_exceed_the_limit_however_much_is_put(filled: RecorderQueue) -> None:
    assert fill(filled, reserved=True) == ALL - ORDINARY
    assert sum(path.stat().st_size for path in filled.folder.glob("*.segment")) == SMALL.spool_bytes_max
    assert filled.bytes_spooled <= SMALL.spool_bytes_max
    assert filled.written == 1 + ALL


def test_a_refused_record_leaves_no_gap_and_smaller_ones_may_still_fit(filled: RecorderQueue) -> None:
    assert filled.full
    with pytest.raises(SpoolFull, match="spool_bytes_max is reached"):
        filled.put_nowait(node(), PAYLOAD)
    assert filled.put_nowait(node(), b"x") == 2 + ORDINARY
    assert filled.full  # for the refused record
    assert filled.put_nowait(node(), PAYLOAD, reserved=True) == 3 + ORDINARY


async def test_space_is_freed_when_records_are_stored_and_segments_deleted(filled: RecorderQueue) -> None:
    assert fill(filled, reserved=True) == ALL - ORDINARY
    waiting = asyncio.ensure_future(filled.room())
    blocked = asyncio.ensure_future(asyncio.to_thread(filled.block_until_room, 30.0))
    await asyncio.sleep(0)
    assert not waiting.done()
    await drain_all(filled)
    await asyncio.wait_for(waiting, 10)
    assert await blocked
    assert not filled.full
    assert filled.put_nowait(node(), PAYLOAD) == 2 + ALL
    await asyncio.wait_for(filled.room(), 10)


async def test_no_producer_waits_for_space_in_a_closed_queue(filled: RecorderQueue) -> None:
    waiting = asyncio.ensure_future(filled.room())
    blocked = asyncio.ensure_future(asyncio.to_thread(filled.block_until_room, 30.0))
    await asyncio.sleep(0.01)
    filled.close()
    await asyncio.wait_for(asyncio.gather(waiting, blocked), 10)
    with pytest.raises(SpoolClosed):
        filled.put_nowait(node(), b"{}")


async def test_a_producer_that_waits_for_a_queue_that_is_not_drained_learns_why(filled: RecorderQueue) -> None:
    fill(filled, reserved=True)
    waiting = asyncio.ensure_future(filled.room())
    blocked = asyncio.ensure_future(asyncio.to_thread(filled.block_until_room, 1000.0))
    await asyncio.sleep(0.01)
    assert not waiting.done()
    assert not blocked.done()
    filled.fail("the log is damaged")
    filled.fail("and something else happened later")
    async with asyncio.timeout(20):
        for each in (waiting, blocked, filled.room()):
            with pytest.raises(SpoolStuck, match=r"is full .* and cannot be emptied: the log is damaged$"):
                await each
    with pytest.raises(SpoolStuck, match="the log is damaged"):
        filled.block_until_room(1000.0)
    with pytest.raises(SpoolStuck, match="the log is damaged"):
        filled.put_nowait(node(), PAYLOAD, reserved=True)


async def test_a_queue_that_is_not_drained_accepts_records_until_it_is_full(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")
    queue.fail("the log is damaged")
    for _ in range(ORDINARY):
        await asyncio.wait_for(queue.room(), 20)
        queue.put_nowait(node(), PAYLOAD)
    with pytest.raises(SpoolStuck):
        queue.put_nowait(node(), PAYLOAD)
    with pytest.raises(SpoolStuck):
        await asyncio.wait_for(queue.room(), 20)
    for _ in range(ALL - ORDINARY):
        assert queue.block_until_room(0.0) is True
        queue.put_nowait(node(), PAYLOAD, reserved=True)
    queue.close()
    assert await queue.room() is None  # type: ignore[func-returns-value]  # a put raises that it is closed
    assert len(await drain(queue)) == 1 + ALL


def test_settings_that_cannot_work_are_refused_before_any_file_is_made(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="three segments"):
        make(tmp_path / "spool", settings=replace(SMALL, spool_reserve_bytes=6 * 4096))
    assert not (tmp_path / "spool").exists()


def test_a_disk_that_filled_up_while_a_segment_was_prepared_stays_full(
    spool: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    appender = FolderWriter(spool, settings=replace(SMALL, spool_bytes_max=2**20)).appender
    resume = GcSafeLock.resume_gc

    def disk_is_full(*_: object, **__: object) -> Segment:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def fill_and_resume(lock: GcSafeLock) -> None:  # the sync thread has not noticed yet that a segment is prepared
        resume(lock)
        monkeypatch.undo()
        with monkeypatch.context() as patch:
            patch.setattr(Segment, "allocate", disk_is_full)
            for _ in range(2):
                with pytest.raises(SpoolFull):
                    while True:
                        appender.put(started() if not appender.open else node(), PAYLOAD, True)

    monkeypatch.setattr(GcSafeLock, "resume_gc", fill_and_resume)
    appender.prepare()
    assert not appender.admits_again(reserved=True)


@pytest.mark.parametrize("full_times", [1, 5])
@pytest.mark.parametrize("since", ["the queue is made", "a record is put"])
async def test_a_wait_for_a_full_disk_ends_soon_after_the_disk_has_space(
    spool: Path, monkeypatch: pytest.MonkeyPatch, since: str, full_times: int
) -> None:
    allocate, tries = Segment.allocate, [0]

    def allocate_when_there_is_space(*arguments: object, number: int, **others: object) -> Segment:
        tries[0] += number == 2
        if number == 2 and tries[0] <= full_times:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return allocate(*arguments, number=number, **others)  # type: ignore[arg-type]

    def make_queue() -> RecorderQueue:
        return make(spool, settings=replace(SMALL, sync_interval_ms=3_600_000), clock=SYSTEM_CLOCK)

    if since == "the queue is made":
        monkeypatch.setattr(Segment, "allocate", allocate_when_there_is_space)
        queue = make_queue()
    else:
        with monkeypatch.context() as patch:  # nothing is prepared, so that a put allocates the segment
            patch.setattr(Appender, "prepare", lambda _: False)
            queue = make_queue()
        monkeypatch.setattr(Segment, "allocate", allocate_when_there_is_space)
    queue.put_nowait(started(), b"{}", reserved=True)
    fill(queue)
    await asyncio.wait_for(queue.room(), 20)
    assert tries[0] > full_times
    queue.put_nowait(node(), PAYLOAD)
    queue.release()


# === capacity =================================================================================================
#
# Admission to the queue: files never exceed the limit, and the reserve is kept for reserved records.

# The largest record: a header of 64 bytes, a type name of 255, the payload and padding; two commits of 72 after it; and
# before it the segment header, 56 bytes and 40 for each open episode.
LARGEST_OF_1000 = 64 + 1256
BESIDE_16_EPISODES = LARGEST_OF_1000 + 2 * 72 + 56 + 16 * 40


def test_the_largest_record_fits_beside_sixteen_open_episodes_or_the_settings_are_refused() -> None:
    enough = Settings(segment_bytes=BESIDE_16_EPISODES, record_bytes_max=1000)
    assert Capacity.of(enough).episodes_max == 16
    assert Capacity.of(enough).frame_bytes_max(episodes=16) == LARGEST_OF_1000
    with pytest.raises(CallerError) as refused:
        Capacity.of(replace(enough, segment_bytes=BESIDE_16_EPISODES - 1))
    assert str(refused.value) == (
        "segment_bytes (2,159) must hold a record of record_bytes_max (1,000) and 16 open episodes: 2,160 at least"
    )
    with pytest.raises(CallerError, match="record_bytes_max"):
        Capacity.of(Settings(segment_bytes=2**18))
