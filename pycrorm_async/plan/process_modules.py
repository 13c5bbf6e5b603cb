"""Who carries out motions: the process modules of the robot that `with simulated_robot:` chooses, for this
context.

The choice nests, ends with the block however it is left, and is inherited by tasks that start inside. A
robot of one's own is a class with these methods: `with ChosenRobot("mine", MyModules()):`.
"""

from __future__ import annotations

from contextvars import ContextVar
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

from pycrorm_async.plan.errors import NoRobotChosen
from pycrorm_async.plan.simulated import SimulatedModules

if TYPE_CHECKING:
    from pycrorm_async.plan.designator import BaseMotion
    from pycrorm_async.plan.motions import (
        LookingMotion,
        MoveArmJointsMotion,
        MoveGripperMotion,
        MoveJointsMotion,
        MoveMotion,
        MoveTCPMotion,
    )

__all__ = ["ProcessModules", "ChosenRobot", "simulated_robot", "chosen_robot"]


class ProcessModules(Protocol):
    """One method a motion; each returns when the motion is over and raises a `PlanFailure` when it did not succeed."""

    async def navigate(self, motion: MoveMotion) -> None: ...

    async def move_tcp(self, motion: MoveTCPMotion) -> None: ...

    async def looking(self, motion: LookingMotion) -> None: ...

    async def move_gripper(self, motion: MoveGripperMotion) -> None: ...

    async def move_arm_joints(self, motion: MoveArmJointsMotion) -> None: ...

    async def move_joints(self, motion: MoveJointsMotion) -> None: ...


_chosen: ContextVar[tuple[ProcessModules, ...]] = ContextVar("_chosen", default=())


class ChosenRobot:
    """A choice of process modules; `with` it, motions of this context are carried out by them."""

    def __init__(self, name: str, modules: ProcessModules) -> None:
        self.name = name
        self._modules = modules

    def __enter__(self) -> Self:
        _chosen.set((*_chosen.get(), self._modules))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        _chosen.set(_chosen.get()[:-1])

    def __repr__(self) -> str:
        return f"<{self.name} robot>"


simulated_robot = ChosenRobot("simulated", SimulatedModules())
"""The robot in the world of this context, moved kinematically: at once, exactly, without physics."""


def chosen_robot(motion: BaseMotion) -> ProcessModules:
    """The modules of the innermost choice. Raises `NoRobotChosen`."""
    chosen = _chosen.get()
    if not chosen:
        raise NoRobotChosen(type(motion).__name__)
    return chosen[-1]
