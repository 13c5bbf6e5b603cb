"""Wait for work as long as it makes progress: bound the time without progress, not the work.

>>> patience = Patience(15.0, progress=lambda: writer.progress)
>>> if not await patience.wait(closing):
...     raise FlushTimeout(15.0, TOO_MANY_EVENTS)
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Final, TypeVar

_T = TypeVar("_T")
_CHECK_S: Final = 0.25
"""Interval at which the progress is read, and the precision of the bound."""
TOO_MANY_EVENTS: Final = "more events than could be stored and folded in that time"
"""The reason of a `FlushTimeout` when nothing else is known to hold the writer up."""


class PatienceEnded(Exception):
    """The work made no progress for too long, and was cancelled."""


class Patience:
    """Ends a wait when `progress` has returned the same value for `limit_s`."""

    def __init__(self, limit_s: float, *, progress: Callable[[], object]) -> None:
        self.limit_s = limit_s
        self._progress = progress

    async def wait(self, work: asyncio.Future[Any]) -> bool:
        """Wait for the work; True when it is done, False after `limit_s` without progress. Cancels nothing."""
        loop = asyncio.get_running_loop()
        last, since_s = self._progress(), loop.time()
        while not work.done():
            left_s = since_s + self.limit_s - loop.time()
            if left_s <= 0:
                return False
            await asyncio.wait([work], timeout=min(left_s, _CHECK_S))
            if (current := self._progress()) != last:
                last, since_s = current, loop.time()
        return True

    async def run(self, work: Coroutine[Any, Any, _T], *, name: str) -> _T:
        """Run the work in a task of this name, which ends with this call; raises `PatienceEnded`."""
        task = asyncio.create_task(work, name=name)
        try:
            if not await self.wait(task):
                raise PatienceEnded
            return task.result()
        finally:
            if not task.done():
                task.cancel()
                await asyncio.wait([task])
