"""Wait for work as long as it makes progress: bound the time without progress, not the work.

>>> patience = Patience(15.0, progress=lambda: writer.progress)
>>> if not await patience.wait(closing):
...     raise FlushTimeout("nothing was stored for 15 s")
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

_CHECK_S: Final = 0.25
"""Interval at which the progress is read, and the precision of the bound."""


class Patience:
    """Ends a wait when `progress` has returned the same value for `limit_s`."""

    def __init__(self, limit_s: float, *, progress: Callable[[], object]) -> None:
        self._limit_s = limit_s
        self._progress = progress

    async def wait(self, work: asyncio.Future[None]) -> bool:
        """Wait for the work; True when it is done, False after `limit_s` without progress. Cancels nothing."""
        loop = asyncio.get_running_loop()
        last, since_s = self._progress(), loop.time()
        while not work.done():
            left_s = since_s + self._limit_s - loop.time()
            if left_s <= 0:
                return False
            await asyncio.wait([work], timeout=min(left_s, _CHECK_S))
            if (current := self._progress()) != last:
                last, since_s = current, loop.time()
        return True
