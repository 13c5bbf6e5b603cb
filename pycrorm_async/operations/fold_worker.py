"""Run one fold worker: answer the daemon's requests until the connection ends.

`FoldWorker` in `fold_workers` starts this process with a connection. The process receives an `Assignment`, answers
`READY`, and then answers each request once: `Prepare` and `Write` fold a batch of events in two steps, `FoldRest`
refreshes materialised views and folds custom projections. It opens the database at the first request, has at most one
open transaction, and none between requests. An exception in a request becomes a `Failure`, and the process continues.

It ignores SIGINT and SIGTERM, which a terminal or a service manager sends to every process, because the daemon ends it.
It ends with its connection, and the kernel kills it when the daemon dies, so that no worker outlives the daemon, not
even a stopped one.
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
from pycrorm_async.projections.custom.discovery import installed_projections
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.run.batch_fold import BatchPreview
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

__all__ = ["Assignment", "Prepare", "Write", "FoldRest", "Failure", "Request", "Answer", "READY", "IGNORED", "main"]

READY: Final = "ready"
IGNORED: Final = (signal.SIGINT, signal.SIGTERM)
_PR_SET_PDEATHSIG: Final = 1


class Assignment(NamedTuple):
    """The database to fold, the id of its log, and the custom projections to fold."""

    url: str
    log_id: str
    projections: Sequence[Projection]


class Prepare(NamedTuple):
    """Read and fold these events; answered with an `BatchPreview`."""

    spans: Sequence[Span]


class Write(NamedTuple):
    """Write the prepared batch; answered with the number of its events that are in the tables now."""


class FoldRest(NamedTuple):
    """Bring views and projections up to date; answered with whether there was anything to do."""

    now: bool


class Failure(NamedTuple):
    """The reason of a failed request. `unavailable`: the database does not answer, so the daemon may try again."""

    reason: str
    unavailable: bool


Request: TypeAlias = Prepare | Write | FoldRest
Answer: TypeAlias = BatchPreview | int | bool | Failure


def main(descriptor: int, daemon: int) -> None:
    """Serve the connection of this file descriptor, for the daemon with this process id."""
    for number in IGNORED:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, IGNORED)
    _end_with(daemon)
    collect_seldom()
    # The daemon opens the same memory and logs its warnings; repeating them in each worker would double them.
    logging.getLogger("pycrorm_async").setLevel(logging.CRITICAL)
    logging.getLogger("pycrorm_async.projections").setLevel(logging.WARNING)
    with Connection(descriptor) as connection, asyncio.Runner() as runner, suppress(EOFError, ConnectionError):
        handler = _RequestHandler(connection.recv())
        connection.send(READY)
        while True:
            connection.send(runner.run(handler.answer(connection.recv())))
    os._exit(0)


def _end_with(daemon: int) -> None:
    """Make the kernel kill this process when the daemon dies, also while this process is stopped."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != daemon:  # the daemon died before the call above
        os._exit(0)


class _RequestHandler:
    """Executes requests."""

    def __init__(self, assignment: Assignment) -> None:
        self._assignment = assignment
        self._log: EventLog | None = None
        self._projector: Projector | None = None

    async def answer(self, request: Request) -> Answer:
        try:
            return await self._execute(request, await self._open())
        except DatabaseUnavailable as error:
            self._projector = None  # after a failover or a restore the tables may have another layout
            return Failure(str(error), unavailable=True)
        except Exception as error:  # noqa: BLE001 - sent to the daemon, which raises it
            self._projector = None
            return Failure(str(error) or repr(error), unavailable=False)

    async def _execute(self, request: Request, projector: Projector) -> Answer:
        match request:
            case Prepare(spans):
                return await projector.prepare(spans)
            case Write():
                return await projector.write()
            case FoldRest(now):
                return await projector.fold_rest(now=now)

    async def _open(self) -> Projector:
        """Open the log and the tables at the first request, and again after a failure."""
        if self._log is None:
            self._log = await self._open_same_log()
        if self._projector is None:
            projections = self._assignment.projections
            projector = Projector(self._log, projections=projections, installed=installed_projections(projections))
            await projector.open()
            self._projector = projector
        return self._projector

    async def _open_same_log(self) -> EventLog:
        """Open the daemon's log. A SQLite file that replaced it is refused and not written."""
        address = DatabaseAddress.parse(self._assignment.url)
        await (await EventLog.open(address, create=False)).close()
        log = await EventLog.open(address, create=True)
        if log.log_id != self._assignment.log_id:
            await log.close()
            raise DatabaseForeign(f"{address} was replaced while the daemon had it open: start `pycrorm writer` again")
        return log
