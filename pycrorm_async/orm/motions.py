"""Map the built-in motions: those of the thesis' table 4.1, and those that set joints.

The joints of `MoveArmJointsMotion` and `MoveJointsMotion` are rows of `parameter_item`.
"""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, relationship, synonym

from pycrorm_async.orm.base import Pose
from pycrorm_async.orm.designators import Motion
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


class MoveMotion(Motion):
    """Drive the base to a pose."""

    __tablename__ = "move_motion"

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)
    pose_id: Mapped[int] = mapped_column("target_id", ForeignKey("pose.id"))

    pose: Mapped[Pose] = relationship(viewonly=True, lazy="selectin")
    target_id: Mapped[int] = synonym("pose_id")
    target: Mapped[Pose] = synonym("pose")


class MoveTCPMotion(Motion):
    """Bring the tool frame of one arm to a pose."""

    __tablename__ = "move_tcp_motion"

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)
    pose_id: Mapped[int] = mapped_column("target_id", ForeignKey("pose.id"))
    arm: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]

    pose: Mapped[Pose] = relationship(viewonly=True, lazy="selectin")
    target_id: Mapped[int] = synonym("pose_id")
    target: Mapped[Pose] = synonym("pose")


class LookingMotion(Motion):
    """Turn the head to a point."""

    __tablename__ = "looking_motion"

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)
    pose_id: Mapped[int] = mapped_column("target_id", ForeignKey("pose.id"))

    pose: Mapped[Pose] = relationship(viewonly=True, lazy="selectin")
    target_id: Mapped[int] = synonym("pose_id")
    target: Mapped[Pose] = synonym("pose")


class MoveGripperMotion(Motion):
    """Open or close a gripper."""

    __tablename__ = "move_gripper_motion"

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)
    motion: Mapped[GripperState]
    gripper: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]


class MoveArmJointsMotion(Motion):
    """Move arm joints to positions (rad), by name."""

    __tablename__ = "move_arm_joints_motion"

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)

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

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)

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

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)
    object_type: Mapped[ObjectType]


class OpeningMotion(Motion):
    """Move an arm so that the container whose handle it grasps opens."""

    __tablename__ = "opening_motion"

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)
    object_id: Mapped[int] = mapped_column("object_part_id", ForeignKey("object.id"))
    arm: Mapped[Arms]

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    object_part_id: Mapped[int] = synonym("object_id")
    object_part: Mapped[Object] = synonym("object")


class ClosingMotion(Motion):
    """Move an arm so that the container whose handle it grasps closes."""

    __tablename__ = "closing_motion"

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)
    object_id: Mapped[int] = mapped_column("object_part_id", ForeignKey("object.id"))
    arm: Mapped[Arms]

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    object_part_id: Mapped[int] = synonym("object_id")
    object_part: Mapped[Object] = synonym("object")


class WorldStateDetectingMotion(Motion):
    """Read objects of a type from the state of the world instead of a camera."""

    __tablename__ = "world_state_detecting_motion"

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)
    object_type: Mapped[ObjectType]


class AccessingMotion(Motion):
    """Open or close a drawer by its handle."""

    __tablename__ = "accessing_motion"

    id: Mapped[int] = mapped_column(ForeignKey("motion.id"), primary_key=True)
    object_id: Mapped[int] = mapped_column("part_of_id", ForeignKey("object.id"))
    arm: Mapped[Arms]
    gripper: Mapped[str]
    drawer_joint: Mapped[str]
    drawer_handle: Mapped[str]
    distance: Mapped[float]

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    part_of_id: Mapped[int] = synonym("object_id")
    part_of: Mapped[Object] = synonym("object")
