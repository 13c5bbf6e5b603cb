"""Inspect a folder and change nothing; repair a damaged one: all whole records can be drained."""

import os
import random
import tempfile
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import SpoolDamaged, SpoolForeign, SpoolUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import RecorderQueue, Spool
from pycrorm_async.queue.locks import FileLock
from pycrorm_async.queue.maintenance import OpenEpisode, RepairReport, inspect_spool, repair_folder
from pycrorm_async.queue.scan import scan
from pycrorm_async.settings import Settings
from tests.queue.factories import (
    DECLARED,
    RECORDER,
    SMALL,
    WALL_NS,
    FolderWriter,
    ended,
    episode,
    lost,
    make,
    node,
    opened_dead,
    overwrite,
    recover,
    started,
)

# === repair ===================================================================================================
#
# Repair a damaged folder: all whole records can be drained, losses are reported, and nothing is overwritten.

ROOMY = replace(SMALL, spool_bytes_max=64 * SMALL.segment_bytes)
LOST = b'{"status":"LOST"}'


@pytest.fixture
def author(spool: Path) -> FolderWriter:
    return FolderWriter(spool, settings=ROOMY)


def repair(folder: Path) -> RepairReport:
    report = repair_folder(folder)
    assert report is not None
    return report


def damage(author: FolderWriter, position: int) -> None:
    path, offset, _ = author.places[position - 1]
    overwrite(path, offset + 70, b"#")


def renumber(records: list[Record]) -> list[Record]:
    return [each._replace(position=index) for index, each in enumerate(records, start=1)]


async def test_records_behind_the_damage_are_kept_except_for_an_episode_that_misses_an_event(
    author: FolderWriter,
) -> None:
    for heading in (
        started(1),
        started(2),
        node(1),
        node(2),
        node(1),
        DECLARED,
        node(2),
        ended(2),
        node(1),
        started(3),
    ):
        author.put(heading)
    author.sync()
    author.put(node(3), b"never synced")
    damage(author, 5)
    report = repair(author.folder)
    assert (report.kept, report.saved, report.unreadable, report.headless) == (4, 5, ((5, 5),), False)
    [given_up] = report.given_up
    assert (given_up.episode, given_up.kept_to) == (episode_text(episode(1)), 2)
    assert (given_up.sequences, given_up.positions) == (((4, 4),), ((9, 9),))
    assert not report.complete
    kept = renumber([each for each in author.records if each.position not in (5, 9)])
    assert await recover(author.folder) == [*kept, lost(10, 1, 3), lost(11, 3, 3)]
    assert repair_folder(author.folder) is None


async def test_the_original_folder_is_kept_and_named(author: FolderWriter) -> None:
    for heading in (started(), node(), node()):
        author.put(heading)
    author.sync()
    damage(author, 2)
    (author.folder / "notes.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in author.folder.iterdir()}
    report = repair(author.folder)
    aside = author.folder.with_name(f"{author.folder.name}.damaged")
    assert report.set_aside == str(aside)
    assert {path.name: path.read_bytes() for path in aside.iterdir()} == {
        name: content for name, content in before.items() if name != "alive"
    }
    path, offset, _ = author.places[1]
    assert (report.damage.file, report.damage.offset) == (str(aside / path.name), offset)
    assert [each.name for each in Spool(author.folder.parent).recorders()] == [author.folder.name]
    with pytest.raises(SpoolDamaged):
        scan(aside, RECORDER)


async def test_a_second_damage_is_kept_under_a_name_of_its_own(author: FolderWriter) -> None:
    for heading in (started(1), started(2), *[node(1)] * 3, node(2)):
        author.put(heading)
    author.sync()
    damage(author, 4)
    assert repair(author.folder).set_aside.endswith(".damaged")
    overwrite(author.folder / "00000001.segment", author.places[1][1] + 70, b"#")
    again = repair(author.folder)
    assert again.set_aside.endswith(".damaged.2")
    assert await recover(author.folder) == [
        *renumber([each for each in author.records if each.position in (1, 3)]),
        lost(3, 1, 3),
    ]


async def test_a_missing_file_costs_only_its_own_records(author: FolderWriter) -> None:
    author.put(started(1))
    for _ in range(3):
        author.put(node(1), b"x" * 900)
    author.put(started(2))
    for _ in range(6):
        author.put(node(2), b"y" * 900)
    author.sync()
    gone = author.segments[1]
    missing = [index for index, (path, _, _) in enumerate(author.places, start=1) if path == gone]
    gone.unlink()
    report = repair(author.folder)
    assert report.unreadable == ((missing[0], missing[-1]),)
    assert missing[0] == 6
    assert await recover(author.folder) == [*author.records[:5], lost(6, 1, 5), lost(7, 2, 2)]
    assert [each.sequences[-1][1] for each in report.given_up] == [7]


async def test_whole_records_are_kept_when_only_their_commit_contradicts_them(author: FolderWriter) -> None:
    author.put(started())
    author.put(node(), b"one")
    span = author.appender.begin_sync()
    author.appender.append_commit(span._replace(checksum=span.checksum ^ 1))
    author.put(node(), b"two")
    report = repair(author.folder)
    assert (report.kept, report.saved, report.complete) == (2, 1, True)
    assert await recover(author.folder) == [*author.records, lost(4, 1, 4)]


async def test_an_unreadable_header_of_the_first_file_costs_nothing(author: FolderWriter) -> None:
    for heading in (started(1), node(1), started(2), ended(1)):
        author.put(heading)
    author.sync()
    overwrite(author.segments[0], 20, b"#")
    report = repair(author.folder)
    assert (report.kept, report.saved, report.complete) == (0, 4, True)
    assert await recover(author.folder) == [*author.records, lost(5, 2, 2)]


async def test_an_unreadable_header_after_deleted_files_costs_only_the_ends_that_it_alone_held(
    author: FolderWriter,
) -> None:
    author.put(started(1))
    author.put(started(2))
    for _ in range(6):
        author.put(node(1), b"x" * 900)
    author.sync()
    left = [
        each for each, (path, _, _) in zip(author.records, author.places, strict=True) if path != author.segments[0]
    ]
    author.segments[0].unlink()
    overwrite(author.segments[1], 60, b"#")
    report = repair(author.folder)
    assert (report.headless, report.unreadable, report.given_up, report.complete) == (True, (), (), False)
    records = await recover(author.folder)
    assert records[:-1] == left
    assert records[-1] == lost(9, 1, 8)


# --- refusals ---------------------------------------------------------------------------------------------------


def test_an_intact_folder_is_left_as_it_is(author: FolderWriter) -> None:
    author.put(started())
    author.sync()
    author.put(node(), b"torn away")
    overwrite(author.places[1][0], author.places[1][1] + 70, b"#")  # an ordinary torn tail is no damage
    before = author.segments[0].read_bytes()
    assert repair_folder(author.folder) is None
    assert author.segments[0].read_bytes() == before
    assert [path.name for path in author.folder.parent.iterdir()] == [author.folder.name]


def test_the_folder_of_a_live_or_drained_recorder_is_refused(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    with pytest.raises(SpoolUnavailable, match="its recorder is alive"):
        repair_folder(queue.folder)
    queue.release()
    draining = FileLock.take(queue.folder / "drain")
    assert draining is not None
    with pytest.raises(SpoolUnavailable, match="another process drains it: stop that process first"):
        repair_folder(queue.folder)
    draining.release()
    assert repair_folder(queue.folder) is None


def test_a_newer_format_is_refused_and_nothing_is_changed(author: FolderWriter) -> None:
    author.put(started())
    author.sync()
    overwrite(author.segments[0], 8, b"\x02")
    with pytest.raises(SpoolForeign, match="is in format 2 of a newer program"):
        repair_folder(author.folder)
    assert [path.name for path in author.folder.parent.iterdir()] == [author.folder.name]


@pytest.fixture
def read_only_folder() -> Iterator[Path]:
    """A folder that this process cannot write to during the test."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        root = os.geteuid() == 0
        yield Path(folder)
        if root:
            os.seteuid(0)
        Path(folder).chmod(0o755)


def test_a_folder_without_write_permission_is_reported_in_one_line_and_stays_as_it_is(read_only_folder: Path) -> None:
    author = FolderWriter(read_only_folder)
    for heading in (started(), node(), node()):
        author.put(heading)
    author.sync()
    damage(author, 2)
    before = author.segments[0].read_bytes()
    for path in (author.folder / "alive", *author.segments):
        path.chmod(0o666)
    author.folder.chmod(0o777)
    read_only_folder.chmod(0o555)
    if os.geteuid() == 0:
        os.seteuid(65534)
    with pytest.raises(SpoolUnavailable, match="Permission denied") as refused:
        repair_folder(author.folder)
    assert "\n" not in str(refused.value)
    assert author.segments[0].read_bytes() == before


# --- killed repairs ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("killed_at", range(40))
async def test_a_repair_killed_at_any_step_is_completed_by_the_next_one(
    author: FolderWriter, killed_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    author.put(started(1))
    author.put(started(2))
    for _ in range(4):
        author.put(node(1), b"x" * 900)
        author.put(node(2), b"y" * 900)
    author.sync()
    damage(author, 6)
    damaged = {path.name: path.read_bytes() for path in author.segments}
    spool = author.folder.parent
    steps = 0

    def counted(step: Callable[..., Any]) -> Callable[..., Any]:
        def may_die(*arguments: Any, **options: Any) -> Any:
            nonlocal steps
            steps += 1
            if steps > killed_at:
                raise KeyboardInterrupt
            return step(*arguments, **options)

        return may_die

    for of, name in ((os, "link"), (os, "fsync"), (os, "open"), (Path, "unlink"), (Path, "replace"), (Path, "open")):
        monkeypatch.setattr(of, name, counted(getattr(of, name)))
    done = False
    try:
        repair_folder(author.folder)
        done = True
    except KeyboardInterrupt:
        pass
    monkeypatch.undo()
    repair_folder(author.folder)
    kept = renumber([each for each in author.records if each.position not in (6, 8, 10)])
    assert await recover(author.folder) == [*kept, lost(8, 1, 6), lost(9, 2, 3)]
    copies = [each for each in spool.iterdir() if each != author.folder]
    assert any({path.name: path.read_bytes() for path in each.iterdir()} == damaged for each in copies)
    assert done or killed_at < 39


# --- damage anywhere --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [*range(12), *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(12, 600))])
async def test_whatever_is_damaged_every_record_is_drained_or_reported(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    author = FolderWriter(tmp_path / "spool", settings=ROOMY)
    open_now: set[int] = set()
    for number in range(1, rng.randrange(3, 7)):
        author.put(started(number))
        open_now.add(number)
        for _ in range(rng.randrange(12)):
            author.put(node(rng.choice(sorted(open_now))), b"z" * rng.randrange(1200))
            if rng.random() < 0.3:
                author.sync()
        if rng.random() < 0.4:
            author.put(ended(number))
            open_now.discard(number)
    author.sync()
    hits = rng.choice([1, 1, 1, 2, 5])
    for _ in range(hits):
        path = rng.choice(author.segments)
        content = bytearray(path.read_bytes())
        at = rng.randrange(len(content.rstrip(b"\0")))
        if at in range(8, 12):  # the number of the format: that is another program's file, which is refused
            continue
        content[at] ^= 1 << rng.randrange(8)
        path.write_bytes(content)
    report = repair_folder(author.folder)
    records = [each for each in await recover(author.folder) if each.payload != LOST]
    if report is None:  # no record is hit, or only the last commit frame, which leaves a torn tail
        assert records == author.records[: len(records)]
        assert len(records) == len(author.records) or hits > 1
        return
    # Reported: every position is kept, unreadable, or lost by name.
    unreadable = {position for first, last in report.unreadable for position in range(first, last + 1)}
    dropped = {
        position for each in report.given_up for first, last in each.positions for position in range(first, last + 1)
    }
    assert unreadable & dropped == set()
    kept = [each for each in author.records if each.position not in unreadable | dropped]
    if hits > 1:  # records at the very end, and the only commit frame that covered them
        kept = kept[: len(records)]
    assert records == renumber(kept)
    assert (report.kept + report.saved) == len(kept)
    # The kept records of an episode have no gap, and only an episode that misses an event loses something.
    sequences: defaultdict[bytes | None, list[int]] = defaultdict(list)
    for each in kept:
        sequences[each.episode].append(each.sequence)
    assert all(numbers == list(range(1, len(numbers) + 1)) for numbers in sequences.values())
    missing = {each.episode for each in author.records if each.position in unreadable}
    assert {each.episode for each in author.records if each.position in dropped} <= missing
    recovered = opened_dead(author.folder)
    recovered.release()


# === inspection ===============================================================================================
#
# Inspection reports the content of a spool and changes nothing.


def everything_in(folder: Path) -> dict[str, bytes | None]:
    return {str(path): path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


@pytest.fixture
def default_author(spool: Path) -> FolderWriter:
    return FolderWriter(spool)


def test_a_dead_recorders_folder_is_reported_whole_and_left_as_it_is(default_author: FolderWriter) -> None:
    spool = default_author.folder.parent
    Spool(spool).bind("the-log")
    for heading in (DECLARED, started(1), node(1), started(2), ended(1), node(2)):
        default_author.put(heading)
    default_author.sync()
    default_author.put(node(2), b"x" * 3400)
    default_author.put(node(2), b"torn")
    path, offset, size = default_author.places[-1]
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
    assert one.tail_bytes == len(default_author.segments[1].read_bytes()[offset:].rstrip(b"\0"))
    assert 0 < one.tail_bytes <= size
    assert (one.damage, one.refused, one.foreign, one.cut_off) == (None, None, (), ())


def test_damage_is_reported_with_its_place_and_what_precedes_it(default_author: FolderWriter) -> None:
    for heading in (started(), node(), node()):
        default_author.put(heading)
    default_author.sync()
    path, offset, _ = default_author.places[1]
    overwrite(path, offset + 70, b"#")
    before = everything_in(default_author.folder)
    [one] = inspect_spool(default_author.folder.parent).recorders
    assert everything_in(default_author.folder) == before
    assert one.damage is not None
    assert (one.damage.file, one.damage.offset) == (str(path), offset)
    assert (one.first, one.last, one.records) == (1, 1, 1)
    repair_folder(default_author.folder)
    after = inspect_spool(default_author.folder.parent)
    assert after.set_aside == (f"{default_author.folder.name}.damaged",)
    assert (after.recorders[0].damage, after.strangers) == (None, ())


def test_the_holders_of_a_folder_are_reported(default_author: FolderWriter) -> None:
    default_author.put(started())
    recovered = opened_dead(default_author.folder)
    [one] = inspect_spool(default_author.folder.parent).recorders
    assert (one.alive, one.being_drained) == (True, True)  # the drainer of a dead folder holds both locks
    recovered.release()
    [one] = inspect_spool(default_author.folder.parent).recorders
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


def test_a_foreign_file_and_a_foreign_recorder_are_named(default_author: FolderWriter) -> None:
    default_author.put(started())
    (default_author.folder / "notes.txt").touch()
    (default_author.folder / "00000001.segment.tail").touch()
    (default_author.folder.parent / "readme").touch()
    (default_author.folder.parent / "photos.damaged").mkdir()
    for name in ("01234567-0000-7000-8000-000000000000", "01234567-0000-7000-8000-000000000001.making"):
        (default_author.folder.parent / name).mkdir()
    report = inspect_spool(default_author.folder.parent)
    assert report.strangers == ("photos.damaged", "readme")
    assert [name[-8:] for name in report.unfinished] == ["00000000", "1.making"]
    assert report.recorders[0].foreign == ("notes.txt",)
    assert report.recorders[0].cut_off == ("00000001.segment.tail",)
    assert report.recorders[0].records == 1


def test_a_newer_format_and_an_unreadable_file_are_reported_beside_the_others(default_author: FolderWriter) -> None:
    default_author.put(started())
    overwrite(default_author.segments[0], 8, b"\x02")
    [one] = inspect_spool(default_author.folder.parent).recorders
    assert one.refused is not None
    assert one.refused.endswith("is in format 2 of a newer program; this one reads format 1")
    default_author.segments[0].unlink()
    default_author.segments[0].mkdir()
    [one] = inspect_spool(default_author.folder.parent).recorders
    assert one.refused is not None
    assert one.refused.endswith("00000001.segment: Is a directory")
    assert one.damage is None
