"""`pycrorm writer`: wire the daemon between a spool and its database.

Theory of operation. The actors are the daemon process, its fold workers (`operations.workers`), and the recorders,
which are other processes with a folder each in the spool. One daemon drains a spool: it takes the spool's `writer` lock
file, whose note also publishes the states of the fold workers to `pycrorm status`. `Folders` finds the folders and
claims each by its `drain` lock. The folder of a living recorder (`LiveSource`) is drained as far as it is synced, and
released when the recorder ends; that of a dead one (`DeadSource`) is read to its end, completed with LOST ends, and
deleted once everything in it is stored. A folder that cannot be claimed is reported and does not delay the others.

A recorder may die at any moment; its folder is then claimed again as that of a dead one, and records that were stored
already are stored only once. A daemon may be killed at any moment: the kernel frees its locks, and nothing is removed
from a folder before the database has confirmed it. If the SQLite file is replaced while the daemon has it open, the
daemon stops, because it would keep writing to the old file, which no longer has a name.
"""

import asyncio
import functools
import os
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Final

import msgspec

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import DatabaseForeign, SpoolTaken
from pycrorm_async.operations.destination import open_destination
from pycrorm_async.operations.rebuild import rebuild_outdated
from pycrorm_async.operations.workers import (
    Assignment,
    ChildProcess,
    DaemonNote,
    FoldWorkers,
    FoldWorkerState,
    WorkerFolds,
)
from pycrorm_async.projections.custom import Projection, validate_projections
from pycrorm_async.queue.locks import FileIdentity
from pycrorm_async.queue.sources import LiveSource, open_dead
from pycrorm_async.queue.spool import RecorderFolder, Spool, folder_error
from pycrorm_async.queue.stored_segments import StoredSegments
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress, shared_address
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.daemon import Daemon, DaemonSummary
from pycrorm_async.writer.drain import ClaimedSource, ScanResult

_SCAN_S_MAX: Final = 1.0
"""The time after which a spool is scanned although it has not changed: its file system may not note every change."""
_SAME_TIME_NS: Final = 50_000_000
"""The time in which two changes of a folder may have the same time: some ticks of the kernel's clock."""


async def serve(
    url: str,
    *,
    spool: Path | None,
    stop: asyncio.Event,
    report: Callable[[str], None],
    settings: Settings | None = None,
    projections: Sequence[Projection] = (),
    fold_workers: int = 0,
    forked: Sequence[ChildProcess] = (),
) -> DaemonSummary:
    """Drain every recorder of the spool and fold, until `stop` is set. Calls `report` with each line for the operator.

    Folds custom `projections` and the installed ones too. `fold_workers` is the number of processes that fold, of which
    the first may be `forked` already; while none is ready, this process folds.

    Raises `SpoolTaken` when another daemon drains this spool, `DatabaseForeign` when the SQLite file is replaced while
    it is open, and the errors of `Memory.open`.
    """
    address = shared_address(url)
    settings = settings or Settings()
    place = Spool(spool or address.default_spool, settings.file_access)
    if not place.path.exists():  # open the database first, so that a refused one gets no spool beside it
        await (await EventLog.open(address, create=True, file_access=place.access)).close()
    lock = place.take_writer()
    if lock is None:
        raise SpoolTaken(place.path, "another `pycrorm writer` drains it already")
    report_once = functools.cache(report)

    def note(workers: Sequence[FoldWorkerState]) -> None:
        """Write the states of the fold workers into the lock file, where `pycrorm status` reads them."""
        try:
            lock.write_note(msgspec.json.encode(DaemonNote(os.getpid(), workers)))
        except OSError as error:
            report_once(f"`pycrorm status` cannot show the fold workers: their states cannot be written: {error}")

    async with AsyncExitStack() as stack:
        stack.callback(lock.release)
        projections = validate_projections(projections)
        await rebuild_outdated(address)
        destination = await stack.enter_async_context(
            open_destination(address, place, clock=SYSTEM_CLOCK, projections=projections, settings=settings)
        )
        report(f"draining {place.path} into {address}")
        stored = StoredSegments(place.path, settings, wall_ns=SYSTEM_CLOCK.wall_ns)
        folders = Folders(place, destination.log_id, address, stored)
        assignment = Assignment(url, destination.log_id, projections, recall=settings.recall)
        workers = await stack.enter_async_context(
            FoldWorkers(fold_workers, assignment, settings=settings, report=report, note=note, forked=forked)
        )
        fold_next_batch = WorkerFolds(destination, workers).fold_next_batch if fold_workers else None
        daemon = Daemon(destination, folders, settings=settings, report=report, fold_next_batch=fold_next_batch)
        return await daemon.run(stop)


class Folders:
    """Scans a spool and claims the folders that can be drained. Implements the writer's `SourceScanner`.

    With `recorder`, the name of one, it leaves the folders of other living recorders.
    """

    def __init__(
        self,
        spool: Spool,
        log_id: str,
        address: DatabaseAddress,
        stored: StoredSegments | None = None,
        *,
        recorder: str | None = None,
    ) -> None:
        self._recorder = recorder
        self._spool = spool
        self._stored = stored
        self._log_id = log_id
        self._file = address.path if address.is_sqlite else None
        self._opened = _identity(self._file)
        self._taken: set[str] = set()
        self._scanned: tuple[float, int | None, Collection[str]] = 0.0, None, ()  # when, and what it would find again

    def is_due(self, but: Collection[str]) -> bool:
        scanned_s, changed_ns, names = self._scanned
        if time.monotonic() > scanned_s + _SCAN_S_MAX or changed_ns is None or {*but} != names:
            return True
        try:
            return self._spool.path.stat().st_mtime_ns != changed_ns
        except OSError:  # which the scan reports
            return True

    def __call__(self, but: Collection[str]) -> ScanResult:
        # A missing file may be put back, so it is no error here. With another file in its place, this process would
        # keep writing to the old one; a new process opens the new file and checks it.
        if (identity := _identity(self._file)) is not None and identity != self._opened:
            raise DatabaseForeign(f"{self._file} was replaced while it was open: start `pycrorm writer` again")
        claimed: list[ClaimedSource] = []
        failed: dict[str, Exception] = {}
        began_s, changed_ns = time.monotonic(), _changed_ns(self._spool.path)
        present = self._spool.recorders()
        self._taken &= {each.name for each in present}
        ours = [each for each in present if self._recorder in (None, each.name) or not each.alive]
        folders = [each for each in ours if each.name not in but]
        if folders:  # a spool that contains a folder cannot be bound to another log any more
            self._spool.bind(self._log_id)
        for folder in folders:
            try:
                source = self._claim(folder)
            except Exception as error:  # noqa: BLE001 - reported for this folder; the others are drained
                failed[folder.name] = folder_error(folder.path, error)
            else:
                if source is not None:
                    claimed.append(source)
                    self._taken.add(folder.name)
        names = {*but, *(each.name for each in claimed)}
        self._scanned = began_s, changed_ns if len(claimed) == len(folders) else None, names
        return ScanResult(claimed, failed)

    def _claim(self, folder: RecorderFolder) -> ClaimedSource | None:
        """Claim a folder as that of a living or a dead recorder; None if another process has it."""
        if folder.alive:
            return LiveSource.take(folder.path)
        # Check a folder that comes back whole: damage further on would make the daemon store its start each time.
        return open_dead(folder.path, stored=self._stored, check=folder.name in self._taken)


def _changed_ns(folder: Path) -> int | None:
    """Return when entries of the folder were added or removed; None if the next ones may get the same time."""
    try:
        changed_ns = folder.stat().st_mtime_ns
    except OSError:
        return None
    return changed_ns if SYSTEM_CLOCK.wall_ns() - changed_ns > _SAME_TIME_NS else None


def _identity(file: Path | None) -> FileIdentity | None:
    """Return the identity of a file; None if it is missing or cannot be examined."""
    try:
        return None if file is None else FileIdentity.of(file.stat())
    except OSError:
        return None
