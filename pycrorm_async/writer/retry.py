"""Asks a database again while it is away, with the pauses of a `Backoff`; all that the writer asks goes through here.

>>> folded = await retry(destination.fold, backoff=BRIEF)
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from typing import TypeVar

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.writer.backoff import Backoff

__all__ = ["retry"]

_T = TypeVar("_T")


async def retry(
    ask: Callable[[], Awaitable[_T]],
    *,
    backoff: Backoff,
    on_away: Callable[[DatabaseUnavailable], None] = lambda _: None,
    randomness: Callable[[], float] = random.random,
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
) -> _T:
    """What `ask` gives in the end. `on_away` is told of every attempt that failed; the last one's error is raised."""
    attempt = 0
    while True:
        try:
            return await ask()
        except DatabaseUnavailable as error:
            attempt += 1
            on_away(error)
            pause_s = backoff.pause_s(attempt, randomness())
            if pause_s is None:
                raise
        await sleep(pause_s)
