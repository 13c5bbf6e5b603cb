"""A recorder's live queue: any thread puts events; one task of the writer reads and acknowledges them.

`put_nowait` copies one frame into a mapped file under a lock. It writes to no file descriptor, so it does not wait for
a disk. On return the event is *written*: it survives `kill -9`. The sync thread makes it *synced*, and only then does
`get_batch` return it; `acknowledge` makes it *stored*.

After a failed sync the queue refuses every new event with the disk's error (`recorder_queue.py`), and still supplies
the events synced before. It cannot continue in a new file, because it has no second copy of the unsynced records. If
the files were deleted or replaced instead, the mapped memory is such a copy, and the queue moves to another folder
(`relocation.py`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from pycrorm_async.clock import Clock
from pycrorm_async.errors import (
    DamageError,
    FilesError,
    InternalError,
    PycrormError,
    SpoolClosed,
    SpoolDamaged,
    SpoolUnavailable,
)
from pycrorm_async.events.codec import Heading, Receipt, Record
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.queue.appender import NOTHING_OPEN, AppenderRelocated, Capacity, RelocatableAppender
from pycrorm_async.queue.blobs import LiveBlobs
from pycrorm_async.queue.format import Batch, Cursor, LastRecord, Place, Reader, Segment, header_bytes
from pycrorm_async.queue.locks import ALIVE, DRAIN, FileIdentity, FileLock, call_in_forked_child, is_locked
from pycrorm_async.queue.relocation import Home, move
from pycrorm_async.queue.sources import DeadLetters
from pycrorm_async.queue.spool import (
    DrainStatus,
    DrainStatusReader,
    Spool,
    make_folder,
    remove_folder,
    remove_made_ahead,
    wrap_os_errors,
)
from pycrorm_async.queue.stored_segments import StoredSegments
from pycrorm_async.queue.sync_thread import Notifier, SyncThread
from pycrorm_async.settings import Settings

# === queue files ==============================================================================================
#
# Sync, acknowledge, trim and move the files of a live queue, in turns of the sync thread.
#
# **Theory of operation.** Three actors share a `QueueFiles`. The sync thread alone changes the files and, in `_turn`,
# the positions and the state of a move. Producers put through `_appender` and wait for space on `_room_notifier`. The
# consumer and callers of `synced_to` read `_synced`, `_setbacks`, `_checks` and wait on `_notifier`. Each attribute is
# written by one thread, except those a producer or the consumer only sets to request work (`_check_requested`,
# `_stored`), and each is replaced in one step, so the readers need no lock: they test their condition again after every
# notification.
#
# A turn does the following, in this order. It syncs the blobs and records put so far, appends a commit frame and syncs
# that. Then it compares the files it holds with those in the folder, because syncing a deleted file succeeds, and only
# then advances `_synced`. It exchanges positions with the drainer of another process. It deletes the segments whose
# records are all stored, and prepares the next segment.
#
# If a file was deleted or replaced, the queue is *displaced*: `_synced` stays, `synced_to` raises, and the turn moves
# the queue to another folder (`relocation.py`). It retries with growing pauses until the move succeeds or the queue is
# closed. Records that a move loses are noted in `_lost` and raised once by `synced_to`.
#
# A sync that fails is never repeated on the same files, because the kernel may have dropped the pages it could not
# write. The queue *fails*: it refuses every later put with the disk's error, and supplies the records synced before.

PROGRESS_INTERVAL_S = 0.05
"""Interval at which the sync thread reads `progress` while segments or producers wait for another process, and the
longest pause before it asks a full disk for space again."""
_MOVE_RETRY_S_MAX = 5.0
"""Bounds the pause before a displaced queue tries again to create a folder."""


class QueueFiles:
    """The part of a queue that the sync thread maintains; `RecorderQueue` adds the producers and the consumer."""

    def __init__(
        self, *, folder: Path, recorder: bytes, settings: Settings, clock: Clock, alive: FileLock, offered: bool
    ) -> None:
        """Allocate the first segments; `alive` is the held lock in the folder. Raises `SpoolUnavailable`."""
        self._spool = folder.parent
        self._settings = settings
        self._clock = clock
        self._former_locks: list[FileLock] = []  # `alive` of the folders this queue has moved from
        self._log_id: str | None = None
        self._notifier = Notifier()
        self._room_notifier = Notifier()
        self._synced = 0
        self._stored = 0
        self._failure: PycrormError | None = None
        self._has_refused = False  # a record, because of the failure
        self._displaced: SpoolUnavailable | None = None  # set until the queue has moved
        self._setback: SpoolUnavailable | None = None
        self._setbacks = 0
        self._lost: tuple[str, ...] = ()
        self._lost_reported = 0
        self._unreported_loss: SpoolUnavailable | None = None  # a loss that `synced_to` has not raised yet
        self._check_requested = False
        self._checks = 0
        self._closed = False
        self._released = False
        self._safe_number = 0
        self._sync_interval_s = settings.sync_interval_ms / 1000
        self._stored_segments = StoredSegments(folder.parent, settings, wall_ns=clock.wall_ns)
        self._blobs = LiveBlobs(
            folder,
            reserve=self._reserve_blob,
            make_room=self._stored_segments.make_room,
        )
        self._sync_thread = SyncThread(name=folder.name, interval_s=self._sync_interval_s, turn=self._turn)
        with wrap_os_errors(folder):
            self._appender = self._appender_in(folder, recorder)
            if self._appender.prepare():
                self._sync_thread.call_in(PROGRESS_INTERVAL_S)
            self._drain_status = DrainStatusReader(folder) if offered else None
            place = Place(folder, recorder, Cursor(1, header_bytes(0), 0))
            self._home = Home(place, alive, FileIdentity.of(folder.stat()), self._appender, self._drain_status)

    @property
    def place(self) -> Place:
        """The folder the queue writes in; another one after its files were deleted or replaced (`relocation.py`)."""
        return self._home.place

    @property
    def folder(self) -> Path:
        return self._home.place.folder

    @property
    def name(self) -> str:
        return self._home.place.folder.name

    @property
    def failure(self) -> PycrormError | None:
        """The error that makes the queue refuse records; None while it accepts them, and after `close`."""
        return self._failure

    @property
    def setback(self) -> str | None:
        """The last loss of files or failure, with the folder where recording continues; None without one."""
        error = self._failure or self._setback
        return None if error is None else str(error)

    @property
    def lost(self) -> tuple[str, ...]:
        """Descriptions of the records lost with deleted files, whether synced or not."""
        return self._lost

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
        if self._drain_status is None:
            return self._stored
        return max(self._stored, self._drain_status.read(synced=self._synced).stored)

    @property
    def external_drain_status(self) -> DrainStatus | None:
        """The drain status from another process, if plausible; None if this process drains the queue."""
        return None if self._drain_status is None else self._drain_status.read(synced=self._synced)

    def ends_at(self, position: int) -> bool:
        """Return whether no record will follow this position."""
        return self._failure is not None or (self._closed and position == self.written)

    async def check_files(self) -> None:
        """Wait until the sync thread has compared its files with the folder, and has moved the queue if they differ."""
        if self._released:
            return
        checks, self._check_requested = self._checks, True
        self._sync_thread.hurry()
        await self._notifier.until(
            lambda: self._failure is not None or (self._checks > checks and self._displaced is None)
        )

    @property
    def _over(self) -> bool:
        return self._closed or self._failure is not None

    # --- the sync thread ---------------------------------------------------------------------------------------

    def _turn(self) -> float | None:
        """Sync, trim, prepare the next segment; return the seconds until the next turn is needed, or None."""
        if self._failure is not None:
            return None
        check_requested, self._check_requested = self._check_requested, False
        try:
            if self._displaced is None:
                self._sync(check=check_requested)
            if self._displaced is not None and not self._move():
                self._report_check(check_requested=check_requested)
                return min(_MOVE_RETRY_S_MAX, self._sync_interval_s * (1 << min(self._setbacks, 10)))
            published = self._drain_status is None or self._exchange(self._drain_status)
            self._trim()
            full = self._prepare()
            self._report_check(check_requested=check_requested)
        except OSError as error:
            if self._note_missing(self._appender.segments):  # the next turn moves the queue
                self._report_check(check_requested=check_requested)
                return 0.0
            self._fail(SpoolUnavailable(self.folder, error.strerror or str(error)))
            return None
        except BaseException as error:
            self._fail(InternalError(f"the sync thread of {self.folder} failed: {error!r}"))
            raise
        if full:
            return min(self._sync_interval_s, PROGRESS_INTERVAL_S)  # plans may wait for the space
        waiting = self._drain_status is not None and (self._room_notifier.awaited or len(self._appender.begun) > 1)
        return PROGRESS_INTERVAL_S if waiting or not published else None

    def _exchange(self, drain_status: DrainStatusReader) -> bool:
        """Publish the synced position to the drainer and read its status; False if publishing failed."""
        published = self._publish(drain_status)
        status = drain_status.read(synced=self._synced)
        self._stored = max(self._stored, status.stored)
        if status.note.failure != self._appender.stuck:
            self._appender.stuck = status.note.failure
            self._room_notifier.notify_all()
        return published

    def _report_check(self, *, check_requested: bool) -> None:
        if check_requested:
            self._checks += 1
            self._notifier.notify_all()

    def _sync(self, *, check: bool = False) -> None:
        span = self._appender.begin_sync()
        if span.records == 0:
            if check:
                self._note_missing(span.segments)
            return
        for segment in span.segments:
            segment.sync()
        self._note_lost_blobs(self._blobs.sync())
        # Append the commit frame only now: if it were synced together with its records, a power cut could keep the
        # frame and lose a record, and an ordinary torn tail would look like damage.
        committed = self._appender.append_commit(span)
        committed.sync()
        if self._note_missing((*span.segments, committed)):
            return
        self._appender.end_sync(span)
        self._appender.touch_ahead()
        self._safe_number = span.segments[-1].number
        self._synced = span.position
        if self._drain_status is not None:
            self._publish(self._drain_status)  # before waiters of this process run
        self._notifier.notify_all()

    def _reserve_blob(self, size: int) -> bool:
        return self._appender.reserve_blob(size)  # of the current appender, which a move replaces

    def _note_lost_blobs(self, names: Sequence[str]) -> None:
        if names:
            self._lost += tuple(f"blob {name}" for name in names)
            _log.error("%s: these blobs were deleted before they were stored: %s", self.folder, ", ".join(names))

    # --- moving ------------------------------------------------------------------------------------------------

    def _missing(self, segments: Sequence[Segment]) -> Path | None:
        """Return the first of our files whose name is missing or names another file."""
        if not self._home.alive.identity.is_at(self.folder / ALIVE):
            return self.folder / ALIVE
        return next((segment.path for segment in dict.fromkeys(segments) if not segment.is_in_place), None)

    def _note_missing(self, segments: Sequence[Segment]) -> bool:
        path = self._missing(segments)
        if path is None:
            return False
        self._displaced = SpoolUnavailable(path, "was deleted or replaced while the queue wrote to it")
        self._note_setback(self._displaced)
        return True

    def _note_setback(self, setback: SpoolUnavailable) -> None:
        if self._setback is None or str(setback) != str(self._setback):
            _log.error("%s", setback)
        self._setback = setback
        self._setbacks += 1
        self._notifier.notify_all()

    def _move(self) -> bool:
        """Move the queue to a new folder with all readable records, and sync; False if that must be retried."""
        displaced = self._displaced
        assert displaced is not None
        try:
            with wrap_os_errors(self._spool):
                self._stored = max(self._stored, self.stored)
                move(
                    self._home,
                    spool=self._spool,
                    access=self._settings.file_access,
                    recorder=episode_id(self._clock.wall_ns(), os.urandom(10)),
                    stored=self._stored,
                    appender_in=self._appender_in,
                    switch_home=self._switch_home,
                )
        except (FilesError, DamageError) as error:
            reason = f"{displaced.reason}, and recording cannot continue in a new folder: {error}"
            self._note_setback(SpoolUnavailable(displaced.path, reason))
            if self._closed and self._setback is not None:
                self._fail(self._setback)
            return False
        if self._log_id is not None:
            with suppress(FilesError):  # a failed note is harmless: this process drains into the right log
                Spool(self._spool, self._settings.file_access).bind(self._log_id)
        losses = self._lost[self._lost_reported :]
        lost = f"lost are {'; '.join(losses)}" if losses else "no record is lost"
        moved = SpoolUnavailable(displaced.path, f"{displaced.reason}; recording continues in {self.folder}, {lost}")
        # Set these before the sync, because `synced_to` returns after it.
        self._setback, self._lost_reported = moved, len(self._lost)
        if losses:
            self._unreported_loss = moved
        _log.error("%s", moved)
        self._displaced = None
        self._sync()
        return self._displaced is None

    def _switch_home(self, home: Home, lost: tuple[str, ...]) -> None:
        """Switch the queue to this home; called under the old appender's lock.

        Notes the lost records here, because the rest of the move may fail and be retried from the new folder.
        """
        self._blobs.move_to(home.place.folder)
        home.appender.blob_bytes = self._blobs.size
        self._lost += lost
        if home.alive is not self._home.alive:
            self._former_locks.append(self._home.alive)
        self._home, self._appender, self._drain_status = home, home.appender, home.drain_status
        self._safe_number = 0

    def _appender_in(
        self, folder: Path, recorder: bytes, after: int = 0, opened: Mapping[EpisodeId, LastRecord] = NOTHING_OPEN
    ) -> RelocatableAppender:
        return RelocatableAppender(
            folder=folder,
            recorder=recorder,
            capacity=Capacity.of(self._settings),
            clock=self._clock,
            wake=self._sync_thread.wake,
            hurry=self._sync_thread.hurry,
            make_room=self._stored_segments.make_room,
            after=after,
            opened=opened,
        )

    def _publish(self, drain_status: DrainStatusReader) -> bool:
        return drain_status.publish(synced=self._synced, closed=self._closed and self._synced == self.written)

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

    def _fail(self, error: PycrormError) -> None:
        _log.error("recording has stopped: %s", error)
        self._failure = error
        self._appender.refuse(partial(self._refused_after, error))
        self._notifier.notify_all()
        self._room_notifier.notify_all()

    def _refused_after(self, error: PycrormError) -> PycrormError:
        self._has_refused = True
        return error


# === recorder queue ===========================================================================================

_LAST_SYNC_S = 30.0
"""Bounds the time that `release` waits for the last sync; a disk that takes longer has failed."""
_log = logging.getLogger("pycrorm_async")
_WAIT_WARNING_S = 2.0
"""A wait for room logs one warning if it takes longer than this."""


class RecorderQueue(QueueFiles):
    """A queue whose items survive the process; `create` makes it, for one recorder in one process.

    Any thread or task may put. The consumer is one task of one event loop, in any thread; its first `get_batch` takes
    the file lock `drain`. If the queue is `offered`, the consumer is in another process (`sources.py`) and
    reports in the file `progress` how far it has stored and folded.
    """

    def __init__(
        self, *, folder: Path, recorder: bytes, settings: Settings, clock: Clock, alive: FileLock, offered: bool
    ) -> None:
        """Use `create`, which makes and locks the folder first. Raises `SpoolUnavailable`."""
        super().__init__(folder=folder, recorder=recorder, settings=settings, clock=clock, alive=alive, offered=offered)
        self._source = OwnSource(self, self._notifier)
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
        folder, alive = make_folder(spool, episode_text(recorder), settings.file_access)
        try:
            return cls(folder=folder, recorder=recorder, settings=settings, clock=clock, alive=alive, offered=offered)
        except BaseException:
            with contextlib.suppress(OSError):
                remove_folder(folder)
            alive.release()
            raise

    # --- producers ---------------------------------------------------------------------------------------------

    def put_nowait(
        self, heading: Heading, payload: bytes, *, reserved: bool = False, receipt: Receipt | None = None
    ) -> int:
        """Append one event and return its sequence in its episode (0 for a recorder-level record).

        May be called from any thread, but not from a signal handler, which could interrupt the holder of the lock. A
        refused event leaves no gap in the sequences.

        Args:
            reserved: the event may use the reserve (`spool_reserve_bytes`), which other events leave free.
            receipt: gets the sequence in the same step as the event is written.

        Raises:
            SpoolFull: the event does not fit; `SpoolStuck` instead after `fail`.
            SpoolClosed: after `close`, and in a forked child.
            SpoolUnavailable: the disk failed.
            EpisodeRefused: for an `EpisodeStarted`, if the header of a segment cannot list one more open episode.
            InternalError: an event before its `EpisodeStarted` or after its `EpisodeEnded`, or a record above
                `record_bytes_max` that no segment can hold. The hooks put neither.
        """
        try:
            return self._appender.put(heading, payload, reserved, receipt)
        except AppenderRelocated:  # the queue moved while this thread waited for the lock
            return self.put_nowait(heading, payload, reserved=reserved, receipt=receipt)

    def put_blob(self, content: bytes) -> str:
        """Write a blob and return its name, the SHA-256 of the content, for events put afterwards to refer to.

        Any thread may call it. On return the blob survives `kill -9`, and it is synced and stored before any event put
        afterwards. It is kept as long as the events put until `release_blob`, which the caller calls once for each put.

        Raises `SpoolFull` without waiting if it does not fit, `SpoolClosed` as `put_nowait` does, and
        `SpoolUnavailable` if the disk refuses it.
        """
        with wrap_os_errors(self.folder):
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

        Warns, and raises `SpoolStuck`, as `room` does. Returns False at once in the sync thread, which frees the space:
        a finalizer that runs there may end a plan, and with it record an event.
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
        if self._drain_status is not None:
            self._sync_thread.call_in(PROGRESS_INTERVAL_S)
        return False

    def _refuse_to_wait(self, *, reserved: bool) -> None:
        if self._appender.stuck is not None and not self._over and not self._appender.admits_again(reserved=reserved):
            raise self._appender.full_error("spool_bytes_max is reached")

    # --- positions ---------------------------------------------------------------------------------------------

    @property
    def is_drained(self) -> bool:
        """True if a task of this process or another process is draining the queue now."""
        with wrap_os_errors(self.folder):
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
            SpoolUnavailable: the disk failed before they were synced, or a record was refused since; or the files were
                deleted or replaced, and a later call succeeds once the queue has moved. If the move lost records, one
                call raises an error that names them.
            SpoolClosed: in a forked child, for records that were not synced before the fork.
        """
        target = self.written if position is None else position
        setbacks, checks = self._setbacks, self._checks
        if self._synced >= target and not self._closed:  # no sync would notice deleted files
            must_check = self._displaced is not None or self._missing(self._appender.segments) is not None
        else:
            must_check = self._displaced is not None
        if self._synced < target or must_check:
            self._check_requested = self._check_requested or must_check
            self._sync_thread.hurry()
            await self._notifier.until(
                lambda: (
                    self._failure is not None
                    or self._setbacks != setbacks
                    or (self._synced >= target and (not must_check or self._checks > checks))
                )
            )
        if self._failure is not None and (self._synced < target or self._has_refused):
            raise self._failure
        if self._setbacks != setbacks and self._setback is not None:
            raise self._setback
        if self._unreported_loss is not None:
            unreported, self._unreported_loss = self._unreported_loss, None
            raise unreported

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
            with contextlib.suppress(FilesError):
                self._log_id = Spool(self._spool).log_id()
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
        appender = None
        while appender is not self._appender:  # the sync thread may replace it meanwhile
            appender = self._appender
            appender.stuck = appender.stuck or reason
        self._room_notifier.notify_all()

    # --- the end -----------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Refuse further events and request the last sync; `get_batch` supplies the rest, then an empty list."""
        if self._closed:
            return
        appender = None
        while appender is not self._appender:  # the sync thread may replace it meanwhile
            appender = self._appender
            appender.refuse(lambda: SpoolClosed(f"queue {self.name} is closed"))
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
            raise SpoolUnavailable(self.folder, f"the last sync took more than {_LAST_SYNC_S:.0f} s")
        self._released = True
        self._appender.close()
        try:
            all_stored = self._failure is None and self.stored == self.written and not self._appender.open
            if all_stored and self._home.is_in_place:
                with wrap_os_errors(self.folder):
                    remove_made_ahead(self.folder)
                    self._keep_last_segments()
                    remove_folder(self.folder)
        finally:
            if self._drain_status is not None:
                self._drain_status.close()
            self._source.release()
            for lock in (self._home.alive, *self._former_locks):
                lock.release()

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
        self._failure = SpoolClosed(f"queue {self.name} belongs to the process that forked this one")
        failure = self._failure
        self._appender.abandon(lambda: failure)
        self._blobs.abandon()
        self._source.reader.close()
        self._notifier, self._room_notifier = Notifier(), Notifier()


# === own source ===============================================================================================
#
# Read synced records back from the folder of a live queue, in order, for the queue's one consumer.
#
# The source belongs to one task of one loop. The sync thread may move the queue to another folder at any time
# (`relocation.py`) and publishes the new `Place`. The source switches to it at its next step and continues behind its
# position. When a read fails, the source first asks the sync thread to check its files; if the queue then has moved,
# the source repeats the read in the new folder.


class OwnSource:
    """The consumer's side of a queue; it holds the lock `drain` from its first batch on."""

    def __init__(self, queue: QueueFiles, notifier: Notifier) -> None:
        self._queue = queue
        self._notifier = notifier
        self._place = queue.place
        self._drain: FileLock | None = None
        self._released = False
        self._dead_letters = DeadLetters(self._place.folder)
        self.reader = Reader(self._place)

    @property
    def drains(self) -> bool:
        return self._drain is not None

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        """Implement `RecorderQueue.get_batch`."""
        while True:
            try:
                self._switch_folder()
                return await self._batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)
            except (SpoolDamaged, SpoolUnavailable) as error:
                if error is self._queue.failure:
                    raise
                if self._queue.place is self._place:
                    await self._queue.check_files()
                if self._queue.place is self._place:
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

    def _switch_folder(self) -> None:
        """Continue in the queue's current folder, behind the last position; records lost in between are skipped."""
        place = self._queue.place
        if place is self._place:
            return
        reader = Reader(place)
        with wrap_os_errors(place.folder):
            reader.skip_to(self.reader.cursor.position)
        self.reader.close()
        self._dead_letters.release()
        if self._drain is not None:
            self._drain.release()
        self._drain, self._dead_letters = None, DeadLetters(place.folder)
        self.reader, self._place = reader, place

    async def _batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        self._take_drain()
        await self._notifier.until(partial(self._has_news, self.reader.cursor.position))
        batch = self._read(None, events_max, bytes_max)
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
        return self._queue.synced > position or self._queue.ends_at(position) or self._queue.place is not self._place

    def _read(self, partial_batch: Batch | None, events_max: int, bytes_max: int) -> Batch:
        if self._queue.place is not self._place:
            raise SpoolUnavailable(self._place.folder, "is no longer used: the queue has moved to another folder")
        with wrap_os_errors(self._place.folder):
            last = self._queue.synced
            return self.reader.read(last=last, events_max=events_max, bytes_max=bytes_max, partial=partial_batch)

    def _take_drain(self) -> None:
        if self._drain is None and not self._released:
            with wrap_os_errors(self._place.folder):
                self._drain = FileLock.take(self._place.folder / DRAIN)
            if self._drain is None:
                raise SpoolUnavailable(self._place.folder, "is being drained by another process")
