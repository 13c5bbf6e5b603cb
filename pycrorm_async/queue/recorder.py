"""The live queue of one recorder: put from any thread, read back and acknowledge in the writer's.

`put_nowait` copies one frame into a mapped file under a lock and makes no system call, so it neither waits for a disk
nor gives up the interpreter. When it returned the event is *written*: it survives `kill -9`. The sync thread makes it
*synced*, and only then `get_batch` gives it away; `acknowledge` makes it *stored*.

A sync that fails is never tried again on the same files and believed, for the kernel may have dropped what it could not
write. The queue refuses everything from then on with the disk's reason; what had been synced is still given away.
Going on in a new file would need a second copy of all that is not synced; a new recorder does not.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from pycrorm_async.clock import Clock
from pycrorm_async.config import Settings
from pycrorm_async.errors import InternalError, PycrormError, SpoolClosed, SpoolUnavailable
from pycrorm_async.events.envelope import Heading, Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.appender import Appender
from pycrorm_async.queue.bell import Bell
from pycrorm_async.queue.capacity import Capacity
from pycrorm_async.queue.folder import DRAIN, available, make_folder, remove_folder
from pycrorm_async.queue.frame import Buffer
from pycrorm_async.queue.locks import FileLock, in_forked_child, is_locked
from pycrorm_async.queue.outside import Outside
from pycrorm_async.queue.progress import Drained
from pycrorm_async.queue.reader import Batch, Cursor, Reader, map_segment
from pycrorm_async.queue.refused import RefusedRecords
from pycrorm_async.queue.segment import header_bytes, segment_path
from pycrorm_async.queue.syncer import Syncer

__all__ = ["RecorderQueue"]

_LAST_SYNC_S = 30.0
_log = logging.getLogger("pycrorm_async")
_SAY_S = 2.0
"""Who waits longer for room is told why."""
_LOOK_S = 0.05
"""How often the sync thread looks what another process has drained, while that may make a difference."""


class RecorderQueue:
    """An asyncio queue whose items survive the process. Made by `create`; one recorder, one life of a process.

    Producers are any threads and tasks. The consumer is one task of one loop, which may be another thread's and takes
    the lock `drain` with its first `get_batch`. A queue that is `offered` has its consumer in another process
    (`living.py`): what that stores and folds is seen in the file `progress`.
    """

    def __init__(
        self, *, folder: Path, recorder: bytes, settings: Settings, clock: Clock, alive: FileLock, offered: bool
    ) -> None:
        """Used by `create`, which made and locked the folder. Raises `SpoolUnavailable`."""
        self.folder = folder
        self.name = folder.name
        self._clock = clock
        self._alive = alive
        self._drain: FileLock | None = None
        self._bell = Bell()
        self._room_bell = Bell()
        self._synced = 0
        self._stored = 0
        self._failure: PycrormError | None = None
        self._closed = False
        self._gone = False
        self._safe_number = 0
        self._sync_interval_s = settings.sync_interval_ms / 1000
        self._syncer = Syncer(name=folder.name, interval_s=self._sync_interval_s, turn=self._turn)
        with available(folder):
            self._appender = Appender(
                folder=folder,
                recorder=recorder,
                capacity=Capacity.of(settings),
                clock=clock,
                wake=self._syncer.wake,
                hurry=self._syncer.hurry,
            )
            self._disk_was_full = self._appender.prepare()
            self._outside = Outside(folder) if offered else None
        self._refused = RefusedRecords(folder)
        self._reader = Reader(recorder=recorder, start=Cursor(1, header_bytes(0), 0), load=self._load)
        in_forked_child(self._forked)
        self._syncer.start()

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
        folder, alive = make_folder(spool, episode_text(recorder))
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
        with `reserved` when nothing would, and `SpoolStuck` instead after `give_up`; `SpoolClosed` after `close` and in
        a forked child; `SpoolUnavailable` after
        the disk failed; `EpisodeRefused` for a start when so many episodes are open that the largest record would not
        fit into a segment beside their names. `InternalError` for what our own hooks never put: an event of an episode
        that is not between its `EpisodeStarted` and its `EpisodeEnded`, for it could have no sequence, and a record
        above `record_bytes_max` that no segment can hold. What is refused leaves no gap.
        """
        return self._appender.put(heading, payload, reserved)

    @property
    def full(self) -> bool:
        """Whether an ordinary event, as large as the largest that was refused, would be refused now."""
        return not self._appender.admits_again(reserved=False)

    async def room(self) -> None:
        """Done when such an ordinary event fits again, or nothing may be put any more: putting says why.

        Raises `SpoolStuck` when there is no use in waiting (`give_up`).
        """
        saying = asyncio.get_running_loop().call_later(_SAY_S, self._say_it_waits)
        try:
            await self._room_bell.until(lambda: self._room_is_decided(reserved=False))
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
        if self._syncer.is_this_thread:
            return False
        end_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
        decided = self._room_bell.block_until(
            lambda: self._room_is_decided(reserved=True),
            remaining_s=lambda: (end_ns - self._clock.monotonic_ns()) / 1e9,
        )
        self._refuse_to_wait(reserved=True)
        return decided

    def _room_is_decided(self, *, reserved: bool) -> bool:
        if self._over or self._appender.stuck is not None or self._appender.admits_again(reserved=reserved):
            return True
        if self._outside is not None:
            self._syncer.call_in(_LOOK_S)
        return False

    def _refuse_to_wait(self, *, reserved: bool) -> None:
        if self._appender.stuck is not None and not self._over and not self._appender.admits_again(reserved=reserved):
            raise self._appender.fullness("spool_bytes_max is reached")

    # --- positions ---------------------------------------------------------------------------------------------

    @property
    def written(self) -> int:
        """Position of the last record: all up to it survive the death of the process."""
        return self._appender.position

    @property
    def synced(self) -> int:
        """All up to this position survive the death of the machine."""
        return self._synced

    @property
    def stored(self) -> int:
        """All up to this position are acknowledged."""
        if self._outside is None:
            return self._stored
        return max(self._stored, self._outside.believed(synced=self._synced).stored)

    @property
    def drained_outside(self) -> Drained | None:
        """What the process that drains this queue says, as far as it can be true; None if it is this one."""
        return None if self._outside is None else self._outside.believed(synced=self._synced)

    @property
    def is_drained(self) -> bool:
        """Whether somebody, here or elsewhere, drains it at this moment."""
        with available(self.folder):
            return self._drain is not None or is_locked(self.folder / DRAIN)

    @property
    def bytes_spooled(self) -> int:
        """Bytes of segments that are not deleted; the last one counts as far as it is written."""
        return self._appender.bytes_held

    async def synced_to(self, position: int | None = None) -> None:
        """Done when everything up to this position, by default all that is written, is safe on the disk.

        From any loop; all who wait share one sync. Raises `SpoolUnavailable` if the disk refused, `SpoolClosed` in a
        forked child.
        """
        target = self.written if position is None else position
        if self._synced < target:
            self._syncer.hurry()
            await self._bell.until(lambda: self._synced >= target or self._failure is not None)
        if self._synced < target and self._failure is not None:
            raise self._failure

    # --- the consumer ------------------------------------------------------------------------------------------

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        """The next synced records in order, at least one, at most the limits (a single larger record comes alone).

        Waits until one is there, then at most `age_s_max` for more; `bytes_max` counts payloads. Empty once the queue
        is closed and drained. For a queue that is not offered. A batch whose call was cancelled is given again. After a
        failed sync gives what had been synced before, then raises `SpoolUnavailable`. Raises it also while another
        process drains this queue.
        """
        self._take_drain()
        await self._bell.until(partial(self._further, self._reader.cursor.position))
        batch = self._read(None, events_max, bytes_max)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(age_s_max):
                while not batch.complete and not self._drained(batch.after.position):
                    await self._bell.until(partial(self._further, batch.after.position))
                    batch = self._read(batch, events_max, bytes_max)
        if not batch.records and self._failure is not None:
            raise self._failure
        self._reader.cursor = batch.after
        return batch.records

    async def acknowledge(self, position: int) -> None:
        """Everything up to this position is stored for good: the sync thread deletes segments that hold no more."""
        assert position <= self._reader.cursor.position, "only what was given can be acknowledged"
        self._stored = max(self._stored, position)
        if self._trimmable():
            self._syncer.hurry()

    def set_aside(self, records: Sequence[Record]) -> bool:
        """These are refused, and kept in a folder of their episode's own when it returns (`refused.py`): True.

        From one thread at a time; blocks. Raises `FilesError` or `SpoolDamaged` when they can only stay here.
        """
        self._refused.put(records)
        return True

    def give_up(self, reason: str) -> None:
        """Nothing more will be acknowledged: from any thread. The first reason stays.

        What fits is put all the same; whoever waits for room, now or later, gets `SpoolStuck`.
        """
        self._appender.stuck = self._appender.stuck or reason
        self._room_bell.ring()

    def _read(self, begun: Batch | None, events_max: int, bytes_max: int) -> Batch:
        with available(self.folder):
            return self._reader.read(last=self._synced, events_max=events_max, bytes_max=bytes_max, begun=begun)

    def _further(self, position: int) -> bool:
        return self._synced > position or self._drained(position)

    def _drained(self, position: int) -> bool:
        """Whether nothing will come after this position any more."""
        return self._failure is not None or (self._closed and position == self.written)

    def _take_drain(self) -> None:
        if self._drain is None and not self._gone:
            with available(self.folder):
                self._drain = FileLock.take(self.folder / DRAIN)
            if self._drain is None:
                raise SpoolUnavailable(self.folder, "is being drained by another process")

    def _load(self, number: int) -> tuple[Path, Buffer]:
        path = segment_path(self.folder, number)
        return path, map_segment(path)

    # --- the sync thread ---------------------------------------------------------------------------------------

    def _turn(self) -> float | None:
        """Syncs, deletes what is stored, makes the next segment ahead; in how many seconds to come again by itself."""
        if self._failure is not None:
            return None
        try:
            self._sync()
            told = self._outside is None or self._exchange(self._outside)
            self._trim()
            full = self._prepare()
        except OSError as error:
            self._fail(SpoolUnavailable(self.folder, error.strerror or str(error)))
            return None
        except BaseException as error:
            self._fail(InternalError(f"the sync thread of {self.folder} failed: {error!r}"))
            raise
        if full:
            return self._sync_interval_s
        waiting = self._outside is not None and (self._room_bell.awaited or len(self._appender.begun) > 1)
        return _LOOK_S if waiting or not told else None

    def _exchange(self, outside: Outside) -> bool:
        """Tells whoever drains this queue what is synced, hears what is stored; False if it could not be told."""
        told = self._tell(outside)
        said = outside.believed(synced=self._synced)
        self._stored = max(self._stored, said.stored)
        if said.note.given_up != self._appender.stuck:
            self._appender.stuck = said.note.given_up
            self._room_bell.ring()
        return told

    def _sync(self) -> None:
        span = self._appender.begin_sync()
        if span.position == self._synced:
            return
        for segment in span.segments:
            segment.sync()
        # Only now may a commit frame say so: had it been written before, a power cut in between could leave the frame
        # on the disk without all that it speaks of, and an ordinary tail would look like damage.
        self._appender.append_commit(span).sync()
        self._appender.end_sync(span)
        self._safe_number = span.segments[-1].number
        self._synced = span.position
        if self._outside is not None:
            self._tell(self._outside)  # first, so that who waited for the disk need not wait for this
        self._bell.ring()

    def _tell(self, outside: Outside) -> bool:
        return outside.tell(synced=self._synced, closed=self._closed and self._synced == self.written)

    def _trimmable(self) -> bool:
        return bool(self._appender.trimmable(stored=self._stored, safe_number=self._safe_number))

    def _trim(self) -> None:
        gone = self._appender.trimmable(stored=self._stored, safe_number=self._safe_number)
        for segment in gone:
            segment.path.unlink(missing_ok=True)
        if gone:
            self._appender.trimmed(gone)
            self._room_bell.ring()

    def _prepare(self) -> bool:
        if self._closed:
            return False
        refused = self._appender.prepare()
        if not refused and self._disk_was_full:
            self._room_bell.ring()
        self._disk_was_full = refused
        return refused

    def _fail(self, error: PycrormError) -> None:
        self._failure = error
        self._appender.refuse(lambda: error)
        self._bell.ring()
        self._room_bell.ring()

    # --- the end -----------------------------------------------------------------------------------------------

    @property
    def _over(self) -> bool:
        return self._closed or self._failure is not None

    def close(self) -> None:
        """No more puts; a last sync begins at once. What is not given away yet still is, then `get_batch` gives []."""
        if self._closed:
            return
        self._appender.refuse(lambda: SpoolClosed(f"queue {self.name} is closed"))
        self._closed = True
        self._syncer.hurry()
        self._bell.ring()
        self._room_bell.ring()

    def release(self) -> None:
        """Closes, waits for the last sync, and gives up files and locks. Twice is once.

        Deletes the folder if everything in it is acknowledged and no episode is open; otherwise the folder is a dead
        one from now on, to be recovered. Blocks; raises `SpoolUnavailable` if the disk does not finish in time.
        """
        if self._gone:
            return
        self.close()
        if not self._syncer.stop(timeout_s=_LAST_SYNC_S):
            raise SpoolUnavailable(self.folder, f"the last sync took more than {_LAST_SYNC_S:.0f} s")
        self._gone = True
        self._appender.close()
        self._reader.close()
        try:
            if self._failure is None and self.stored == self.written and not self._appender.open:
                with available(self.folder):
                    remove_folder(self.folder)
        finally:
            if self._outside is not None:
                self._outside.close()
            self._refused.release()
            for lock in (self._drain, self._alive):
                if lock is not None:
                    lock.release()

    def _forked(self) -> None:
        """In a forked child: the queue is the parent's. The locks' copies close by themselves."""
        self._closed = self._gone = True
        self._failure = SpoolClosed(f"queue {self.name} belongs to the process that forked this one")
        failure = self._failure
        self._appender.abandon(lambda: failure)
        self._reader.close()
        self._bell, self._room_bell = Bell(), Bell()
