"""Supply a drain with records, and keep the dead letters it leaves."""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import accumulate
from pathlib import Path
from typing import Final, Self

import msgspec

from pycrorm_async.errors import SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.codec import LOST, Record
from pycrorm_async.events.ids import EpisodeId, episode_text, is_named, parse_episode_id
from pycrorm_async.queue import format as spool_format
from pycrorm_async.queue import scan, spool
from pycrorm_async.queue.blobs import blob_files
from pycrorm_async.queue.locks import ALIVE, DRAIN, REFUSED, FileLock, create_folder, is_locked
from pycrorm_async.queue.stored_segments import StoredSegments

# === dead letters =============================================================================================
#
# Keep the records that the database refuses, so that their recorder's segments can be deleted all the same.
#
# Each episode has one folder beside the recorder's, `<recorder>.<episode>.refused`, with segments in the same format.
# While the recorder's own folder exists, only its drainer adds records and no process drains them. Afterwards the
# folder is recovered like any dead folder: every start offers its records to the database, until the database takes all
# of them.
#
# After a crash between adding records here and acknowledging them there, the drainer adds the same records again;
# `DeadLetters` recognises them by their sequence.

_SEGMENT_BYTES: Final = 2**22
"""Size in bytes at which the next records begin another file."""


class DeadLetters:
    """The dead letters of one recorder, written by its drainer. Creates no folder before the first record."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._episodes: dict[EpisodeId, _EpisodeFolder] = {}

    def put(self, records: Sequence[Record]) -> None:
        """Add records; durable on return. Ignores records added before. Each episode's records must have no gap.

        Raises `FilesError` or `SpoolDamaged`: then keep the records in the recorder's folder and add no more.
        """
        runs: dict[EpisodeId, list[Record]] = {}
        for record in records:
            assert record.episode is not None, "only episodes are refused"
            runs.setdefault(record.episode, []).append(record)
        for episode, run in runs.items():
            if episode not in self._episodes:
                self._episodes[episode] = _EpisodeFolder(self._folder, episode)
            self._episodes[episode].put(run)
            if run[-1].type == spool_format.EPISODE_ENDED:
                self._episodes.pop(episode).release()

    def release(self) -> None:
        """Unlock the folders for other processes. Idempotent."""
        while self._episodes:
            self._episodes.popitem()[1].release()


class _EpisodeFolder:
    """One episode's folder, locked. Seals the files of earlier processes and continues in a new file."""

    def __init__(self, recorder_folder: Path, episode: EpisodeId) -> None:
        self._recorder = spool.parse_folder_name(recorder_folder.name).recorder
        self._episode = episode
        self.folder = recorder_folder.with_name(f"{recorder_folder.name}.{episode_text(episode)}{REFUSED}")
        self._last: spool_format.LastRecord | None = None
        self._uncommitted: tuple[int, ...] = ()
        with spool.wrap_os_errors(self.folder):
            with suppress(FileExistsError):
                create_folder(self.folder)
            alive = FileLock.take(self.folder / ALIVE)
            if alive is None:
                raise SpoolUnavailable(self.folder, "is used by another process")
            self._alive = alive
            try:
                self._resume()
            except BaseException:
                alive.release()
                raise

    def put(self, run: Sequence[Record]) -> None:
        head = run[0].sequence - 1 if self._last is None else self._last.sequence
        fresh = [record for record in run if record.sequence > head]
        if not fresh:
            return
        if fresh[0].sequence != head + 1:
            raise SpoolUnavailable(
                self.folder, f"holds events up to {head}, and event {fresh[0].sequence} leaves a gap"
            )
        with spool.wrap_os_errors(self.folder):
            if self._bytes < _SEGMENT_BYTES:
                self._append(fresh)
            else:
                self._begin(fresh)
        self._position += len(fresh)
        self._last, self._uncommitted = _last_of(fresh[-1]), ()

    def release(self) -> None:
        self._alive.release()

    def _resume(self) -> None:
        """Find the last record; truncate a torn tail and sync the rest."""

        def note_last(_: spool_format.ReadCursor, frame: spool_format.Frame) -> None:
            if frame.kind == spool_format.EVENT:
                self._last = _last_of(frame)

        prefix, damage, self._uncommitted = scan.survey(self.folder, self._recorder, on_frame=note_last)
        if damage is not None:
            raise damage
        scan.seal(self.folder, prefix)
        scan.sync_segments(self.folder, prefix.bases)
        spool_format.sync_path(self.folder.parent)
        self._number, self._position = prefix.cut.number, prefix.cut.position
        self._bytes = _SEGMENT_BYTES  # a sealed file is not extended: begin another

    def _begin(self, fresh: Sequence[Record]) -> None:
        first = fresh[0]
        before = self._last or spool_format.LastRecord(first.sequence - 1, first.wall_ns, first.monotonic_ns)
        opened = {self._episode: before} if first.sequence > 1 else {}
        self._number += 1
        header = spool_format.SegmentHeader(self._recorder, self._number, self._position + 1, opened)
        content = b"".join((spool_format.encode_segment_header(header), *self._span(fresh)))
        spool.write_durably(spool_format.segment_path(self.folder, self._number), content)
        self._bytes = len(content)

    def _append(self, fresh: Sequence[Record]) -> None:
        with spool_format.segment_path(self.folder, self._number).open("ab") as file:
            for part in self._span(fresh):  # records, sync, commit frame, sync: in this order (queue/__init__.py)
                self._bytes += file.write(part)
                file.flush()
                os.fdatasync(file.fileno())

    def _span(self, fresh: Sequence[Record]) -> tuple[bytes, bytes]:
        frames = [
            spool_format.Frame(
                spool_format.EVENT, version, 0, sequence, wall_ns, monotonic_ns, self._episode, kind.encode(), payload
            )
            for _, _, sequence, kind, version, wall_ns, monotonic_ns, payload in fresh
        ]
        salt = spool_format.salt_of(self._recorder, self._number)
        return spool_format.encode_span(frames, after=self._position, salt=salt, uncommitted=self._uncommitted)


def _last_of(record: Record | spool_format.Frame) -> spool_format.LastRecord:
    return spool_format.LastRecord(record.sequence, record.wall_ns, record.monotonic_ns)


# === dead source ==============================================================================================
#
# Drain a dead recorder's folder: supply its whole records and the computed ends, then delete the folder.
#
# **Theory of operation.** `open_dead` takes `alive`, which proves that the recorder is dead, and `drain`, which
# excludes other drainers; `release` releases both. No process writes the segments any more, so the only races are with
# other recoverers, which the locks exclude, and with a kill of this process.
#
# The source scans as far as a batch needs (`scan.py`), in parts, between which other tasks of the loop run, such as the
# append of the batch before. It syncs a segment before it supplies any of its records: a killed process' last pages may
# exist only in the page cache. `get_batch` supplies records up to the scanner's `confirmed` position, that is records
# covered by a commit frame, and the rest only when the whole folder is scanned. So a folder that is damaged further on
# supplies its records before the damage and then raises `SpoolDamaged`. A repair of that folder keeps the same records
# at its beginning, so draining again continues with the same positions and sequences.
#
# When the scan has finished, each open episode without a name of its own gets a computed end: an EpisodeEnded of status
# LOST behind the last record, derived from the episode's last record and never written to the folder. A recovery that
# is killed and repeated computes the same bytes, and the log stores them once.
#
# `acknowledge` deletes segments whose records are all stored, oldest first, but keeps the last scanned one: the ends
# are computed from its header and records, and the next segment's header, which lists the open episodes too, may be
# damaged. The folder loses its last segment only in `release`, after all records and ends are acknowledged.


def open_dead(folder: Path, *, stored: StoredSegments | None = None, check: bool = False) -> DeadSource | None:
    """Open a dead folder as a source; None if its recorder lives, another process drains it, or it is missing.

    Also None for dead letters of a recorder whose own folder still exists, because its drainer may add more.

    Holds `alive` and `drain` until `release`. Scans until there are records to supply, and with `check` the whole
    folder. Moves segments whose records are all stored to `stored`, or deletes them without it. Raises `SpoolDamaged`,
    `SpoolForeign` and `SpoolUnavailable`; then it holds no lock.
    """
    with spool.wrap_os_errors(folder), ExitStack() as locks:
        own = folder.with_name(folder.name.partition(".")[0])
        if own != folder and (own / ALIVE).exists():
            return None
        for name in (ALIVE, DRAIN):
            lock = FileLock.take(folder / name, create=name == DRAIN)
            if lock is None:
                return None
            locks.callback(lock.release)
        recorder = spool.parse_folder_name(folder.name).recorder
        scan.truncate_at_lost_blob(folder, recorder)
        if check:
            scan.scan(folder, recorder)
        return DeadSource(folder, recorder, locks, stored)


class DeadSource:
    """The records of a dead recorder, in order, then the computed ends. Constructed by `open_dead`.

    Implements the writer's `ClaimedSource`.

    `lost` holds these ends, one per open episode; it is empty until the scan has finished. `stored` is the last
    acknowledged position.
    """

    is_alive = False

    def __init__(self, folder: Path, recorder: EpisodeId, locks: ExitStack, stored: StoredSegments | None) -> None:
        """Called by `open_dead` only. Takes over the locks, unless it raises."""
        self.folder = folder
        self.name = folder.name
        self.lost: tuple[Record, ...] = ()
        self._ready: list[Record] = []
        """Records scanned but not supplied yet; those beyond position `_confirmed` must wait."""
        self._confirmed = 0
        self._is_scanned = False
        self._scanner = scan.SegmentScanner(folder, recorder, records=self._ready)
        self._parts: Iterator[None] | None = None  # of the segment that is being scanned
        self._supplied = self._synced = 0
        while not self._is_scanned and self._confirmed == self._scanner.prefix.start.position:
            deque(self._scan_further(1), 0)
            self._sync(self._scanner.number)
            self._confirm(self._scanner.number)
        self._released = False
        self._stored_segments = stored
        self._dead_letters = DeadLetters(folder)
        self._supplied = self.stored = self._scanner.prefix.start.position
        self._locks = locks.pop_all()

    @property
    def all_stored(self) -> bool:
        """True if all records and computed ends are supplied and acknowledged."""
        return self._is_scanned and self.stored == self._confirmed

    @property
    def holds_dead_letters(self) -> bool:
        """True if this is a folder of dead letters."""
        return spool.parse_folder_name(self.name).episode is not None

    @property
    def damage(self) -> SpoolDamaged | None:
        """The damage met by the scan, if any; no record behind it is supplied."""
        return self._scanner.damage

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:  # noqa: ARG002
        """Return the next records in order, at least one, within the limits; an empty list after the last.

        Raises `SpoolDamaged` when only records that damage may affect remain, and `SpoolUnavailable`.
        """
        records, complete = self._next(events_max, bytes_max)
        while not (complete or self._is_scanned):
            try:
                for _ in self._scan_further(events_max):
                    await asyncio.sleep(0)
                number = self._scanner.number
                await asyncio.to_thread(self._sync, number)
                self._confirm(number)
            except SpoolDamaged:
                if not records:
                    raise
                break  # the next call raises
            records, complete = self._next(events_max, bytes_max)
        del self._ready[: len(records)]
        self._supplied += len(records)
        return records

    async def acknowledge(self, position: int) -> None:
        """Note that records up to this position are durable in the database; delete segments without others.

        Raises `SpoolUnavailable`.
        """
        assert position <= self._supplied, "only supplied records can be acknowledged"
        self.stored = max(self.stored, position)
        bases = self._scanner.prefix.bases
        with spool.wrap_os_errors(self.folder):
            for number in sorted(bases):
                following = bases.get(number + 1)
                if following is None or following - 1 > position:
                    break
                self._delete_segment(spool_format.segment_path(self.folder, number))

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

    def mark_pending(self, reason: str | None) -> None:
        """Do nothing: no process waits for the records of a dead folder to become visible."""

    def release(self) -> str | None:
        """Delete the folder if all its records are stored, and release the locks. Idempotent.

        Returns the outcome for a report; None if records are not stored: the next recovery supplies them again. Raises
        `SpoolUnavailable`.
        """
        try:
            if not self.all_stored:
                return None
            if not self._released:
                with spool.wrap_os_errors(self.folder):
                    spool.remove_made_ahead(self.folder)
                    self._keep_last_segments()
                    spool.remove_folder(self.folder)
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
            self._delete_segment(spool_format.segment_path(self.folder, number), length=length, blobs=blobs)

    def _scan_further(self, count: int) -> Iterator[None]:
        """Scan until this many records are ready, at most to the end of the segment; yield after each part."""
        with spool.wrap_os_errors(self.folder):
            self._parts = self._parts or self._scanner.parts()
            for _ in self._parts:
                if self._scanner.confirmed - self._supplied >= count:
                    return
                yield
            self._parts = None

    def _sync(self, number: int) -> None:
        if number != self._synced:
            with spool.wrap_os_errors(self.folder):
                scan.sync_segments(self.folder, [number])

    def _confirm(self, number: int) -> None:
        """Note that this segment, to which the scan has got, is synced, so that its records may be supplied."""
        self._synced = number
        if self._scanner.finished and not self._is_scanned:
            self.lost = computed_ends(self._scanner.prefix)
            self._ready += self.lost
        self._confirmed = self._scanner.confirmed + len(self.lost)
        self._is_scanned = self._scanner.finished

    def _next(self, events_max: int, bytes_max: int) -> tuple[list[Record], bool]:
        """Return the records to supply, and whether one more would exceed a limit."""
        records = self._ready[: min(events_max, self._confirmed - self._supplied)]
        sizes = [len(record.payload) for record in records]
        total = sum(sizes)
        if total < bytes_max:
            return records, len(records) == events_max
        fitting = sum(size <= bytes_max for size in accumulate(sizes))
        return records[: max(1, fitting)], True


def computed_ends(prefix: scan.ValidPrefix) -> tuple[Record, ...]:
    """Compute an EpisodeEnded of status LOST for each open episode, positioned behind the last record.

    Named episodes get none: a later recorder can continue them.
    """
    open_ = sorted(each for each in prefix.open.items() if not is_named(each[0]))
    return tuple(
        Record(
            position=prefix.cut.position + 1 + index,
            episode=episode,
            sequence=last.sequence + 1,
            type=spool_format.EPISODE_ENDED,
            version=1,
            wall_ns=last.wall_ns,
            monotonic_ns=last.monotonic_ns,
            payload=LOST,
        )
        for index, (episode, last) in enumerate(open_)
    )


async def read_in_parts(
    reader: spool_format.Reader, last: int, *, events_max: int, bytes_max: int
) -> spool_format.ReadBatch:
    """Read a batch as `reader.read` does, in parts, between which other tasks of the loop run."""
    batch: spool_format.ReadBatch | None = None
    position = reader.cursor.position
    while batch is None or not (batch.complete or position >= last):
        until = min(last, position + spool_format.RECORDS_AT_ONCE)
        batch = reader.read(last=until, events_max=events_max, bytes_max=bytes_max, partial=batch)
        position = batch.after.position
        await asyncio.sleep(0)
    return batch


# === live source ==============================================================================================
#
# Drain the folder of a recorder that lives in another process: supply its records as soon as they are synced.
#
# The holder of `drain` reads; only the recorder deletes segments, after it reads in `progress` that they are stored. So
# either process may be killed at any time. After a killed drainer the next one starts behind the visible position and
# appends again what was stored and is not visible yet, which the log stores once. So it publishes the visibility of all
# records for which a flush of the recorder may wait. If the recorder deletes stored segments meanwhile, reading raises
# `SpoolUnavailable`, and the daemon takes the folder again.
# After a killed recorder this source ends, and recovery supplies the whole folder again without regard to `progress`.

_PAUSE_S_MIN = 0.002
"""The first pause in s while no new records are synced; later pauses are longer."""
_PAUSE_S_MAX = 0.05
"""Bounds the pause between two reads of `progress`, and with it the delay until a synced record is supplied."""
_ALIVE_CHECK_S = 0.25
"""Interval between two tests of the recorder's `alive`."""


class LiveSource:
    """A live recorder's folder as a source. Constructed by `take`, used by one task, ended by `release`.

    Implements the writer's `ClaimedSource`.
    """

    holds_dead_letters = False

    def __init__(self, folder: Path, recorder: EpisodeId, drain: FileLock, progress: spool.Progress) -> None:
        """Called by `take` only, which holds the lock. Raises what `take` raises."""
        self.folder = folder
        self.name = folder.name
        self._recorder = recorder
        self._drain = drain
        self._progress = progress
        self._dead_letters = DeadLetters(folder)
        before = progress.drained()
        self._status = before._replace(note=spool.DrainNote())  # drops the note of an earlier drainer
        visible = min(before.stored, before.folded, progress.recorded().synced)
        self._reader = spool_format.Reader(spool_format.ReadPlace(folder, recorder, self._start_of(visible)))
        self._reader.skip_to(visible)
        self._until: int | None = None
        self._alive_checked_s = 0.0
        progress.write_drain_status(self._status)

    @classmethod
    def take(cls, folder: Path) -> Self | None:
        """Open the folder as a source; None if it is not offered, drained by another process, closed and drained, or
        its recorder is dead.

        Raises `SpoolDamaged`, `SpoolForeign` and `SpoolUnavailable`; then it holds no lock.
        """
        with spool.wrap_os_errors(folder), ExitStack() as opened:
            progress = spool.Progress.open(folder, writing=True)
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
        while not self._has_ended(recorded := self._progress.recorded()):
            last = recorded.synced if self._until is None else min(recorded.synced, self._until)
            if last > self.supplied:
                try:
                    with spool.wrap_os_errors(self.folder):
                        batch = await read_in_parts(self._reader, last, events_max=events_max, bytes_max=bytes_max)
                except (SpoolDamaged, SpoolUnavailable):
                    if self.is_alive:
                        raise
                    return []  # its files were deleted, or it is dead
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

    def mark_pending(self, reason: str | None) -> None:
        """Publish the reason why the tables do not show stored records. Raises `SpoolUnavailable`."""
        self._update_note(pending=reason)

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
        with spool.wrap_os_errors(self.folder):
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
        if is_alive and self.stored < self.supplied:
            return None
        return "has ended" if closed else "is still recording" if is_alive else "died"

    # --- inside -----------------------------------------------------------------------------------------------

    def _has_ended(self, recorded: spool.RecorderStatus) -> bool:
        if self._until is not None and self.supplied >= self._until:
            return True
        if recorded.closed and self.supplied >= recorded.synced:
            return True
        # Test this also under load: once the recorder is dead, recovery supplies all records again.
        now_s = asyncio.get_running_loop().time()
        if now_s - self._alive_checked_s < _ALIVE_CHECK_S:
            return False
        self._alive_checked_s = now_s
        return not self.is_alive

    def _update_note(self, **fields: object) -> None:
        status = self._status._replace(note=msgspec.structs.replace(self._status.note, **fields))
        if status != self._status:
            self._write_status(status)

    def _write_status(self, status: spool.DrainStatus) -> None:
        with spool.wrap_os_errors(self.folder):
            self._progress.write_drain_status(status)
        self._status = status

    def _start_of(self, visible: int) -> spool_format.ReadCursor:
        """Return the beginning of the segment with the record behind this position, or of the oldest segment."""
        start: spool_format.ReadCursor | None = None
        for number, path in spool_format.segments_in(self.folder).items():
            with spool_format.map_segment(path) as buffer:
                header = scan.read_header(path, buffer, recorder=self._recorder, number=number)
            if header is None or (start is not None and header.base - 1 > visible):
                break
            start = spool_format.ReadCursor(number, spool_format.header_bytes(len(header.open)), header.base - 1)
        return start or spool_format.ReadCursor(1, spool_format.header_bytes(0), 0)
