"""Classify exceptions of plans, describe them in a line, and name the object for which an arm reached."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from pycrorm_async.plan.failures import (
    IKError,
    ManipulationGoalInCollision,
    ManipulationLowLevelFailure,
    PlanFailure,
)

_DESCRIPTION_LENGTH_MAX: Final = 200
"""Bounds the characters of a description, so that a list of failed alternatives stays readable."""


def describe_error(error: BaseException) -> str:
    """Describe an exception by class and message in one short line. Never raises.

    >>> describe_error(ObjectLost("the gripper is empty"))
    'ObjectLost: the gripper is empty'
    """
    name = type(error).__name__
    try:
        message = " ".join(str(error).split())
    except Exception:  # noqa: BLE001  a user's __str__ may raise anything
        return name
    if len(message) > _DESCRIPTION_LENGTH_MAX:
        message = f"{message[: _DESCRIPTION_LENGTH_MAX - 1]}…"
    return f"{name}: {message}" if message else name


def is_plan_failure(error: BaseException) -> bool:
    """Return whether it is a plan failure, or a group of plan failures only (as a `TaskGroup` raises)."""
    if isinstance(error, ExceptionGroup):
        return all(map(is_plan_failure, error.exceptions))
    return isinstance(error, PlanFailure)


@contextmanager
def reaching_for(name: str | None) -> Iterator[None]:
    """Add the object's name to the message and, as the last one, to the arguments of a failed reach; None adds nothing.

    Failed reaches are `IKError`, `ManipulationGoalInCollision` and the subclasses of `ManipulationLowLevelFailure`.

    >>> with reaching_for("milk"):
    ...     raise ManipulationGoalNotReached("the arm stopped at 0.3 m", 0.3)
    Traceback (most recent call last):
    pycrorm_async.plan.failures.ManipulationGoalNotReached: the arm stopped at 0.3 m, reaching for milk
    """
    try:
        yield
    except (IKError, ManipulationGoalInCollision, ManipulationLowLevelFailure) as failure:
        if name is not None:
            message = f"{failure.message}, reaching for {name}"
            first = failure.args[:1] if isinstance(failure, IKError) else (message,)
            failure.args = (*first, *failure.args[1:], name)
            failure.message = message
        raise
