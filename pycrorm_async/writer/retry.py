"""Asks a database again while it is away, with the pauses of a `Backoff`; all that the writer asks goes through here.

>>> folded = await retry(destination.fold, backoff=BRIEF)
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TypeVar

from pycrorm_async.errors import DatabaseUnavailable

__all__ = ["retry", "Backoff", "PATIENT", "BRIEF"]

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


@dataclass(frozen=True, kw_only=True, slots=True)
class Backoff:
    """A policy; `attempts_max` None never gives up."""

    first_s: float
    longest_s: float
    attempts_max: int | None = None

    def pause_s(self, attempt: int, randomness: float) -> float | None:
        """The pause after failed attempt 1, 2, 3 …; None to give up. `randomness`, in [0, 1], takes up to half off."""
        if self.attempts_max is not None and attempt >= self.attempts_max:
            return None
        doublings = min(attempt - 1, 30)  # a power without a bound would overflow after some days
        pause_s: float = min(self.longest_s, self.first_s * 2**doublings)
        return pause_s * (1 + randomness) / 2


PATIENT = Backoff(first_s=0.1, longest_s=10.0)
"""Beside a plan: the queue keeps taking events on disk, so there is no reason to give up."""

BRIEF = Backoff(first_s=0.1, longest_s=1.0, attempts_max=5)
"""For a command somebody waits for."""
