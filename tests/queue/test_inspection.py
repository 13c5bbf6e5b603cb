"""Inspection reports the content of a spool and changes nothing."""

import threading
from pathlib import Path

import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import RecorderQueue, Spool, open_dead
from pycrorm_async.queue.maintenance import OpenEpisode, inspect_spool, repair_folder
from pycrorm_async.settings import Settings
from tests.queue.factories import DECLARED, RECORDER, WALL_NS, FolderWriter, ended, episode, node, overwrite, started


def everything_in(folder: Path) -> dict[str, bytes | None]:
    return {str(path): path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


@pytest.fixture
def author(spool: Path) -> FolderWriter:
    return FolderWriter(spool)


def test_a_dead_recorders_folder_is_reported_whole_and_left_as_it_is(author: FolderWriter) -> None:
    spool = author.folder.parent
    Spool(spool).bind("the-log")
    for heading in (DECLARED, started(1), node(1), started(2), ended(1), node(2)):
        author.put(heading)
    author.sync()
    author.put(node(2), b"x" * 3400)
    author.put(node(2), b"torn")
    path, offset, size = author.places[-1]
    overwrite(path, offset, b"\0")
    before = everything_in(spool)
    report = inspect_spool(spool)
    assert everything_in(spool) == before
    assert (report.log_id, report.set_aside, report.strangers) == ("the-log", (), ())
    [one] = report.recorders
    assert (one.name, one.alive, one.being_drained) == (episode_text(RECORDER), False, False)
    assert (one.first, one.last, one.safe, one.records, one.episodes) == (1, 8, 6, 8, 2)
    assert one.types == {"DesignatorTypeDeclared": 2, "EpisodeEnded": 1, "EpisodeStarted": 2, "NodeStarted": 3}
    assert one.open == (OpenEpisode(episode_text(episode(2)), 3, WALL_NS),)
    assert [(each.file, each.bytes, each.base, each.records) for each in one.segments] == [
        ("00000001.segment", 4096, 1, 6),
        ("00000002.segment", 4096, 7, 2),
    ]
    assert one.tail_bytes == len(author.segments[1].read_bytes()[offset:].rstrip(b"\0"))
    assert 0 < one.tail_bytes <= size
    assert (one.damage, one.refused, one.foreign, one.cut_off) == (None, None, (), ())


def test_damage_is_reported_with_its_place_and_what_precedes_it(author: FolderWriter) -> None:
    for heading in (started(), node(), node()):
        author.put(heading)
    author.sync()
    path, offset, _ = author.places[1]
    overwrite(path, offset + 70, b"#")
    before = everything_in(author.folder)
    [one] = inspect_spool(author.folder.parent).recorders
    assert everything_in(author.folder) == before
    assert one.damage is not None
    assert (one.damage.file, one.damage.offset) == (str(path), offset)
    assert (one.first, one.last, one.records) == (1, 1, 1)
    repair_folder(author.folder)
    after = inspect_spool(author.folder.parent)
    assert after.set_aside == (f"{author.folder.name}.damaged",)
    assert (after.recorders[0].damage, after.strangers) == (None, ())


def test_the_holders_of_a_folder_are_reported(author: FolderWriter) -> None:
    author.put(started())
    recovered = open_dead(author.folder)
    assert recovered is not None
    [one] = inspect_spool(author.folder.parent).recorders
    assert (one.alive, one.being_drained) == (True, True)  # the drainer of a dead folder holds both locks
    recovered.release()
    [one] = inspect_spool(author.folder.parent).recorders
    assert (one.alive, one.being_drained) == (False, False)


async def test_a_live_recorder_that_writes_and_deletes_never_looks_damaged(spool: Path) -> None:
    settings = Settings(
        sync_interval_ms=1,
        segment_bytes=2**14,
        spool_bytes_max=2**26,
        spool_reserve_bytes=1,
        record_bytes_max=2**12,
    )
    queue = RecorderQueue.create(spool, settings=settings, clock=SYSTEM_CLOCK, recorder=RECORDER)
    queue.put_nowait(started(), b"{}")
    over = threading.Event()

    def put_without_end() -> None:
        size = 0
        while not over.is_set():
            size = (size + 101) % 900
            queue.put_nowait(node(), b"y" * size, reserved=True)
            over.wait(0.0002)

    thread = threading.Thread(target=put_without_end)
    thread.start()
    try:
        seen = []
        for _ in range(60):
            batch = await queue.get_batch(events_max=100, bytes_max=2**20, age_s_max=0.0)
            written_before = queue.written
            [one] = inspect_spool(spool).recorders
            assert (one.alive, one.damage, one.refused) == (True, None, None)
            assert one.last >= written_before
            seen.append(one.first)
            await queue.acknowledge(batch[-1].position)
    finally:
        over.set()
        thread.join()
    assert seen == sorted(seen)
    assert seen[-1] > 1  # the files were deleted meanwhile
    queue.close()
    queue.release()


# --- bad input --------------------------------------------------------------------------------------------------


def test_a_folder_that_is_no_spool_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "photo.jpg").touch()
    for name, reason in (
        ("none", "does not exist"),
        ("file", "is a file, not a folder"),
        ("folder", "is not a spool: it contains neither a recorder's folder nor the note of a database"),
    ):
        with pytest.raises(SpoolUnavailable, match=reason) as refused:
            inspect_spool(tmp_path / name)
        assert "\n" not in str(refused.value)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder", "photo.jpg"]


def test_a_foreign_file_and_a_foreign_recorder_are_named(author: FolderWriter) -> None:
    author.put(started())
    (author.folder / "notes.txt").touch()
    (author.folder / "00000001.segment.tail").touch()
    (author.folder.parent / "readme").touch()
    (author.folder.parent / "photos.damaged").mkdir()
    for name in ("01234567-0000-7000-8000-000000000000", "01234567-0000-7000-8000-000000000001.making"):
        (author.folder.parent / name).mkdir()
    report = inspect_spool(author.folder.parent)
    assert report.strangers == ("photos.damaged", "readme")
    assert [name[-8:] for name in report.unfinished] == ["00000000", "1.making"]
    assert report.recorders[0].foreign == ("notes.txt",)
    assert report.recorders[0].cut_off == ("00000001.segment.tail",)
    assert report.recorders[0].records == 1


def test_a_newer_format_and_an_unreadable_file_are_reported_beside_the_others(author: FolderWriter) -> None:
    author.put(started())
    overwrite(author.segments[0], 8, b"\x02")
    [one] = inspect_spool(author.folder.parent).recorders
    assert one.refused is not None
    assert one.refused.endswith("is in format 2 of a newer program; this one reads format 1")
    author.segments[0].unlink()
    author.segments[0].mkdir()
    [one] = inspect_spool(author.folder.parent).recorders
    assert one.refused is not None
    assert one.refused.endswith("00000001.segment: Is a directory")
    assert one.damage is None
