"""A recorder's live queue: any thread puts events; one task of the writer reads and acknowledges them.

`put_nowait` copies one frame into a mapped file under a lock. It writes to no file descriptor, so it does not wait for
a disk. On return the event is *written*: it survives `kill -9`. The sync thread makes it *synced*, and only then does
`get_batch` return it; `acknowledge` makes it *stored*.

After a failed sync the queue refuses every new event with the disk's error (`queue_files.py`), and still supplies the
events synced before. It cannot continue in a new file, because it has no second copy of the unsynced records. If the
files were deleted or replaced instead, the mapped memory is such a copy, and the queue moves to another folder
(`relocation.py`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence
from pathlib import Path

from pycrorm_async.clock import Clock
from pycrorm_async.errors import FilesError, SpoolClosed, SpoolUnavailable
from pycrorm_async.events.envelope import Heading, Receipt, Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.files.locks import FileLock, call_in_forked_child, is_locked
from pycrorm_async.queue.files.names import DRAIN
from pycrorm_async.queue.files.recorder_folder import make_folder, remove_folder, remove_made_ahead, wrap_os_errors
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.live.capacity import Capacity
from pycrorm_async.queue.live.notifier import Notifier
from pycrorm_async.queue.live.queue_files import PROGRESS_INTERVAL_S, QueueFiles
from pycrorm_async.queue.live.relocatable_appender import AppenderRelocated
from pycrorm_async.queue.sources.own_source import OwnSource
from pycrorm_async.settings import Settings

_LAST_SYNC_S = 30.0
"""Bounds the time that `release` waits for the last sync; a disk that takes longer has failed."""
_log = logging.getLogger("pycrorm_async")
_WAIT_WARNING_S = 2.0
"""A wait for room logs one warning if it takes longer than this."""


class RecorderQueue(QueueFiles):
    """A queue whose items survive the process; `create` makes it, for one recorder in one process.

    Any thread or task may put. The consumer is one task of one event loop, in any thread; its first `get_batch` takes
    the file lock `drain`. If the queue is `offered`, the consumer is in another process (`sources/live_source.py`) and
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
            SpoolUnavailable: the disk failed before they were synced; or the files were deleted or replaced, and a
                later call succeeds once the queue has moved. If the move lost records, one call raises an error that
                names them.
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
        if self._synced < target and self._failure is not None:
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
        """Keep records that the database refused as dead letters (`sources/dead_letters.py`); return True.

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
