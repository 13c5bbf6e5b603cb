"""Sync, acknowledge, trim and move the files of a live queue, in turns of the sync thread.

**Theory of operation.** Three actors share a `QueueFiles`. The sync thread alone changes the files and, in `_turn`, the
positions and the state of a move. Producers put through `_appender` and wait for space on `_room_notifier`. The
consumer and callers of `synced_to` read `_synced`, `_setbacks`, `_checks` and wait on `_notifier`. Each attribute is
written by one thread, except those a producer or the consumer only sets to request work (`_check_requested`,
`_stored`), and each is replaced in one step, so the readers need no lock: they test their condition again after every
notification.

A turn does the following, in this order. It syncs the blobs and records put so far, appends a commit frame and syncs
that. Then it compares the files it holds with those in the folder, because syncing a deleted file succeeds, and only
then advances `_synced`. It exchanges positions with the drainer of another process. It deletes the segments whose
records are all stored, and prepares the next segment.

If a file was deleted or replaced, the queue is *displaced*: `_synced` stays, `synced_to` raises, and the turn moves the
queue to another folder (`relocation.py`). It retries with growing pauses until the move succeeds or the queue is
closed. Records that a move loses are noted in `_lost` and raised once by `synced_to`.

A sync that fails is never repeated on the same files, because the kernel may have dropped the pages it could not write.
The queue *fails*: it refuses every later put with the disk's error, and supplies the records synced before.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from pycrorm_async.clock import Clock
from pycrorm_async.errors import DamageError, FilesError, InternalError, PycrormError, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, episode_id
from pycrorm_async.queue.blobs.live_blobs import LiveBlobs
from pycrorm_async.queue.files.drain_status import DrainStatus, DrainStatusReader
from pycrorm_async.queue.files.locks import FileIdentity, FileLock
from pycrorm_async.queue.files.names import ALIVE
from pycrorm_async.queue.files.reader import Cursor, Place
from pycrorm_async.queue.files.recorder_folder import wrap_os_errors
from pycrorm_async.queue.files.segment import LastRecord, Segment, header_bytes
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.live.appender import NOTHING_OPEN
from pycrorm_async.queue.live.capacity import Capacity
from pycrorm_async.queue.live.notifier import Notifier
from pycrorm_async.queue.live.relocatable_appender import RelocatableAppender
from pycrorm_async.queue.live.relocation import Home, move
from pycrorm_async.queue.live.sync_thread import SyncThread
from pycrorm_async.queue.retention.stored_segments import StoredSegments
from pycrorm_async.settings import Settings

PROGRESS_INTERVAL_S = 0.05
"""Interval at which the sync thread reads `progress` while segments or producers wait for another process."""
_MOVE_RETRY_S_MAX = 5.0
"""Bounds the pause before a displaced queue tries again to create a folder."""

_log = logging.getLogger("pycrorm_async")


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
            self._disk_was_full = self._appender.prepare()
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
            return self._sync_interval_s
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
        refused = self._appender.prepare()
        if not refused and self._disk_was_full:
            self._room_notifier.notify_all()
        self._disk_was_full = refused
        return refused

    def _fail(self, error: PycrormError) -> None:
        _log.error("recording has stopped: %s", error)
        self._failure = error
        self._appender.refuse(lambda: error)
        self._notifier.notify_all()
        self._room_notifier.notify_all()
