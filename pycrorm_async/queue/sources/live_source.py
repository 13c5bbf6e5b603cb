"""Drain the folder of a recorder that lives in another process: supply its records as soon as they are synced.

The holder of `drain` reads; only the recorder deletes segments, after it reads in `progress` that they are stored. So
either process may be killed at any time. After a killed drainer the next one starts behind the stored position and
appends the records in between again, which the log stores once. A flush of the recorder may wait for records that the
killed drainer stored and that are not visible yet; `invisible` lists them, so that their visibility is published. After
a killed recorder this source ends, and recovery supplies the whole folder again without regard to `progress`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import msgspec

from pycrorm_async.errors import SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, parse_episode_id
from pycrorm_async.queue.files.drain_status import DrainNote, DrainStatus, Progress
from pycrorm_async.queue.files.locks import FileLock, is_locked
from pycrorm_async.queue.files.names import ALIVE, DRAIN
from pycrorm_async.queue.files.reader import Cursor, Place, Reader
from pycrorm_async.queue.files.recorder_folder import wrap_os_errors
from pycrorm_async.queue.files.scan import read_header
from pycrorm_async.queue.files.segment import header_bytes, map_segment, segment_numbers, segment_path
from pycrorm_async.queue.sources.dead_letters import DeadLetters

_PAUSE_S_MIN = 0.002
"""The first pause in s while no new records are synced; later pauses are longer."""
_PAUSE_S_MAX = 0.02
"""Bounds the pause between two reads of `progress`, and with it the delay until a synced record is supplied."""
_ALIVE_CHECK_S = 0.25
"""Interval between two tests of the recorder's `alive`."""


class LiveSource:
    """A live recorder's folder as a source. Constructed by `take`, used by one task, ended by `release`.

    Implements the writer's `ClaimedSource`.

    Attributes:
        invisible: by episode, the last sequence that earlier drainers stored and that was not visible, as far as the
            segments are left.
    """

    holds_dead_letters = False

    def __init__(self, folder: Path, recorder: EpisodeId, drain: FileLock, progress: Progress) -> None:
        """Called by `take` only, which holds the lock. Raises what `take` raises."""
        self.folder = folder
        self.name = folder.name
        self._recorder = recorder
        self._drain = drain
        self._progress = progress
        self._dead_letters = DeadLetters(folder)
        before = progress.drained()
        self._status = before._replace(note=DrainNote())  # drops the note of an earlier drainer
        visible = min(before.stored, before.folded)
        self._reader = Reader(Place(folder, recorder, self._start_of(visible)))
        self.invisible: dict[EpisodeId, int] = {}
        stored = min(before.stored, progress.recorded().synced)
        self._reader.skip_to(min(visible, stored))
        self._reader.skip_to(stored, on_records=self._note_invisible)
        self._until: int | None = None
        self._alive_checked_s = 0.0
        progress.write_drain_status(self._status)

    @classmethod
    def take(cls, folder: Path) -> Self | None:
        """Open the folder as a source; None if it is not offered, drained by another process, closed and drained, or
        its recorder is dead.

        Reads the segments from the first record that is not visible to the last one that is stored. Raises
        `SpoolDamaged`, `SpoolForeign` and `SpoolUnavailable`; then it holds no lock.
        """
        with wrap_os_errors(folder), ExitStack() as opened:
            progress = Progress.open(folder, writing=True)
            if progress is None:
                return None
            opened.callback(progress.close)
            recorded = progress.recorded()
            if recorded.closed and progress.drained().stored >= recorded.synced:
                return None  # the recorder is about to delete it
            drain = FileLock.take(folder / DRAIN, create=False)
            if drain is None:
                return None
            opened.callback(drain.release)
            if not is_locked(folder / ALIVE):
                return None
            try:
                source = cls(folder, parse_episode_id(folder.name), drain, progress)
            except FileNotFoundError:  # the recorder deleted stored segments meanwhile: the next attempt succeeds
                return None
            opened.pop_all()
            return source

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:  # noqa: ARG002
        """Return the next synced records in order, at least one, within the limits (a larger record comes alone).

        Waits for the first record but not for more, because the records of one sync arrive together. Returns an empty
        list, now and in every later call, when the recorder is dead or has closed its queue, or after `finish`.
        """
        pause_s = _PAUSE_S_MIN
        while not self._has_ended():
            synced = self._progress.recorded().synced
            last = synced if self._until is None else min(synced, self._until)
            if last > self.supplied:
                try:
                    with wrap_os_errors(self.folder):
                        batch = self._reader.read(last=last, events_max=events_max, bytes_max=bytes_max)
                except (SpoolDamaged, SpoolUnavailable):
                    if self.is_alive:
                        raise
                    return []  # the recorder moved to another folder (`relocation.py`), or it is dead
                self._reader.cursor = batch.after
                return batch.records
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, _PAUSE_S_MAX)
        return []

    async def acknowledge(self, position: int) -> None:
        """Publish that records up to this position are durable in the database. Raises `SpoolUnavailable`."""
        assert position <= self.supplied, "only supplied records can be acknowledged"
        if position > self._status.stored:
            self._write_status(self._status._replace(stored=position))

    def dead_letter(self, records: Sequence[Record]) -> bool:
        """Implement `RecorderQueue.dead_letter`."""
        self._dead_letters.put(records)
        return True

    def fail(self, reason: str) -> None:
        """Publish the reason why no more records will be acknowledged: waiting producers then fail. The first stays."""
        if self._status.note.failure is None:
            self._update_note(failure=reason)

    def finish(self) -> None:
        """End this source behind the records that are synced now."""
        self._until = self._progress.recorded().synced

    def mark_visible(self, position: int, stopped: Mapping[str, str]) -> None:
        """Publish that records up to this position are visible in the tables, except those of `stopped` episodes.

        `stopped` maps episode id to reason. Raises `SpoolUnavailable`.
        """
        assert position <= self.supplied, "only supplied records can be visible"
        note = msgspec.structs.replace(self._status.note, stopped=dict(stopped))
        status = self._status._replace(folded=max(position, self._status.folded), note=note)
        if status != self._status:
            self._write_status(status)

    def mark_unavailable(self, reason: str | None) -> None:
        """Publish the reason why the database is unavailable; None when it is available. Raises `SpoolUnavailable`."""
        self._update_note(unavailable=reason)

    @property
    def supplied(self) -> int:
        """Position of the last supplied record."""
        return self._reader.cursor.position

    @property
    def stored(self) -> int:
        """Position last acknowledged by this drainer or an earlier one."""
        return self._status.stored

    @property
    def is_alive(self) -> bool:
        """True if the recorder lives and has not deleted its folder. Raises `SpoolUnavailable`."""
        with wrap_os_errors(self.folder):
            return is_locked(self.folder / ALIVE)

    def release(self) -> str | None:
        """Close the files and release `drain`. Idempotent.

        Returns the outcome for a report; None if the recorder lives and supplied records are not stored. Raises
        `SpoolUnavailable`.
        """
        try:
            closed, is_alive = self._progress.recorded().closed, self.is_alive
        finally:
            self._reader.close()
            self._progress.close()
            self._dead_letters.release()
            self._drain.release()
        if is_alive and self.stored != self.supplied:
            return None
        return "has ended" if closed else "is still recording" if is_alive else "died"

    # --- inside -----------------------------------------------------------------------------------------------

    def _has_ended(self) -> bool:
        if self._until is not None and self.supplied >= self._until:
            return True
        recorded = self._progress.recorded()
        if recorded.closed and self.supplied >= recorded.synced:
            return True
        # Test this also under load: once the recorder is dead, recovery supplies all records again.
        now_s = asyncio.get_running_loop().time()
        if now_s - self._alive_checked_s < _ALIVE_CHECK_S:
            return False
        self._alive_checked_s = now_s
        return not self.is_alive

    def _note_invisible(self, records: Sequence[Record]) -> None:
        self.invisible.update((each.episode, each.sequence) for each in records if each.episode is not None)

    def _update_note(self, **fields: object) -> None:
        status = self._status._replace(note=msgspec.structs.replace(self._status.note, **fields))
        if status != self._status:
            self._write_status(status)

    def _write_status(self, status: DrainStatus) -> None:
        with wrap_os_errors(self.folder):
            self._progress.write_drain_status(status)
        self._status = status

    def _start_of(self, visible: int) -> Cursor:
        """Return the beginning of the segment with the record behind this position, or of the oldest segment."""
        start: Cursor | None = None
        for number in segment_numbers(self.folder):
            path = segment_path(self.folder, number)
            try:
                buffer = map_segment(path)
            except FileNotFoundError:  # stored and deleted since the listing
                continue
            with buffer:
                header = read_header(path, buffer, recorder=self._recorder, number=number)
            if header is None or (start is not None and header.base - 1 > visible):
                break
            start = Cursor(number, header_bytes(len(header.open)), header.base - 1)
        return start or Cursor(1, header_bytes(0), 0)
