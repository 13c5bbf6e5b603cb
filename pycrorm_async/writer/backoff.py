"""How long to wait before a database that is away is asked again: twice as long each time, never in step with others.

>>> Backoff(first_s=1.0, longest_s=8.0).pause_s(3, 1.0)
4.0
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Backoff", "PATIENT", "BRIEF"]


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
