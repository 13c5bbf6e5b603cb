"""The files of a live queue, and the turns of the sync thread, which alone changes them.

A turn syncs what was put, acknowledges it if the files are still the ones in the folder, deletes what is stored, and
makes the next segment ahead. Where files were deleted or replaced it moves the queue (`relocation.py`).
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
from pycrorm_async.queue.files.drain_status import DrainStatus, DrainStatusReader
from pycrorm_async.queue.files.locks import FileIdentity, FileLock
from pycrorm_async.queue.files.names import ALIVE
from pycrorm_async.queue.files.reader import Cursor
from pycrorm_async.queue.files.recorder_folder import wrap_os_errors
from pycrorm_async.queue.files.segment import LastRecord, Segment, header_bytes
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.live.appender import NOTHING_OPEN
from pycrorm_async.queue.live.capacity import Capacity
from pycrorm_async.queue.live.consumer import Place
from pycrorm_async.queue.live.notifier import Notifier
from pycrorm_async.queue.live.relocatable_appender import RelocatableAppender
from pycrorm_async.queue.live.relocation import Home, move
from pycrorm_async.queue.live.sync_thread import SyncThread
from pycrorm_async.queue.retention.stored_segments import StoredSegments
from pycrorm_async.settings import Settings

__all__ = ["QueueFiles", "LOOK_S"]

LOOK_S = 0.05
"""How often the sync thread looks what another process has drained, while that may make a difference."""
_MOVE_AGAIN_S_MAX = 5.0
"""The longest pause before a displaced queue tries again to make a folder."""

_log = logging.getLogger("pycrorm_async")


class QueueFiles:
    """What the sync thread keeps of a queue. Producers and the consumer only read it (`recorder.py`)."""

    def __init__(
        self, *, folder: Path, recorder: bytes, settings: Settings, clock: Clock, alive: FileLock, offered: bool
    ) -> None:
        """`alive` is locked, and in the folder. Raises `SpoolUnavailable`."""
        self._spool = folder.parent
        self._settings = settings
        self._clock = clock
        self._left: list[FileLock] = []  # the `alive` of folders this queue has moved from
        self._log_id: str | None = None
        self._notifier = Notifier()
        self._room_notifier = Notifier()
        self._synced = 0
        self._stored = 0
        self._failure: PycrormError | None = None
        self._displaced: SpoolUnavailable | None = None  # until it has moved
        self._setback: SpoolUnavailable | None = None
        self._setbacks = 0
        self._lost: tuple[str, ...] = ()
        self._lost_noted = 0
        self._unreported: SpoolUnavailable | None = None  # a loss that no call of `synced_to` has raised
        self._asked = False
        self._answers = 0
        self._closed = False
        self._gone = False
        self._safe_number = 0
        self._sync_interval_s = settings.sync_interval_ms / 1000
        self._kept = StoredSegments(folder.parent, settings, wall_ns=clock.wall_ns)
        self._sync_thread = SyncThread(name=folder.name, interval_s=self._sync_interval_s, turn=self._turn)
        with wrap_os_errors(folder):
            self._appender = self._appender_in(folder, recorder)
            self._disk_was_full = self._appender.prepare()
            self._outside = DrainStatusReader(folder) if offered else None
            place = Place(folder, recorder, Cursor(1, header_bytes(0), 0))
            self._home = Home(place, alive, FileIdentity.of(folder.stat()), self._appender, self._outside)

    @property
    def place(self) -> Place:
        """The folder it writes in. Another one after its files were deleted or replaced (`relocation.py`)."""
        return self._home.place

    @property
    def folder(self) -> Path:
        return self._home.place.folder

    @property
    def name(self) -> str:
        return self._home.place.folder.name

    @property
    def failure(self) -> PycrormError | None:
        """Why nothing is taken any more; None while records are taken, and after `close`."""
        return self._failure

    @property
    def setback(self) -> str | None:
        """What befell its files last, and where it goes on; None if nothing did."""
        error = self._failure or self._setback
        return None if error is None else str(error)

    @property
    def lost(self) -> tuple[str, ...]:
        """The records that went with deleted files, in words: they had been synced, or were to be."""
        return self._lost

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
        return max(self._stored, self._outside.read(synced=self._synced).stored)

    @property
    def external_drain_status(self) -> DrainStatus | None:
        """What the process that drains this queue says, as far as it can be true; None if it is this one."""
        return None if self._outside is None else self._outside.read(synced=self._synced)

    @property
    def _over(self) -> bool:
        return self._closed or self._failure is not None

    # --- the sync thread ---------------------------------------------------------------------------------------

    def _turn(self) -> float | None:
        """Syncs, deletes what is stored, makes the next segment ahead; in how many seconds to come again by itself."""
        if self._failure is not None:
            return None
        asked, self._asked = self._asked, False
        try:
            if self._displaced is None:
                self._sync(look=asked)
            if self._displaced is not None and not self._move():
                self._answer(asked=asked)
                return min(_MOVE_AGAIN_S_MAX, self._sync_interval_s * (1 << min(self._setbacks, 10)))
            told = self._outside is None or self._exchange(self._outside)
            self._trim()
            full = self._prepare()
            self._answer(asked=asked)
        except OSError as error:
            if self._note_missing(self._appender.segments):  # the next turn moves
                self._answer(asked=asked)
                return 0.0
            self._fail(SpoolUnavailable(self.folder, error.strerror or str(error)))
            return None
        except BaseException as error:
            self._fail(InternalError(f"the sync thread of {self.folder} failed: {error!r}"))
            raise
        if full:
            return self._sync_interval_s
        waiting = self._outside is not None and (self._room_notifier.awaited or len(self._appender.begun) > 1)
        return LOOK_S if waiting or not told else None

    def _exchange(self, outside: DrainStatusReader) -> bool:
        """Tells whoever drains this queue what is synced, hears what is stored; False if it could not be told."""
        told = self._tell(outside)
        said = outside.read(synced=self._synced)
        self._stored = max(self._stored, said.stored)
        if said.note.given_up != self._appender.stuck:
            self._appender.stuck = said.note.given_up
            self._room_notifier.notify_all()
        return told

    def _answer(self, *, asked: bool) -> None:
        if asked:
            self._answers += 1
            self._notifier.notify_all()

    def _sync(self, *, look: bool = False) -> None:
        span = self._appender.begin_sync()
        if span.records == 0:
            if look:
                self._note_missing(span.segments)
            return
        for segment in span.segments:
            segment.sync()
        # Only now may a commit frame say so: had it been written before, a power cut in between could leave the frame
        # on the disk without all that it speaks of, and an ordinary tail would look like damage.
        committed = self._appender.append_commit(span)
        committed.sync()
        if self._note_missing((*span.segments, committed)):
            return
        self._appender.end_sync(span)
        self._safe_number = span.segments[-1].number
        self._synced = span.position
        if self._outside is not None:
            self._tell(self._outside)  # first, so that who waited for the disk need not wait for this
        self._notifier.notify_all()

    # --- moving ------------------------------------------------------------------------------------------------

    def _missing(self, segments: Sequence[Segment]) -> Path | None:
        """The first file of ours that has lost its name to another, or to none."""
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
        """Goes on in a new folder, and syncs there; False if that cannot be made now. What can be read is kept."""
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
                    settle=self._settle,
                )
        except (FilesError, DamageError) as error:
            reason = f"{displaced.reason}, and recording cannot go on in a new folder: {error}"
            self._note_setback(SpoolUnavailable(displaced.path, reason))
            if self._closed and self._setback is not None:
                self._fail(self._setback)
            return False
        if self._log_id is not None:
            with suppress(FilesError):  # the drain of this process has the right log open all the same
                Spool(self._spool, self._settings.file_access).bind(self._log_id)
        news = self._lost[self._lost_noted :]
        lost = f"lost are {'; '.join(news)}" if news else "no record is lost"
        moved = SpoolUnavailable(displaced.path, f"{displaced.reason}; recording goes on in {self.folder}, {lost}")
        # All of it before the sync, after which `synced_to` returns.
        self._setback, self._lost_noted = moved, len(self._lost)
        if news:
            self._unreported = moved
        _log.error("%s", moved)
        self._displaced = None
        self._sync()
        return self._displaced is None

    def _settle(self, home: Home, lost: tuple[str, ...]) -> None:
        """Called under the lock of the appender before: from now on this is where the queue writes.

        What is lost is noted here, because the rest of the move may fail and be made again from this folder.
        """
        self._lost += lost
        if home.alive is not self._home.alive:
            self._left.append(self._home.alive)
        self._home, self._appender, self._outside = home, home.appender, home.outside
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
            make_room=self._kept.make_room,
            after=after,
            opened=opened,
        )

    def _tell(self, outside: DrainStatusReader) -> bool:
        return outside.publish(synced=self._synced, closed=self._closed and self._synced == self.written)

    def _trimmable(self) -> bool:
        return bool(self._appender.trimmable(stored=self._stored, safe_number=self._safe_number))

    def _trim(self) -> None:
        gone = self._appender.trimmable(stored=self._stored, safe_number=self._safe_number)
        for segment in gone:
            self._kept.keep(segment.path)
        if gone:
            self._appender.trimmed(gone)
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
        _log.error("nothing more is recorded: %s", error)
        self._failure = error
        self._appender.refuse(lambda: error)
        self._notifier.notify_all()
        self._room_notifier.notify_all()
