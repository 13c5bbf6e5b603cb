"""A dead recorder's folder, recovered: a source of everything that is whole in it, and its deletion afterwards.

It is looked at segment by segment, while what was found is given away already: nothing before a commit frame says that
it was safe, or all was looked at. So a folder that is damaged further on gives what was safe before the damage, and
then raises; what a repair keeps of it begins with the same records.

Each episode left open gets an end of status LOST behind the last record, computed from that episode's last record and
never written: recovering again, also after being killed in between, gives the same records.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.envelope import LOST, Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.names import ALIVE, DRAIN, MENDED
from pycrorm_async.queue.files.recorder_folder import (
    available,
    held_by,
    remove_folder,
    remove_made_ahead,
)
from pycrorm_async.queue.files.scan import SegmentScanner, ValidPrefix, make_safe, scan
from pycrorm_async.queue.files.segment import CLOSES, segment_path
from pycrorm_async.queue.retention.stored_segments import StoredSegments
from pycrorm_async.queue.sources.dead_letters import RefusedRecords

__all__ = ["RecoveredQueue", "computed_ends", "open_dead"]


def open_dead(folder: Path, *, stored: StoredSegments | None = None) -> RecoveredQueue | None:
    """The folder as a source, or None if its recorder lives, somebody drains it, or it is gone.

    None also for what was refused of a recorder whose own folder is still there: whoever drains that may put more in.

    Takes `alive`, which proves the death, and `drain`, until `release` or `remove`. Looks at as much of it as it takes
    to give something. Segments whose records are all stored go to `stored`, if given. Raises `SpoolDamaged`,
    `SpoolForeign` and `SpoolUnavailable`, holding nothing.
    """
    with available(folder):
        own = folder.with_name(folder.name.partition(".")[0])
        if own != folder and ((own / ALIVE).exists() or own.with_name(f"{own.name}{MENDED}").exists()):
            return None
        alive = FileLock.take(folder / ALIVE, create=False)
        if alive is None:
            return None
        try:
            drain = FileLock.take(folder / DRAIN)
            if drain is None:
                alive.release()
                return None
            try:
                recorder = held_by(folder.name).recorder
                return RecoveredQueue(folder, recorder, (drain, alive), stored)
            except BaseException:
                drain.release()
                raise
        except BaseException:
            alive.release()
            raise


class RecoveredQueue:
    """The records of a dead recorder, in order, then the computed ends. Made by `open_dead`.

    `lost` are these ends, one for each episode left open, and empty until all of the folder was looked at; `stored` is
    the position acknowledged last.
    """

    def __init__(
        self, folder: Path, recorder: EpisodeId, locks: tuple[FileLock, ...], stored: StoredSegments | None
    ) -> None:
        self.folder = folder
        self.name = folder.name
        self.lost: tuple[Record, ...] = ()
        self._recorder = recorder
        self._ready: list[Record] = []
        """What was found and not given yet. Given is what `_settled` covers."""
        self._settled = 0
        self._walk = SegmentScanner(folder, recorder, found=self._ready.append)
        while self._look_further() and self._settled == self._walk.kept.start.position:
            pass
        self._locks = locks
        self._kept = stored
        self._refused = RefusedRecords(folder)
        self._given = self.stored = self._walk.kept.start.position

    @property
    def all_stored(self) -> bool:
        """Whether everything that is in it was looked at, given and acknowledged, with the computed ends."""
        return self._walk.over and self.stored == self._settled

    @property
    def holds_refused(self) -> bool:
        """Whether all of it was refused before."""
        return held_by(self.name).episode is not None

    @property
    def damage(self) -> SpoolDamaged | None:
        """What was met; nothing is given that may stand behind it."""
        return self._walk.damage

    def check(self) -> None:
        """Looks at all of it, and gives nothing. Raises `SpoolDamaged`, `SpoolForeign` and `SpoolUnavailable`."""
        with available(self.folder):
            scan(self.folder, self._recorder)

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:  # noqa: ARG002
        """The next records in order, at least one, at most the limits; empty when all are given.

        Raises `SpoolDamaged` where that begins which may not be kept, and `SpoolUnavailable`.
        """
        batch = self._next(events_max, bytes_max)
        while not (batch.complete or self._walk.over):
            try:
                await asyncio.to_thread(self._look_further)
            except SpoolDamaged:
                if not batch.records:
                    raise
                break  # the next call raises
            batch = self._next(events_max, bytes_max)
        del self._ready[: len(batch.records)]
        self._given += len(batch.records)
        return batch.records

    async def acknowledge(self, position: int) -> None:
        """Everything up to this position is stored for good: segments that hold no more go, oldest first.

        The last one that was looked at stays: the ends are computed from it, and the header of the next one, which says
        what is open there too, may be damaged. Raises `SpoolUnavailable`.
        """
        assert position <= self._given, "only what was given can be acknowledged"
        self.stored = max(self.stored, position)
        bases = self._walk.kept.bases
        with available(self.folder):
            for number in sorted(bases):
                following = bases.get(number + 1)
                if following is None or following - 1 > position:
                    break
                self._forget(segment_path(self.folder, number))

    def dead_letter(self, records: Sequence[Record]) -> bool:
        """As `RecorderQueue.dead_letter`; what was refused before stays where it is."""
        if self.holds_refused:
            return False
        self._refused.put(records)
        return True

    def fail(self, reason: str) -> None:
        """Nobody puts into it, so nobody waits for room."""

    def remove(self) -> None:
        """Deletes the folder, all of which is stored, and gives up the locks. Raises `SpoolUnavailable`."""
        assert self.all_stored, "what is not acknowledged is not deleted"
        try:
            with available(self.folder):
                remove_made_ahead(self.folder)
                self._forget_rest()
                remove_folder(self.folder)
        finally:
            self.release()

    def release(self) -> None:
        """Gives up the locks; what was not acknowledged is given again by whoever recovers next. Twice is once."""
        self._refused.release()
        for lock in self._locks:
            lock.release()

    def _forget(self, segment: Path, *, length: int | None = None) -> None:
        if self._kept is None:
            segment.unlink(missing_ok=True)
        else:
            self._kept.keep(segment, length=length)

    def _forget_rest(self) -> None:
        """Of the last segment what stands before the cut; one without a record is not kept."""
        cut = self._walk.kept.cut
        for number, base in sorted(self._walk.kept.bases.items()):
            if base <= cut.position:
                length = cut.offset if number == cut.number else None
                self._forget(segment_path(self.folder, number), length=length)

    def _look_further(self) -> bool:
        """At the next segment, which is on the disk then; False if there is no more."""
        with available(self.folder):
            if self._walk.over:
                return False
            more = self._walk.step()
            if more:
                make_safe(self.folder, [self._walk.kept.cut.number])
        if not more:
            self.lost = computed_ends(self._walk.kept)
            self._ready += self.lost
        self._settled = self._walk.settled + len(self.lost)
        return more

    def _next(self, events_max: int, bytes_max: int) -> _Batch:
        records = self._ready[: min(events_max, self._settled - self._given)]
        sizes = [len(record.payload) for record in records]
        total = sum(sizes)
        if total < bytes_max:
            return _Batch(records, complete=len(records) == events_max)
        fitting = sum(size <= bytes_max for size in accumulate(sizes))
        return _Batch(records[: max(1, fitting)], complete=True)


class _Batch(NamedTuple):
    """`complete`: one more would pass a limit."""

    records: list[Record]
    complete: bool


def computed_ends(kept: ValidPrefix) -> tuple[Record, ...]:
    """An end of status LOST for each episode that is open, behind the last record."""
    return tuple(
        Record(
            position=kept.cut.position + 1 + index,
            episode=episode,
            sequence=last.sequence + 1,
            type=CLOSES,
            version=1,
            wall_ns=last.wall_ns,
            monotonic_ns=last.monotonic_ns,
            payload=LOST,
        )
        for index, (episode, last) in enumerate(sorted(kept.open.items()))
    )
