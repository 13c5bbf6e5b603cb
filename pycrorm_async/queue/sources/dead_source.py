"""Drain a dead recorder's folder: supply its whole records and the computed ends, then delete the folder.

**Theory of operation.** `open_dead` takes `alive`, which proves that the recorder is dead, and `drain`, which excludes
other drainers; `release` releases both. No process writes the segments any more, so the only races are with other
recoverers, which the locks exclude, and with a kill of this process.

The source scans one segment at a time (`files/scan.py`) and syncs it before it supplies any of its records: a killed
process' last pages may exist only in the page cache. `get_batch` supplies records up to the scanner's `confirmed`
position, that is records covered by a commit frame, and the rest only when the whole folder is scanned. So a folder
that is damaged further on supplies its records before the damage and then raises `SpoolDamaged`. A repair of that
folder keeps the same records at its beginning, so draining again continues with the same positions and sequences.

When the scan has finished, each open episode gets a computed end: an EpisodeEnded of status LOST behind the last
record, derived from the episode's last record and never written to the folder. A recovery that is killed and repeated
computes the same bytes, and the log stores them once.

`acknowledge` deletes segments whose records are all stored, oldest first, but keeps the last scanned one: the ends are
computed from its header and records, and the next segment's header, which lists the open episodes too, may be damaged.
The folder loses its last segment only in `release`, after all records and ends are acknowledged.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.envelope import LOST, Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue.blobs.blob_files import blob_files
from pycrorm_async.queue.blobs.lost_blobs import truncate_at_lost_blob
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.names import ALIVE, DRAIN, MENDED
from pycrorm_async.queue.files.recorder_folder import (
    parse_folder_name,
    remove_folder,
    remove_made_ahead,
    wrap_os_errors,
)
from pycrorm_async.queue.files.scan import SegmentScanner, ValidPrefix, scan, sync_segments
from pycrorm_async.queue.files.segment import EPISODE_ENDED, segment_path
from pycrorm_async.queue.retention.stored_segments import StoredSegments
from pycrorm_async.queue.sources.dead_letters import DeadLetters


def open_dead(folder: Path, *, stored: StoredSegments | None = None, check: bool = False) -> DeadSource | None:
    """Open a dead folder as a source; None if its recorder lives, another process drains it, or it is missing.

    Also None for dead letters of a recorder whose own folder still exists, because its drainer may add more.

    Holds `alive` and `drain` until `release`. Scans until there are records to supply, and with `check` the whole
    folder. Moves segments whose records are all stored to `stored`, or deletes them without it. Raises `SpoolDamaged`,
    `SpoolForeign` and `SpoolUnavailable`; then it holds no lock.
    """
    with wrap_os_errors(folder), ExitStack() as locks:
        own = folder.with_name(folder.name.partition(".")[0])
        if own != folder and ((own / ALIVE).exists() or own.with_name(f"{own.name}{MENDED}").exists()):
            return None
        for name in (ALIVE, DRAIN):
            lock = FileLock.take(folder / name, create=name == DRAIN)
            if lock is None:
                return None
            locks.callback(lock.release)
        recorder = parse_folder_name(folder.name).recorder
        truncate_at_lost_blob(folder, recorder)
        if check:
            scan(folder, recorder)
        return DeadSource(folder, recorder, locks, stored)


class DeadSource:
    """The records of a dead recorder, in order, then the computed ends. Constructed by `open_dead`.

    Implements the writer's `ClaimedSource`.

    `lost` holds these ends, one per open episode; it is empty until the scan has finished. `stored` is the last
    acknowledged position.
    """

    is_alive = False
    invisible: Mapping[EpisodeId, int] = {}

    def __init__(self, folder: Path, recorder: EpisodeId, locks: ExitStack, stored: StoredSegments | None) -> None:
        """Called by `open_dead` only. Takes over the locks, unless it raises."""
        self.folder = folder
        self.name = folder.name
        self.lost: tuple[Record, ...] = ()
        self._ready: list[Record] = []
        """Records scanned but not supplied yet; those beyond position `_confirmed` must wait."""
        self._confirmed = 0
        self._scanner = SegmentScanner(folder, recorder, on_record=self._ready.append)
        while self._scan_further() and self._confirmed == self._scanner.prefix.start.position:
            pass
        self._released = False
        self._stored_segments = stored
        self._dead_letters = DeadLetters(folder)
        self._supplied = self.stored = self._scanner.prefix.start.position
        self._locks = locks.pop_all()

    @property
    def all_stored(self) -> bool:
        """True if all records and computed ends are supplied and acknowledged."""
        return self._scanner.finished and self.stored == self._confirmed

    @property
    def holds_dead_letters(self) -> bool:
        """True if this is a folder of dead letters."""
        return parse_folder_name(self.name).episode is not None

    @property
    def damage(self) -> SpoolDamaged | None:
        """The damage met by the scan, if any; no record behind it is supplied."""
        return self._scanner.damage

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:  # noqa: ARG002
        """Return the next records in order, at least one, within the limits; an empty list after the last.

        Raises `SpoolDamaged` when only records that damage may affect remain, and `SpoolUnavailable`.
        """
        batch = self._next(events_max, bytes_max)
        while not (batch.complete or self._scanner.finished):
            try:
                await asyncio.to_thread(self._scan_further)
            except SpoolDamaged:
                if not batch.records:
                    raise
                break  # the next call raises
            batch = self._next(events_max, bytes_max)
        del self._ready[: len(batch.records)]
        self._supplied += len(batch.records)
        return batch.records

    async def acknowledge(self, position: int) -> None:
        """Note that records up to this position are durable in the database; delete segments without others.

        Raises `SpoolUnavailable`.
        """
        assert position <= self._supplied, "only supplied records can be acknowledged"
        self.stored = max(self.stored, position)
        bases = self._scanner.prefix.bases
        with wrap_os_errors(self.folder):
            for number in sorted(bases):
                following = bases.get(number + 1)
                if following is None or following - 1 > position:
                    break
                self._delete_segment(segment_path(self.folder, number))

    def dead_letter(self, records: Sequence[Record]) -> bool:
        """Implement `RecorderQueue.dead_letter`; return False for records that are dead letters already; these stay."""
        if self.holds_dead_letters:
            return False
        self._dead_letters.put(records)
        return True

    def fail(self, reason: str) -> None:
        """Do nothing: no producer waits for space in a dead folder."""

    def finish(self) -> None:
        """Do nothing: no more records are added to a dead folder."""

    def mark_visible(self, position: int, stopped: Mapping[str, str]) -> None:
        """Do nothing: no process waits for the records of a dead folder to become visible."""

    def mark_unavailable(self, reason: str | None) -> None:
        """Do nothing: no process waits for the records of a dead folder to be stored."""

    def release(self) -> str | None:
        """Delete the folder if all its records are stored, and release the locks. Idempotent.

        Returns the outcome for a report; None if records are not stored: the next recovery supplies them again. Raises
        `SpoolUnavailable`.
        """
        try:
            if not self.all_stored:
                return None
            if not self._released:
                with wrap_os_errors(self.folder):
                    remove_made_ahead(self.folder)
                    self._keep_last_segments()
                    remove_folder(self.folder)
        finally:
            self._released = True
            self._dead_letters.release()
            self._locks.close()
        count = len(self.lost)
        return f"is recovered ({count} episode{'s' * (count != 1)} LOST)" if count else "is recovered"

    def _delete_segment(self, segment: Path, *, length: int | None = None, blobs: Sequence[Path] = ()) -> None:
        if self._stored_segments is None:
            segment.unlink(missing_ok=True)
        else:
            self._stored_segments.keep(segment, length=length, blobs=blobs)

    def _keep_last_segments(self) -> None:
        """Move the remaining segments to the stored ones, truncated at the cut; one without a record is not kept.

        All blobs are kept with the last segment.
        """
        cut = self._scanner.prefix.cut
        numbers = [number for number, base in sorted(self._scanner.prefix.bases.items()) if base <= cut.position]
        for number in numbers:
            length = cut.offset if number == cut.number else None
            blobs = blob_files(self.folder) if number == numbers[-1] else []
            self._delete_segment(segment_path(self.folder, number), length=length, blobs=blobs)

    def _scan_further(self) -> bool:
        """Scan and sync the next segment; False if there is none."""
        with wrap_os_errors(self.folder):
            if self._scanner.finished:
                return False
            more = self._scanner.step()
            if more:
                sync_segments(self.folder, [self._scanner.prefix.cut.number])
        if not more:
            self.lost = computed_ends(self._scanner.prefix)
            self._ready += self.lost
        self._confirmed = self._scanner.confirmed + len(self.lost)
        return more

    def _next(self, events_max: int, bytes_max: int) -> _Batch:
        records = self._ready[: min(events_max, self._confirmed - self._supplied)]
        sizes = [len(record.payload) for record in records]
        total = sum(sizes)
        if total < bytes_max:
            return _Batch(records, complete=len(records) == events_max)
        fitting = sum(size <= bytes_max for size in accumulate(sizes))
        return _Batch(records[: max(1, fitting)], complete=True)


class _Batch(NamedTuple):
    """Records to supply. `complete`: one more would exceed a limit."""

    records: list[Record]
    complete: bool


def computed_ends(prefix: ValidPrefix) -> tuple[Record, ...]:
    """Compute an EpisodeEnded of status LOST for each open episode, positioned behind the last record."""
    return tuple(
        Record(
            position=prefix.cut.position + 1 + index,
            episode=episode,
            sequence=last.sequence + 1,
            type=EPISODE_ENDED,
            version=1,
            wall_ns=last.wall_ns,
            monotonic_ns=last.monotonic_ns,
            payload=LOST,
        )
        for index, (episode, last) in enumerate(sorted(prefix.open.items()))
    )
