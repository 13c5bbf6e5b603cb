"""The folder of a recorder that lives in another process, as a source: what it has synced, as it comes.

Whoever holds `drain` reads; the recorder alone deletes segments, when it sees in `progress` that they are stored. So
either side may be killed at any moment. A drainer that is killed is followed by one that starts behind what is stored,
and what was appended and not yet said is appended again, which stores it once. A recorder that is killed leaves a dead
folder: this source ends, and recovery gives all of it once more, `progress` ignored.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

import msgspec

from pycrorm_async.errors import SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, parse_episode_id
from pycrorm_async.queue.files.drain_status import DrainNote, DrainStatus, Progress
from pycrorm_async.queue.files.frame import Buffer
from pycrorm_async.queue.files.locks import FileLock, is_locked
from pycrorm_async.queue.files.names import ALIVE, DRAIN
from pycrorm_async.queue.files.reader import Cursor, Reader
from pycrorm_async.queue.files.recorder_folder import available
from pycrorm_async.queue.files.scan import checked_header
from pycrorm_async.queue.files.segment import header_bytes, map_segment, segment_numbers, segment_path
from pycrorm_async.queue.sources.dead_letters import RefusedRecords

__all__ = ["LiveQueue"]

_PAUSE_S_MIN = 0.002
_PAUSE_S_MAX = 0.02
_LOOK_ALIVE_S = 0.25


class LiveQueue:
    """Made by `take`; used by one task, and let go of with `release`."""

    def __init__(self, folder: Path, recorder: EpisodeId, drain: FileLock, progress: Progress) -> None:
        """Used by `take`, which holds the lock. Raises as that does."""
        self.folder = folder
        self.name = folder.name
        self._recorder = recorder
        self._drain = drain
        self._progress = progress
        self._refused = RefusedRecords(folder)
        before = progress.drained()
        self._said = before._replace(note=DrainNote())  # what a drainer before said in words is not ours to repeat
        self._reader = Reader(recorder=recorder, start=self._segment_of(before.stored), load=self._load)
        self._reader.skip_to(min(before.stored, progress.recorded().synced))
        self._until: int | None = None
        self._alive_looked_s = 0.0
        progress.tell_drained(self._said)

    @classmethod
    def take(cls, folder: Path) -> Self | None:
        """The folder as a source, or None: it is not offered, somebody drains it, it is all drained, or its recorder
        is dead.

        Reads up to a segment to find where to go on. Raises `SpoolDamaged`, `SpoolForeign` and `SpoolUnavailable`,
        holding nothing.
        """
        with available(folder):
            progress = Progress.open(folder, writing=True)
            if progress is None:
                return None
            taken: Self | None = None
            try:
                taken = cls._take(folder, progress)
            except FileNotFoundError:  # a segment that was stored and deleted while this looked: the next look finds on
                taken = None
            finally:
                if taken is None:
                    progress.close()
            return taken

    @classmethod
    def _take(cls, folder: Path, progress: Progress) -> Self | None:
        recorded = progress.recorded()
        if recorded.closed and progress.drained().stored >= recorded.synced:
            return None  # the recorder is about to delete it
        drain = FileLock.take(folder / DRAIN, create=False)
        if drain is None:
            return None
        try:
            if is_locked(folder / ALIVE):
                return cls(folder, parse_episode_id(folder.name), drain, progress)
        except BaseException:
            drain.release()
            raise
        drain.release()
        return None

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:  # noqa: ARG002
        """The next synced records in order, at least one, at most the limits (a single larger record comes alone).

        Waits until one is there, but not for more: what one sync covers comes together. Empty when the recorder is dead
        or has closed its queue, or after `finish`, and then for ever.
        """
        pause_s = _PAUSE_S_MIN
        while not self._ended():
            synced = self._progress.recorded().synced
            last = synced if self._until is None else min(synced, self._until)
            if last > self.given:
                try:
                    with available(self.folder):
                        batch = self._reader.read(last=last, events_max=events_max, bytes_max=bytes_max)
                except (SpoolDamaged, SpoolUnavailable):
                    if self.is_alive:
                        raise
                    return []  # its recorder went on in another folder (`relocation.py`), or it is dead
                self._reader.cursor = batch.after
                return batch.records
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, _PAUSE_S_MAX)
        return []

    async def acknowledge(self, position: int) -> None:
        """Everything up to this position is stored for good: the recorder may delete it. Raises `SpoolUnavailable`."""
        assert position <= self.given, "only what was given can be acknowledged"
        if position > self._said.stored:
            self._say(self._said._replace(stored=position))

    def dead_letter(self, records: Sequence[Record]) -> bool:
        """As `RecorderQueue.dead_letter`."""
        self._refused.put(records)
        return True

    def fail(self, reason: str) -> None:
        """Whoever waits for room there is told; the first reason stays."""
        if self._said.note.given_up is None:
            self._say_in_words(given_up=reason)

    def finish(self) -> None:
        """Nothing is given any more beyond what is synced now."""
        self._until = self._progress.recorded().synced

    def mark_visible(self, position: int, stopped: Mapping[str, str]) -> None:
        """Everything up to this position shows in the tables, or never will: of the episodes that are `stopped`, by id.

        Raises `SpoolUnavailable`.
        """
        assert position <= self.given, "only what was given can be shown"
        note = msgspec.structs.replace(self._said.note, stopped=dict(stopped))
        said = self._said._replace(folded=max(position, self._said.folded), note=note)
        if said != self._said:
            self._say(said)

    def mark_unavailable(self, reason: str | None) -> None:
        """Why the database takes nothing now; None when it does again. Raises `SpoolUnavailable`."""
        self._say_in_words(away=reason)

    @property
    def given(self) -> int:
        """Position of the last record that was given."""
        return self._reader.cursor.position

    @property
    def stored(self) -> int:
        """Position acknowledged last, by this drainer or one before."""
        return self._said.stored

    @property
    def is_alive(self) -> bool:
        """Whether the recorder lives, and does not delete its folder. Raises `SpoolUnavailable`."""
        with available(self.folder):
            return is_locked(self.folder / ALIVE)

    @property
    def is_closed(self) -> bool:
        """Whether the recorder will put nothing more."""
        return self._progress.recorded().closed

    def release(self) -> None:
        """Another may drain it. Twice is once."""
        self._reader.close()
        self._progress.close()
        self._refused.release()
        self._drain.release()

    # --- inside -----------------------------------------------------------------------------------------------

    def _ended(self) -> bool:
        if self._until is not None and self.given >= self._until:
            return True
        recorded = self._progress.recorded()
        if recorded.closed and self.given >= recorded.synced:
            return True
        # Looked at also while there is much to give: recovery gives it all again, so what is given now is given twice.
        now_s = asyncio.get_running_loop().time()
        if now_s - self._alive_looked_s < _LOOK_ALIVE_S:
            return False
        self._alive_looked_s = now_s
        return not self.is_alive

    def _say_in_words(self, **words: object) -> None:
        said = self._said._replace(note=msgspec.structs.replace(self._said.note, **words))
        if said != self._said:
            self._say(said)

    def _say(self, said: DrainStatus) -> None:
        with available(self.folder):
            self._progress.tell_drained(said)
        self._said = said

    def _segment_of(self, stored: int) -> Cursor:
        """Before the first record of the segment that holds what follows this position, or of the oldest there is."""
        found: Cursor | None = None
        for number in segment_numbers(self.folder):
            path = segment_path(self.folder, number)
            try:
                buffer = map_segment(path)
            except FileNotFoundError:  # stored, and deleted since it was listed
                continue
            with buffer:
                header = checked_header(path, buffer, recorder=self._recorder, number=number)
            if header is None or (found is not None and header.base - 1 > stored):
                break
            found = Cursor(number, header_bytes(len(header.open)), header.base - 1)
        return found or Cursor(1, header_bytes(0), 0)

    def _load(self, number: int) -> tuple[Path, Buffer]:
        path = segment_path(self.folder, number)
        return path, map_segment(path)
