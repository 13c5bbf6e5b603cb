"""Wait for the daemon that drains a memory's queue: flush and close without writing."""

from __future__ import annotations

import asyncio
import logging

from pycrorm_async.errors import DatabaseError, EpisodeParked, FlushTimeout
from pycrorm_async.settings import Settings
from pycrorm_async.writer.ports import DrainProgress, OfferedQueue

__all__ = ["DelegatedWriter"]

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
        `FlushTimeout` after `flush_timeout_s` without progress; its message says whether a process drains the queue.
        """
        before, loop = self._status.stored, asyncio.get_running_loop()
        last, since_s = self._progress, loop.time()
        while self._status.folded < position:
            self._raise_given_up()
            if self._progress != last:
                last, since_s = self._progress, loop.time()
            if loop.time() - since_s > self._settings.flush_timeout_s:
                raise FlushTimeout(
                    f"not finished after {self._settings.flush_timeout_s:g} s ({self._hindrance(before)});"
                    " everything recorded is safe in the spool"
                )
            await asyncio.sleep(_POLL_S)
        self._raise_stopped()

    async def close(self) -> None:
        """Wait until the queue, which the caller closed, is stored and visible in the tables.

        Stops waiting, with a warning, when no process drains the queue, when the database is unavailable, and after
        `flush_timeout_s` without progress: the next drainer of the spool stores the rest. Raises `EpisodeParked`.
        """
        await self._queue.synced_to()
        before, position = self._status.stored, self._queue.written
        loop = asyncio.get_running_loop()
        last, since_s = self._progress, loop.time()
        while self._status.folded < position:
            now_s = loop.time()
            if self._is_being_stored:
                self._drained_s = now_s
            if self._progress != last:
                last, since_s = self._progress, now_s
            if now_s - self._drained_s > _UNDRAINED_S or now_s - since_s > self._settings.flush_timeout_s:
                _log.warning("%s (%s)", self._describe_rest(position), self._hindrance(before))
                break
            await asyncio.sleep(_POLL_S)
        self._raise_stopped()

    @property
    def _status(self) -> DrainProgress:
        status = self._queue.external_drain_status
        assert status is not None, "the queue is offered to a daemon"
        return status

    @property
    def _progress(self) -> tuple[int, int]:
        return self._status.stored, self._status.folded

    @property
    def _is_being_stored(self) -> bool:
        return self._status.note.away is None and self._queue.is_drained

    def _raise_given_up(self) -> None:
        """Raise the drainer's reason if it had to stop; a drainer that still runs only reports a refused episode."""
        reason = self._status.note.given_up
        if reason is not None and not self._queue.is_drained:
            raise DatabaseError(f"{reason}; everything recorded is safe in the spool")

    def _describe_rest(self, position: int) -> str:
        status = self._status
        if status.stored >= position:
            return f"all events are stored, but the last {position - status.folded} are not visible in the tables yet"
        return f"{position - status.stored} events are safe in {self._queue.folder.parent} and not in the database yet"

    def _hindrance(self, before: int) -> str:
        status = self._status
        if status.note.given_up is not None:
            return f"no more events are stored: {status.note.given_up}"
        if not self._queue.is_drained:
            return "no process drains this spool: start `pycrorm writer`"
        if status.note.away is not None:
            return f"the daemon reports that the database is unavailable: {status.note.away}"
        return (
            "the daemon makes no progress"
            if status.stored == before
            else "more events than could be stored and folded in that time"
        )

    def _raise_stopped(self) -> None:
        stopped = dict(self._status.note.stopped)
        if stopped:
            raise EpisodeParked(stopped)
