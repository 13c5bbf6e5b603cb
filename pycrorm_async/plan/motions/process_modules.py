"""Choose the robot whose process modules execute the motions of the current context: `with simulated_robot:`.

Choices nest, end with their block, and are inherited by tasks that start inside. A user's own robot is a class with
these methods: `with ChosenRobot("mine", MyModules()):`; a motion without a method fails with
`CapabilityAbsenceFailure`. Arms keep to their soft limits; in `with simulated_robot_within(Limits.HARD):` they move up
to the mechanical stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from pycrorm_async.plan.execution.observer import Seen
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
from pycrorm_async.plan.motions.robot_choice import RobotChoice
from pycrorm_async.plan.motions.simulated_robot import SimulatedModules
from pycrorm_async.world.robots.robot_description import Limits


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


class ChosenRobot(RobotChoice):
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
        super().__init__(name, modules, limits=limits, collisions=collisions)


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
