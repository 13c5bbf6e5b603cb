"""Dead recorders' folders: whole records are supplied, stored segments deleted, lost synced ones are damage."""

import asyncio
import errno
import os
import shutil
import threading
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import pytest

from pycrorm_async.errors import SpoolDamaged, SpoolForeign, SpoolUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import episode_id, episode_text
from pycrorm_async.queue import Spool, open_dead
from pycrorm_async.queue.format import CHECKSUM, EVENT, Frame, encode, salt_of, segments_in
from pycrorm_async.queue.locks import FileLock
from pycrorm_async.queue.maintenance import repair_folder
from pycrorm_async.queue.scan import scan, seal, sync_segments, tails
from tests.queue.factories import (
    DECLARED,
    RECORDER,
    WALL_NS,
    FolderWriter,
    drain,
    ended,
    episode,
    lost,
    make,
    node,
    opened_dead,
    overwrite,
    recover,
    second_frame,
    started,
)

# === dead source ==============================================================================================
#
# Dead recorders' folders: whole records are supplied, torn ones are ignored, and lost synced ones are damage.


async def test_records_come_back_in_order_and_open_episodes_end_lost_in_the_order_of_their_ids(
    author: FolderWriter,
) -> None:
    for heading in (DECLARED, started(2), started(1), started(3), node(1), ended(3), node(1)):
        author.put(heading, heading.type.encode())
    assert await recover(author.folder) == [*author.records, lost(8, 1, 4), lost(9, 2, 2)]


async def test_recovering_twice_supplies_the_same_records_and_writes_nothing(author: FolderWriter) -> None:
    author.put(started())
    author.sync()
    author.put(node(), b"unsynced")
    before = author.segments[0].read_bytes()
    assert await recover(author.folder) == await recover(author.folder) == [*author.records, lost(3, 1, 3)]
    assert author.segments[0].read_bytes() == before
    assert sorted(path.name for path in author.folder.iterdir()) == ["00000001.segment", "alive", "drain"]


async def test_a_recorder_that_recorded_nothing_leaves_no_folder(author: FolderWriter) -> None:
    recovered = opened_dead(author.folder)
    assert await drain(recovered) == []
    assert (recovered.all_stored, recovered.stored, recovered.lost) == (True, 0, ())
    recovered.release()
    assert not author.folder.exists()


def test_the_folder_of_a_recorder_that_is_alive_or_drained_is_not_opened(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    assert open_dead(queue.folder) is None
    queue.release()
    draining = FileLock.take(queue.folder / "drain")
    assert draining is not None
    assert open_dead(queue.folder) is None
    draining.release()
    first = opened_dead(queue.folder)
    assert open_dead(queue.folder) is None
    first.release()
    again = opened_dead(queue.folder)
    again.release()
    assert open_dead(spool / "gone") is None


# --- torn ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("filling", [b"\0", b"\xff", b"\x01"])
async def test_a_tail_torn_at_any_unsynced_byte_keeps_all_whole_records_before_it(
    author: FolderWriter, filling: bytes
) -> None:
    author.put(started())
    author.put(node(), b"synced")
    author.sync()
    safe_end = author.end
    for payload in (b"", b"x", b"12345678901234567890"):
        author.put(node(), payload)
    path, whole = author.segments[0], author.segments[0].read_bytes()
    for cut in range(safe_end, author.end + 1):
        path.write_bytes(whole[:cut] + filling * (len(whole) - cut))
        result = sum(1 for _, offset, size in author.places if torn_end(whole, offset, size, filling) <= cut)
        assert result >= 2
        assert await recover(author.folder) == [*author.records[:result], lost(result + 1, 1, result + 1)], cut


def torn_end(whole: bytes, offset: int, size: int, filling: bytes) -> int:
    """The end of a record here: after the last byte that differs from the zeros that fill the file."""
    return offset + len(whole[offset : offset + size].rstrip(filling))


@pytest.mark.parametrize(
    ("unsynced", "missing", "kept"),
    [(["{}", "never reached the disk", "did"], 1, 1), (["x" * 900] * 5, 2, 2), (["x" * 900] * 4, "header", 4)],
    ids=["a record before another", "the end of a segment before the next", "the header of a segment"],
)
async def test_what_no_sync_covers_may_be_missing_before_what_reached_the_disk(
    author: FolderWriter, unsynced: list[str], missing: int | str, kept: int
) -> None:
    author.put(started())
    author.sync()
    for payload in unsynced:
        author.put(node(), payload.encode())
    path, offset, size = (author.segments[-1], 0, 96) if missing == "header" else author.places[int(missing)]
    overwrite(path, offset, bytes(size))
    assert await recover(author.folder) == [*author.records[:kept], lost(kept + 1, 1, kept + 1)]
    assert any(tail for _, tail in tails(author.folder, scan(author.folder, RECORDER)))


async def test_a_record_of_another_file_that_reused_blocks_still_hold_is_not_read(author: FolderWriter) -> None:
    author.put(started())
    author.sync()
    stale = second_frame(b"stale", salt=salt_of(episode_id(1, b"an elder.."), 1))
    overwrite(author.segments[0], author.end, stale)
    assert await recover(author.folder) == [author.records[0], lost(2, 1, 2)]
    ours = stale[:56] + CHECKSUM.pack(salt_of(RECORDER, 1)) + stale[60:]
    overwrite(author.segments[0], author.end, ours)  # the checksum covers the salt
    assert await recover(author.folder) == [author.records[0], lost(2, 1, 2)]


# --- damaged ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_any_one_bit_flipped_is_damage_where_it_was_synced_and_never_costs_a_synced_record(
    author: FolderWriter,
) -> None:
    author.put(started())
    author.put(node(), b"ab")
    author.sync()
    safe_end = author.end
    author.put(node(), b"unsynced")
    path, whole = author.segments[0], author.segments[0].read_bytes()
    for bit in range((author.end + 64) * 8):
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        if bit // 8 < safe_end - 72:
            with pytest.raises((SpoolDamaged, SpoolForeign)):
                scan(author.folder, RECORDER)
        else:
            assert scan(author.folder, RECORDER).cut.position == (2 if bit // 8 < author.end else 3), bit


async def test_damage_is_reported_with_file_and_offset_and_changes_nothing(author: FolderWriter) -> None:
    for heading in (started(), node(), node()):
        author.put(heading)
    author.sync()
    path, offset, _ = author.places[1]
    overwrite(path, offset + 70, b"#")
    before = path.read_bytes()
    with pytest.raises(SpoolDamaged) as damage:
        open_dead(author.folder)
    assert (damage.value.path, damage.value.offset) == (path, offset)
    assert "position 2 is missing" in damage.value.reason
    assert "covers all records up to position 3" in damage.value.reason
    assert path.read_bytes() == before
    assert [each.alive for each in Spool(author.folder.parent).recorders()] == [False]


def change_a_record(author: FolderWriter) -> None:
    overwrite(author.places[1][0], author.places[1][1], second_frame(b"x" * 899 + b"y"))


DAMAGES: dict[str, Callable[[FolderWriter], None]] = {
    "position 4 is missing, although the commit frame": lambda author: overwrite(*author.places[3][:2], b"\0"),
    "position 5 is missing": lambda author: author.segments[1].unlink(),
    "differ from those that were synced": change_a_record,
    "event 13 of episode": lambda author: overwrite(
        author.segments[-1],
        author.end,
        encode(Frame(EVENT, 1, 11, 13, WALL_NS, 1, episode(1), b"NodeStarted", b"{}"), salt_of(RECORDER, 3)),
    ),
}


@pytest.mark.parametrize("reason", DAMAGES)
def test_what_no_power_cut_leaves_is_damage_with_its_reason(author: FolderWriter, reason: str) -> None:
    author.put(started())
    for _ in range(9):
        author.put(node(), b"x" * 900)
    author.sync()
    assert len(author.segments) == 3
    DAMAGES[reason](author)
    with pytest.raises(SpoolDamaged, match=reason):
        open_dead(author.folder, check=True)


def test_an_unreadable_header_is_damage_when_the_segments_before_it_are_deleted(author: FolderWriter) -> None:
    author.put(started())
    for _ in range(4):
        author.put(node(), b"x" * 900)
    author.segments[0].unlink()
    overwrite(author.segments[1], 60, b"#")
    with pytest.raises(SpoolDamaged, match="header is unreadable"):
        open_dead(author.folder)


# --- foreign ---------------------------------------------------------------------------------------------------


def test_a_newer_format_is_refused_by_name(author: FolderWriter) -> None:
    author.put(started())
    overwrite(author.segments[0], 8, b"\x02")
    with pytest.raises(SpoolForeign, match=r"1\.segment is in format 2 of a newer program; this one reads format 1"):
        open_dead(author.folder)


def test_a_segment_of_another_recorder_is_refused_by_name(author: FolderWriter, tmp_path: Path) -> None:
    author.put(started())
    other = author.folder.with_name(episode_text(episode_id(1, b"an elder..")))
    author.folder.rename(other)
    with pytest.raises(SpoolForeign, match=f"is segment 1 of recorder {episode_text(RECORDER)}"):
        open_dead(other)


async def test_foreign_files_in_a_folder_are_never_deleted(author: FolderWriter) -> None:
    author.put(started())
    (author.folder / "notes.txt").write_text("mine")
    recovered = opened_dead(author.folder)
    assert await drain(recovered) == [author.records[0], lost(2, 1, 2)]
    await recovered.acknowledge(2)
    recovered.release()
    assert [path.name for path in author.folder.iterdir()] == ["notes.txt"]
    assert Spool(author.folder.parent).recorders() == []


async def test_a_disk_that_does_not_sync_a_dead_recorders_records_is_reported_before_any_is_supplied(
    author: FolderWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    for heading in (started(), *[node()] * 4):
        author.put(heading, b"x" * 900)
    synced: list[str] = []

    def full(descriptor: int) -> None:
        synced.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        if len(synced) == 2:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fdatasync", full)
    with pytest.raises(SpoolUnavailable, match="Input/output error"):
        open_dead(author.folder)
    assert synced == ["00000001.segment", "00000002.segment"]
    monkeypatch.undo()
    assert await recover(author.folder) == [*author.records, lost(6, 1, 6)]


# === dead source deletion =====================================================================================
#
# A dead recorder's stored segments are deleted and its torn tail is cut, wherever the process doing so is killed.

# --- acknowledging and deleting ---------------------------------------------------------------------------------------


def test_a_segment_may_be_deleted_only_when_the_header_after_it_is_synced(author: FolderWriter) -> None:
    author.put(started())
    for _ in range(4):
        author.put(node(), b"x" * 900)
    assert [each.number for each in author.appender.trimmable(stored=4, safe_number=1)] == []
    assert [each.number for each in author.appender.trimmable(stored=3, safe_number=2)] == []
    assert [each.number for each in author.appender.trimmable(stored=4, safe_number=2)] == [1]
    assert [each.number for each in author.appender.trimmable(stored=5, safe_number=2)] == [1]


async def test_after_stored_segments_are_deleted_the_next_header_yields_the_same_ends(author: FolderWriter) -> None:
    author.put(started(1))
    author.put(started(2))
    for _ in range(7):
        author.put(node(1), b"x" * 900)
    ends = [lost(10, 1, 9), lost(11, 2, 2)]
    assert len(author.segments) == 3
    recovered = opened_dead(author.folder)
    assert await drain(recovered) == [*author.records, *ends]
    left = [sum(1 for path, _, _ in author.places if path == segment) for segment in author.segments]
    for gone in range(3):
        await recovered.acknowledge(sum(left[:gone]))
        assert [path for path in author.segments if path.exists()] == author.segments[gone:]
        recovered.release()
        recovered = opened_dead(author.folder)
        assert await drain(recovered) == [*author.records[sum(left[:gone]) :], *ends]
    await recovered.acknowledge(11)
    assert author.segments[2].exists()
    recovered.release()
    assert not author.folder.exists()


async def test_a_commit_that_covers_only_stored_and_deleted_records_is_no_damage(author: FolderWriter) -> None:
    author.put(started(), b"x" * 900)
    author.put(node(), b"x" * 900)
    span = author.appender.begin_sync()
    author.put(node(), b"x" * 1700)
    for _ in range(4):
        author.put(node(), b"x" * 100)
    author.appender.append_commit(span)
    author.sync()
    assert [path for path, _, _ in author.places] == [author.segments[0]] * 3 + [author.segments[1]] * 4
    author.segments[0].unlink()
    assert await recover(author.folder) == [*author.records[3:], lost(8, 1, 8)]


async def test_the_end_of_an_episode_whose_records_are_all_deleted_has_the_times_of_its_last_record(
    author: FolderWriter,
) -> None:
    author.put(started())
    for _ in range(4):
        author.put(node(), b"x" * 900)
    author.segments[0].unlink()
    path, offset, size = author.places[4]
    overwrite(path, offset, bytes(size))
    assert await recover(author.folder) == [lost(5, 1, 5)]


async def test_a_deletion_killed_anywhere_leaves_the_same_records_or_nothing(author: FolderWriter) -> None:
    author.put(started())
    for _ in range(4):
        author.put(node(), b"x" * 900)
    whole = [*author.records, lost(6, 1, 6)]
    assert await recover(author.folder) == whole
    author.segments[0].unlink()
    assert await recover(author.folder) == whole[4:]
    author.segments[1].unlink()
    assert await recover(author.folder) == []
    assert not author.folder.exists()
    author.folder.mkdir()
    (author.folder / "alive").touch()
    assert await recover(author.folder) == []
    assert not author.folder.exists()
    author.folder.mkdir()
    assert Spool(author.folder.parent).recorders() == []


# --- sealing ---------------------------------------------------------------------------------------------------


async def test_sealing_copies_the_tail_aside_and_cuts_it_and_supplies_the_same_records_again(
    author: FolderWriter,
) -> None:
    author.put(started())
    author.sync()
    for _ in range(5):
        author.put(node(), b"x" * 900)
    path, offset, size = author.places[2]
    overwrite(path, offset, bytes(size))
    first, second = author.segments
    tails = [first.read_bytes()[offset:].rstrip(b"\0"), second.read_bytes().rstrip(b"\0")]
    for _ in range(2):
        seal(author.folder, scan(author.folder, RECORDER))
        assert await recover(author.folder) == [*author.records[:2], lost(3, 1, 3)]
        assert first.stat().st_size == offset
        assert not second.exists()
        assert [path.with_name(f"{path.name}.tail").read_bytes() for path in (first, second)] == tails


async def test_a_sealing_that_was_killed_anywhere_can_be_repeated(author: FolderWriter) -> None:
    author.put(started())
    author.put(node(), b"torn")
    path, offset, _ = author.places[1]
    overwrite(path, offset + 64, b"#")
    tail = path.read_bytes()[offset:].rstrip(b"\0")
    copy = path.with_name(f"{path.name}.tail")
    copy.with_name(f"{copy.name}.making").write_bytes(tail[:10])
    seal(author.folder, scan(author.folder, RECORDER))
    assert copy.read_bytes() == tail
    assert path.stat().st_size == offset
    assert await recover(author.folder) == [author.records[0], lost(2, 1, 2)]


# === dead source incremental ==================================================================================
#
# Records of a dead recorder are supplied while the rest of its folder is still being scanned, if that is safe.

RECORDS, SYNCED_EVERY, SEGMENTS = 20, 3, 4


def long_folder(
    spool: Path, *, synced: Collection[int] = range(0, RECORDS, SYNCED_EVERY), letter: bytes = b"x"
) -> FolderWriter:
    """A folder with a commit frame after every third record, across segments, and two records that were never
    synced.
    """
    author = FolderWriter(spool)
    author.put(started())
    for number in range(2, RECORDS + 1):
        author.put(node(), b'"%d %s"' % (number, letter * 600))
        if number in synced:
            author.sync()
    assert len(author.segments) == SEGMENTS
    return author


async def supplied_before_damage(folder: Path, *, events_max: int = 10_000) -> list[Record]:
    """Return all records that are supplied and acknowledged before the scan or the opening meets damage."""
    records: list[Record] = []
    try:
        recovered = open_dead(folder)
    except SpoolDamaged:
        return records
    assert recovered is not None
    try:
        with pytest.raises(SpoolDamaged):
            while True:
                batch = await recovered.get_batch(events_max=events_max, bytes_max=2**22, age_s_max=0.0)
                assert batch
                records += batch
                await recovered.acknowledge(batch[-1].position)
                assert not recovered.all_stored
        with pytest.raises(SpoolDamaged):  # the source repeats the error
            await recovered.get_batch(events_max=events_max, bytes_max=2**22, age_s_max=0.0)
        assert not recovered.lost
    finally:
        assert recovered.release() is None
    with pytest.raises(SpoolDamaged):
        open_dead(folder, check=True)
    return records


@pytest.mark.parametrize("events_max", [1, 100])
async def test_whole_files_are_supplied_and_deleted_before_the_scan_has_ended(spool: Path, events_max: int) -> None:
    author = long_folder(spool)
    recovered = opened_dead(author.folder)
    assert not recovered.lost
    records: list[Record] = []
    while batch := await recovered.get_batch(events_max=events_max, bytes_max=2**22, age_s_max=0.0):
        records += batch
        await recovered.acknowledge(batch[-1].position)
        begun = sum(path in {place[0] for place in author.places[len(records) :]} for path in author.segments)
        # Each file is deleted when the next one is in order and nothing in the file is needed; the last file stays.
        assert max(1, begun) <= len(segments_in(author.folder)) <= max(1, begun) + 1
        if events_max == 1 and len(records) == 10:
            assert (len(segments_in(author.folder)) < SEGMENTS, recovered.lost) == (True, ())
    assert records == [*author.records, lost(RECORDS + 1, 1, RECORDS + 1)]
    assert recovered.lost == (records[-1],)
    assert recovered.all_stored
    recovered.release()
    assert not author.folder.exists()


async def test_a_folder_is_not_deleted_while_the_thread_of_a_cancelled_task_syncs_its_last_records(
    spool: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    author = long_folder(spool)
    is_syncing, goes_on = threading.Event(), threading.Event()

    def sync_slowly(folder: Path, numbers: Sequence[int]) -> None:
        if numbers[0] == SEGMENTS:
            is_syncing.set()
            assert goes_on.wait(60)
        sync_segments(folder, numbers)

    monkeypatch.setattr("pycrorm_async.queue.scan.sync_segments", sync_slowly)
    recovered = opened_dead(author.folder)
    synced = max(range(0, RECORDS, SYNCED_EVERY))
    reading = asyncio.create_task(recovered.get_batch(events_max=synced, bytes_max=2**22, age_s_max=0.0))
    assert await asyncio.to_thread(is_syncing.wait, 60)
    reading.cancel()
    with pytest.raises(asyncio.CancelledError):
        await reading
    try:
        assert recovered.release() is None
        assert author.folder.exists()
    finally:
        goes_on.set()


@pytest.mark.parametrize("changed", range(RECORDS - RECORDS % SYNCED_EVERY))
async def test_a_damaged_folder_supplies_what_was_synced_before_the_damage(spool: Path, changed: int) -> None:
    events_max = 2 if changed % 2 else 10_000
    author = long_folder(spool)
    path, offset, _ = author.places[changed]
    overwrite(path, offset + 68, b"#")
    supplied = await supplied_before_damage(author.folder, events_max=events_max)
    safe = changed - changed % SYNCED_EVERY
    assert supplied == author.records[: len(supplied)]
    assert len(supplied) <= safe
    in_segments_before = [place[0] for place in author.places].index(path)
    assert (
        len(supplied) >= (in_segments_before - 1) // SYNCED_EVERY * SYNCED_EVERY
    )  # the commit frame is on the disk too
    again = await supplied_before_damage(author.folder)
    assert again == supplied[len(supplied) - len(again) :]  # only the deleted records are missing

    repair_folder(author.folder)
    repaired = await recover(author.folder)
    whole = supplied + [each for each in repaired if each.position > len(supplied)]
    assert whole[:-1] == author.records[:changed]  # an episode ends where the gap is
    assert whole[-1:] == ([lost(changed + 1, 1, changed + 1)] if changed else [])


@pytest.mark.parametrize("number", range(2, SEGMENTS + 1))
async def test_a_damaged_header_costs_nothing_although_the_files_before_it_were_deleted(
    spool: Path, number: int
) -> None:
    author = long_folder(spool)
    overwrite(author.segments[number - 1], 60, b"#")
    supplied = await supplied_before_damage(author.folder, events_max=2)
    assert supplied == author.records[: len(supplied)]
    assert len(segments_in(author.folder)) <= SEGMENTS - max(0, number - 3)
    report = repair_folder(author.folder)
    assert report is not None
    assert report.complete
    repaired = await recover(author.folder)
    whole = supplied + [each for each in repaired if each.position > len(supplied)]
    assert whole == [*author.records, lost(RECORDS + 1, 1, RECORDS + 1)]


@pytest.mark.parametrize("first", [0, 3])
async def test_records_that_a_later_commit_frame_contradicts_are_not_supplied(
    spool: Path, tmp_path: Path, first: int
) -> None:
    author = long_folder(spool, synced=[first, 18])
    other = long_folder(tmp_path / "other", synced=[first, 18], letter=b"y")
    shutil.copyfile(other.segments[1], author.segments[1])  # whole frames of the same recorder and segment
    assert await supplied_before_damage(author.folder) == author.records[:first]
