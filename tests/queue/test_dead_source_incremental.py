"""Records of a dead recorder are supplied while the rest of its folder is still being scanned, if that is safe."""

import shutil
from collections.abc import Collection
from pathlib import Path

import pytest

from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.codec import Record
from pycrorm_async.queue import open_dead
from pycrorm_async.queue.format import segment_numbers
from pycrorm_async.queue.maintenance import repair_folder
from tests.queue.factories import FolderWriter, lost, node, overwrite, recover, started

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


@pytest.mark.parametrize("events_max", [1, 2, 5, 100])
async def test_whole_files_are_supplied_and_deleted_before_the_scan_has_ended(spool: Path, events_max: int) -> None:
    author = long_folder(spool)
    recovered = open_dead(author.folder)
    assert recovered is not None
    assert not recovered.lost
    records: list[Record] = []
    while batch := await recovered.get_batch(events_max=events_max, bytes_max=2**22, age_s_max=0.0):
        records += batch
        await recovered.acknowledge(batch[-1].position)
        begun = sum(path in {place[0] for place in author.places[len(records) :]} for path in author.segments)
        # Each file is deleted when the next one is in order and nothing in the file is needed; the last file stays.
        assert max(1, begun) <= len(segment_numbers(author.folder)) <= max(1, begun) + 1
        if events_max == 1 and len(records) == 10:
            assert (len(segment_numbers(author.folder)) < SEGMENTS, recovered.lost) == (True, ())
    assert records == [*author.records, lost(RECORDS + 1, 1, RECORDS + 1)]
    assert recovered.lost == (records[-1],)
    assert recovered.all_stored
    recovered.release()
    assert not author.folder.exists()


@pytest.mark.parametrize("events_max", [2, 10_000])
@pytest.mark.parametrize("changed", range(RECORDS - RECORDS % SYNCED_EVERY))
async def test_a_damaged_folder_supplies_what_was_synced_before_the_damage(
    spool: Path, changed: int, events_max: int
) -> None:
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
    assert len(segment_numbers(author.folder)) <= SEGMENTS - max(0, number - 3)
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


async def test_the_next_source_supplies_again_what_was_not_deleted(spool: Path) -> None:
    author = long_folder(spool)
    for count in (3, 9):
        recovered = open_dead(author.folder)
        assert recovered is not None
        batch = await recovered.get_batch(events_max=count, bytes_max=2**22, age_s_max=0.0)
        await recovered.acknowledge(batch[-1].position)
        recovered.release()
        assert batch == author.records[:count]
    records = await recover(author.folder)
    assert records == [*author.records[records[0].position - 1 :], lost(RECORDS + 1, 1, RECORDS + 1)]
    assert 1 < records[0].position <= 10
