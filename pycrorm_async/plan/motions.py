"""The motions: what a robot's controllers do at once. Each is carried out by the robot chosen with
`with simulated_robot:`, and recorded with its target.

>>> with simulated_robot:
...     await MoveMotion(Pose([0.6, 0.4, 0])).perform()
"""

from __future__ import annotations

from dataclasses import dataclass

from pycrorm_async.plan.designator import BaseMotion
from pycrorm_async.plan.errors import ResolutionError
from pycrorm_async.plan.process_modules import chosen_robot
from pycrorm_async.world.enums import Arms, GripperState
from pycrorm_async.world.pose import Pose

__all__ = [
    "MoveMotion",
    "MoveTCPMotion",
    "LookingMotion",
    "MoveGripperMotion",
    "MoveArmJointsMotion",
    "MoveJointsMotion",
]


@dataclass
class MoveMotion(BaseMotion):
    """Drive the base to a pose in the map."""

    target: Pose

    async def perform(self) -> None:
        await chosen_robot(self).navigate(self)


@dataclass
class MoveTCPMotion(BaseMotion):
    """Bring the tool frame of one arm to a pose in the map. Raises `IKError`."""

    target: Pose
    arm: Arms
    allow_gripper_collision: bool | None = None

    async def perform(self) -> None:
        await chosen_robot(self).move_tcp(self)


@dataclass
class LookingMotion(BaseMotion):
    """Turn the head to a point in the map."""

    target: Pose

    async def perform(self) -> None:
        await chosen_robot(self).looking(self)


@dataclass
class MoveGripperMotion(BaseMotion):
    """Open or close a gripper."""

    motion: GripperState
    gripper: Arms
    allow_gripper_collision: bool | None = None

    async def perform(self) -> None:
        await chosen_robot(self).move_gripper(self)


@dataclass
class MoveArmJointsMotion(BaseMotion):
    """Bring arm joints (by name) to positions in rad, both arms at once. Raises `ConfigurationNotReached`."""

    left_arm_poses: dict[str, float] | None = None
    right_arm_poses: dict[str, float] | None = None

    async def perform(self) -> None:
        await chosen_robot(self).move_arm_joints(self)


@dataclass
class MoveJointsMotion(BaseMotion):
    """Bring joints to positions in rad or m, all at once.

    Raises:
        TorsoGoalUnreachable: the torso alone was to go where it cannot.
        ConfigurationNotReached: a position is outside its joint's limits.
        ResolutionError: not one position for each name.
    """

    names: list[str]
    positions: list[float]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.names) != len(self.positions):
            counts = f"expected {len(self.names)} values, one for each name, got {len(self.positions)}"
            raise ResolutionError(type(self).__name__, wrong=[f"positions: {counts}"])

    async def perform(self) -> None:
        await chosen_robot(self).move_joints(self)
