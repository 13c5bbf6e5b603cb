"""A destination that says when it is away and when it is back, and does everything else as the one behind it."""

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


def is_notable(unanswered_s: float) -> bool:
    """Whether a database that has not answered for so long is away: a deadlock or a restart of its own is not.

    >>> is_notable(0.3), is_notable(2.0)
    (False, True)
    """
    return unanswered_s >= _NOTABLE_S


class AvailabilityMonitor(Tables):
    """`on_away` is called with the reason once it is notable, `on_back` with the seconds at the next answer."""

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
        self._said = False

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        return await self._answered(self._destination.append(records))

    async def confirm(self) -> None:
        await self._answered(self._destination.confirm())

    async def fold(self) -> int:
        return await self._answered(self._destination.fold())

    async def fold_next_batch(self) -> bool:
        return await self._answered(self._destination.fold_next_batch())

    async def behind(self) -> Mapping[str, int]:
        return await self._answered(self._destination.behind())

    async def stopped(self) -> Mapping[str, str]:
        return await self._answered(self._destination.stopped())

    async def _answered(self, answer: Awaitable[_T]) -> _T:
        asked_s = self._now_s()
        try:
            found = await answer
        except DatabaseUnavailable as error:
            self._note_away(asked_s, str(error))
            raise
        self._note_answer(asked_s)
        return found

    def _note_away(self, asked_s: float, reason: str) -> None:
        if self._unanswered_since_s is None:
            self._unanswered_since_s = asked_s
        if not self._said and is_notable(self._now_s() - self._unanswered_since_s):
            self._said = True
            self._on_away(reason)

    def _note_answer(self, asked_s: float) -> None:
        since_s = self._unanswered_since_s
        if since_s is None or asked_s < since_s:  # asked before it went away
            return
        self._unanswered_since_s = None
        if self._said:
            self._said = False
            self._on_back(self._now_s() - since_s)
