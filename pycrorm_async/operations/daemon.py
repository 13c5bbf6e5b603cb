"""`pycrorm writer`: wires the daemon between a spool and its database."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AsyncExitStack
from pathlib import Path

import msgspec

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import DatabaseForeign, SpoolTaken
from pycrorm_async.events.envelope import Record
from pycrorm_async.operations.destination import open_destination, shared_address
from pycrorm_async.operations.fold_process import FoldProcess
from pycrorm_async.operations.fold_worker import Assignment
from pycrorm_async.operations.fold_workers import DaemonNote, FoldWorkers, FoldWorkerState, FoldWorkerTables
from pycrorm_async.projections.custom.discovery import checked
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.recorder_folder import folder_error
from pycrorm_async.queue.files.spool import RecorderFolder, Spool
from pycrorm_async.queue.retention.stored_segments import StoredSegments
from pycrorm_async.queue.sources.dead_source import RecoveredQueue, open_dead
from pycrorm_async.queue.sources.live_source import LiveQueue
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.daemon import Daemon, DaemonSummary
from pycrorm_async.writer.ports import ClaimedSource, ReleaseOutcome, ScanResult, Tables

__all__ = ["serve"]


async def serve(
    url: str,
    *,
    spool: Path | None,
    leave: asyncio.Event,
    say: Callable[[str], None],
    settings: Settings | None = None,
    projections: Sequence[Projection] = (),
    fold_workers: int = 0,
    forked: Sequence[FoldProcess] = (),
) -> DaemonSummary:
    """Drains every recorder of the spool and folds, until `leave` is set; `say` gets one line for each notable thing.

    `projections` of one's own are kept up to date too, with those that are installed. `fold_workers` processes fold, of
    which the first ones may be `forked` already; while there is none, this one does.

    Raises `SpoolTaken` when another daemon drains this spool, `DatabaseForeign` when a SQLite file is replaced by
    another meanwhile, and as `Memory.open` does.
    """
    address = shared_address(url)
    settings = settings or Settings()
    place = Spool(spool or address.default_spool, settings.file_access)
    if not place.path.exists():  # the database first: where it is refused, no spool is made beside it
        await (await EventLog.open(address, create=True, file_access=place.access)).close()
    lock = place.take_writer()
    if lock is None:
        raise SpoolTaken(place.path, "another `pycrorm writer` drains it already")
    note = _Note(lock, say)
    async with AsyncExitStack() as held:
        held.callback(lock.release)
        projections = checked(projections)
        destination = await held.enter_async_context(
            open_destination(address, place, clock=SYSTEM_CLOCK, projections=projections, settings=settings)
        )
        say(f"draining {place.path} into {address}")
        stored = StoredSegments(place.path, settings, wall_ns=SYSTEM_CLOCK.wall_ns)
        look = _Folders(place, destination.log_id, address, stored)
        assignment = Assignment(url, destination.log_id, projections)
        workers = await held.enter_async_context(
            FoldWorkers(fold_workers, assignment, settings=settings, say=say, note=note, forked=forked)
        )
        shown: Tables = FoldWorkerTables(destination, workers) if fold_workers else destination
        return await Daemon(shown, look, settings=settings, say=say).run(leave)


class _Note:
    """Writes the states of the fold workers into the daemon's lock, where `pycrorm status` reads them."""

    def __init__(self, lock: FileLock, say: Callable[[str], None]) -> None:
        self._lock = lock
        self._say = say
        self._failed = False

    def __call__(self, workers: Sequence[FoldWorkerState]) -> None:
        try:
            self._lock.write_note(msgspec.json.encode(DaemonNote(os.getpid(), workers)))
        except OSError as error:
            if not self._failed:
                self._say(f"the states of the fold workers cannot be written for `pycrorm status`: {error}")
            self._failed = True


class _Folders:
    """Looks round in a spool, and takes hold of what can be drained. Implements the writer's `Look`."""

    def __init__(
        self, spool: Spool, log_id: str, address: DatabaseAddress, stored: StoredSegments | None = None
    ) -> None:
        self._spool = spool
        self._stored = stored
        self._log_id = log_id
        self._file = address.path if address.is_sqlite else None
        self._opened = _identity(self._file)
        self._taken: set[str] = set()

    def __call__(self, but: Collection[str]) -> ScanResult:
        # A file that is only gone may be put back. Into another one this process, which has the old one open, would
        # never write: the next one looks what it is.
        if (now := _identity(self._file)) is not None and now != self._opened:
            raise DatabaseForeign(f"{self._file} was replaced while it was open: start `pycrorm writer` again")
        held: list[ClaimedSource] = []
        failed: dict[str, Exception] = {}
        present = self._spool.recorders()
        self._taken &= {each.name for each in present}
        folders = [each for each in present if each.name not in but]
        if folders:  # with a folder in it the spool cannot be bound to another log any more
            self._spool.bind(self._log_id)
        for folder in folders:
            try:
                taken = _take(folder, self._stored, again=folder.name in self._taken)
            except Exception as error:  # noqa: BLE001 - said of this folder; the others are drained
                failed[folder.name] = folder_error(folder.path, error)
            else:
                if taken is not None:
                    held.append(taken)
                    self._taken.add(folder.name)
        return ScanResult(held, failed)


def _identity(file: Path | None) -> tuple[int, int] | None:
    """Which file this is; None for none, and where there is no telling."""
    try:
        status = file.stat() if file is not None else None
    except OSError:
        return None
    return None if status is None else (status.st_dev, status.st_ino)


def _take(folder: RecorderFolder, stored: StoredSegments | None = None, *, again: bool) -> ClaimedSource | None:
    if folder.alive:
        return _Living.take(folder.path)
    dead = open_dead(folder.path, stored=stored)
    if dead is None:
        return None
    try:
        if again:  # it may be damaged further on, and what comes before that is not to be stored again and again
            dead.check()
    except BaseException:
        dead.release()
        raise
    return _Dead(dead)


class _Living(LiveQueue):
    """A living recorder's folder, as the daemon holds it. Implements `ClaimedSource`."""

    def release_folder(self) -> ReleaseOutcome:
        is_alive, closed = self.is_alive, self.is_closed
        self.release()
        what = "has ended" if closed else "is left at work" if is_alive else "died"
        return ReleaseOutcome(what, whole=self.stored == self.supplied or not is_alive)


class _Dead(ClaimedSource):
    """What a dead recorder left. Nobody waits there, so nobody is told anything."""

    is_alive = False

    def __init__(self, queue: RecoveredQueue) -> None:
        self._queue = queue

    @property
    def name(self) -> str:
        return self._queue.name

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
        return await self._queue.get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)

    async def acknowledge(self, position: int) -> None:
        await self._queue.acknowledge(position)

    def dead_letter(self, records: Sequence[Record]) -> bool:
        return self._queue.dead_letter(records)

    def fail(self, reason: str) -> None:
        self._queue.fail(reason)

    def finish(self) -> None:
        """All of it is there already."""

    def mark_visible(self, position: int, stopped: Mapping[str, str]) -> None: ...

    def mark_unavailable(self, reason: str | None) -> None: ...

    def release_folder(self) -> ReleaseOutcome:
        if not self._queue.all_stored:
            self._queue.release()
            return ReleaseOutcome("is kept", whole=False, again=not self._queue.holds_refused)
        self._queue.remove()
        count = len(self._queue.lost)
        return ReleaseOutcome(
            f"is recovered ({count} episode{'s' * (count != 1)} LOST)" if count else "is recovered", whole=True
        )
