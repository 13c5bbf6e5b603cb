"""The live queue: positions, safety levels, batches and acknowledging, and the beginning and end of its folder."""

import asyncio
import os
import threading
import time
from pathlib import Path

import pytest

from pycrorm_async.errors import EpisodeRefused, InternalError, SpoolClosed, SpoolUnavailable
from pycrorm_async.events.codec import Heading
from pycrorm_async.queue import RecorderQueue, Spool
from pycrorm_async.queue.format import COMMIT, EVENT, Segment, decode_each, header_bytes, salt_of
from pycrorm_async.queue.locks import FileLock
from pycrorm_async.settings import Settings
from tests.queue.factories import (
    DECLARED,
    LONG_S,
    RECORDER,
    batch_of,
    crashed_copy,
    drain,
    ended,
    lost,
    make,
    node,
    record,
    recover,
    started,
)

# === recorder queue ===========================================================================================
#
# The live queue: positions and sequences, safety levels, batches and acknowledging.


async def test_records_come_back_in_the_order_of_their_puts(queue: RecorderQueue) -> None:
    assert queue.put_nowait(DECLARED, b'{"kind":"action"}') == 0
    assert queue.put_nowait(started(1), b"{}") == 1
    assert queue.put_nowait(started(2), b"{}") == 1
    assert queue.put_nowait(node(1), '{"text":"Grüße"}'.encode()) == 2
    assert queue.put_nowait(ended(2), b"") == 2
    assert queue.written == 5
    queue.close()
    assert await drain(queue) == [
        record(1, DECLARED, 0, b'{"kind":"action"}'),
        record(2, started(1), 1, b"{}"),
        record(3, started(2), 1, b"{}"),
        record(4, node(1), 2, '{"text":"Grüße"}'.encode()),
        record(5, ended(2), 2, b""),
    ]


async def test_a_written_record_survives_a_kill_before_any_sync(tmp_path: Path) -> None:
    queue = make(tmp_path / "a", settings=Settings(sync_interval_ms=3_600_000))
    queue.put_nowait(started(), b"{}")
    queue.put_nowait(node(), b"1")
    assert queue.synced == 0
    left = crashed_copy(queue, tmp_path / "b")
    queue.release()
    assert await recover(left) == [record(1, started(), 1, b"{}"), record(2, node(), 2, b"1"), lost(3, 1, 3)]


async def test_only_synced_records_are_supplied(unsynced: RecorderQueue) -> None:
    unsynced.put_nowait(started(), b"{}")
    waiting = batch_of(unsynced, 10)
    assert await asyncio.wait({waiting}, timeout=0.05) == (set(), {waiting})
    await unsynced.synced_to()
    assert unsynced.synced == 1
    assert await waiting == [record(1, started(), 1, b"{}")]


async def test_a_sync_happens_unasked_and_serves_many_waiters_in_several_loops(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")
    others = [asyncio.to_thread(asyncio.run, queue.synced_to(1)) for _ in range(3)]
    await asyncio.gather(queue.synced_to(), queue.synced_to(1), *others)
    assert queue.synced == 1
    queue.put_nowait(node(), b"{}")
    assert [each.position for each in await batch_of(queue, 2, age_s=LONG_S)] == [1, 2]  # no caller requested this sync


async def test_a_cancelled_waiter_leaves_the_others_waiting(unsynced: RecorderQueue) -> None:
    unsynced.put_nowait(started(), b"{}")
    waiting = batch_of(unsynced, 1)
    given_up = batch_of(unsynced, 1)
    await asyncio.sleep(0)
    given_up.cancel()
    with pytest.raises(asyncio.CancelledError):
        await given_up
    await unsynced.synced_to()
    assert [each.position for each in await waiting] == [1]


async def test_sequences_of_many_threads_have_no_gaps_and_no_duplicates(tmp_path: Path) -> None:
    queue = make(tmp_path, settings=Settings(segment_bytes=2**16, record_bytes_max=2**12))
    queue.put_nowait(started(0), b"{}")
    returned: list[tuple[int, int]] = []
    begin = threading.Barrier(4)

    def produce(number: int) -> None:
        begin.wait()
        queue.put_nowait(started(number), b"{}")
        mine = [(0, queue.put_nowait(node(0), b"shared")) for _ in range(500)]
        mine += [(number, queue.put_nowait(node(number), b"own")) for _ in range(500)]
        returned.extend(mine)

    threads = [threading.Thread(target=produce, args=(number,)) for number in (1, 2, 3, 4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    queue.close()
    records = await drain(queue)
    queue.release()
    assert sorted(returned) == [(0, sequence) for sequence in range(2, 2002)] + [
        (number, sequence) for number in (1, 2, 3, 4) for sequence in range(2, 502)
    ]
    assert [each.position for each in records] == list(range(1, 4006))
    for number in range(5):
        mine = [each.sequence for each in records if each.episode == started(number).episode]
        assert mine == list(range(1, len(mine) + 1))


async def test_an_event_of_an_episode_that_is_not_open_is_refused_and_leaves_no_gap(queue: RecorderQueue) -> None:
    with pytest.raises(InternalError, match="cannot take NodeStarted"):
        queue.put_nowait(node(1), b"{}")
    queue.put_nowait(started(1), b"{}")
    queue.put_nowait(ended(1), b"{}")
    with pytest.raises(InternalError, match="is not open"):
        queue.put_nowait(node(1), b"straggler")
    assert queue.put_nowait(started(2), b"{}") == 1
    assert queue.written == 3


async def test_a_record_that_no_segment_can_hold_is_refused_and_leaves_no_gap(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")
    largest = 4096 - 56 - 40 - 2 * 72 - 64 - len("NodeStarted")
    largest -= (largest + len("NodeStarted")) % 8
    with pytest.raises(InternalError, match="does not fit into a segment"):
        queue.put_nowait(node(), bytes(largest + 8))
    assert queue.put_nowait(node(), bytes(largest)) == 2
    queue.close()
    assert [len(each.payload) for each in await drain(queue)] == [2, largest]


async def test_episodes_are_opened_while_there_is_space_for_the_largest_record(queue: RecorderQueue) -> None:
    most = (4096 - 2 * 72 - 56 - 64 - 2304) // 40
    for number in range(most):
        queue.put_nowait(started(number), b"{}")
    with pytest.raises(EpisodeRefused, match=f"{most} episodes are open"):
        queue.put_nowait(started(most), b"{}")
    longest = Heading(started(0).episode, "x" * 255, 1)
    assert [queue.put_nowait(longest, bytes(2048), reserved=True) for _ in range(3)] == [2, 3, 4]
    queue.put_nowait(ended(1), b"{}")
    assert queue.put_nowait(started(most), b"{}") == 1
    queue.close()
    assert len(await drain(queue)) == most + 5


async def test_a_type_name_too_long_for_a_frame_is_refused(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")
    for name in ("", "x" * 256, "ä" * 128):
        with pytest.raises(InternalError, match="1 to 255 bytes"):
            queue.put_nowait(Heading(started().episode, name, 1), b"{}")
    assert queue.put_nowait(Heading(started().episode, "ä" * 127, 1), b"{}") == 2


async def test_a_batch_is_complete_at_its_age_with_the_records_that_came_until_then(
    queue: RecorderQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = asyncio.get_running_loop()
    now_s = loop.time()
    monkeypatch.setattr(loop, "time", lambda: now_s)
    queue.put_nowait(started(), b"{}")
    waiting = batch_of(queue, 3, age_s=LONG_S)
    await queue.synced_to()
    await steps(10)
    queue.put_nowait(node(), b"{}")
    await queue.synced_to()
    await steps(10)
    now_s += LONG_S - 0.5
    await steps(10)
    assert not waiting.done()
    now_s += 1.0
    assert [each.position for each in await waiting] == [1, 2]


async def steps(count: int) -> None:
    """Run the ready callbacks of the loop this many times, and the sync thread before each."""
    for _ in range(count):
        time.sleep(0.005)  # noqa: ASYNC251  the loop's own clock does not advance
        await asyncio.sleep(0)


async def test_a_consumer_in_its_own_loop_and_thread_is_woken_by_producers(queue: RecorderQueue) -> None:
    async def consume() -> list[int]:
        positions: list[int] = []
        while batch := await queue.get_batch(events_max=10, bytes_max=2**20, age_s_max=0.0):
            positions += [each.position for each in batch]
            await queue.acknowledge(batch[-1].position)
        return positions

    consumed = asyncio.ensure_future(asyncio.to_thread(asyncio.run, consume()))
    queue.put_nowait(started(), b"{}")
    for _ in range(20):
        queue.put_nowait(node(), b"{}")
        await asyncio.sleep(0.001)
    queue.close()
    assert await consumed == list(range(1, 22))
    assert queue.stored == 21


async def test_bytes_spooled_counts_headers_records_and_commits(unsynced: RecorderQueue) -> None:
    assert unsynced.bytes_spooled == 56
    unsynced.put_nowait(started(), b"{}")
    assert unsynced.bytes_spooled == 56 + 64 + 16
    await unsynced.synced_to()
    await unsynced.synced_to()
    assert unsynced.bytes_spooled == 56 + 80 + 72
    for _ in range(4):
        unsynced.put_nowait(node(), b"x" * 900)
    assert unsynced.bytes_spooled == 4096 + 96 + 976


async def test_after_a_sync_as_many_bytes_are_made_writable_as_the_records_before_took(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touched: list[tuple[int, int]] = []
    monkeypatch.setattr(Segment, "touch", lambda _segment, start, end: touched.append((start, end)))
    queue = make(tmp_path, settings=Settings(sync_interval_ms=3_600_000))
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    before = queue.bytes_spooled
    queue.put_nowait(node(), b"1" * 1_000)
    await queue.synced_to()
    end = queue.bytes_spooled
    queue.release()
    assert touched[:2] == [(before, 2 * before), (end, 2 * end - before)]


# === recorder queue closing ===================================================================================
#
# The folder of a live queue: refused at the beginning, drained by one source, closed, and left behind or deleted.


async def test_closing_refuses_puts_syncs_drains_and_ends_with_an_empty_batch(unsynced: RecorderQueue) -> None:
    unsynced.put_nowait(started(), b"{}")
    unsynced.put_nowait(node(), b"{}")
    unsynced.close()
    unsynced.close()
    with pytest.raises(SpoolClosed):
        unsynced.put_nowait(node(), b"{}")
    assert [each.position for each in await batch_of(unsynced, 1)] == [1]
    assert [each.position for each in await batch_of(unsynced, 1)] == [2]
    assert await batch_of(unsynced, 1) == []
    assert await batch_of(unsynced, 1) == []


async def test_closing_wakes_a_consumer_that_waits_for_a_batch(queue: RecorderQueue) -> None:
    waiting = batch_of(queue, 1, age_s=LONG_S)
    await asyncio.sleep(0)
    queue.close()
    assert await waiting == []


async def test_a_queue_whose_records_are_all_stored_leaves_no_files(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    queue.put_nowait(ended(), b"{}")
    queue.close()
    assert len(await drain(queue)) == 2
    await queue.acknowledge(2)
    queue.release()
    queue.release()
    assert Spool(spool).recorders() == []
    assert Spool(spool).strangers() == []


async def test_a_queue_with_an_open_episode_leaves_its_folder_for_recovery(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    queue.close()
    await drain(queue)
    await queue.acknowledge(1)
    queue.release()
    assert await recover(queue.folder) == [record(1, started(), 1, b"{}"), lost(2, 1, 2)]


async def test_a_queue_that_is_released_undrained_leaves_all_of_it_synced(spool: Path) -> None:
    queue = make(spool, settings=Settings(sync_interval_ms=3_600_000))
    queue.put_nowait(started(), b"{}")
    queue.put_nowait(ended(), b"{}")
    queue.release()
    assert queue.synced == 2
    assert [(each.path, each.alive) for each in Spool(spool).recorders()] == [(queue.folder, False)]
    assert await recover(queue.folder) == [record(1, started(), 1, b"{}"), record(2, ended(), 2, b"{}")]


async def test_a_folder_is_drained_by_one_source_only(queue: RecorderQueue) -> None:
    drained_elsewhere = FileLock.take(queue.folder / "drain")
    assert drained_elsewhere is not None
    with pytest.raises(SpoolUnavailable, match="drained by another process"):
        await queue.get_batch(events_max=1, bytes_max=1, age_s_max=0.0)
    drained_elsewhere.release()
    queue.close()
    assert await drain(queue) == []
    assert FileLock.take(queue.folder / "drain") is None


async def test_a_second_recorder_with_the_same_id_is_refused(queue: RecorderQueue, spool: Path) -> None:
    with pytest.raises(SpoolUnavailable):
        make(spool)
    assert queue.put_nowait(started(), b"{}") == 1


# --- fdatasync --------------------------------------------------------------------------------------------------------


async def test_a_record_is_synced_after_one_fdatasync_of_it_and_one_of_its_commit_frame(
    unsynced: RecorderQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without either call the list is shorter: no other test of a few milliseconds notices that."""
    written: list[tuple[list[int], int]] = []
    fdatasync = os.fdatasync

    def watched(descriptor: int) -> None:
        content = Path(f"/proc/self/fd/{descriptor}").read_bytes()
        frames = decode_each(content, header_bytes(0), salt_of(RECORDER, 1))
        written.append(([kind for kind, *_ in frames], unsynced.synced))
        fdatasync(descriptor)

    monkeypatch.setattr(os, "fdatasync", watched)
    unsynced.put_nowait(started(), b"{}")
    unsynced.put_nowait(node(), b"{}")
    await unsynced.synced_to()
    assert written == [([EVENT, EVENT], 0), ([EVENT, EVENT, COMMIT], 0)]
    assert unsynced.synced == 2
