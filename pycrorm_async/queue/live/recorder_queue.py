"""The live queue of one recorder: put from any thread, read back and acknowledge in the writer's.

`put_nowait` copies one frame into a mapped file under a lock and makes no system call, so it neither waits for a disk
nor gives up the interpreter. When it returned the event is *written*: it survives `kill -9`. The sync thread makes it
*synced*, and only then `get_batch` gives it away; `acknowledge` makes it *stored*.

A sync that fails is never tried again on the same files and believed, for the kernel may have dropped what it could not
write. The queue refuses everything from then on with the disk's reason; what had been synced is still given away.
Going on in a new file would need a second copy of all that is not synced; a new recorder does not.

Where the files themselves were deleted or replaced, the copy is the mapping: the queue moves (`relocation.py`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence
from pathlib import Path

from pycrorm_async.clock import Clock
from pycrorm_async.errors import FilesError, SpoolClosed, SpoolUnavailable
from pycrorm_async.events.envelope import Heading, Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.files.locks import FileLock, call_in_forked_child, is_locked
from pycrorm_async.queue.files.names import DRAIN
from pycrorm_async.queue.files.recorder_folder import make_folder, remove_folder, remove_made_ahead, wrap_os_errors
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.live.capacity import Capacity
from pycrorm_async.queue.live.consumer import Consumer
from pycrorm_async.queue.live.notifier import Notifier
from pycrorm_async.queue.live.queue_files import LOOK_S, QueueFiles
from pycrorm_async.queue.live.relocatable_appender import Relocated
from pycrorm_async.settings import Settings

__all__ = ["RecorderQueue"]

_LAST_SYNC_S = 30.0
_log = logging.getLogger("pycrorm_async")
_SAY_S = 2.0
"""Who waits longer for room is told why."""


class RecorderQueue(QueueFiles):
    """An asyncio queue whose items survive the process. Made by `create`; one recorder, one life of a process.

    Producers are any threads and tasks. The consumer is one task of one loop, which may be another thread's and takes
    the lock `drain` with its first `get_batch`. A queue that is `offered` has its consumer in another process
    (`living.py`): what that stores and folds is seen in the file `progress`.
    """

    def __init__(
        self, *, folder: Path, recorder: bytes, settings: Settings, clock: Clock, alive: FileLock, offered: bool
    ) -> None:
        """Used by `create`, which made and locked the folder. Raises `SpoolUnavailable`."""
        super().__init__(folder=folder, recorder=recorder, settings=settings, clock=clock, alive=alive, offered=offered)
        self._consumer = Consumer(self, self._notifier)
        call_in_forked_child(self._forked)
        self._sync_thread.start()

    @classmethod
    def create(
        cls, spool: Path, *, settings: Settings, clock: Clock, recorder: EpisodeId, offered: bool = False
    ) -> RecorderQueue:
        """A new queue in a folder of its own below `spool`, named by `recorder`, a UUIDv7.

        With `offered` it is another process that drains it. Raises `SpoolUnavailable` when the folder cannot be made or
        written, `CallerError` for settings that contradict each other. Blocks for the few milliseconds it takes to
        allocate the first segment.
        """
        Capacity.of(settings)
        folder, alive = make_folder(spool, episode_text(recorder), settings.file_access)
        try:
            return cls(folder=folder, recorder=recorder, settings=settings, clock=clock, alive=alive, offered=offered)
        except BaseException:
            with contextlib.suppress(OSError):
                remove_folder(folder)
            alive.release()
            raise

    # --- producers ---------------------------------------------------------------------------------------------

    def put_nowait(self, heading: Heading, payload: bytes, *, reserved: bool = False) -> int:
        """Append one event and return its sequence in its episode (0 for a recorder-level record).

        From any thread, but not from a signal handler. Raises `SpoolFull` when less than the reserve would stay free,
        with `reserved` when nothing would, and `SpoolStuck` instead after `fail`; `SpoolClosed` after `close` and in
        a forked child; `SpoolUnavailable` after the disk failed; `EpisodeRefused` for a start when no more open
        episodes fit into a segment's header. `InternalError` for what our own hooks never put: an event of an episode
        that is not between its `EpisodeStarted` and its `EpisodeEnded`, for it could have no sequence, and a record
        above `record_bytes_max` that no segment can hold. What is refused leaves no gap.
        """
        try:
            return self._appender.put(heading, payload, reserved)
        except Relocated:  # while this thread waited for the lock
            return self.put_nowait(heading, payload, reserved=reserved)

    @property
    def full(self) -> bool:
        """Whether an ordinary event, as large as the largest that was refused, would be refused now."""
        return not self._appender.admits_again(reserved=False)

    async def room(self) -> None:
        """Done when such an ordinary event fits again, or nothing may be put any more: putting says why.

        Raises `SpoolStuck` when there is no use in waiting (`fail`).
        """
        saying = asyncio.get_running_loop().call_later(_SAY_S, self._say_it_waits)
        try:
            await self._room_notifier.until(lambda: self._room_is_decided(reserved=False))
        finally:
            saying.cancel()
        self._refuse_to_wait(reserved=False)

    def _say_it_waits(self) -> None:
        _log.warning(
            "the plan waits: %s is full, or its disk, and goes on when the database has taken some of it"
            " (`pycrorm status` says how that is)",
            self.folder.parent,
        )

    def block_until_room(self, timeout_s: float) -> bool:
        """Block this thread until a reserved event fits; False if the time is over. Raises `SpoolStuck` as `room` does.

        False at once in the sync thread, which makes the room: the collector may have closed a plan there.
        """
        if self._sync_thread.is_this_thread:
            return False
        end_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
        decided = self._room_notifier.block_until(
            lambda: self._room_is_decided(reserved=True),
            remaining_s=lambda: (end_ns - self._clock.monotonic_ns()) / 1e9,
        )
        self._refuse_to_wait(reserved=True)
        return decided

    def _room_is_decided(self, *, reserved: bool) -> bool:
        if self._over or self._appender.stuck is not None or self._appender.admits_again(reserved=reserved):
            return True
        if self._outside is not None:
            self._sync_thread.call_in(LOOK_S)
        return False

    def _refuse_to_wait(self, *, reserved: bool) -> None:
        if self._appender.stuck is not None and not self._over and not self._appender.admits_again(reserved=reserved):
            raise self._appender.full_error("spool_bytes_max is reached")

    # --- positions ---------------------------------------------------------------------------------------------

    @property
    def is_drained(self) -> bool:
        """Whether somebody, here or elsewhere, drains it at this moment."""
        with wrap_os_errors(self.folder):
            return self._consumer.drains or is_locked(self.folder / DRAIN)

    @property
    def declarations_unrepeated(self) -> int:
        """How many declarations later segments do not begin with, because they take too much of a segment."""
        return self._appender.declarations.unrepeated

    @property
    def bytes_spooled(self) -> int:
        """Bytes of segments that are not deleted; the last one counts as far as it is written."""
        return self._appender.bytes_held

    async def synced_to(self, position: int | None = None) -> None:
        """Done when everything up to this position, by default all that is written, is safe on the disk.

        From any loop; all who wait share one sync. Raises `SpoolUnavailable` if the disk refused, and if the files were
        deleted or replaced meanwhile: when the queue has moved the next call succeeds. Records that were lost by it are
        raised once by a call that comes later. `SpoolClosed` in a forked child.
        """
        target = self.written if position is None else position
        setbacks, answers = self._setbacks, self._answers
        if self._synced >= target and not self._closed:  # nothing to sync, so the files are looked at here
            looking = self._displaced is not None or self._missing(self._appender.segments) is not None
        else:
            looking = self._displaced is not None
        if self._synced < target or looking:
            self._asked = self._asked or looking
            self._sync_thread.hurry()
            await self._notifier.until(
                lambda: (
                    self._failure is not None
                    or self._setbacks != setbacks
                    or (self._synced >= target and (not looking or self._answers > answers))
                )
            )
        if self._synced < target and self._failure is not None:
            raise self._failure
        if self._setbacks != setbacks and self._setback is not None:
            raise self._setback
        if self._unreported is not None:
            unreported, self._unreported = self._unreported, None
            raise unreported

    async def look(self) -> None:
        """Done when the sync thread has compared its files with those in the folder, and moved if they differ."""
        if self._gone:
            return
        answers, self._asked = self._answers, True
        self._sync_thread.hurry()
        await self._notifier.until(
            lambda: self._failure is not None or (self._answers > answers and self._displaced is None)
        )

    # --- the consumer ------------------------------------------------------------------------------------------

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        """The next synced records in order, at least one, at most the limits (a single larger record comes alone).

        Waits until one is there, then at most `age_s_max` for more; `bytes_max` counts payloads. Empty once the queue
        is closed and drained. For a queue that is not offered. A batch whose call was cancelled is given again. After a
        failed sync gives what had been synced before, then raises `SpoolUnavailable`. Raises it also while another
        process drains this queue.
        """
        return await self._consumer.get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)

    async def acknowledge(self, position: int) -> None:
        """Everything up to this position is stored for good: segments that hold no more go (`stored.py`)."""
        assert position <= self._consumer.reader.cursor.position, "only what was given can be acknowledged"
        if self._log_id is None:
            with contextlib.suppress(FilesError):
                self._log_id = Spool(self._spool).log_id()
        self._stored = max(self._stored, position)
        if self._trimmable():
            self._sync_thread.hurry()

    def dead_letter(self, records: Sequence[Record]) -> bool:
        """These are refused, and kept in a folder of their episode's own when it returns (`refused.py`): True.

        From one thread at a time; blocks. Raises `FilesError` or `SpoolDamaged` when they can only stay here.
        """
        self._consumer.dead_letter(records)
        return True

    def fail(self, reason: str) -> None:
        """Nothing more will be acknowledged: from any thread. The first reason stays.

        What fits is put all the same; whoever waits for room, now or later, gets `SpoolStuck`.
        """
        self._appender.stuck = self._appender.stuck or reason
        self._room_notifier.notify_all()

    def ends_at(self, position: int) -> bool:
        """Whether nothing will come after this position any more."""
        return self._failure is not None or (self._closed and position == self.written)

    # --- the end -----------------------------------------------------------------------------------------------

    def close(self) -> None:
        """No more puts; a last sync begins at once. What is not given away yet still is, then `get_batch` gives []."""
        if self._closed:
            return
        appender = None
        while appender is not self._appender:  # the sync thread may be about to replace it
            appender = self._appender
            appender.refuse(lambda: SpoolClosed(f"queue {self.name} is closed"))
        self._closed = True
        self._sync_thread.hurry()
        self._notifier.notify_all()
        self._room_notifier.notify_all()

    def release(self) -> None:
        """Closes, waits for the last sync, and gives up files and locks. Twice is once.

        Deletes the folder if everything in it is acknowledged and no episode is open; otherwise the folder is a dead
        one from now on, to be recovered. Blocks; raises `SpoolUnavailable` if the disk does not finish in time.
        """
        if self._gone:
            return
        self.close()
        if not self._sync_thread.stop(timeout_s=_LAST_SYNC_S):
            raise SpoolUnavailable(self.folder, f"the last sync took more than {_LAST_SYNC_S:.0f} s")
        self._gone = True
        self._appender.close()
        try:
            all_stored = self._failure is None and self.stored == self.written and not self._appender.open
            if all_stored and self._home.is_in_place:
                with wrap_os_errors(self.folder):
                    remove_made_ahead(self.folder)
                    self._keep_rest()
                    remove_folder(self.folder)
        finally:
            if self._outside is not None:
                self._outside.close()
            self._consumer.release()
            for lock in (self._home.alive, *self._left):
                lock.release()

    def _keep_rest(self) -> None:
        """What is left in the folder, all of it stored. No file is mapped any more."""
        if self.written:
            *full, last = self._appender.begun
            for segment in full:
                self._kept.keep(segment.path)
            self._kept.keep(last.path, length=self._appender.end)

    def _forked(self) -> None:
        """In a forked child: the queue is the parent's. The locks' copies close by themselves."""
        self._closed = self._gone = True
        self._failure = SpoolClosed(f"queue {self.name} belongs to the process that forked this one")
        failure = self._failure
        self._appender.abandon(lambda: failure)
        self._consumer.reader.close()
        self._notifier, self._room_notifier = Notifier(), Notifier()
