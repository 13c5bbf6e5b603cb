"""Stored segments are kept for as long and as many as the settings allow, and never displace new events."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path

import pytest

from pycrorm_async.clock import Clock
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.operations.destination import stored_heads, stored_recorders, stored_records
from pycrorm_async.queue import RecorderQueue, Spool, stored_segments
from pycrorm_async.queue.format import Segment
from pycrorm_async.queue.maintenance import inspect_spool
from pycrorm_async.queue.scan import scan
from pycrorm_async.queue.stored_segments import EpisodeNumbers, StoredSegments, kept_segments
from pycrorm_async.settings import Settings
from tests.queue.factories import (
    DECLARED,
    MONOTONIC_NS,
    RECORDER,
    SMALL,
    WALL_NS,
    crashed_copy,
    drain,
    ended,
    episode,
    make,
    node,
    opened_dead,
    started,
    take,
)

HOUR_NS = 3600 * 10**9


class Hours:
    """A wall clock that the test sets."""

    def __init__(self) -> None:
        self.hour = 0.0

    def wall_ns(self) -> int:
        return WALL_NS + round(self.hour * HOUR_NS)


@pytest.fixture
def bound(spool: Path) -> Path:
    Spool(spool).bind("a-log")
    return spool


async def live(spool: Path, *, settings: Settings = SMALL, hours: Hours | None = None, number: int = 1) -> None:
    """Return a recorder that fills two segments and part of a third, all of it stored."""
    wall_ns = (hours or Hours()).wall_ns
    recorder = EpisodeId(RECORDER[:-1] + bytes([number]))
    queue = RecorderQueue.create(
        spool, settings=settings, clock=Clock(wall_ns, lambda: MONOTONIC_NS), recorder=recorder
    )
    put(queue)
    queue.close()
    records = await drain(queue)
    await queue.acknowledge(records[-1].position)
    queue.release()


def put(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")
    for _ in range(9):
        queue.put_nowait(node(), b"n" * 900)
    queue.put_nowait(ended(), b"{}")


def stored_files(spool: Path) -> list[tuple[str, str]]:
    return [(each.path.parent.name, each.path.name) for each in kept_segments(spool)]


async def test_stored_segments_are_kept_whole_and_the_recorders_folder_is_deleted(bound: Path) -> None:
    await live(bound)
    folder = bound / "stored" / "a-log" / (name := episode_text(EpisodeId(RECORDER[:-1] + b"\1")))
    assert stored_files(bound) == [(name, f"0000000{number}.segment") for number in (1, 2, 3)]
    assert scan(folder, RECORDER[:-1] + b"\1").cut.position == 11
    assert (folder / "00000003.segment").stat().st_size < SMALL.segment_bytes
    assert sorted(each.name for each in bound.iterdir()) == ["log", "stored"]
    assert (Spool(bound).recorders(), inspect_spool(bound).strangers) == ([], ())


async def test_a_dead_recorders_segments_are_kept_without_the_torn_tail(tmp_path: Path, bound: Path) -> None:
    queue = make(tmp_path / "alive")
    put(queue)
    await queue.synced_to()
    folder = crashed_copy(queue, bound)
    stored = StoredSegments(bound, SMALL, wall_ns=Hours().wall_ns)
    recovered = opened_dead(folder, stored=stored)
    for record in await drain(recovered, events_max=4):
        await recovered.acknowledge(record.position)
    recovered.release()
    assert stored_files(bound) == [(folder.name, f"0000000{number}.segment") for number in (1, 2, 3)]
    assert scan(bound / "stored" / "a-log" / folder.name, RECORDER).cut.position == 11
    assert not folder.exists()
    queue.close()
    queue.release()


async def test_the_oldest_segments_are_deleted_when_they_are_too_old_or_too_many(
    bound: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hours = Hours()
    for number, hour in ((1, 0), (2, 10), (3, 23)):
        hours.hour = hour
        await live(bound, hours=hours, number=number)
    assert len(stored_files(bound)) == 9
    hours.hour = 24.5
    StoredSegments(bound, SMALL, wall_ns=hours.wall_ns).prune()
    names = [name for name, _ in stored_files(bound)]
    assert len(names) == 6
    assert not (bound / "stored" / "a-log" / episode_text(EpisodeId(RECORDER[:-1] + b"\1"))).exists()

    StoredSegments(bound, replace(SMALL, keep_stored_bytes=4 * 4096), wall_ns=hours.wall_ns).prune()
    assert [name for name, _ in stored_files(bound)] == names[2:]
    monkeypatch.setattr(stored_segments, "FILES_MAX", 2)
    StoredSegments(bound, SMALL, wall_ns=hours.wall_ns).prune()
    assert [name for name, _ in stored_files(bound)] == names[4:]


async def test_a_recorder_keeps_within_the_bytes_while_it_records(bound: Path) -> None:
    for number in (1, 2, 3):
        await live(bound, settings=replace(SMALL, keep_stored_bytes=4 * 4096), number=number)
        assert len(stored_files(bound)) <= 4
    assert len(stored_files(bound)) == 4


@pytest.mark.parametrize("nothing", [{"keep_stored_s": 0.0}, {"keep_stored_bytes": 0}])
async def test_nothing_is_kept_where_the_settings_forbid_it(bound: Path, nothing: dict[str, int]) -> None:
    await live(bound, settings=replace(SMALL, **nothing))  # type: ignore[arg-type]
    assert sorted(each.name for each in bound.iterdir()) == ["log"]


async def test_nothing_is_kept_without_a_log_or_for_a_log_that_names_no_folder(spool: Path) -> None:
    await live(spool)
    Spool(spool).bind("../elsewhere")
    await live(spool)
    assert sorted(each.name for each in spool.iterdir()) == ["log"]


async def test_segments_stored_in_another_log_are_kept_apart(bound: Path) -> None:
    await live(bound)
    Spool(bound).bind("another-log")
    await live(bound, number=2)
    assert sorted(each.path.parent.parent.name for each in kept_segments(bound)) == ["a-log"] * 3 + ["another-log"] * 3


async def test_a_full_disk_deletes_kept_segments_before_it_refuses_an_event(
    bound: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in (2, 3):
        await live(bound, number=number)
    allocate = Segment.allocate.__func__  # type: ignore[attr-defined]

    def limited(cls: type[Segment], folder: Path, *, number: int, size: int) -> Segment:
        held = sum(path.stat().st_size for path in bound.rglob("*.segment"))
        if held + size > 6 * 4096:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        segment: Segment = allocate(cls, folder, number=number, size=size)
        return segment

    monkeypatch.setattr(Segment, "allocate", classmethod(limited))
    assert len(stored_files(bound)) == 6
    queue = make(bound)
    put(queue)  # no drainer stores anything meanwhile
    await queue.synced_to()
    assert 0 < len(stored_files(bound)) <= 3
    queue.close()
    queue.release()


async def test_a_clock_that_is_set_back_leaves_no_gap(bound: Path) -> None:
    hours = Hours()
    hours.hour = 5
    await live(bound, hours=hours)
    folder = bound / "stored" / "a-log" / stored_files(bound)[0][0]
    long_ago = WALL_NS - HOUR_NS
    os.utime(folder / "00000002.segment", ns=(long_ago, long_ago))
    StoredSegments(bound, replace(SMALL, keep_stored_bytes=2 * 4096), wall_ns=hours.wall_ns).prune()
    assert [file for _, file in stored_files(bound)] == ["00000002.segment", "00000003.segment"]


async def test_a_segment_that_cannot_be_kept_is_deleted(bound: Path, caplog: pytest.LogCaptureFixture) -> None:
    (bound / "stored").write_text("not a folder")
    await live(bound)
    assert sorted(each.name for each in bound.iterdir()) == ["log", "stored"]
    assert "cannot be kept, so it is deleted: Not a directory" in caplog.text


async def test_each_segment_begins_with_the_declarations_in_use_and_can_be_read_alone(bound: Path) -> None:
    queue = make(bound)
    queue.put_nowait(DECLARED, b'{"dtype":"A"}')
    queue.put_nowait(DECLARED, b'{"dtype":"B"}')
    queue.put_nowait(DECLARED, b'{"dtype":"A"}')
    put(queue)
    queue.close()
    records = await drain(queue)
    assert [each.position for each in records] == list(range(1, len(records) + 1))
    declared = [each.payload.decode()[10:11] for each in records if each.episode is None]
    assert declared == ["A", "B", "A", "A", "B", "A", "B"]
    await queue.acknowledge(records[-1].position)
    queue.release()
    folder = bound / "stored" / "a-log" / queue.name
    for number in (1, 2):
        (folder / f"0000000{number}.segment").unlink()
    [last] = [each for each in stored_recorders(bound, "a-log") if each.name == queue.name]
    assert [each.payload for part in stored_records(last) for each in part if each.episode is None] == [
        b'{"dtype":"A"}',
        b'{"dtype":"B"}',
    ]


async def test_a_declaration_without_space_is_recorded_once_and_counted(queue: RecorderQueue, bound: Path) -> None:
    for number in range(12):
        queue.put_nowait(DECLARED, b'{"dtype":"%d"}' % number)
    put(queue)
    assert (queue.declarations_unrepeated, queue.written > 23) == (4, True)
    queue.put_nowait(started(2), b"s" * 2_000)  # the largest record still fits
    queue.close()
    assert len(await drain(queue)) == queue.written


# === episode numbers ==========================================================================================


def test_numbers_are_read_as_any_process_noted_them_and_each_is_noted_once(tmp_path: Path) -> None:
    mine, other = EpisodeNumbers(tmp_path / "stored" / "a"), EpisodeNumbers(tmp_path / "stored" / "a")
    assert mine.read() == {}
    mine.note({episode(1): 7})
    other.note({episode(1): 7, episode(2): 8})
    size = (tmp_path / "stored" / "a" / "numbers").stat().st_size
    mine.note({episode(1): 7})
    assert (tmp_path / "stored" / "a" / "numbers").stat().st_size == size
    assert mine.read() == other.read() == {episode(1): 7, episode(2): 8}


def test_a_file_of_numbers_cut_or_changed_at_any_byte_never_gives_a_wrong_number(tmp_path: Path) -> None:
    file = tmp_path / "stored" / "a" / "numbers"
    EpisodeNumbers(file.parent).note({episode(1): 10})
    content = file.read_bytes()
    for damaged in (
        *(content[:length] for length in range(len(content))),
        *(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :] for at in range(len(content))),
    ):
        file.write_bytes(damaged)
        assert EpisodeNumbers(file.parent).read() in ({}, {episode(1): 10})
        EpisodeNumbers(file.parent).note({episode(2): 20})
        assert EpisodeNumbers(file.parent).read()[episode(2)] == 20


def test_a_full_file_of_numbers_replaces_the_one_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored_segments, "_NUMBERS_BYTES_MAX", 500)
    monkeypatch.setattr(stored_segments, "_NOTED_MAX", 3)
    numbers = EpisodeNumbers(tmp_path / "stored" / "a")
    for number in range(1, 41):
        numbers.note({episode(number): number})
    read = numbers.read()
    assert read == {episode(number): number for number in range(41 - len(read), 41)}
    assert 9 < len(read) < 25


def test_numbers_that_cannot_be_noted_are_no_error(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "stored").write_text("not a folder")
    numbers = EpisodeNumbers(tmp_path / "stored" / "a")
    numbers.note({episode(1): 1})
    assert "numbers of episodes cannot be noted" in caplog.text
    assert numbers.read() == {}


# === stored heads =============================================================================================


async def test_the_last_event_of_each_recorder_is_read_from_its_newest_segment(bound: Path) -> None:
    await live(bound)
    assert stored_heads(bound, "a-log") == {episode(1): 11}
    newest = kept_segments(bound)[-1].path
    newest.write_bytes(newest.read_bytes()[:-1])  # the commit frame is torn
    assert stored_heads(bound, "a-log") == {episode(1): 11}
    newest.write_bytes(b"")
    assert stored_heads(bound, "a-log") == {}


async def test_the_stored_events_of_a_living_recorder_are_read_as_far_as_its_drainer_stored_them(bound: Path) -> None:
    queue = make(bound, offered=True)
    for number in (1, 2, 3):
        queue.put_nowait(started(number), b"{}")
        queue.put_nowait(node(number), b"n" * 900)
    await queue.synced_to()
    assert stored_heads(bound, "a-log") == {}
    source = take(queue)
    await source.get_batch(events_max=3, bytes_max=2**20, age_s_max=0)
    await source.acknowledge(3)
    assert stored_heads(bound, "a-log") == {episode(1): 2, episode(2): 1}
    source.release()
    queue.release()
