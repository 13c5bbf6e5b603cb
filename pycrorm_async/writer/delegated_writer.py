"""The writer of a memory whose queue another process drains: nothing is written here, it is only waited for."""

from __future__ import annotations

import asyncio
import logging

from pycrorm_async.errors import DatabaseError, EpisodeParked, FlushTimeout
from pycrorm_async.settings import Settings
from pycrorm_async.writer.ports import DrainProgress, OfferedQueue

__all__ = ["DelegatedWriter"]

_log = logging.getLogger("pycrorm_async")
_LOOK_S = 0.01
_UNTENDED_S = 2.0
"""How long nobody drains, or the database is away, before closing does not wait: the folder is safe, and found when it
is dead. Longer than a daemon takes to look round for a queue that was just made."""


class DelegatedWriter:
    """What `WriterThread` is for a memory that writes by itself: flushes and closes. Belongs to the plan's loop."""

    def __init__(self, queue: OfferedQueue, settings: Settings) -> None:
        self._queue = queue
        self._settings = settings
        self._tended_s = asyncio.get_running_loop().time()

    async def flush(self, position: int) -> None:
        """Returns when everything up to this position is stored and shows in the tables.

        Raises `EpisodeParked` for episodes of this queue that stopped, `DatabaseError` when whoever drains it had to
        stop, and `FlushTimeout` after `flush_timeout_s` without progress, which says whether anybody drains at all.
        """
        before, loop = self._said.stored, asyncio.get_running_loop()
        seen, since_s = self._progress, loop.time()
        while self._said.folded < position:
            self._raise_given_up()
            if self._progress != seen:
                seen, since_s = self._progress, loop.time()
            if loop.time() - since_s > self._settings.flush_timeout_s:
                raise FlushTimeout(
                    f"not finished after {self._settings.flush_timeout_s:g} s ({self._hindrance(before)});"
                    " everything recorded is safe in the spool"
                )
            await asyncio.sleep(_LOOK_S)
        self._raise_stopped()

    async def close(self) -> None:
        """Waits until the queue, which the caller closed, is stored and shows in the tables, as long as that goes on.

        Where nobody drains or the database is away it does not wait: what is left is safe in the spool, and is stored
        by whoever drains that next. So it is after `flush_timeout_s` without progress. Raises `EpisodeParked`.
        """
        await self._queue.synced_to()
        before, position = self._said.stored, self._queue.written
        loop = asyncio.get_running_loop()
        seen, since_s = self._progress, loop.time()
        while self._said.folded < position:
            now_s = loop.time()
            if self._is_tended:
                self._tended_s = now_s
            if self._progress != seen:
                seen, since_s = self._progress, now_s
            if now_s - self._tended_s > _UNTENDED_S or now_s - since_s > self._settings.flush_timeout_s:
                _log.warning("%s (%s)", self._left(position), self._hindrance(before))
                break
            await asyncio.sleep(_LOOK_S)
        self._raise_stopped()

    @property
    def _said(self) -> DrainProgress:
        said = self._queue.external_drain_status
        assert said is not None, "made for a queue that is offered"
        return said

    @property
    def _progress(self) -> tuple[int, int]:
        return self._said.stored, self._said.folded

    @property
    def _is_tended(self) -> bool:
        return self._said.note.away is None and self._queue.is_drained

    def _raise_given_up(self) -> None:
        """Where an episode is refused the drainer goes on with the others; one that had to stop is gone."""
        reason = self._said.note.given_up
        if reason is not None and not self._queue.is_drained:
            raise DatabaseError(f"{reason}; everything recorded is safe in the spool")

    def _left(self, position: int) -> str:
        said = self._said
        if said.stored >= position:
            return f"all events are stored, and the last {position - said.folded} do not show in the tables yet"
        return f"{position - said.stored} events are safe in {self._queue.folder.parent} and not in the database yet"

    def _hindrance(self, before: int) -> str:
        said = self._said
        if said.note.given_up is not None:
            return f"nothing more is stored: {said.note.given_up}"
        if not self._queue.is_drained:
            return "nobody drains this spool: start `pycrorm writer`"
        if said.note.away is not None:
            return f"the daemon says that the database is away: {said.note.away}"
        return "the daemon does not get on" if said.stored == before else "there was too much to store and fold"

    def _raise_stopped(self) -> None:
        stopped = dict(self._said.note.stopped)
        if stopped:
            raise EpisodeParked(stopped)
