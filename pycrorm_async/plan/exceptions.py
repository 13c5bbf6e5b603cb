"""Classify exceptions of plans, and describe them in a line."""

from __future__ import annotations

from typing import Final

from pycrorm_async.plan.failures import PlanFailure

__all__ = ["describe_error", "is_plan_failure"]

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
