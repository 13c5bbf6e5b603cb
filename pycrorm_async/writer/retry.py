"""Retry a database operation while the database is unavailable, with the pauses of a `Backoff`.

>>> folded = await retry(destination.fold, backoff=BRIEF)
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TypeVar

from pycrorm_async.errors import DatabaseUnavailable

_T = TypeVar("_T")


async def retry(
    operation: Callable[[], Awaitable[_T]],
    *,
    backoff: Backoff,
    on_unavailable: Callable[[DatabaseUnavailable], None] = lambda _: None,
    randomness: Callable[[], float] = random.random,
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
) -> _T:
    """Return the operation's result. Calls `on_unavailable` after each failed attempt; raises the last one's error."""
    attempt = 0
    while True:
        try:
            return await operation()
        except DatabaseUnavailable as error:
            attempt += 1
            on_unavailable(error)
            pause_s = backoff.pause_s(attempt, randomness())
            if pause_s is None:
                raise
        await sleep(pause_s)


@dataclass(frozen=True, kw_only=True, slots=True)
class Backoff:
    """A policy for retries; with `attempts_max` None they never end."""

    first_s: float
    longest_s: float
    attempts_max: int | None = None

    def pause_s(self, attempt: int, randomness: float) -> float | None:
        """Return the pause after failed attempt 1, 2, 3 …; None to stop. `randomness`, 0 to 1, gives half to full."""
        if self.attempts_max is not None and attempt >= self.attempts_max:
            return None
        doublings = min(attempt - 1, 30)  # bounded, because the power would overflow after some days
        pause_s: float = min(self.longest_s, self.first_s * 2**doublings)
        return pause_s * (1 + randomness) / 2


PATIENT = Backoff(first_s=0.1, longest_s=10.0)
"""The backoff of writers: retries never end, because the queue keeps recording events on disk."""

BRIEF = Backoff(first_s=0.1, longest_s=1.0, attempts_max=5)
"""The backoff of commands that a user waits for: five attempts."""
