"""The contract of a source, for a recorder's own queue, a live recorder's folder, and a dead one's.

A daemon claims the folders of the last two: they have the methods of a `ClaimedSource` as well.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, TypeVar

import pytest

from pycrorm_async.errors import SpoolStuck
from pycrorm_async.events.codec import Record
from pycrorm_async.queue import DeadSource, LiveSource, RecorderQueue, Spool, open_dead
from pycrorm_async.queue import format as spool_format
from pycrorm_async.queue.format import EVENT, read_segment, segment_path
from pycrorm_async.queue.scan import survey
from pycrorm_async.queue.spool import DrainNote, DrainStatus
from pycrorm_async.writer.drain import ClaimedSource, Source
from tests.queue.factories import RECORDER, crashed_copy, ended, eventually, fill, make, node, started, take

AnySource = RecorderQueue | LiveSource | DeadSource
Opened = TypeVar("Opened")
SIZES = [0, *[200] * 40, 0]
"""Sizes of the payloads of one episode that spans several segments."""


class SourceCase:
    """A recorder, and the source of its records under test."""

    def __init__(self, kind: Literal["own", "living", "dead"], folder: Path) -> None:
        self.kind = kind
        self.queue = make(folder / "spool", offered=kind == "living")
        self._other = folder / "other"
        self._left: Path | None = None
        self._opened: list[AnySource] = []

    async def record(self, sizes: Sequence[int] = SIZES, *, synced_every: int = 1000) -> None:
        """Record and sync one whole episode."""
        for index, size in enumerate(sizes):
            heading = started() if index == 0 else ended() if index == len(sizes) - 1 else node()
            self.queue.put_nowait(heading, b"%04d" % index + b"x" * size)
            if index % synced_every == synced_every - 1:
                await self.queue.synced_to()
        await self.queue.synced_to()

    def source(self) -> AnySource:
        """Return the first source, and at each further call its successor."""
        for each in self._opened:
            each.release()
        self._opened.append(self._next())
        return self._opened[-1]

    def _next(self) -> AnySource:
        if self.kind == "own" and not self._opened:
            return self.queue
        if self.kind == "living":
            return take(self.queue)
        if self.kind == "dead" and self._left is None:
            self._left = crashed_copy(self.queue, self._other)
        return _present(open_dead(self._left or self.queue.folder))

    @property
    def folder(self) -> Path:
        return self._left or self.queue.folder

    def end(self) -> None:
        for each in (*self._opened, self.queue):
            each.release()


def _present(opened: Opened | None) -> Opened:
    assert opened is not None
    return opened


@pytest.fixture(params=["own", "living", "dead"])
def scene(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[SourceCase]:
    case = SourceCase(request.param, tmp_path)
    yield case
    case.end()


@pytest.fixture(params=["living", "dead"])
def claimable(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[SourceCase]:
    case = SourceCase(request.param, tmp_path)
    yield case
    case.end()


def claim(case: SourceCase) -> ClaimedSource:
    source = case.source()
    assert not isinstance(source, RecorderQueue)
    return source


async def batch(source: Source, *, events_max: int = 1000, bytes_max: int = 2**22) -> list[Record]:
    async with asyncio.timeout(60):
        return list(await source.get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=0.05))


async def rest(source: Source) -> list[Record]:
    """Return all further records of a closed queue."""
    records: list[Record] = []
    while some := await batch(source):
        records += some
        assert len(records) <= 2 * len(SIZES)
    return records


def positions(records: Sequence[Record]) -> list[int]:
    return [each.position for each in records]


def dead_letters(spool: Path) -> list[int]:
    """Return the sequences of the dead letters in the order of their files."""
    sequences: list[int] = []
    [kept] = [each.path for each in Spool(spool).recorders() if each.refused is not None]
    survey(kept, RECORDER, on_frame=lambda _, frame: sequences.append(frame.sequence) if frame.kind == EVENT else None)
    return sequences


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


async def test_each_synced_record_is_supplied_once_in_order(scene: SourceCase) -> None:
    await scene.record()
    source = scene.source()
    records: list[Record] = []
    while len(records) < len(SIZES):
        records += await batch(source, events_max=7)
    assert positions(records) == list(range(1, len(SIZES) + 1))
    assert [each.sequence for each in records] == list(range(1, len(SIZES) + 1))
    assert [each.payload for each in records] == [b"%04d" % at + b"x" * size for at, size in enumerate(SIZES)]


async def test_a_batch_holds_at_most_this_many_records(scene: SourceCase) -> None:
    await scene.record()
    source = scene.source()
    assert positions(await batch(source, events_max=1)) == [1]
    assert positions(await batch(source, events_max=30)) == list(range(2, 32))


async def test_a_batch_holds_at_most_this_many_bytes_and_a_larger_record_comes_alone(scene: SourceCase) -> None:
    await scene.record([6, 6, 6, 996, 6, 0])  # payloads of 10 bytes, one of 1000
    source = scene.source()
    sizes = [positions(await batch(source, bytes_max=25)) for _ in range(4)]
    assert sizes == [[1, 2], [3], [4], [5, 6]]


async def test_other_tasks_run_while_a_batch_is_read(scene: SourceCase, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spool_format, "RECORDS_AT_ONCE", 2)
    await scene.record(synced_every=3)
    source = scene.source()
    await batch(source, events_max=1)  # takes the lock
    reading = asyncio.create_task(batch(source, events_max=40))
    turns: list[int] = []
    while not reading.done():
        await asyncio.sleep(0)
        # A dead source also waits for a thread that syncs, so count the turns in which it has read.
        turns.append(len(source._ready) if isinstance(source, DeadSource) else len(turns))
    assert positions(reading.result()) == list(range(2, 42))
    assert len(set(turns)) > 10


async def test_a_batch_whose_reading_was_cancelled_is_supplied_by_the_next_call(
    scene: SourceCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool_format, "RECORDS_AT_ONCE", 2)
    await scene.record(synced_every=3)
    scene.queue.close()
    source = scene.source()
    records: list[Record] = []
    for turns in range(30):
        reading = asyncio.create_task(batch(source, events_max=20))
        for _ in range(turns):
            await asyncio.sleep(0)
        if not reading.done():
            reading.cancel()
            with pytest.raises(asyncio.CancelledError):
                await reading
        else:
            records += reading.result()
    records += await rest(source)
    assert positions(records) == list(range(1, len(SIZES) + 1))


async def test_after_the_last_record_of_a_closed_queue_every_batch_is_empty(scene: SourceCase) -> None:
    await scene.record()
    scene.queue.close()
    source = scene.source()
    assert len(await rest(source)) == len(SIZES)
    assert await batch(source) == []
    assert await batch(source) == []


async def test_the_next_source_supplies_again_what_was_not_acknowledged(scene: SourceCase) -> None:
    await scene.record()
    source = scene.source()
    first, second = await batch(source, events_max=5), await batch(source, events_max=5)
    assert positions(second) == list(range(6, 11))
    await source.acknowledge(first[-1].position)
    scene.queue.close()
    again = positions(await rest(scene.source()))
    assert again == list(range(again[0], len(SIZES) + 1))
    assert again[0] <= 6


@pytest.mark.parametrize("stored", [0, 1, 20, 41])
async def test_only_segments_whose_records_are_all_stored_are_deleted(scene: SourceCase, stored: int) -> None:
    await scene.record()
    source = scene.source()
    supplied = [await batch(source, events_max=1) for _ in range(max(stored, 1))]
    assert positions(supplied[-1]) == [max(stored, 1)]
    bases = survey(scene.folder, RECORDER).prefix.bases
    contents = {number: read_segment(segment_path(scene.folder, number)) for number in bases}
    await source.acknowledge(stored)
    kept = {number for number in bases if bases.get(number + 1, len(SIZES) + 2) - 1 > stored}
    await eventually(lambda: all(segment_path(scene.folder, each).exists() == (each in kept) for each in bases))
    await asyncio.sleep(0.1)  # a further turn of the sync thread, which could delete more
    assert {number for number in bases if segment_path(scene.folder, number).exists()} == kept
    assert (len(kept) < len(bases)) == (stored >= 20)
    for number in sorted(kept)[:-1]:  # the sync thread still writes to the last one
        assert read_segment(segment_path(scene.folder, number)) == contents[number]


async def test_a_refused_record_becomes_one_dead_letter_however_often_it_is_refused(scene: SourceCase) -> None:
    await scene.record()
    source = scene.source()
    refused = await batch(source, events_max=9)
    assert source.dead_letter(refused[:5])
    assert source.dead_letter(refused)
    assert source.dead_letter(refused)
    source.release()
    assert dead_letters(scene.folder.parent) == list(range(1, 10))
    source = scene.source()  # nothing was acknowledged, so it supplies the same records
    assert source.dead_letter(await batch(source, events_max=10))
    source.release()
    assert dead_letters(scene.folder.parent) == list(range(1, 11))


async def test_a_source_that_fails_wakes_the_producers_of_its_recorder_that_wait_for_space(scene: SourceCase) -> None:
    scene.queue.put_nowait(started(), b"{}")
    fill(scene.queue)
    await scene.queue.synced_to()
    source = scene.source()
    waiting = asyncio.create_task(scene.queue.room())
    await asyncio.sleep(0.1)
    assert not waiting.done()
    before = contents(scene.folder) if scene.kind == "dead" else {}  # a living recorder writes meanwhile
    source.fail("the first reason")
    source.fail("another reason")
    if scene.kind == "dead":  # the producer is the recorder of which the test copied the folder
        assert contents(scene.folder) == before
        await asyncio.sleep(0.1)
        assert not waiting.done()
        waiting.cancel()
        return
    with pytest.raises(SpoolStuck, match="the first reason"):
        async with asyncio.timeout(60):
            await waiting


async def test_a_source_can_be_released_twice_and_frees_the_folder_for_the_next(scene: SourceCase) -> None:
    await scene.record()
    source = scene.source()
    await batch(source, events_max=3)
    source.release()
    source.release()
    scene.queue.close()
    assert positions(await rest(scene.source())) == list(range(1, len(SIZES) + 1))


# --- claimed by a daemon ----------------------------------------------------------------------------------------------


async def test_a_finished_source_ends_behind_the_records_that_were_synced_before(claimable: SourceCase) -> None:
    await claimable.record()
    source = claim(claimable)
    source.finish()
    await claimable.record([0, 0])
    assert positions(await rest(source)) == list(range(1, len(SIZES) + 1))
    assert await batch(source) == []


async def test_the_next_source_supplies_again_what_is_left_and_was_not_visible(claimable: SourceCase) -> None:
    await claimable.record()
    source = claim(claimable)
    await batch(source, events_max=30)
    await source.acknowledge(25)
    source.mark_visible(24, {})
    again = positions(await batch(claim(claimable), events_max=1000))
    assert again == list(range(again[0], len(SIZES) + 1))
    assert again[0] == 25 if claimable.kind == "living" else again[0] <= 25


async def test_visibility_and_the_state_of_the_database_are_published_to_a_living_recorder(
    claimable: SourceCase,
) -> None:
    await claimable.record()
    source = claim(claimable)
    await batch(source)
    await source.acknowledge(20)
    before = contents(claimable.folder) if claimable.kind == "dead" else {}  # a living recorder writes meanwhile
    source.mark_unavailable("the server restarts")
    source.mark_pending("rebuild")
    source.mark_visible(5, {"an episode": "a gap"})
    status = claimable.queue.external_drain_status
    if claimable.kind == "dead":
        assert contents(claimable.folder) == before
        assert status is None
        return
    note = DrainNote(unavailable="the server restarts", stopped={"an episode": "a gap"}, pending="rebuild")
    assert status == DrainStatus(stored=20, folded=5, note=note)
    source.mark_unavailable(None)
    source.mark_pending(None)
    source.mark_visible(3, {})
    assert claimable.queue.external_drain_status == DrainStatus(stored=20, folded=5)


async def test_a_source_reports_whether_its_recorder_lives(claimable: SourceCase) -> None:
    await claimable.record()
    source = claim(claimable)
    assert source.is_alive == (claimable.kind == "living")
    claimable.queue.release()
    assert not source.is_alive


async def test_a_released_source_has_an_outcome_when_all_records_are_stored(claimable: SourceCase) -> None:
    await claimable.record()
    claimable.queue.close()
    source = claim(claimable)
    await batch(source, events_max=30)  # not acknowledged, so that the recorder deletes nothing meanwhile
    assert source.release() is None
    source = claim(claimable)
    records = await rest(source)
    await source.acknowledge(records[-1].position)
    assert source.release() == ("has ended" if claimable.kind == "living" else "is recovered")


async def test_dead_letters_are_a_source_that_keeps_what_is_refused_again(claimable: SourceCase) -> None:
    await claimable.record()
    claimable.queue.close()
    source = claim(claimable)
    records = await rest(source)
    assert source.dead_letter(records[:3])
    await source.acknowledge(records[-1].position)
    assert not source.holds_dead_letters
    source.release()
    claimable.queue.release()
    [kept] = [each.path for each in Spool(claimable.folder.parent).recorders() if each.refused is not None]
    letters: ClaimedSource = _present(open_dead(kept))
    assert letters.holds_dead_letters
    refused = await rest(letters)
    assert [(each.sequence, each.payload) for each in refused][:3] == [
        (each.sequence, each.payload) for each in records[:3]
    ]
    assert not letters.dead_letter(refused)
    assert letters.release() is None
    assert dead_letters(claimable.folder.parent) == [1, 2, 3]
