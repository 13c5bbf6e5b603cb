"""Wait for the daemon that drains a memory's queue: flush and close without writing."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable

from pycrorm_async.errors import DatabaseError, EpisodeParked, FlushTimeout
from pycrorm_async.settings import Settings
from pycrorm_async.writer.patience import TOO_MANY_EVENTS, Patience, PatienceEnded
from pycrorm_async.writer.ports import ExternalDrain, OfferedQueue

_log = logging.getLogger("pycrorm_async")
_POLL_S = 0.01
"""Interval at which the drain status is read."""
_UNDRAINED_S = 2.0
"""Bounds the wait of `close` while no process drains or the database is unavailable: the events are safe in the folder.
Longer than a daemon takes to find a new queue."""


class DelegatedWriter:
    """The counterpart of `WriterThread` for a queue that a daemon drains. Belongs to the plan's loop."""

    def __init__(self, queue: OfferedQueue, settings: Settings) -> None:
        self._queue = queue
        self._settings = settings
        self._drained_s = asyncio.get_running_loop().time()

    async def flush(self, position: int) -> None:
        """Wait until the records up to this position are stored and visible in the tables.

        Raises `EpisodeParked` for episodes of this queue that stopped, `DatabaseError` if the drainer had to stop, and
        `FlushTimeout` after `flush_timeout_s` without progress; its message states whether a process drains the queue.
        """
        hindrance = await self._wait(position, undrained_s_max=math.inf, on_poll=self._raise_failure)
        if hindrance is not None:
            raise FlushTimeout(self._settings.flush_timeout_s, hindrance)
        self._raise_stopped()

    async def close(self) -> None:
        """Wait until the queue, which the caller closed, is stored and visible in the tables.

        Stops waiting, with a warning, when no process drains the queue, when the database is unavailable, and after
        `flush_timeout_s` without progress: the next drainer of the spool stores the rest. Raises `EpisodeParked`.
        """
        await self._queue.synced_to()
        position = self._queue.written
        hindrance = await self._wait(position, undrained_s_max=_UNDRAINED_S)
        if hindrance is not None:
            _log.warning("%s (%s)", self._describe_rest(position), hindrance)
        self._raise_stopped()

    async def _wait(
        self, position: int, *, undrained_s_max: float, on_poll: Callable[[], None] = lambda: None
    ) -> str | None:
        """Wait until the records up to this position are visible; return the hindrance if the wait reached a limit."""
        before = self._status.stored
        patience = Patience(self._settings.flush_timeout_s, progress=lambda: self._progress)
        try:
            visible = await patience.run(self._poll(position, undrained_s_max, on_poll), name="pycrorm wait for daemon")
        except PatienceEnded:
            visible = False
        return None if visible else self._hindrance(before)

    async def _poll(self, position: int, undrained_s_max: float, on_poll: Callable[[], None]) -> bool:
        """Return True when the records up to this position are visible, False when none drains them for too long."""
        loop = asyncio.get_running_loop()
        while self._status.folded < position:
            on_poll()
            now_s = loop.time()
            if self._status.note.unavailable is None and self._queue.is_drained:
                self._drained_s = now_s
            if now_s - self._drained_s > undrained_s_max:
                return False
            await asyncio.sleep(_POLL_S)
        return True

    @property
    def _status(self) -> ExternalDrain:
        status = self._queue.external_drain_status
        assert status is not None, "the queue is offered to a daemon"
        return status

    @property
    def _progress(self) -> tuple[int, int]:
        return self._status.stored, self._status.folded

    def _raise_failure(self) -> None:
        """Raise the drainer's reason if it had to stop; a drainer that still runs only reports a refused episode."""
        reason = self._status.note.failure
        if reason is not None and not self._queue.is_drained:
            raise DatabaseError(f"{reason}; everything recorded is safe in the spool")

    def _describe_rest(self, position: int) -> str:
        status = self._status
        if status.stored >= position:
            return f"all events are stored, but the last {position - status.folded} are not visible in the tables yet"
        return f"{position - status.stored} events are safe in {self._queue.folder.parent} and not in the database yet"

    def _hindrance(self, before: int) -> str:
        status = self._status
        if status.note.failure is not None:
            return f"no more events are stored: {status.note.failure}"
        if not self._queue.is_drained:
            return "no process drains this spool: start `pycrorm writer`"
        if status.note.unavailable is not None:
            return f"the daemon reports that the database is unavailable: {status.note.unavailable}"
        return "the daemon makes no progress" if status.stored == before else TOO_MANY_EVENTS

    def _raise_stopped(self) -> None:
        stopped = dict(self._status.note.stopped)
        if stopped:
            raise EpisodeParked(stopped)
