"""Choose the robot whose process modules execute the motions of the current context: `with simulated_robot:`.

Choices nest, end with their block, and are inherited by tasks that start inside. A user's own robot is a class with
these methods: `with ChosenRobot("mine", MyModules()):`; a motion without a method fails with
`CapabilityAbsenceFailure`. Arms keep to their soft limits; in `with simulated_robot_within(Limits.HARD):` they move up
to the mechanical stops.
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


class MovingModules(Protocol):
    """The motions of the robot itself, the minimum that a user's own robot implements.

    One method per motion; it returns when the motion has ended and raises a `PlanFailure` if it failed.
    """

    async def navigate(self, motion: MoveMotion) -> None: ...

    async def move_tcp(self, motion: MoveTCPMotion) -> None: ...

    async def looking(self, motion: LookingMotion) -> None: ...

    async def move_gripper(self, motion: MoveGripperMotion) -> None: ...

    async def move_arm_joints(self, motion: MoveArmJointsMotion) -> None: ...

    async def move_joints(self, motion: MoveJointsMotion) -> None: ...


class ProcessModules(MovingModules, Protocol):
    """All motions, including the optional ones: perceiving, opening and closing.

    Perceiving returns the percepts, the best first, or raises `PerceptionObjectNotFound` with the reason. All are
    recorded, and the motion returns the first. A percept that matches no object of the world is a `Seen` of a
    `BelieveObject`.
    """

    async def detecting(self, motion: DetectingMotion) -> Sequence[Seen]: ...

    async def world_state_detecting(self, motion: WorldStateDetectingMotion) -> Sequence[Seen]: ...

    async def open(self, motion: OpeningMotion) -> None: ...

    async def close(self, motion: ClosingMotion) -> None: ...

    async def accessing(self, motion: AccessingMotion) -> None: ...


_chosen: ContextVar[tuple[ChosenRobot, ...]] = ContextVar("_chosen", default=())


class ChosenRobot:
    """A choice of process modules; inside its `with` block they execute the motions of the context.

    Args:
        name: used in messages.
        modules: the robot's modules; a method of `ProcessModules` that they lack is a motion the robot cannot execute.
        limits: joint limits of its arms, used by searches that check reachability (`CostmapLocation`).
        collisions: whether searches refuse places where its base would collide, and grippers refuse objects that are
            wider than their opening.
    """

    def __init__(
        self, name: str, modules: MovingModules, *, limits: Limits = Limits.SOFT, collisions: bool = False
    ) -> None:
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


def simulated_robot_within(limits: Limits, *, collisions: bool = False) -> ChosenRobot:
    """Return the simulated robot with these limits of the arms' joints.

    Soft limits are those of the thesis' experiments. Within hard limits an arm reaches about twice as many poses, also
    from above with the torso down.

    Args:
        limits: limits of the arms' joints.
        collisions: whether a goal at which the arm or the held object collides raises `ManipulationGoalInCollision`,
            and one at which the base collides `NavigationGoalInCollision`. A motion may allow collisions of the
            gripper. Paths are not checked. Location designators then offer only places where the base, with its
            heading, is clear, and a gripper refuses an object wider than its opening.

    >>> with simulated_robot_within(Limits.HARD):
    ...     await MoveTCPMotion(Pose([0.9495, 0.188, 0.790675]), Arms.LEFT).perform()
    """
    name = f"simulated ({limits.name.lower()} limits{', minding collisions' if collisions else ''})"
    return ChosenRobot(name, SimulatedModules(limits, collisions=collisions), limits=limits, collisions=collisions)


simulated_robot = simulated_robot_within(Limits.SOFT)
"""The robot of the current world, moved kinematically: instantly, exactly, without physics."""


def chosen_robot(motion: BaseMotion, module: str) -> ProcessModules:
    """Return the modules of the innermost choice, which have the method of that name.

    Raises:
        NoRobotChosen: no robot is chosen in this context.
        CapabilityAbsenceFailure: the modules lack the method.
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
    """Return the arm limits of the innermost choice; soft limits without a choice."""
    chosen = _chosen.get()
    return chosen[-1].limits if chosen else Limits.SOFT


def collisions_count() -> bool:
    """Return whether collisions count for the innermost choice; False without a choice."""
    chosen = _chosen.get()
    return bool(chosen) and chosen[-1].collisions
