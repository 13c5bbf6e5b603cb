"""Report when a database becomes unavailable and available again, for a destination that forwards every call."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import TypeVar

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.writer.ports import Tables

__all__ = ["AvailabilityMonitor", "is_notable"]

_T = TypeVar("_T")
_NOTABLE_S = 1.0
"""A database that has not answered for less than this is not reported: a deadlock or a quick restart."""


def is_notable(unanswered_s: float) -> bool:
    """Return whether a database that has not answered for this long counts as unavailable.

    >>> is_notable(0.3), is_notable(2.0)
    (False, True)
    """
    return unanswered_s >= _NOTABLE_S


class AvailabilityMonitor(Tables):
    """Calls `on_away` with the reason when the database is unavailable, `on_back` with the seconds when it is back."""

    def __init__(
        self,
        destination: Tables,
        *,
        now_s: Callable[[], float],
        on_away: Callable[[str], None],
        on_back: Callable[[float], None],
    ) -> None:
        self._destination = destination
        self._now_s = now_s
        self._on_away = on_away
        self._on_back = on_back
        self._unanswered_since_s: float | None = None
        self._reported = False

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        return await self._observe(self._destination.append(records))

    async def confirm(self) -> None:
        await self._observe(self._destination.confirm())

    async def fold(self) -> int:
        return await self._observe(self._destination.fold())

    async def fold_next_batch(self) -> bool:
        return await self._observe(self._destination.fold_next_batch())

    async def behind(self) -> Mapping[str, int]:
        return await self._observe(self._destination.behind())

    async def stopped(self) -> Mapping[str, str]:
        return await self._observe(self._destination.stopped())

    async def _observe(self, call: Awaitable[_T]) -> _T:
        called_s = self._now_s()
        try:
            result = await call
        except DatabaseUnavailable as error:
            self._note_away(called_s, str(error))
            raise
        self._note_success(called_s)
        return result

    def _note_away(self, called_s: float, reason: str) -> None:
        if self._unanswered_since_s is None:
            self._unanswered_since_s = called_s
        if not self._reported and is_notable(self._now_s() - self._unanswered_since_s):
            self._reported = True
            self._on_away(reason)

    def _note_success(self, called_s: float) -> None:
        since_s = self._unanswered_since_s
        if since_s is None or called_s < since_s:  # the call began before the database became unavailable
            return
        self._unanswered_since_s = None
        if self._reported:
            self._reported = False
            self._on_back(self._now_s() - since_s)
