"""Drain a live recorder's folder in another process, once and in order, until the recorder ends."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from pycrorm_async.errors import SpoolDamaged, SpoolFull, SpoolStuck, SpoolUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.queue import LiveSource, RecorderQueue, Spool, open_dead
from pycrorm_async.queue.format import segment_path, segments_in
from pycrorm_async.queue.locks import ALIVE, FileLock
from pycrorm_async.queue.spool import DrainStatus, Progress, RecorderStatus
from tests.queue.factories import (
    ALL,
    ORDINARY,
    PAYLOAD,
    SMALL,
    crashed_copy,
    drain,
    ended,
    episode,
    eventually,
    fill,
    lost,
    make,
    next_positions,
    node,
    opened_dead,
    overwrite,
    record,
    recover,
    started,
    take,
)

# === live source ==============================================================================================
#
# Drain a live recorder's folder in another process: all synced records, once, in order, and nothing deleted early.


def segments(queue: RecorderQueue) -> list[str]:
    return sorted(path.name for path in queue.folder.glob("*.segment"))


# --- supplied records -------------------------------------------------------------------------------------------------


async def test_records_that_are_not_synced_are_not_supplied(spool: Path) -> None:
    queue = make(spool, settings=replace(SMALL, sync_interval_ms=3_600_000), offered=True)
    source = take(queue)
    queue.put_nowait(started(), b"{}")
    waiting = asyncio.ensure_future(next_positions(source))
    await asyncio.sleep(0.1)
    assert not waiting.done()
    await queue.synced_to()
    assert await waiting == [1]
    source.release()
    queue.release()


# --- permission to drain ----------------------------------------------------------------------------------------------


async def test_a_folder_is_drained_by_one_source_only(offered: RecorderQueue) -> None:
    assert not offered.is_drained
    source = take(offered)
    assert offered.is_drained
    assert LiveSource.take(offered.folder) is None
    source.release()
    source.release()
    assert not offered.is_drained
    take(offered).release()


async def test_a_queue_that_its_own_process_drains_is_not_taken(queue: RecorderQueue) -> None:
    assert LiveSource.take(queue.folder) is None
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    assert LiveSource.take(queue.folder) is None
    assert len(await queue.get_batch(events_max=10, bytes_max=2**20, age_s_max=0.0)) == 1
    assert queue.external_drain_status is None
    assert queue.is_drained


@pytest.mark.parametrize("size", [0, 4095])
async def test_a_folder_whose_progress_file_is_missing_or_short_is_not_taken(offered: RecorderQueue, size: int) -> None:
    os.truncate(offered.folder / "progress", size)
    assert LiveSource.take(offered.folder) is None
    (offered.folder / "progress").unlink()
    assert LiveSource.take(offered.folder) is None
    assert not offered.is_drained


async def test_a_deleted_folder_is_neither_taken_nor_made_again(spool: Path) -> None:
    queue = make(spool, offered=True)
    queue.release()
    assert LiveSource.take(queue.folder) is None
    assert not queue.folder.exists()


# --- stored records ---------------------------------------------------------------------------------------------------


async def test_a_full_spool_that_another_process_drains_wakes_the_producers(offered: RecorderQueue) -> None:
    offered.put_nowait(started(), b"{}")
    assert fill(offered) == ORDINARY
    assert fill(offered, reserved=True) == ALL - ORDINARY
    waiting = asyncio.ensure_future(offered.room())
    blocked = threading.Thread(target=offered.block_until_room, args=(60.0,))
    blocked.start()
    await asyncio.sleep(0.15)
    assert not waiting.done()
    source = take(offered)
    positions = await next_positions(source)
    await source.acknowledge(positions[-1])
    await asyncio.wait_for(waiting, 30)
    await asyncio.to_thread(blocked.join, 30)
    assert not blocked.is_alive()
    assert offered.put_nowait(node(), PAYLOAD) == 2 + ALL
    source.release()


async def test_a_waiting_producer_learns_why_nothing_more_is_stored_and_waits_again_for_the_next_drainer(
    offered: RecorderQueue,
) -> None:
    offered.put_nowait(started(), b"{}")
    fill(offered)
    source = take(offered)
    waiting = asyncio.ensure_future(offered.room())
    await asyncio.sleep(0.1)
    source.fail("the episode was refused")
    source.fail("a second reason")
    with pytest.raises(SpoolStuck, match="cannot be emptied: the episode was refused"):
        await asyncio.wait_for(waiting, 30)
    source.release()
    source = take(offered)
    waiting = asyncio.ensure_future(offered.room())
    await eventually(lambda: offered._appender.stuck is None)
    positions = await next_positions(source)
    await source.acknowledge(positions[-1])
    with contextlib.suppress(SpoolStuck):  # it may have begun to wait before it saw the new drainer
        await asyncio.wait_for(waiting, 30)
    await asyncio.wait_for(offered.room(), 30)
    source.release()


async def test_a_folder_whose_stored_segments_are_deleted_meanwhile_is_no_damage_and_is_taken_again(
    spool: Path, tmp_path: Path
) -> None:
    """The recorder deletes the oldest segments while the next drainer reads the first one."""
    queue = make(spool, offered=True)
    for number in range(60):
        queue.put_nowait(started() if not number else node(), b"x" * 200)
    await queue.synced_to()
    folder = crashed_copy(queue, tmp_path / "other")  # no recorder deletes anything here by itself
    queue.release()
    alive, numbers = FileLock.take(folder / ALIVE), list(segments_in(folder))
    assert alive is not None
    assert len(numbers) > 4

    def take_again() -> LiveSource:
        source = LiveSource.take(folder)
        assert source is not None
        return source

    source = take_again()
    assert await next_positions(source, events_max=1) == [1]
    for each in numbers[:2]:
        segment_path(folder, each).unlink()
    with pytest.raises(SpoolUnavailable, match="No such file"):
        await next_positions(source, events_max=100)
    source.release()
    source = take_again()
    assert (await next_positions(source, events_max=100))[-1] == 60
    source.release()
    segment_path(folder, numbers[3]).unlink()  # an older one is still there
    source = take_again()
    with pytest.raises(SpoolDamaged, match="is missing"):
        await next_positions(source, events_max=100)
    source.release()
    alive.release()


async def test_impossible_progress_is_ignored(offered: RecorderQueue) -> None:
    offered.put_nowait(started(), b"{}")
    await offered.synced_to()
    lying = Progress.open(offered.folder, writing=True)
    assert lying is not None
    lying.write_drain_status(DrainStatus(stored=2, folded=2))
    assert (offered.stored, offered.external_drain_status) == (0, DrainStatus())
    lying.write_drain_status(DrainStatus(stored=1, folded=1))
    assert (offered.stored, offered.external_drain_status) == (1, DrainStatus(1, 1))
    source = take(offered)
    lying.write_recorder_status(RecorderStatus(synced=9))
    with pytest.raises(SpoolDamaged, match="position 2 is missing"):
        await next_positions(source)
    source.release()
    lying.close()


# === live source end ==========================================================================================
#
# Draining a live recorder's folder ends when the recorder closes, is released, is killed or forks.

ROOT = Path(__file__).parents[2]


async def test_a_closed_queue_ends_and_deletes_itself_when_all_is_stored(spool: Path) -> None:
    queue = make(spool, offered=True)
    source = take(queue)
    queue.put_nowait(started(), b"{}")
    queue.put_nowait(ended(), b"{}")
    queue.close()
    assert [each.sequence for each in await drain(source)] == [1, 2]
    await source.acknowledge(2)
    await eventually(lambda: queue.stored == 2)
    assert LiveSource.take(queue.folder) is None
    queue.release()
    assert not queue.folder.exists()
    source.mark_visible(2, {})  # written to a deleted file, which harms no process
    source.release()


async def test_a_queue_that_is_released_before_all_is_stored_leaves_a_dead_folder(spool: Path) -> None:
    queue = make(spool, offered=True)
    source = take(queue)
    queue.put_nowait(started(), b"{}")
    queue.put_nowait(ended(), b"{}")
    await queue.synced_to()
    assert await next_positions(source, events_max=1) == [1]
    await source.acknowledge(1)
    queue.release()
    async with asyncio.timeout(30):
        while await source.get_batch(events_max=1, bytes_max=2**20, age_s_max=0.0):
            pass
    assert open_dead(queue.folder) is None  # while the source holds the folder
    source.release()
    assert LiveSource.take(queue.folder) is None
    assert await recover(queue.folder) == [record(1, started(), 1, b"{}"), record(2, ended(), 2, b"{}")]


async def test_recovery_ignores_and_deletes_the_progress_file(spool: Path) -> None:
    queue = make(spool, offered=True)
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    queue.release()
    overwrite(queue.folder / "progress", 128, b"\xff" * 64)
    recovered = opened_dead(queue.folder)
    assert await drain(recovered) == [record(1, started(), 1, b"{}"), lost(2, 1, 2)]
    await recovered.acknowledge(2)
    recovered.release()
    assert not queue.folder.exists()


async def test_a_recorder_killed_while_it_is_drained_ends_the_source_and_recovery_supplies_all_again(
    spool: Path,
) -> None:
    script = (
        "import sys, threading\n"
        "from pathlib import Path\n"
        "from tests.queue.factories import make, node, started\n"
        "queue = make(Path(sys.argv[1]), offered=True)\n"
        "queue.put_nowait(started(), b'{}')\n"
        "for number in range(10):\n"
        "    queue.put_nowait(node(), b'%d' % number)\n"
        "print('put', flush=True)\n"
        "threading.Event().wait()\n"
    )
    process = subprocess.Popen(  # noqa: ASYNC220
        [sys.executable, "-c", script, str(spool)], stdout=subprocess.PIPE, cwd=ROOT
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"put\n"
        (folder,) = Spool(spool).recorders()
        source = LiveSource.take(folder.path)
        assert source is not None
        supplied: list[Record] = []
        while len(supplied) < 11:
            supplied += await source.get_batch(events_max=4, bytes_max=2**20, age_s_max=0.0)
        await source.acknowledge(6)
        waiting = asyncio.ensure_future(next_positions(source))
        await asyncio.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        assert await waiting == []
        assert not source.is_alive
        source.release()
    assert supplied[0].episode == episode(1)
    assert await recover(folder.path) == [*supplied, lost(12, 1, 12)]


async def test_a_forked_child_writes_nothing_in_the_name_of_its_parent(offered: RecorderQueue) -> None:
    source = take(offered)
    offered.put_nowait(started(), b"{}")
    await offered.synced_to()
    child = os.fork()
    if child == 0:
        offered.close()
        offered.release()
        os._exit(0)
    os.waitpid(child, 0)  # noqa: ASYNC222
    assert source._progress.recorded() == RecorderStatus(1, closed=False)
    assert await next_positions(source) == [1]
    with contextlib.suppress(SpoolFull):
        offered.put_nowait(ended(), b"{}")
    assert await next_positions(source) == [2]
    source.release()
