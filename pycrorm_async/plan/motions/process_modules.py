"""Who carries out motions: the process modules of the robot that `with simulated_robot:` chooses, for this
context.

The choice nests, ends with the block however it is left, and is inherited by tasks that start inside. A
robot of one's own is a class with these methods: `with ChosenRobot("mine", MyModules()):`; a motion it has no
method for fails with `CapabilityAbsenceFailure`. Arms keep to their soft limits; `with
simulated_robot_within(Limits.HARD):` they go up to the stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextvars import ContextVar
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self, cast

from pycrorm_async.plan.errors import NoRobotChosen
from pycrorm_async.plan.execution.observer import Seen
from pycrorm_async.plan.failures import CapabilityAbsenceFailure
from pycrorm_async.plan.motions.simulated_robot import SimulatedModules
from pycrorm_async.world.robots.robot_description import Limits

if TYPE_CHECKING:
    from pycrorm_async.plan.designator import BaseMotion
    from pycrorm_async.plan.motions.motions import (
        AccessingMotion,
        ClosingMotion,
        DetectingMotion,
        LookingMotion,
        MoveArmJointsMotion,
        MoveGripperMotion,
        MoveJointsMotion,
        MoveMotion,
        MoveTCPMotion,
        OpeningMotion,
        WorldStateDetectingMotion,
    )

__all__ = [
    "MovingModules",
    "ProcessModules",
    "ChosenRobot",
    "simulated_robot",
    "simulated_robot_within",
    "chosen_robot",
    "chosen_limits",
]


class MovingModules(Protocol):
    """What the robot itself moves: the least that a robot of one's own has.

    One method a motion; each returns when the motion is over and raises a `PlanFailure` when it did not succeed.
    """

    async def navigate(self, motion: MoveMotion) -> None: ...

    async def move_tcp(self, motion: MoveTCPMotion) -> None: ...

    async def looking(self, motion: LookingMotion) -> None: ...

    async def move_gripper(self, motion: MoveGripperMotion) -> None: ...

    async def move_arm_joints(self, motion: MoveArmJointsMotion) -> None: ...

    async def move_joints(self, motion: MoveJointsMotion) -> None: ...


class ProcessModules(MovingModules, Protocol):
    """What a robot may also be able to do: perceive, open and close.

    Perceiving returns what was found, the best seen first; `PerceptionObjectNotFound` says why nothing was.
    """

    async def detecting(self, motion: DetectingMotion) -> Sequence[Seen]: ...

    async def world_state_detecting(self, motion: WorldStateDetectingMotion) -> Sequence[Seen]: ...

    async def open(self, motion: OpeningMotion) -> None: ...

    async def close(self, motion: ClosingMotion) -> None: ...

    async def accessing(self, motion: AccessingMotion) -> None: ...


_chosen: ContextVar[tuple[ChosenRobot, ...]] = ContextVar("_chosen", default=())


class ChosenRobot:
    """A choice of process modules; `with` it, motions of this context are carried out by them.

    Args:
        name: for people.
        modules: one robot's; those of `ProcessModules` that it has no method for are motions it cannot do.
        limits: what its arms keep to, for those who ask in advance what they can reach (`CostmapLocation`).
    """

    def __init__(self, name: str, modules: MovingModules, *, limits: Limits = Limits.SOFT) -> None:
        self.name = name
        self.modules = modules
        self.limits = limits

    def __enter__(self) -> Self:
        _chosen.set((*_chosen.get(), self))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        _chosen.set(_chosen.get()[:-1])

    def __repr__(self) -> str:
        return f"<{self.name} robot>"


def simulated_robot_within(limits: Limits, *, collisions: bool = False) -> ChosenRobot:
    """As `simulated_robot`, with arms that keep to these limits.

    Soft limits are those of the thesis' experiments. Within hard ones an arm reaches about twice as much, also
    from above with the torso down.

    Args:
        limits: of the arms' joints.
        collisions: a hand does not go where its arm, or what it holds, would be in something (except that a gripper
            may, where the motion allows it): `ManipulationGoalInCollision`. Ways there are not looked at.

    >>> with simulated_robot_within(Limits.HARD):
    ...     await MoveTCPMotion(Pose([0.9495, 0.188, 0.790675]), Arms.LEFT).perform()
    """
    name = f"simulated ({limits.name.lower()} limits{', minding collisions' if collisions else ''})"
    return ChosenRobot(name, SimulatedModules(limits, collisions=collisions), limits=limits)


simulated_robot = simulated_robot_within(Limits.SOFT)
"""The robot in the world of this context, moved kinematically: at once, exactly, without physics."""


def chosen_robot(motion: BaseMotion, module: str) -> ProcessModules:
    """The modules of the innermost choice, which have the method of that name.

    Raises:
        NoRobotChosen: nothing says which robot moves.
        CapabilityAbsenceFailure: the robot has no such method.
    """
    chosen = _chosen.get()
    if not chosen:
        raise NoRobotChosen(type(motion).__name__)
    robot = chosen[-1]
    if not hasattr(robot.modules, module):
        name = type(motion).__name__
        message = f"the {robot.name} robot cannot do {name}: {type(robot.modules).__name__} has no method {module!r}"
        raise CapabilityAbsenceFailure(message, robot.name, name)
    return cast("ProcessModules", robot.modules)


def chosen_limits() -> Limits:
    """What the arms of the innermost choice keep to; soft limits outside of any."""
    chosen = _chosen.get()
    return chosen[-1].limits if chosen else Limits.SOFT
