"""Map the built-in motions: those of the thesis' table 4.1, and those that set joints.

The joints of `MoveArmJointsMotion` and `MoveJointsMotion` are rows of `parameter_item`.
"""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, synonym

from pycrorm_async.orm.designators import Motion, ObjectParameter, ObjectPartParameter, TargetParameter
from pycrorm_async.orm.objects import Object
from pycrorm_async.world.enums import Arms, GripperState, ObjectType

__all__ = [
    "MoveMotion",
    "MoveTCPMotion",
    "LookingMotion",
    "MoveGripperMotion",
    "MoveArmJointsMotion",
    "MoveJointsMotion",
    "DetectingMotion",
    "OpeningMotion",
    "ClosingMotion",
    "WorldStateDetectingMotion",
    "AccessingMotion",
]


class MoveMotion(TargetParameter, Motion):
    """Drive the base to a pose."""

    __tablename__ = "move_motion"


class MoveTCPMotion(TargetParameter, Motion):
    """Bring the tool frame of one arm to a pose."""

    __tablename__ = "move_tcp_motion"

    arm: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]


class LookingMotion(TargetParameter, Motion):
    """Turn the head to a point."""

    __tablename__ = "looking_motion"


class MoveGripperMotion(Motion):
    """Open or close a gripper."""

    __tablename__ = "move_gripper_motion"

    motion: Mapped[GripperState]
    gripper: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]


class MoveArmJointsMotion(Motion):
    """Move arm joints to positions (rad), by name."""

    __tablename__ = "move_arm_joints_motion"

    @property
    def left_arm_poses(self) -> dict[str, float]:
        """Target positions of the left arm by joint name, rad."""
        return self.mapping("left_arm_poses")

    @property
    def right_arm_poses(self) -> dict[str, float]:
        """Target positions of the right arm by joint name, rad."""
        return self.mapping("right_arm_poses")


class MoveJointsMotion(Motion):
    """Move joints to positions (rad or m)."""

    __tablename__ = "move_joints_motion"

    @property
    def names(self) -> list[str]:
        """The joints' names, in the designator's order."""
        return self.entries("names")

    @property
    def positions(self) -> list[float]:
        """The target positions, in the order of `names`."""
        return self.entries("positions")


class DetectingMotion(Motion):
    """Look for objects of a type."""

    __tablename__ = "detecting_motion"

    object_type: Mapped[ObjectType]


class OpeningMotion(ObjectPartParameter, Motion):
    """Move an arm so that the container whose handle it grasps opens."""

    __tablename__ = "opening_motion"

    arm: Mapped[Arms]


class ClosingMotion(ObjectPartParameter, Motion):
    """Move an arm so that the container whose handle it grasps closes."""

    __tablename__ = "closing_motion"

    arm: Mapped[Arms]


class WorldStateDetectingMotion(Motion):
    """Read objects of a type from the state of the world instead of a camera."""

    __tablename__ = "world_state_detecting_motion"

    object_type: Mapped[ObjectType]


class AccessingMotion(ObjectParameter, Motion):
    """Open or close a drawer by its handle."""

    __tablename__ = "accessing_motion"

    arm: Mapped[Arms]
    gripper: Mapped[str]
    drawer_joint: Mapped[str]
    drawer_handle: Mapped[str]
    distance: Mapped[float]

    object_id: Mapped[int] = mapped_column("part_of_id", ForeignKey("object.id"), sort_order=-1)
    part_of_id: Mapped[int] = synonym("object_id")
    part_of: Mapped[Object] = synonym("object")
