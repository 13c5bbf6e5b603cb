"""A recorder's live queue: any thread puts events; one task of the writer reads and acknowledges them.

`put_nowait` copies one frame into a mapped file under a lock. It writes to no file descriptor, so it does not wait for
a disk. On return the event is *written*: it survives `kill -9`. The sync thread makes it *synced*, and only then does
`get_batch` return it; `acknowledge` makes it *stored*.

After a failed sync the queue refuses every new event with the disk's error, and still supplies the events synced
before. It cannot continue in a new file, because it has no second copy of the unsynced records. Files that another
program has deleted or replaced end the queue in the same way, within a sync: nothing is acknowledged any more, because
the sync of a file without a name succeeds and keeps nothing.

**Theory of operation.** Three actors share a queue. The *sync thread* alone changes the files and, in `_turn`, the
positions. *Producers* put through `_appender` and wait for space on `_room_notifier`. The *consumer* and callers of
`synced_to` read `_synced` and wait on `_notifier`. Each attribute is replaced in one step, so the readers need no lock:
they test their condition again after every notification.

A turn does the following, in this order. It syncs the blobs and records put so far, appends a commit frame and syncs
that. Then it compares the files it holds with those in the folder, and only then advances `_synced`. It exchanges
positions with the drainer of another process. It deletes the segments whose records are all stored, and prepares the
next segment.

A sync that fails is never repeated on the same files, because the kernel may have dropped the pages it could not
write. The queue *fails*: it refuses every later put with the disk's error, and supplies the records synced before.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

from pycrorm_async import core, errors
from pycrorm_async.clock import Clock
from pycrorm_async.events.codec import Heading, Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue import spool as spools
from pycrorm_async.queue.appender import Appender, Capacity
from pycrorm_async.queue.blobs import LiveBlobs
from pycrorm_async.queue.format import ReadBatch, ReadCursor, Reader, ReadPlace, Segment, header_bytes
from pycrorm_async.queue.locks import ALIVE, DRAIN, FileIdentity, FileLock, call_in_forked_child, is_locked
from pycrorm_async.queue.sources import DeadLetters, read_in_parts
from pycrorm_async.queue.stored_segments import StoredSegments
from pycrorm_async.queue.sync_thread import Notifier, SyncThread
from pycrorm_async.settings import Settings

PROGRESS_INTERVAL_S = 0.05
"""Interval at which the sync thread reads `progress` while segments or producers wait for another process, and the
longest pause before it asks a full disk for space again."""
_LAST_SYNC_S = 30.0
"""Bounds the time that `release` waits for the last sync; a disk that takes longer has failed."""
_log = logging.getLogger("pycrorm_async")
_WAIT_WARNING_S = 2.0
"""A wait for room logs one warning if it takes longer than this."""


@functools.cache
def _note_core() -> None:
    """Log once if the compiled core is missing."""
    if not core.IS_COMPILED:
        _log.info(core.description())


class RecorderQueue:
    """A queue whose items survive the process; `create` makes it, for one recorder in one process.

    Any thread or task may put. The consumer is one task of one event loop, in any thread; its first `get_batch` takes
    the file lock `drain`. If the queue is `offered`, the consumer is in another process (`sources.py`) and
    reports in the file `progress` how far it has stored and folded.
    """

    def __init__(
        self, *, folder: Path, recorder: bytes, settings: Settings, clock: Clock, alive: FileLock, offered: bool
    ) -> None:
        """Use `create`, which makes and locks the folder first; `alive` is that lock. Raises `SpoolUnavailable`."""
        self.folder: Final = folder
        self.name: Final = folder.name
        self._clock = clock
        self._alive = alive
        self._log_id: str | None = None
        self._notifier = Notifier()
        self._room_notifier = Notifier()
        self._synced = 0
        self._stored = 0
        self._failure: errors.PycrormError | None = None
        self._has_refused = False  # a record, because of the failure
        self._is_displaced = False
        self._closed = False
        self._released = False
        self._safe_number = 0
        self._sync_interval_s = settings.sync_interval_ms / 1000
        self._stored_segments = StoredSegments(folder.parent, settings, wall_ns=clock.wall_ns)
        self._sync_thread = SyncThread(name=folder.name, interval_s=self._sync_interval_s, turn=self._turn)
        with spools.wrap_os_errors(folder):
            self._appender = Appender(
                folder=folder,
                recorder=recorder,
                capacity=Capacity.of(settings),
                clock=clock,
                wake=self._sync_thread.wake,
                hurry=self._sync_thread.hurry,
                make_room=self._stored_segments.make_room,
            )
            self._append: Final = self._appender.append
            if self._appender.prepare():
                self._sync_thread.call_in(PROGRESS_INTERVAL_S)
            self._progress = spools.Progress.make(folder) if offered else None
            self._identity = FileIdentity.of(folder.stat())
        self._blobs = LiveBlobs(folder, reserve=self._appender.reserve_blob, make_room=self._stored_segments.make_room)
        self._source = OwnSource(self, self._notifier, ReadPlace(folder, recorder, ReadCursor(1, header_bytes(0), 0)))
        call_in_forked_child(self._abandon)
        self._sync_thread.start()

    @classmethod
    def create(
        cls, spool: Path, *, settings: Settings, clock: Clock, recorder: EpisodeId, offered: bool = False
    ) -> RecorderQueue:
        """Create a queue in its own folder below `spool`; `recorder`, a UUIDv7, names the folder.

        If `offered`, another process drains it. Raises `SpoolUnavailable` if the folder cannot be created or written,
        and `CallerError` for contradictory settings. Blocks for a few milliseconds to allocate the first segment.
        """
        Capacity.of(settings)  # raises for contradictory settings before anything is created
        _note_core()
        folder, alive = spools.make_folder(spool, episode_text(recorder), settings.file_access)
        try:
            return cls(folder=folder, recorder=recorder, settings=settings, clock=clock, alive=alive, offered=offered)
        except BaseException:
            with contextlib.suppress(OSError):
                spools.remove_folder(folder)
            alive.release()
            raise

    # --- producers ---------------------------------------------------------------------------------------------

    def put_nowait(
        self,
        heading: Heading,
        payload: bytes,
        *,
        reserved: bool = False,
        at: tuple[int, int] | None = None,
        after: int = 0,
    ) -> int:
        """Append one event and return its sequence in its episode (0 for a recorder-level record).

        May be called from any thread, but not from a signal handler, which could interrupt the holder of the lock. A
        refused event leaves no gap in the sequences.

        Args:
            reserved: the event may use the reserve (`spool_reserve_bytes`), which other events leave free.
            at: the wall time and the monotonic time of the event, ns; by default those of the clock. The monotonic
                time is that of the episode's last event if it is earlier.
            after: of the first event of a named episode that earlier recorders began: the last sequence they stored.

        Raises:
            SpoolFull: the event does not fit; `SpoolStuck` instead after `fail`.
            SpoolClosed: after `close`, and in a forked child.
            SpoolUnavailable: the disk failed.
            EpisodeRefused: for an `EpisodeStarted`, if the header of a segment cannot list one more open episode.
            InternalError: an event before its `EpisodeStarted` or after its `EpisodeEnded`, or a record above
                `record_bytes_max` that no segment can hold. The hooks put neither.
        """
        sequence = self._append(heading, payload, reserved) if at is None else None
        return self._appender.put(heading, payload, reserved, at, after) if sequence is None else sequence

    def put_blob(self, content: bytes) -> str:
        """Write a blob and return its name, the SHA-256 of the content, for events put afterwards to refer to.

        Any thread may call it. On return the blob survives `kill -9`, and it is synced and stored before any event put
        afterwards. It is kept as long as the events put until `release_blob`, which the caller calls once for each put.

        Raises `SpoolFull` without waiting if it does not fit, `SpoolClosed` after `close` and in a forked child, and
        `SpoolUnavailable` if the disk refuses it.
        """
        with spools.wrap_os_errors(self.folder):
            return self._blobs.put(content)

    def release_blob(self, name: str) -> None:
        """State that no event put from now on refers to this blob because of one of its puts."""
        self._blobs.release(name, self.written)

    @property
    def full(self) -> bool:
        """True if an event that is not reserved, as large as the largest one refused so far, would be refused now."""
        return not self._appender.admits_again(reserved=False)

    async def room(self) -> None:
        """Wait until the queue is not `full`, or until it refuses all events.

        Raises `SpoolStuck` when waiting cannot help, because draining has stopped (`fail`).
        """
        warning = asyncio.get_running_loop().call_later(_WAIT_WARNING_S, self._warn_waiting)
        try:
            await self._room_notifier.until(lambda: self._room_is_decided(reserved=False))
        finally:
            warning.cancel()
        self._refuse_to_wait(reserved=False)

    def _warn_waiting(self) -> None:
        _log.warning(
            "the plan waits because spool %s or its disk is full; it continues when the database has stored some events"
            " (`pycrorm status` shows the state)",
            self.folder.parent,
        )

    def block_until_room(self, timeout_s: float, *, reserved: bool = True) -> bool:
        """Block this thread until an event fits or the queue refuses all events; False after `timeout_s`.

        Warns after two seconds. Raises `SpoolStuck` when waiting cannot help, because draining has stopped (`fail`).
        Returns False at once in the sync thread, which frees the space: a finalizer that runs there may end a plan, and
        with it record an event.
        """
        if self._sync_thread.is_this_thread:
            return False
        decided = self._block_until_decided(min(timeout_s, _WAIT_WARNING_S), reserved=reserved)
        if not decided and timeout_s > _WAIT_WARNING_S:
            self._warn_waiting()
            decided = self._block_until_decided(timeout_s - _WAIT_WARNING_S, reserved=reserved)
        self._refuse_to_wait(reserved=reserved)
        return decided

    def _block_until_decided(self, timeout_s: float, *, reserved: bool) -> bool:
        end_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
        return self._room_notifier.block_until(
            lambda: self._room_is_decided(reserved=reserved),
            remaining_s=lambda: (end_ns - self._clock.monotonic_ns()) / 1e9,
        )

    def _room_is_decided(self, *, reserved: bool) -> bool:
        if self._over or self._appender.stuck is not None or self._appender.admits_again(reserved=reserved):
            return True
        if self._progress is not None:
            self._sync_thread.call_in(PROGRESS_INTERVAL_S)
        return False

    def _refuse_to_wait(self, *, reserved: bool) -> None:
        if self._appender.stuck is not None and not self._over and not self._appender.admits_again(reserved=reserved):
            raise self._appender.full_error("spool_bytes_max is reached")

    # --- positions ---------------------------------------------------------------------------------------------

    @property
    def failure(self) -> errors.PycrormError | None:
        """The error that makes the queue refuse records; None while it accepts them, and after `close`."""
        return self._failure

    @property
    def lost(self) -> tuple[str, ...]:
        """A description of the records that deleted or replaced files took before they were stored; empty else."""
        if self._is_displaced and self.stored < self.written:
            return (f"positions {self.stored + 1} to {self.written}",)
        return ()

    @property
    def written(self) -> int:
        """Position of the last record put: records up to it survive the death of the process."""
        return self._appender.position

    @property
    def synced(self) -> int:
        """Last synced position: records up to it survive the death of the machine."""
        return self._synced

    @property
    def stored(self) -> int:
        """Last acknowledged position."""
        status = self.external_drain_status
        return self._stored if status is None else max(self._stored, status.stored)

    @property
    def external_drain_status(self) -> spools.DrainStatus | None:
        """The drain status from another process, if plausible; None if this process drains the queue."""
        if self._progress is None:
            return None
        status = self._progress.drained()
        # No drainer can have a position beyond `_synced`.
        return spools.DrainStatus() if max(status.stored, status.folded) > self._synced else status

    def ends_at(self, position: int) -> bool:
        """Return whether no record will follow this position."""
        return self._failure is not None or (self._closed and position == self.written)

    @property
    def _over(self) -> bool:
        return self._closed or self._failure is not None

    @property
    def is_drained(self) -> bool:
        """True if a task of this process or another process is draining the queue now."""
        with spools.wrap_os_errors(self.folder):
            return self._source.drains or is_locked(self.folder / DRAIN)

    @property
    def declarations_unrepeated(self) -> int:
        """Number of type declarations too large to be repeated at the start of later segments."""
        return self._appender.declarations.unrepeated

    @property
    def bytes_spooled(self) -> int:
        """Bytes of all blobs and segments not deleted yet; the current segment counts up to its last frame's end."""
        return self._appender.bytes_held + self._blobs.size

    async def synced_to(self, position: int | None = None) -> None:
        """Wait until the records up to this position, by default all written ones, are synced.

        May be called from any event loop; concurrent calls share one sync.

        Raises:
            SpoolUnavailable: the disk failed, or the files were deleted or replaced, before they were synced; or a
                record was refused since.
            SpoolClosed: in a forked child, for records that were not synced before the fork.
        """
        target = self.written if position is None else position
        if self._synced < target:
            self._sync_thread.hurry()
            await self._notifier.until(lambda: self._failure is not None or self._synced >= target)
        elif not self._closed:
            self.check_files()  # which no sync would notice
        if self._failure is not None and (self._synced < target or self._has_refused or self._is_displaced):
            raise self._failure

    def check_files(self) -> bool:
        """Return whether the files are those of this queue; if not, refuse every record from now on."""
        if self._failure is not None or self._released:
            return False
        path = self._missing(self._appender.segments)
        if path is not None:
            self._is_displaced = True
            reason = "was deleted or replaced while the queue wrote to it: nothing is recorded until the next start"
            self._fail(errors.SpoolUnavailable(path, reason))
        return path is None

    # --- the consumer ------------------------------------------------------------------------------------------

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        """Return the next synced records in order, within the limits; a record above the limits is returned alone.

        Waits for the first record, then at most `age_s_max` for more; `bytes_max` counts payloads. Returns an empty
        list only once the queue is closed and all its records were supplied. Must not be called on an offered queue.
        After a cancelled call the next one returns the same records. After a failed sync returns the records synced
        before, then raises `SpoolUnavailable`; raises it also while another process drains this queue.
        """
        return await self._source.get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)

    async def acknowledge(self, position: int) -> None:
        """Mark the records up to this position as stored in the database; the sync thread frees their segments."""
        assert position <= self._source.reader.cursor.position, "only supplied records can be acknowledged"
        if self._log_id is None:
            with contextlib.suppress(errors.FilesError):
                self._log_id = spools.Spool(self.folder.parent).log_id()
        self._stored = max(self._stored, position)
        if self._trimmable():
            self._sync_thread.hurry()

    def dead_letter(self, records: Sequence[Record]) -> bool:
        """Keep records that the database refused as dead letters (`sources.py`); return True.

        They are durable on return. Called by one thread at a time; blocks. Raises `FilesError` or `SpoolDamaged`; then
        the caller must not acknowledge the records.
        """
        self._source.dead_letter(records)
        return True

    def fail(self, reason: str) -> None:
        """State that no more records will be acknowledged, and why; the first reason is kept.

        May be called from any thread. Events that fit are still accepted; waiting for space that does not come raises
        `SpoolStuck`, now or later.
        """
        self._appender.stuck = self._appender.stuck or reason
        self._room_notifier.notify_all()

    # --- the end -----------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Refuse further events and request the last sync; `get_batch` supplies the rest, then an empty list."""
        if self._closed:
            return
        self._appender.refuse(lambda: errors.SpoolClosed(f"queue {self.name} is closed"))
        self._closed = True
        self._sync_thread.hurry()
        self._notifier.notify_all()
        self._room_notifier.notify_all()

    def release(self) -> None:
        """Close the queue, wait for the last sync, and release files and locks. Idempotent.

        Deletes the folder if all its records are stored, no episode is open and no file was lost; otherwise leaves the
        folder for recovery. Blocks. Raises `SpoolUnavailable` if the last sync takes more than 30 s; then the queue
        keeps its locks, and the call may be repeated.
        """
        if self._released:
            return
        self.close()
        if not self._sync_thread.stop(timeout_s=_LAST_SYNC_S):
            raise errors.SpoolUnavailable(self.folder, f"the last sync took more than {_LAST_SYNC_S:.0f} s")
        self._released = True
        self._appender.close()
        try:
            all_stored = self._failure is None and self.stored == self.written and not self._appender.open
            if all_stored and self._identity.is_at(self.folder):
                with spools.wrap_os_errors(self.folder):
                    spools.remove_made_ahead(self.folder)
                    self._keep_last_segments()
                    spools.remove_folder(self.folder)
        finally:
            if self._progress is not None:
                self._progress.close()
            self._source.release()
            self._alive.release()

    def _keep_last_segments(self) -> None:
        """Keep the last segments, whose records are all stored, for a database that goes back. Needs unmapped files."""
        if self.written:
            *full, last = self._appender.begun
            for segment in full:
                self._stored_segments.keep(segment.path)
            self._stored_segments.keep(last.path, length=self._appender.end, blobs=self._blobs.take_all())

    def _abandon(self) -> None:
        """Detach in a forked child: the queue belongs to the parent. The locks close their own copies there."""
        self._closed = self._released = True
        self._failure = errors.SpoolClosed(f"queue {self.name} belongs to the process that forked this one")
        failure = self._failure
        self._appender.abandon(lambda: failure)
        self._blobs.abandon()
        self._source.reader.close()
        self._notifier, self._room_notifier = Notifier(), Notifier()

    # --- the sync thread ---------------------------------------------------------------------------------------

    def _turn(self) -> float | None:
        """Sync, trim, prepare the next segment; return the seconds until the next turn is needed, or None."""
        if self._failure is not None:
            return None
        try:
            if not self._sync():
                return None
            published = self._publish()
            self._read_progress()
            self._trim()
            full = self._prepare()
        except OSError as error:
            if self.check_files():
                self._fail(errors.SpoolUnavailable(self.folder, error.strerror or str(error)))
            return None
        except BaseException as error:
            self._fail(errors.InternalError(f"the sync thread of {self.folder} failed: {error!r}"))
            raise
        if full:
            return min(self._sync_interval_s, PROGRESS_INTERVAL_S)  # plans may wait for the space
        waiting = self._progress is not None and (self._room_notifier.awaited or len(self._appender.begun) > 1)
        return PROGRESS_INTERVAL_S if waiting or not published else None

    def _read_progress(self) -> None:
        """Read how far the drainer in another process is, and whether it has stopped."""
        status = self.external_drain_status
        if status is not None:
            self._stored = max(self._stored, status.stored)
            if status.note.failure != self._appender.stuck:
                self._appender.stuck = status.note.failure
                self._room_notifier.notify_all()

    def _sync(self) -> bool:
        """Sync what was put; return False if another program has deleted or replaced the files."""
        span = self._appender.begin_sync()
        if span.records == 0:
            return True
        for segment in span.segments:
            segment.sync()
        self._blobs.sync()
        # Append the commit frame only now: if it were synced together with its records, a power cut could keep the
        # frame and lose a record, and an ordinary torn tail would look like damage.
        committed = self._appender.append_commit(span)
        committed.sync()
        if not self.check_files():
            return False
        self._appender.end_sync(span)
        self._appender.touch_ahead()
        self._safe_number = span.segments[-1].number
        self._synced = span.position
        self._publish()  # before waiters of this process run
        self._notifier.notify_all()
        return True

    def _missing(self, segments: Sequence[Segment]) -> Path | None:
        """Return the first of our files whose name is missing or names another file."""
        if not self._alive.identity.is_at(self.folder / ALIVE):
            return self.folder / ALIVE
        return next((segment.path for segment in dict.fromkeys(segments) if not segment.is_in_place), None)

    def _publish(self) -> bool:
        """Write the synced position for the drainer in another process; return False if that must be retried."""
        if self._progress is not None:
            try:
                is_last = self._closed and self._synced == self.written
                self._progress.write_recorder_status(spools.RecorderStatus(self._synced, is_last))
            except OSError:  # must not refuse the plan's events
                return False
        return True

    def _trimmable(self) -> bool:
        return bool(self._appender.trimmable(stored=self._stored, safe_number=self._safe_number))

    def _trim(self) -> None:
        segments = self._appender.trimmable(stored=self._stored, safe_number=self._safe_number)
        for segment in segments:
            following = self._appender.begun[self._appender.begun.index(segment) + 1]
            self._stored_segments.keep(segment.path, blobs=self._blobs.take(before=following.base))
        if segments:
            self._appender.trimmed(segments)
            self._room_notifier.notify_all()

    def _prepare(self) -> bool:
        if self._closed:
            return False
        if self._appender.prepare():
            return True
        self._room_notifier.notify_all()  # plans that wait since a put met a full disk
        return False

    def _fail(self, error: errors.PycrormError) -> None:
        _log.error("recording has stopped: %s", error)
        self._failure = error
        self._appender.refuse(partial(self._refused_after, error))
        self._notifier.notify_all()
        self._room_notifier.notify_all()

    def _refused_after(self, error: errors.PycrormError) -> errors.PycrormError:
        self._has_refused = True
        return error


# === own source ===============================================================================================
#
# Read synced records back from the folder of a live queue, in order, for the queue's one consumer.
#
# The source belongs to one task of one loop.


class OwnSource:
    """The consumer's side of a queue; it holds the lock `drain` from its first batch on."""

    def __init__(self, queue: RecorderQueue, notifier: Notifier, place: ReadPlace) -> None:
        self._queue = queue
        self._notifier = notifier
        self._drain: FileLock | None = None
        self._released = False
        self._dead_letters = DeadLetters(queue.folder)
        self.reader = Reader(place)

    @property
    def drains(self) -> bool:
        return self._drain is not None

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        """Implement `RecorderQueue.get_batch`."""
        try:
            return await self._batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)
        except (errors.SpoolDamaged, errors.SpoolUnavailable) as error:
            self._queue.check_files()  # a deleted file explains the error
            raise self._queue.failure or error from None

    def dead_letter(self, records: Sequence[Record]) -> None:
        """Implement `RecorderQueue.dead_letter`."""
        self._dead_letters.put(records)

    def release(self) -> None:
        """Close the files and release the locks. Idempotent."""
        self._released = True
        self.reader.close()
        self._dead_letters.release()
        if self._drain is not None:
            self._drain.release()

    async def _batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        self._take_drain()
        await self._notifier.until(partial(self._has_news, self.reader.cursor.position))
        last = self._queue.synced
        with spools.wrap_os_errors(self._queue.folder):
            batch = await read_in_parts(self.reader, last, events_max=events_max, bytes_max=bytes_max)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(age_s_max):
                while not batch.complete and not self._queue.ends_at(batch.after.position):
                    await self._notifier.until(partial(self._has_news, batch.after.position))
                    batch = self._read(batch, events_max, bytes_max)
        if not batch.records and self._queue.failure is not None:
            raise self._queue.failure
        self.reader.cursor = batch.after
        return batch.records

    def _has_news(self, position: int) -> bool:
        return self._queue.synced > position or self._queue.ends_at(position)

    def _read(self, partial_batch: ReadBatch, events_max: int, bytes_max: int) -> ReadBatch:
        with spools.wrap_os_errors(self._queue.folder):
            last = self._queue.synced
            return self.reader.read(last=last, events_max=events_max, bytes_max=bytes_max, partial=partial_batch)

    def _take_drain(self) -> None:
        if self._drain is None and not self._released:
            with spools.wrap_os_errors(self._queue.folder):
                self._drain = FileLock.take(self._queue.folder / DRAIN)
            if self._drain is None:
                raise errors.SpoolUnavailable(self._queue.folder, "is being drained by another process")
