"""Blobs in a recorder's folder, on real files: synced before the records that refer to them, kept as long as those."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import msgspec
import pytest

from pycrorm_async.errors import SpoolClosed, SpoolFull, SpoolUnavailable
from pycrorm_async.events.codec import Heading
from pycrorm_async.queue import RecorderQueue, Spool
from pycrorm_async.queue.blobs import blob_files, read_blob
from pycrorm_async.queue.format import Segment
from pycrorm_async.queue.maintenance import inspect_spool, repair_folder
from pycrorm_async.queue.stored_segments import kept_segments
from tests.queue.factories import (
    RECORDER,
    SMALL,
    crashed_copy,
    drain,
    ended,
    episode,
    eventually,
    make,
    node,
    opened_dead,
    overwrite,
    started,
)

OBSERVED = Heading(episode(1), "Observed", 1)
IMAGE = b"an image"
NAME = sha256(IMAGE).hexdigest()
ROOMY = replace(SMALL, spool_bytes_max=64 * SMALL.segment_bytes)


def referring(name: str = NAME, size: int = len(IMAGE)) -> bytes:
    return msgspec.json.encode({"name": "camera", "values": {"$blob": name, "media_type": "image/png", "size": size}})


def put_referring(queue: RecorderQueue, content: bytes = IMAGE) -> str:
    name = queue.put_blob(content)
    queue.put_nowait(OBSERVED, referring(name, len(content)))
    queue.release_blob(name)
    return name


@pytest.fixture
def bound(spool: Path) -> Path:
    Spool(spool).bind("a-log")
    return spool


async def test_a_blob_is_on_the_disk_before_the_commit_frame_of_the_record_that_refers_to_it(
    unsynced: RecorderQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    fsync, append_commit = os.fsync, Segment.sync

    def watched_fsync(descriptor: int) -> None:
        fsync(descriptor)
        order.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)

    def watched_sync(segment: Segment) -> None:
        append_commit(segment)
        order.append("segment")

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(Segment, "sync", watched_sync)
    unsynced.put_nowait(started(), b"{}")
    put_referring(unsynced)
    assert NAME not in order, "the plan's thread must not wait for the disk"
    await unsynced.synced_to()
    last_sync = len(order) - 1 - order[::-1].index("segment")
    assert order.index(NAME) < last_sync
    assert order.index("blobs") < last_sync


async def test_equal_contents_are_one_file_and_release_frees_their_space(bound: Path) -> None:
    queue = make(bound)
    queue.put_nowait(started(), b"{}")
    before = queue.bytes_spooled
    for _ in range(3):
        put_referring(queue)
    assert [each.name for each in blob_files(queue.folder)] == [NAME]
    assert blob_files(queue.folder)[0].read_bytes() == IMAGE
    assert queue._appender.blob_bytes == 4096
    assert queue.bytes_spooled > before + 4096
    queue.put_nowait(ended(), b"{}")
    queue.close()
    records = await drain(queue)
    await queue.acknowledge(records[-1].position)
    queue.release()
    (segment,) = kept_segments(bound)
    kept = segment.path.with_name("00000001.segment.blobs") / NAME
    assert kept.read_bytes() == IMAGE
    assert not (bound / RECORDER.hex()).exists()
    assert read_blob(bound, NAME) == IMAGE


async def test_a_blob_leaves_with_the_last_segment_that_refers_to_it_and_not_before(bound: Path) -> None:
    queue = make(bound, settings=replace(ROOMY, sync_interval_ms=60_000))
    queue.put_nowait(started(), b"{}")
    put_referring(queue)
    for _ in range(9):
        queue.put_nowait(node(), b"n" * 900)
    held = queue.put_blob(b"held")
    put_referring(queue)  # again, in a later segment
    for _ in range(9):
        queue.put_nowait(node(), b"n" * 900)
    await queue.synced_to()
    records = await queue.get_batch(events_max=5, bytes_max=2**20, age_s_max=0.0)
    await queue.acknowledge(records[-1].position)
    await eventually(lambda: len(kept_segments(bound)) == 1)
    assert {each.name for each in blob_files(queue.folder)} == {NAME, held}
    records = await queue.get_batch(events_max=100, bytes_max=2**20, age_s_max=0.0)
    await queue.acknowledge(records[-1].position)
    await eventually(lambda: [each.name for each in blob_files(queue.folder)] == [held])
    kept = [each.path for each in kept_segments(bound)]
    assert [path for path in kept if (path.with_name(f"{path.name}.blobs") / NAME).exists()] == kept[-1:]
    queue.put_nowait(ended(), b"{}")
    queue.release()


async def test_kept_blobs_count_and_are_deleted_with_their_segment(bound: Path) -> None:
    content = os.urandom(3 * 4096)
    queue = make(bound, settings=replace(ROOMY, keep_stored_bytes=6 * 4096))
    for number in (1, 2):
        queue.put_nowait(started(number), b"{}")
    name = put_referring(queue, content)
    for number in (1, 2):
        queue.put_nowait(ended(number), b"{}")
    queue.close()
    records = await drain(queue)
    await queue.acknowledge(records[-1].position)
    queue.release()
    (segment,) = kept_segments(bound)
    assert segment.bytes == 4 * 4096
    assert read_blob(bound, name) == content
    queue._stored_segments.make_room(1)
    assert kept_segments(bound) == []
    assert list((bound / "stored").rglob("*.blobs")) == []
    assert read_blob(bound, name) is None


def test_a_blob_that_does_not_fit_beside_the_reserve_is_refused_at_once_and_leaves_no_file(
    queue: RecorderQueue,
) -> None:
    queue.put_nowait(started(), b"{}")
    with pytest.raises(SpoolFull, match="spool_bytes_max is reached"):
        queue.put_blob(bytes(6 * 4096))
    assert list((queue.folder / "blobs").iterdir() if (queue.folder / "blobs").exists() else []) == []
    assert queue._appender.blob_bytes == 0
    queue.put_blob(bytes(3 * 4096))
    with pytest.raises(SpoolFull):
        for _ in range(100):
            queue.put_nowait(node(), b"n" * 900)
    segments = queue._appender.begun
    assert (len(segments) + 3) * 4096 <= SMALL.spool_bytes_max


def test_a_full_disk_refuses_a_blob_and_nothing_else(queue: RecorderQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    queue.put_nowait(started(), b"{}")

    def full(descriptor: int, offset: int, size: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(SpoolUnavailable, match="No space left"):
        queue.put_blob(IMAGE)
    monkeypatch.undo()
    assert list((queue.folder / "blobs").iterdir()) == []
    assert queue._appender.blob_bytes == 0
    put_referring(queue)


def test_a_closed_queue_refuses_blobs(queue: RecorderQueue) -> None:
    queue.close()
    with pytest.raises(SpoolClosed):
        queue.put_blob(IMAGE)


async def test_a_killed_recorders_blobs_are_kept_with_its_last_segment(bound: Path, tmp_path: Path) -> None:
    queue = make(bound)
    queue.put_nowait(started(), b"{}")
    put_referring(queue)
    left = crashed_copy(queue, tmp_path / "left")
    queue.put_nowait(ended(), b"{}")
    queue.release()
    source = opened_dead(left, stored=queue._stored_segments)
    records = await drain(source)
    assert [each.type for each in records] == ["EpisodeStarted", "Observed", "EpisodeEnded"]
    assert read_blob(left.parent, NAME) == IMAGE
    await source.acknowledge(records[-1].position)
    source.release()
    assert not left.exists()


@pytest.mark.parametrize("spoiled", ["missing", "empty", "zeros", "none"])
async def test_an_unsynced_record_whose_blob_a_power_cut_took_belongs_to_the_torn_tail(
    unsynced: RecorderQueue, tmp_path: Path, spoiled: str
) -> None:
    unsynced.put_nowait(started(), b"{}")
    await unsynced.synced_to()
    unsynced.put_nowait(node(), b"{}")
    put_referring(unsynced)
    unsynced.put_nowait(node(), b"{}")
    left = crashed_copy(unsynced, tmp_path / "left")
    blob = left / "blobs" / NAME
    if spoiled == "missing":
        blob.unlink()
    elif spoiled == "empty":
        blob.write_bytes(b"")
    elif spoiled == "zeros":
        blob.write_bytes(bytes(len(IMAGE)))
    source = opened_dead(left)
    types = [each.type for each in await drain(source)]
    source.release()
    whole = ["EpisodeStarted", "NodeStarted", "Observed", "NodeStarted", "EpisodeEnded"]
    assert types == (whole if spoiled == "none" else ["EpisodeStarted", "NodeStarted", "EpisodeEnded"])
    assert (left / "00000001.segment.tail").exists() is (spoiled != "none")


async def test_a_synced_record_stays_although_its_blob_was_deleted(unsynced: RecorderQueue, tmp_path: Path) -> None:
    unsynced.put_nowait(started(), b"{}")
    put_referring(unsynced)
    await unsynced.synced_to()
    left = crashed_copy(unsynced, tmp_path / "left")
    (left / "blobs" / NAME).unlink()
    source = opened_dead(left)
    assert [each.type for each in await drain(source)] == ["EpisodeStarted", "Observed", "EpisodeEnded"]
    source.release()


async def test_a_blob_that_is_deleted_before_its_sync_ends_the_queue(unsynced: RecorderQueue) -> None:
    unsynced.put_nowait(started(), b"{}")
    await unsynced.synced_to()
    put_referring(unsynced)
    (unsynced.folder / "blobs" / NAME).unlink()
    with pytest.raises(SpoolUnavailable, match="No such file"):
        await unsynced.synced_to()
    assert unsynced.synced == 1


async def test_a_repaired_folder_and_the_damaged_one_both_have_the_blobs(spool: Path, tmp_path: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    put_referring(queue)
    await queue.synced_to()
    left = crashed_copy(queue, tmp_path / "left")
    queue.put_nowait(ended(), b"{}")
    queue.release()
    overwrite(left / "00000001.segment", 56 + 20, b"!")
    report = repair_folder(left)
    assert report is not None
    assert (left / "blobs" / NAME).read_bytes() == IMAGE
    assert (Path(report.set_aside) / "blobs" / NAME).read_bytes() == IMAGE


async def test_a_report_counts_blobs_and_finds_nothing_foreign(queue: RecorderQueue, spool: Path) -> None:
    Spool(spool).bind("a-log")
    queue.put_nowait(started(), b"{}")
    before = inspect_spool(spool).recorders[0].bytes_spooled
    put_referring(queue)
    (recorder,) = inspect_spool(spool).recorders
    assert recorder.foreign == ()
    assert recorder.blobs == 1
    assert recorder.bytes_spooled == before + len(IMAGE)
