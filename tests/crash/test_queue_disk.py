"""A disk that fails: a later sync does not hide a failed one, and a full disk raises an error and no signal."""

import asyncio
import contextlib
import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import SpoolFull, SpoolUnavailable
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.settings import Settings
from tests.queue.factories import RECORDER, SMALL, drain, lost, make, node, record, recover, started

SLOW = Settings(
    sync_interval_ms=3_600_000,
    segment_bytes=SMALL.segment_bytes,
    spool_bytes_max=SMALL.spool_bytes_max,
    spool_reserve_bytes=SMALL.spool_reserve_bytes,
    record_bytes_max=SMALL.record_bytes_max,
)


def break_next_sync(queue: RecorderQueue) -> None:
    """Make the next sync of the current segment fail: its descriptor refers to a pipe, which cannot be synced."""
    read, write = os.pipe()
    os.dup2(write, queue._appender._current.descriptor)
    os.close(read)
    os.close(write)


async def test_a_failed_sync_refuses_all_records_but_those_synced_before(tmp_path: Path) -> None:
    queue = make(tmp_path, settings=SLOW)
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    queue.put_nowait(node(), b"not synced")
    break_next_sync(queue)
    waiters = [asyncio.ensure_future(queue.synced_to()) for _ in range(3)]
    for waiter in waiters:
        with pytest.raises(SpoolUnavailable, match="Invalid argument"):
            await waiter
    for _ in range(2):
        with pytest.raises(SpoolUnavailable, match="Invalid argument"):
            queue.put_nowait(node(), b"{}", reserved=True)
        with pytest.raises(SpoolUnavailable, match="Invalid argument"):
            await queue.synced_to()
    await queue.room()
    assert queue.block_until_room(1000.0)
    batch = await queue.get_batch(events_max=10, bytes_max=2**20, age_s_max=1000.0)
    assert batch == [record(1, started(), 1, b"{}")]
    await queue.acknowledge(1)
    for _ in range(2):
        with pytest.raises(SpoolUnavailable, match="Invalid argument"):
            await queue.get_batch(events_max=10, bytes_max=2**20, age_s_max=1000.0)
    assert (queue.written, queue.synced, queue.stored) == (2, 1, 1)
    queue.release()
    assert await recover(queue.folder) == [
        record(1, started(), 1, b"{}"),
        record(2, node(), 2, b"not synced"),
        lost(3, 1, 3),
    ]


async def test_a_sync_that_would_succeed_after_a_failed_one_does_not_hide_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = make(tmp_path, settings=SLOW)
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    queue.put_nowait(node(), b"dropped by the kernel")
    fdatasync, failures = os.fdatasync, [OSError(errno.EIO, os.strerror(errno.EIO))]

    def fail_once(descriptor: int) -> None:  # as Linux does: the next call does not report the lost pages
        if failures:
            queue.put_nowait(node(), b"put meanwhile")
            raise failures.pop()
        fdatasync(descriptor)

    monkeypatch.setattr(os, "fdatasync", fail_once)
    with pytest.raises(SpoolUnavailable, match="Input/output error"):
        await queue.synced_to()
    queue.release()  # the sync thread takes its last turn
    assert (queue.written, queue.synced) == (3, 1)


async def test_a_failed_sync_ends_the_wait_of_the_writer(tmp_path: Path) -> None:
    queue = make(tmp_path, settings=SLOW)
    waiting = asyncio.ensure_future(queue.get_batch(events_max=10, bytes_max=2**20, age_s_max=1000.0))
    await asyncio.sleep(0)
    queue.put_nowait(started(), b"{}")
    break_next_sync(queue)
    with pytest.raises(SpoolUnavailable):
        await queue.synced_to()
    with pytest.raises(SpoolUnavailable):
        await waiting
    queue.release()


@pytest.fixture(params=["mounted", "simulated"])
def small_disk(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A disk of 256 KiB: a mounted one, and a simulated one for machines that do not permit a mount."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)]
    if request.param == "mounted" and subprocess.run(mount, capture_output=True, check=False).returncode == 0:
        yield disk
        subprocess.run(["umount", str(disk)], check=True)
        return
    allocate = os.posix_fallocate

    def used_bytes() -> int:
        while True:  # the other thread may rename a file during the count
            with contextlib.suppress(FileNotFoundError):
                sizes, again = ({path: path.stat().st_size for path in disk.rglob("*")} for _ in range(2))
                if sizes == again:
                    return sum(sizes.values())

    def allocate_on_a_small_disk(descriptor: int, offset: int, size: int) -> None:
        if used_bytes() + size > 2**18:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        allocate(descriptor, offset, size)

    monkeypatch.setattr(os, "posix_fallocate", allocate_on_a_small_disk)
    yield disk


ON_A_SMALL_DISK = Settings(
    sync_interval_ms=5, segment_bytes=2**15, spool_bytes_max=2**30, spool_reserve_bytes=2**16, record_bytes_max=2**12
)


async def test_a_full_disk_is_reported_as_a_full_spool_and_recording_resumes_when_there_is_space(
    small_disk: Path,
) -> None:
    queue = RecorderQueue.create(small_disk / "spool", settings=ON_A_SMALL_DISK, clock=SYSTEM_CLOCK, recorder=RECORDER)
    queue.put_nowait(started(), b"{}")
    put = 1
    with contextlib.suppress(SpoolFull):
        while True:
            put = queue.put_nowait(node(), b"x" * 1000, reserved=True)
    with pytest.raises(SpoolFull, match="No space left on device"):  # the disk is full and the spool is not
        queue.put_nowait(node(), b"x" * 1000, reserved=True)
    assert queue.full
    assert put > 150
    assert queue.block_until_room(0.02) is False
    await queue.synced_to()
    records = await queue.get_batch(events_max=10_000, bytes_max=2**22, age_s_max=0.0)
    assert [each.sequence for each in records] == list(range(1, put + 1))
    await queue.acknowledge(put)
    assert await asyncio.to_thread(queue.block_until_room, 30.0)
    await asyncio.wait_for(queue.room(), 30)
    assert queue.put_nowait(node(), b"x" * 1000) == put + 1
    queue.close()
    assert [each.sequence for each in await drain(queue)] == [put + 1]
    queue.release()


def test_a_queue_that_does_not_fit_on_the_disk_is_refused_in_one_line_and_leaves_no_files(small_disk: Path) -> None:
    with pytest.raises(SpoolUnavailable, match="No space left on device") as refused:
        RecorderQueue.create(
            small_disk / "spool",
            settings=Settings(segment_bytes=2**20, record_bytes_max=2**12),
            clock=SYSTEM_CLOCK,
            recorder=RECORDER,
        )
    assert "\n" not in str(refused.value)
    assert list((small_disk / "spool").iterdir()) == []
