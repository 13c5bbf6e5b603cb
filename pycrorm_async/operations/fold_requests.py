"""Answer the requests of a daemon or of a rebuild in the process of a fold worker, until the connection ends.

`FoldWorker` starts this process with a connection. The process receives an `Assignment`, answers `READY`, and then
answers each request once. For a daemon, `Prepare` and `Write` fold a batch of events in two steps, and `FoldRest`
refreshes materialised views and folds custom projections. For a rebuild, `FoldShare` folds a batch of the worker's
share of the episodes. The process opens the database at the first request, has at most one open transaction, and none
between requests. An exception in a request becomes a `Failure`, and the process continues.

Its parent alone ends it (`processes`), and the kernel kills it when the parent dies, so that no worker outlives the
daemon, not even a stopped one.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Final, NamedTuple, TypeAlias

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable
from pycrorm_async.projections.custom.discovery import installed_projections
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.rebuild import Rebuild
from pycrorm_async.projections.run.batch_fold import BatchPreview
from pycrorm_async.projections.run.targets import Share
from pycrorm_async.store.address import BUSY_TIMEOUT_S, DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

READY: Final = "ready"


class Assignment(NamedTuple):
    """The database to fold, the id of its log, the custom projections to fold, the wait for SQLite's lock, and whether
    to make cases."""

    url: str
    log_id: str
    projections: Sequence[Projection] = ()
    busy_timeout_s: float = BUSY_TIMEOUT_S
    recall: bool = True


class Prepare(NamedTuple):
    """Read and fold these events; answered with a `BatchPreview`."""

    spans: Sequence[Span]


class Write(NamedTuple):
    """Write the prepared batch; answered with the number of its events that are in the tables now."""


class FoldRest(NamedTuple):
    """Bring views and projections up to date; answered with whether there was anything to do."""

    now: bool


class FoldShare(NamedTuple):
    """Fold a batch of this share of a rebuild; answered with the number of its events, None when none is left."""

    share: Share


class Failure(NamedTuple):
    """The reason of a failed request. `unavailable`: the database does not answer, so the parent may try again."""

    reason: str
    unavailable: bool


Request: TypeAlias = Prepare | Write | FoldRest | FoldShare
Answer: TypeAlias = BatchPreview | int | bool | Failure | None


def main(connection: Connection) -> None:
    """Answer the requests of a daemon or of a rebuild until the connection ends."""
    collect_seldom()
    # The parent opens the same memory and logs its warnings; repeating them in each worker would double them.
    logging.getLogger("pycrorm_async").setLevel(logging.CRITICAL)
    logging.getLogger("pycrorm_async.projections").setLevel(logging.WARNING)
    with asyncio.Runner() as runner:
        try:
            handler = _RequestHandler(connection.recv())
            connection.send(READY)
            while True:
                connection.send(runner.run(handler.answer(connection.recv())))
        except (EOFError, ConnectionError):
            os._exit(0)


class _RequestHandler:
    """Executes requests."""

    def __init__(self, assignment: Assignment) -> None:
        self._assignment = assignment
        self._log: EventLog | None = None
        self._projector: Projector | None = None
        self._rebuild: Rebuild | None = None

    async def answer(self, request: Request) -> Answer:
        try:
            return await self._execute(request)
        except Exception as error:  # noqa: BLE001 - sent to the parent, which raises it
            self._projector = self._rebuild = None  # after a failover or a restore the tables may have another layout
            return Failure(str(error) or repr(error), unavailable=isinstance(error, DatabaseUnavailable))

    async def _execute(self, request: Request) -> Answer:
        if self._log is None:
            self._log = await self._open_same_log()
        match request:
            case Prepare(spans):
                return await (await self._opened(self._log)).prepare(spans)
            case Write():
                return await (await self._opened(self._log)).write()
            case FoldRest(now):
                return await (await self._opened(self._log)).fold_rest(now=now)
            case FoldShare(share):
                if self._rebuild is None:
                    self._rebuild = await Rebuild.join(self._log, share)
                return await self._rebuild.fold_next_batch()

    async def _opened(self, log: EventLog) -> Projector:
        """Open the tables at the first request, and again after a failure."""
        if self._projector is None:
            projections = self._assignment.projections
            installed = installed_projections(projections, own=self._assignment.recall)
            projector = Projector(log, projections=projections, installed=installed)
            await projector.open()
            self._projector = projector
        return self._projector

    async def _open_same_log(self) -> EventLog:
        """Open the parent's log. A SQLite file that replaced it is refused and not written."""
        assignment = self._assignment
        address = DatabaseAddress.parse(assignment.url)
        await (await EventLog.open(address, create=False)).close()
        log = await EventLog.open(address, create=True, busy_timeout_s=assignment.busy_timeout_s)
        if log.log_id != assignment.log_id:
            await log.close()
            raise DatabaseForeign(f"{address} was replaced while the daemon had it open: start `pycrorm writer` again")
        return log
