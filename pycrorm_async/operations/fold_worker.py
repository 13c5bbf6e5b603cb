"""The process of one fold worker: answers the daemon's requests until their connection ends.

`FoldWorker` in `fold_workers` starts it with a connection. It receives an `Assignment`, answers `READY`, and then gives
one answer to each request: `Prepare` and `Write` fold a batch of events in two steps, `FoldRest` brings kept views and
projections of one's own up to date. The process opens the database at the first request and has one transaction open
at most, and none between requests. Whatever a request raises becomes a `Failure`; the process survives it.

It ignores SIGINT and SIGTERM, which a terminal or a service manager sends to every process: the daemon ends it. It ends
when the connection does, and the kernel kills it when the daemon dies, so that not even a stopped worker outlives it.
"""

from __future__ import annotations

import asyncio
import ctypes
import logging
import os
import signal
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Final, NamedTuple, TypeAlias

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable
from pycrorm_async.projections.custom.discovery import installed_besides
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.run.batch_fold import Prepared
from pycrorm_async.projections.run.pipeline import Outlook
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

__all__ = ["Assignment", "Prepare", "Write", "FoldRest", "Failure", "Request", "Answer", "READY", "IGNORED", "main"]

READY: Final = "ready"
IGNORED: Final = (signal.SIGINT, signal.SIGTERM)
_PR_SET_PDEATHSIG: Final = 1


class Assignment(NamedTuple):
    """The database to fold, the id of its log, and projections of one's own."""

    url: str
    log_id: str
    projections: Sequence[Projection]


class Prepare(NamedTuple):
    """Read and fold these events; answered with an `Outlook`."""

    spans: Sequence[Span]


class Write(NamedTuple):
    """Write the prepared batch; answered with the number of its events that are in the tables now."""


class FoldRest(NamedTuple):
    """Bring views and projections up to date; answered with whether there was anything to do."""

    now: bool


class Failure(NamedTuple):
    """Why a request was not carried out. `unavailable`: the database does not answer, so it is worth asking again."""

    reason: str
    unavailable: bool


Request: TypeAlias = Prepare | Write | FoldRest
Answer: TypeAlias = Outlook | int | bool | Failure


def main(descriptor: int, daemon: int) -> None:
    """Serves the connection of this file descriptor, for the daemon with this process id."""
    for number in IGNORED:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, IGNORED)
    _end_with(daemon)
    collect_seldom()
    # The daemon opens the same memory and reports what there is to report about it.
    logging.getLogger("pycrorm_async").setLevel(logging.CRITICAL)
    logging.getLogger("pycrorm_async.projections").setLevel(logging.WARNING)
    with Connection(descriptor) as connection, asyncio.Runner() as runner, suppress(EOFError, ConnectionError):
        fold = _Fold(connection.recv())
        connection.send(READY)
        while True:
            connection.send(runner.run(fold.answer(connection.recv())))
    os._exit(0)


def _end_with(daemon: int) -> None:
    """Has the kernel kill this process when the daemon dies, also while this process is stopped."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != daemon:  # it died before that
        os._exit(0)


class _Fold:
    """Carries requests out. At most one batch is prepared."""

    def __init__(self, assignment: Assignment) -> None:
        self._assignment = assignment
        self._log: EventLog | None = None
        self._projector: Projector | None = None
        self._batch: Prepared | None = None

    async def answer(self, request: Request) -> Answer:
        try:
            return await self._carried_out(request, await self._opened())
        except DatabaseUnavailable as error:
            self._projector = None  # after a failover or a restore the tables may be of another shape
            return Failure(str(error), unavailable=True)
        except Exception as error:  # noqa: BLE001 - the daemon raises it
            self._projector = None
            return Failure(str(error) or repr(error), unavailable=False)

    async def _carried_out(self, request: Request, projector: Projector) -> Answer:
        match request:
            case Prepare(spans):
                self._batch = None
                self._batch = batch = await projector.prepare(spans)
                return Outlook(batch.count, batch.reached, batch.is_whole)
            case Write():
                prepared, self._batch = self._batch, None
                return 0 if prepared is None else await projector.write(prepared)
            case FoldRest(now):
                return await projector.fold_rest(now=now)

    async def _opened(self) -> Projector:
        """Opened at the first request, and at the next one if that failed."""
        if self._log is None:
            self._log = await self._same_log()
        if self._projector is None:
            ours = self._assignment.projections
            projector = Projector(self._log, projections=ours, installed=installed_besides(ours))
            await projector.open()
            self._projector = projector
        return self._projector

    async def _same_log(self) -> EventLog:
        """The daemon's log; no other is made or written where the file of a daemon that is at work was replaced."""
        address = DatabaseAddress.parse(self._assignment.url)
        await (await EventLog.open(address, create=False)).close()
        log = await EventLog.open(address, create=True)
        if log.log_id != self._assignment.log_id:
            await log.close()
            raise DatabaseForeign(f"{address} was replaced while the daemon had it open")
        return log
