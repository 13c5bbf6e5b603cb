"""What an expression of the plan language returns when it succeeds, and how its operands are tried."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from pycrorm_async.plan.failures import PlanFailures, describe_error, is_plan_failure

__all__ = ["Attempt", "Outcome", "attempt", "combine_failures"]


@dataclass(frozen=True, slots=True, repr=False)
class Outcome:
    """How an expression went; a memory keeps `in_brief()` as the result of its node.

    Attributes:
        results: what the operands returned, in order as written; of `Repeat` what its rounds returned. None for one
            that failed, was not tried, or was interrupted.
        succeeded: which operands, or rounds, succeeded, by position from 0.
        failures: of the others, in the order they failed.
        rounds: of `Repeat`, how many there were.
        interrupted: of `Monitor`, whether its condition held before the operand was done.
    """

    results: tuple[Any, ...] = ()
    succeeded: tuple[int, ...] = ()
    failures: tuple[Exception, ...] = ()
    rounds: int | None = None
    interrupted: bool | None = None

    def __repr__(self) -> str:
        told = ((each.name, getattr(self, each.name)) for each in fields(self))
        return f"Outcome({', '.join(f'{name}={value!r}' for name, value in told if value not in ((), None))})"

    def in_brief(self) -> dict[str, Any]:
        """As plain values. What the operands returned is at their own nodes.

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
    """A result, or the plan failure there is instead."""

    result: Any = None
    failure: Exception | None = None


async def attempt(perform: Callable[[], Any]) -> Attempt:
    """What performing it gives. Whatever is raised that is no plan failure passes through."""
    try:
        return Attempt(await perform())
    except Exception as error:
        if not is_plan_failure(error):
            raise
        return Attempt(failure=error)


def combine_failures(failures: list[Exception], summary: str) -> Exception:
    """The only failure itself, or all of them as `PlanFailures`, to be raised.

    Takes them out of the list: the traceback of a failure holds the frame that raises it, and so what is in its
    variables; no cycle for the collector.
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
