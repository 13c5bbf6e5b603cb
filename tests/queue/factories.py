"""Factories for the tests of the queue: ids, headings, records, a frozen clock, small files, and crashed folders."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any

from pycrorm_async.clock import Clock
from pycrorm_async.errors import SpoolFull
from pycrorm_async.events.codec import Heading, Record
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.queue import DeadSource, LiveSource, RecorderQueue, open_dead
from pycrorm_async.queue.appender import Appender, Capacity
from pycrorm_async.queue.format import EVENT, Frame, encode, salt_of
from pycrorm_async.queue.locks import MAKING
from pycrorm_async.settings import Settings

WALL_NS = 1_700_000_000_123_456_789
MONOTONIC_NS = 987_654_321
STILL = Clock(wall_ns=repeat(WALL_NS).__next__, monotonic_ns=repeat(MONOTONIC_NS).__next__)
"""A frozen clock in C, so that the compiled core appends with it too."""

SMALL = Settings(
    sync_interval_ms=5,
    segment_bytes=4096,
    spool_bytes_max=8 * 4096,
    spool_reserve_bytes=2 * 4096,
    record_bytes_max=2048,
)

SLOW = replace(SMALL, sync_interval_ms=3_600_000)
"""The queue syncs only when it is asked to."""

# Every node takes 976 bytes. The first segment holds the start and 3 nodes, each other segment 3: 24 in 8 segments. The
# reserve is 8192 bytes: of the last three segments (3 x 3856) 3376 may be used, which hold 3 nodes.
ORDINARY, ALL = 18, 24
PAYLOAD = b"x" * 900
LONG_S = 30.0

RECORDER = episode_id(1_700_000_000_000_000_000, b"recorder..")


def episode(number: int) -> EpisodeId:
    """Return the n-th episode's id; ids sort by number."""
    return episode_id(1_700_000_000_000_000_000 + number * 1_000_000, b"an episode")


def started(number: int = 1) -> Heading:
    return Heading(episode(number), "EpisodeStarted", 1)


def ended(number: int = 1) -> Heading:
    return Heading(episode(number), "EpisodeEnded", 1)


def node(number: int = 1) -> Heading:
    return Heading(episode(number), "NodeStarted", 1)


DECLARED = Heading(None, "DesignatorTypeDeclared", 1)


def record(position: int, heading: Heading, sequence: int, payload: bytes) -> Record:
    """Return the record that a queue with the frozen clock makes of a heading."""
    return Record(position, heading.episode, sequence, *heading[1:], WALL_NS, MONOTONIC_NS, payload)


def lost(position: int, number: int, sequence: int) -> Record:
    """Return the computed end of an episode."""
    return record(position, ended(number), sequence, b'{"status":"LOST"}')


def make(spool: Path, *, settings: Settings = SMALL, clock: Clock = STILL, offered: bool = False) -> RecorderQueue:
    return RecorderQueue.create(spool, settings=settings, clock=clock, recorder=RECORDER, offered=offered)


def fill(queue: RecorderQueue, *, reserved: bool = False) -> int:
    """Put nodes until the queue refuses one; return their number."""
    for count in range(10_000):
        try:
            queue.put_nowait(node(), PAYLOAD, reserved=reserved)
        except SpoolFull:
            return count
    raise AssertionError("the queue is never full")


def crashed_copy(queue: RecorderQueue, spool: Path) -> Path:
    """Copy the folder as `kill -9` would leave it now: its files, unlocked, in another spool."""
    return copy_beside_recording(queue.folder, spool / episode_text(RECORDER))


def copy_beside_recording(source: Path, target: Path) -> Path:
    """Copy the folder of a queue that records, without files that its sync thread is preparing and may rename."""
    return Path(shutil.copytree(source, target, ignore=shutil.ignore_patterns(f"*{MAKING}")))


async def drain(queue: RecorderQueue | DeadSource | LiveSource, *, events_max: int = 10_000) -> list[Record]:
    """Return all remaining records without acknowledging them; a live queue must be closed."""
    records: list[Record] = []
    while batch := await queue.get_batch(events_max=events_max, bytes_max=2**22, age_s_max=0.0):
        records += batch
    return records


def opened_dead(folder: Path, **options: Any) -> DeadSource:
    """Open a dead folder that no other process has; the options are those of `open_dead`."""
    source = open_dead(folder, **options)
    assert source is not None
    return source


async def recover(folder: Path) -> list[Record]:
    """Return all records that recovery supplies, and leave the folder as it is."""
    recovered = opened_dead(folder)
    try:
        return await drain(recovered)
    finally:
        recovered.release()


def append(appender: Appender, heading: Heading, payload: bytes, reserved: bool) -> int:
    """Put as a queue does: with the compiled core if it takes the record."""
    sequence = appender.append(heading, payload, reserved)
    return appender.put(heading, payload, reserved) if sequence is None else sequence


class FolderWriter:
    """Write a recorder's folder step by step without a sync thread: the test calls each step of a sync.

    `records` is what was put, including the declarations that begin a segment; `places` is the (file, offset, size)
    of each.
    """

    def __init__(
        self, spool: Path, *, settings: Settings = SMALL, recorder: EpisodeId = RECORDER, clock: Clock = STILL
    ) -> None:
        self.folder = spool / episode_text(recorder)
        self.folder.mkdir(parents=True)
        (self.folder / "alive").touch()
        self.appender = Appender(
            folder=self.folder,
            recorder=recorder,
            capacity=Capacity.of(settings),
            clock=clock,
            wake=lambda: None,
            hurry=lambda: None,
            make_room=lambda _: False,
        )
        self.records: list[Record] = []
        self.places: list[tuple[Path, int, int]] = []
        self._declared: dict[bytes, Heading] = {}

    def put(self, heading: Heading, payload: bytes = b"{}") -> None:
        if heading.episode is None:
            self._declared[payload] = heading
        sequence = append(self.appender, heading, payload, True)
        repeated = self.appender.position - len(self.records) - 1
        put = [(each, 0, content) for content, each in list(self._declared.items())[:repeated]]
        put.append((heading, sequence, payload))
        sizes = [64 + -(-(len(each.type) + len(content)) // 8) * 8 for each, _, content in put]
        offset = self.appender._offset - sum(sizes)
        for (each, number, content), size in zip(put, sizes, strict=True):
            self.records.append(record(len(self.records) + 1, each, number, content))
            self.places.append((self.appender.begun[-1].path, offset, size))
            offset += size

    def sync(self) -> None:
        span = self.appender.begin_sync()
        for segment in span.segments:
            segment.sync()
        self.appender.append_commit(span).sync()
        self.appender.end_sync(span)

    @property
    def segments(self) -> list[Path]:
        return [begun.path for begun in self.appender.begun]

    @property
    def end(self) -> int:
        """The offset of the next frame in the last segment."""
        return self.appender._offset


def second_frame(payload: bytes, *, sequence: int = 2, salt: int = salt_of(RECORDER, 1)) -> bytes:
    """Return the frame of a node at position 2 of the first segment, as a forger or an older file would leave it."""
    return encode(Frame(EVENT, 1, 2, sequence, WALL_NS, 1, episode(1), b"NodeStarted", payload), salt)


def overwrite(path: Path, offset: int, content: bytes) -> None:
    with path.open("rb+") as file:
        file.seek(offset)
        file.write(content)


def batch_of(
    queue: RecorderQueue, events: int, *, bytes_max: int = 2**22, age_s: float = 0.0
) -> asyncio.Task[list[Record]]:
    return asyncio.ensure_future(queue.get_batch(events_max=events, bytes_max=bytes_max, age_s_max=age_s))


# === live sources =============================================================================================
#
# Take the folder of a live recorder, and read from it as another process does.


def take(queue: RecorderQueue) -> LiveSource:
    """Take the folder; again if the recorder deletes stored segments just then."""
    for _ in range(10):
        source = LiveSource.take(queue.folder)
        if source is not None:
            return source
    raise AssertionError("the folder is not offered")


async def next_positions(source: LiveSource, *, events_max: int = 10_000, bytes_max: int = 2**22) -> list[int]:
    """Return the positions of the next batch, which must arrive within a minute."""
    batch = await asyncio.wait_for(
        source.get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=0.05), timeout=60
    )
    return [each.position for each in batch]


async def eventually(condition: Callable[[], bool]) -> None:
    """Wait until the condition holds, for a minute at most."""
    async with asyncio.timeout(60):
        while not condition():  # noqa: ASYNC110 - what another thread or process does sets no event of ours
            await asyncio.sleep(0.005)
