"""The folder of a live queue: refused at the beginning, drained by one source, closed, and left behind or deleted."""

import asyncio
from pathlib import Path

import pytest

from pycrorm_async.errors import SpoolClosed, SpoolUnavailable
from pycrorm_async.queue import RecorderQueue, Spool
from pycrorm_async.queue.locks import FileLock
from pycrorm_async.settings import Settings
from tests.queue.factories import LONG_S, batch_of, drain, ended, lost, make, node, record, recover, started


async def test_closing_refuses_puts_syncs_drains_and_ends_with_an_empty_batch(tmp_path: Path) -> None:
    queue = make(tmp_path, settings=Settings(sync_interval_ms=3_600_000))
    queue.put_nowait(started(), b"{}")
    queue.put_nowait(node(), b"{}")
    queue.close()
    queue.close()
    with pytest.raises(SpoolClosed):
        queue.put_nowait(node(), b"{}")
    assert [each.position for each in await batch_of(queue, 1)] == [1]
    assert [each.position for each in await batch_of(queue, 1)] == [2]
    assert await batch_of(queue, 1) == []
    assert await batch_of(queue, 1) == []
    queue.release()


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


@pytest.mark.parametrize("deep", [False, True])
def test_a_spool_that_cannot_be_made_is_reported_in_one_clear_line(tmp_path: Path, deep: bool) -> None:
    blocking = tmp_path / "blocking"
    blocking.touch()
    with pytest.raises(SpoolUnavailable) as refused:
        make(blocking / "spool" if deep else blocking)
    assert str(blocking) in str(refused.value)
    assert "\n" not in str(refused.value)
