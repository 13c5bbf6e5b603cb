"""Wire the log and the tables of a database to the writer, and bind a spool to them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from shlex import quote

from pycrorm_async.clock import Clock
from pycrorm_async.errors import CallerError, DatabaseError, TablesForeign
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.operations.healed_log import HealedLog
from pycrorm_async.projections.custom.discovery import installed_projections
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.schema.user_views import UserView
from pycrorm_async.queue.blobs.blob_files import read_blob
from pycrorm_async.queue.files.recorder_folder import wrap_os_errors
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.retention.stored_segments import stored_in
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog

_APPENDS_AT_ONCE = 4
"""Bounds the concurrent appends to a server, for any number of recorders: the pool's connections less one for folding.
"""

_WATCH_S = 1.0
"""The interval between two checks that a SQLite file still exists; a check takes two microseconds."""

_log = logging.getLogger("pycrorm_async")


class LogAndTables:
    """The log and the tables folded from it. Implements the writer's `Log`, `Destination` and `Tables`.

    While this process cannot use the tables, it appends events and folding raises `TablesForeign`.
    """

    def __init__(self, log: EventLog, projector: Projector, healed: HealedLog | None = None) -> None:
        self.log = log
        self.log_id = log.log_id
        self._healed = healed
        self._projector = projector
        self._refused = False
        self._rounds = 0
        # SQLite allows one writer, and a waiting connection polls for the lock. A semaphore serves waiters in order.
        self._appending = asyncio.Semaphore(1 if log.address.is_sqlite else _APPENDS_AT_ONCE)

    async def open_tables(self) -> None:
        """Open the tables. Raises as `Projector.open` does, except `TablesForeign`: each fold then opens them again."""
        try:
            await self._projector.open()
        except TablesForeign as error:
            self._refused = True
            _log.warning("%s; events are stored in the log but not folded until then", error)

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        await self.log.store_blobs(records)  # before this process' turn, so that others need not wait for large blobs
        async with self._appending:
            if self._healed is None:
                return await self.log.append(records)
            async with self._folding_healed(self._healed):
                return await self._healed.append(records)

    async def confirm(self) -> None:
        if self._healed is not None:
            async with self._folding_healed(self._healed):
                await self._healed.confirm()

    @asynccontextmanager
    async def _folding_healed(self, healed: HealedLog) -> AsyncIterator[None]:
        """Fold the events that `healed` appended again inside, because a flush waits for new events only."""
        rounds = healed.rounds
        yield
        if healed.rounds != rounds:
            try:
                await self.fold()
            except DatabaseError as error:
                _log.warning("the events that were appended again are not visible in the tables yet: %s", error)

    @property
    def writes(self) -> int:
        return self.log.writes

    async def fold(self) -> int:
        async with self._tables():
            return await self._projector.catch_up()

    async def fold_next_batch(self) -> bool:
        async with self._tables():
            return await self._projector.fold_next_batch()

    @asynccontextmanager
    async def _tables(self) -> AsyncIterator[None]:
        """Open the tables again after a failed fold or a healed log, because their layout may have changed."""
        if self._refused or self._rounds != self._rounds_healed:
            self._rounds = self._rounds_healed
            self._refused = True
            await self._projector.open()
            self._refused = False
        try:
            yield
        except Exception:
            self._refused = True
            raise

    @property
    def _rounds_healed(self) -> int:
        return 0 if self._healed is None else self._healed.rounds

    async def behind(self) -> Mapping[str, int]:
        return {each.id: each.folded for each in await self.log.behind()}

    async def stopped(self) -> Mapping[str, str]:
        return {each.id: each.refused or each.parked or "" for each in await self.log.stopped()}


@asynccontextmanager
async def open_destination(
    address: DatabaseAddress,
    spool: Spool,
    *,
    clock: Clock,
    views: Sequence[UserView] = (),
    projections: Sequence[Projection] = (),
    settings: Settings | None = None,
) -> AsyncIterator[LogAndTables]:
    """Open the log and the tables for writing in the running loop, and bind the spool to the log.

    Folds these projections and the installed ones. With `settings`, the events that the spool keeps are appended again
    to a log that lost them. Raises `SpoolForeign`.
    """
    expected = expected_log(address, spool)
    log = await EventLog.open(address, create=True, clock=clock, file_access=spool.access, belongs_to=expected)
    if address.is_sqlite:
        log.advice = (
            "put it back, or end this process and store its events in a new database with:"
            f" pycrorm spool rebind --url {quote(address.to_type)} --spool {quote(str(spool.path))}"
        )
    watching = asyncio.create_task(_watch_file(log), name="pycrorm watch file")
    try:
        spool.bind(log.log_id)
        log.blobs.source = _SpoolBlobs(spool.path)
        installed = installed_projections(projections, own=settings is None or settings.recall)
        projector = Projector(log, views=views, projections=projections, installed=installed)
        healed: HealedLog | None = None
        if settings is not None and settings.keep_stored_s and settings.keep_stored_bytes:
            folder = stored_in(spool.path, log.log_id)
            healed = None if folder is None else HealedLog(log, spool.path, folder, settings, clock=clock)
        destination = LogAndTables(log, projector, healed)
        await destination.open_tables()
        yield destination
    finally:
        watching.cancel()
        await log.close()


class _SpoolBlobs:
    """The blobs in the folders of a spool. Implements `BlobSource`."""

    def __init__(self, spool: Path) -> None:
        self._spool = spool

    async def read_blob(self, name: str) -> bytes | None:
        with wrap_os_errors(self._spool):
            return await asyncio.to_thread(read_blob, self._spool, name)


def expected_log(address: DatabaseAddress, spool: Spool) -> str | None:
    """The id of the log that the database must contain; None where a new log may be created.

    A SQLite file that was deleted while the spool was empty is created again. An empty database on a server is refused,
    because an operator may be restoring it at this moment.
    """
    return None if address.is_sqlite and not spool.recorders() else spool.log_id()


async def _watch_file(log: EventLog) -> None:
    """Log an error when the database file is removed, also while there is nothing to store."""
    lost = False
    while True:
        await asyncio.sleep(_WATCH_S)
        loss = log.loss
        if loss is not None and not lost:
            _log.error("%s", loss)
        elif loss is None and lost:
            _log.warning("%s: the file exists again", log.address)
        lost = loss is not None


def shared_address(url: str) -> DatabaseAddress:
    """The address of a database that another process can open too. Raises `UnknownUrl`, `CallerError`."""
    address = DatabaseAddress.parse(url)
    if address.is_private:
        raise CallerError("sqlite:// exists only in its own process, no other can open it: name a file")
    return address
