"""Choose among the alternatives of a description by the chance of success that an adviser predicts for each.

`adviser` is that of the current context, or None; `Memory.advising` sets it. An expression that performs a description
performs its alternatives in the order of their chances, asks again after each failure, and leaves out those that the
adviser does not allow. Where the adviser has no answer, the alternatives keep their own order.
"""

from collections.abc import AsyncGenerator, AsyncIterable, Iterable, Sequence
from contextlib import aclosing
from contextvars import ContextVar
from typing import Any, Protocol

from pycrorm_async.plan.failures import RefusedByPrediction

ALTERNATIVES_MAX = 100
"""Bounds the alternatives that are compared at once; the next ones follow when these are used up."""


class Chance(Protocol):
    """The prediction for an alternative: the chance of success with its interval, and the likeliest failure."""

    @property
    def chance(self) -> float: ...
    @property
    def low(self) -> float: ...
    @property
    def high(self) -> float: ...
    @property
    def reason(self) -> str | None: ...


class Adviser(Protocol):
    """Predicts how likely actions are to succeed."""

    @property
    def minimum(self) -> float:
        """The least chance with which an alternative is tried, 0 to 1."""
        ...

    def allows(self, chance: Chance) -> bool:
        """Return whether an alternative with this chance is tried."""
        ...

    async def chances(self, alternatives: Sequence[Any]) -> Sequence[Chance] | None:
        """Return the chance of each; None if there is no answer. Never raises."""
        ...

    def note(self, chances: Sequence[Chance], taken: int) -> None:
        """Record which alternative is tried, and how many are left out for now."""
        ...


adviser: ContextVar[Adviser | None] = ContextVar("adviser", default=None)


async def advised(description: Any, by: Adviser) -> AsyncGenerator[Any, None]:
    """Yield the alternatives, that with the best chance first; those of a description that asks a memory in its order.

    Raises `RefusedByPrediction` at the end if alternatives were left out.
    """
    refused: list[Chance] = []
    async with aclosing(_parts(description)) as parts:
        async for part in parts:
            while part:
                chances = await by.chances(part)
                taken = 0 if chances is None else best_of(chances, by)
                if taken is None:
                    refused += chances or ()
                    break
                if chances is not None:
                    by.note(chances, taken)
                yield part.pop(taken)
    if refused:
        best = max(refused, key=lambda each: each.chance)
        raise RefusedByPrediction(len(refused), best.chance, best.low, best.high, by.minimum, best.reason)


def best_of(chances: Sequence[Chance], by: Adviser) -> int | None:
    """Return the index of the best chance that is allowed, the first of equal ones; None if none is allowed."""
    allowed = [number for number, each in enumerate(chances) if by.allows(each)]
    return max(allowed, key=lambda number: chances[number].chance, default=None)


async def _parts(description: Iterable[Any] | AsyncIterable[Any]) -> AsyncGenerator[list[Any], None]:
    if isinstance(description, AsyncIterable):
        async for each in description:
            yield [each]
        return
    part: list[Any] = []
    try:
        for each in description:
            part.append(each)
            if len(part) == ALTERNATIVES_MAX:
                yield part
                part = []
    except Exception:
        if part:
            yield part  # what comes before the failure is tried first, as without advice
        raise
    if part:
        yield part
