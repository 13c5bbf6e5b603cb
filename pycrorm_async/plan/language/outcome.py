"""The result of an expression of the plan language, and functions that try operands and combine their failures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from pycrorm_async.plan.exceptions import describe_error, is_plan_failure
from pycrorm_async.plan.failures import PlanFailures


@dataclass(frozen=True, slots=True, repr=False)
class Outcome:
    """The outcome of an expression; a memory records `in_brief()` as the result of its node.

    Attributes:
        results: the operands' results in the order of the operands, for `Repeat` the rounds' results. None for one that
            failed, was not tried, or was interrupted.
        succeeded: positions, from 0, of the operands or rounds that succeeded.
        failures: failures of the others, in the order in which they occurred.
        rounds: number of rounds of a `Repeat`.
        interrupted: for a `Monitor`, whether its condition held before the operand ended.
    """

    results: tuple[Any, ...] = ()
    succeeded: tuple[int, ...] = ()
    failures: tuple[Exception, ...] = ()
    rounds: int | None = None
    interrupted: bool | None = None

    def __repr__(self) -> str:
        values = ((each.name, getattr(self, each.name)) for each in fields(self))
        return f"Outcome({', '.join(f'{name}={value!r}' for name, value in values if value not in ((), None))})"

    def in_brief(self) -> dict[str, Any]:
        """Return the outcome as plain values, without the operands' results, which are at their own nodes.

        >>> Outcome(results=(None, 3), succeeded=(1,), failures=(ObjectLost("gone"),)).in_brief()
        {'succeeded': [1], 'failures': ['ObjectLost: gone']}
        """
        if self.interrupted is not None:
            return {"interrupted": self.interrupted}
        if self.rounds is not None:
            return {"rounds": self.rounds}
        brief: dict[str, Any] = {"succeeded": list(self.succeeded)}
        if self.failures:
            brief["failures"] = [describe_error(each) for each in self.failures]
        return brief


class Attempt(NamedTuple):
    """A result, or the plan failure that was raised instead."""

    result: Any = None
    failure: Exception | None = None


async def attempt(perform: Callable[[], Any]) -> Attempt:
    """Perform and return the result or the plan failure; any other exception propagates."""
    try:
        return Attempt(await perform())
    except Exception as error:
        if not is_plan_failure(error):
            raise
        return Attempt(failure=error)


def combine_failures(failures: list[Exception], summary: str) -> Exception:
    """Return a single failure itself, or several as `PlanFailures`, for the caller to raise.

    Empties the list, because the failure's traceback holds the caller's frame and its variables: this breaks the
    reference cycle.
    """
    error = (
        failures[0] if len(failures) == 1 else PlanFailures(f"{summary}: {_list_failures(failures)}", tuple(failures))
    )
    failures.clear()
    return error


def _list_failures(failures: list[Exception]) -> str:
    named = [describe_error(each) for each in failures[:_NAMED_MAX]]
    more = len(failures) - len(named)
    return "; ".join([*named, f"and {more} more"] if more else named)


_NAMED_MAX = 10
"""Bounds the failures that a message describes."""
