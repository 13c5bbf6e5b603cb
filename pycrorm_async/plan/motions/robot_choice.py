"""Keep the robot chosen for the motions of the current context, and execute motions with its process modules."""

from __future__ import annotations

from collections.abc import Awaitable
from contextvars import ContextVar
from types import TracebackType
from typing import Any, Self

from pycrorm_async.plan.errors import NoRobotChosen
from pycrorm_async.plan.failures import CapabilityAbsenceFailure
from pycrorm_async.plan.protocols import Performable
from pycrorm_async.world.robots.robot_description import Limits

_chosen: ContextVar[tuple[RobotChoice, ...]] = ContextVar("_chosen", default=())


class RobotChoice:
    """A choice of process modules; inside its `with` block their methods execute the motions of the context."""

    def __init__(self, name: str, modules: object, *, limits: Limits, collisions: bool) -> None:
        self.name = name
        self.modules = modules
        self.limits = limits
        self.collisions = collisions

    def __enter__(self) -> Self:
        _chosen.set((*_chosen.get(), self))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        _chosen.set(_chosen.get()[:-1])

    def __repr__(self) -> str:
        return f"<{self.name} robot>"


def execute(motion: Performable, module: str) -> Awaitable[Any]:
    """Execute the motion with the method of this name of the innermost choice; see `ProcessModules` for its result.

    Raises:
        NoRobotChosen: no robot is chosen in this context.
        CapabilityAbsenceFailure: the modules lack the method.
    """
    chosen = _chosen.get()
    if not chosen:
        raise NoRobotChosen(type(motion).__name__)
    robot = chosen[-1]
    method = getattr(robot.modules, module, None)
    if method is None:
        name = type(motion).__name__
        message = f"the {robot.name} robot cannot do {name}: {type(robot.modules).__name__} has no method {module!r}"
        raise CapabilityAbsenceFailure(message, robot.name, name)
    executing: Awaitable[Any] = method(motion)
    return executing


def chosen_limits() -> Limits:
    """Return the arm limits of the innermost choice; soft limits without a choice."""
    chosen = _chosen.get()
    return chosen[-1].limits if chosen else Limits.SOFT


def collisions_count() -> bool:
    """Return whether collisions count for the innermost choice; False without a choice."""
    chosen = _chosen.get()
    return bool(chosen) and chosen[-1].collisions
