"""Report when a database becomes unavailable and available again."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeVar

from pycrorm_async.errors import DatabaseUnavailable

_T = TypeVar("_T")
_NOTABLE_S = 1.0
"""A database that has not answered for less than this is not reported: a deadlock or a quick restart."""


class Availability:
    """Calls `on_lost` with the reason when the database is unavailable, `on_back` with the seconds when it is back."""

    def __init__(
        self, *, now_s: Callable[[], float], on_lost: Callable[[str], None], on_back: Callable[[float], None]
    ) -> None:
        self._now_s = now_s
        self._on_lost = on_lost
        self._on_back = on_back
        self._unanswered_since_s: float | None = None
        self._reported = False

    async def observe(self, call: Awaitable[_T]) -> _T:
        """Await a call of the database, and note whether it answered."""
        called_s = self._now_s()
        try:
            result = await call
        except DatabaseUnavailable as error:
            self._note_failure(called_s, str(error))
            raise
        self._note_success(called_s)
        return result

    def _note_failure(self, called_s: float, reason: str) -> None:
        if self._unanswered_since_s is None:
            self._unanswered_since_s = called_s
        if not self._reported and self._now_s() - self._unanswered_since_s >= _NOTABLE_S:
            self._reported = True
            self._on_lost(reason)

    def _note_success(self, called_s: float) -> None:
        since_s = self._unanswered_since_s
        if since_s is None or called_s < since_s:  # the call began before the database became unavailable
            return
        self._unanswered_since_s = None
        if self._reported:
            self._reported = False
            self._on_back(self._now_s() - since_s)
