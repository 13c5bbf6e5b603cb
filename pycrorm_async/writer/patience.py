"""Wait for work as long as it gets on: a bound on standing still, not on the work.

>>> patience = Patience(15.0, progress=lambda: writer.progress)
>>> if not await patience.wait(closing):
...     raise FlushTimeout("nothing was stored for 15 s")
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

__all__ = ["Patience"]

_LOOK_S: Final = 0.25
"""How often the progress is looked at; the bound is exact to this."""


class Patience:
    """Ends a wait when `progress` has given the same for `limit_s`."""

    def __init__(self, limit_s: float, *, progress: Callable[[], object]) -> None:
        self._limit_s = limit_s
        self._progress = progress

    async def wait(self, work: asyncio.Future[None]) -> bool:
        """Whether the work is done, well or not; False when it has stood still for too long. Cancels nothing."""
        loop = asyncio.get_running_loop()
        seen, since_s = self._progress(), loop.time()
        while not work.done():
            left_s = since_s + self._limit_s - loop.time()
            if left_s <= 0:
                return False
            await asyncio.wait([work], timeout=min(left_s, _LOOK_S))
            if (now := self._progress()) != seen:
                seen, since_s = now, loop.time()
        return True
