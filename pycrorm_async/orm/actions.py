"""Map the built-in actions: those of the thesis' table 4.1, and further ones of this package.

Columns have the names of the designators' fields. The first pose is also `pose`, the first object also `object`, as in
the thesis' queries. Enum columns return and accept members.
"""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, relationship, synonym

from pycrorm_async.orm.base import Pose
from pycrorm_async.orm.designators import Action
from pycrorm_async.orm.objects import Object
from pycrorm_async.world.enums import Arms, Grasp, GripperState

__all__ = [
    "NavigateAction",
    "ParkArmsAction",
    "MoveTorsoAction",
    "SetGripperAction",
    "ReleaseAction",
    "GripAction",
    "PickUpAction",
    "PlaceAction",
    "TransportAction",
    "LookAtAction",
    "DetectAction",
    "OpenAction",
    "CloseAction",
    "GraspingAction",
    "FaceAtAction",
    "MoveAndPickUpAction",
    "BatchRolloutAction",
]


class NavigateAction(Action):
    """Drive to a place."""

    __tablename__ = "navigate_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    pose_id: Mapped[int] = mapped_column("target_location_id", ForeignKey("pose.id"))

    pose: Mapped[Pose] = relationship(viewonly=True, lazy="selectin")
    target_location_id: Mapped[int] = synonym("pose_id")
    target_location: Mapped[Pose] = synonym("pose")


class ParkArmsAction(Action):
    """Fold an arm, or both, out of the way."""

    __tablename__ = "park_arms_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    arm: Mapped[Arms]


class MoveTorsoAction(Action):
    """Lift or lower the torso to `position` (m)."""

    __tablename__ = "move_torso_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    position: Mapped[float]


class SetGripperAction(Action):
    """Open or close a gripper."""

    __tablename__ = "set_gripper_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    gripper: Mapped[Arms]
    motion: Mapped[GripperState]


class ReleaseAction(Action):
    """Release an object."""

    __tablename__ = "release_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    gripper: Mapped[Arms]
    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"))

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    object_designator_id: Mapped[int] = synonym("object_id")
    object_designator: Mapped[Object] = synonym("object")


class GripAction(Action):
    """Hold an object with `effort` (N)."""

    __tablename__ = "grip_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    gripper: Mapped[Arms]
    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"))
    effort: Mapped[float]

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    object_designator_id: Mapped[int] = synonym("object_id")
    object_designator: Mapped[Object] = synonym("object")


class PickUpAction(Action):
    """Grasp an object and lift it; `object` is its row from before the action."""

    __tablename__ = "pick_up_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"))
    arm: Mapped[Arms]
    grasp: Mapped[Grasp]

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    object_designator_id: Mapped[int] = synonym("object_id")
    object_designator: Mapped[Object] = synonym("object")


class PlaceAction(Action):
    """Place a grasped object at a pose."""

    __tablename__ = "place_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"))
    arm: Mapped[Arms]
    pose_id: Mapped[int] = mapped_column("target_location_id", ForeignKey("pose.id"))

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    pose: Mapped[Pose] = relationship(viewonly=True, lazy="selectin")
    object_designator_id: Mapped[int] = synonym("object_id")
    object_designator: Mapped[Object] = synonym("object")
    target_location_id: Mapped[int] = synonym("pose_id")
    target_location: Mapped[Pose] = synonym("pose")


class TransportAction(Action):
    """Fetch an object and bring it to a place."""

    __tablename__ = "transport_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"))
    arm: Mapped[Arms]
    pose_id: Mapped[int] = mapped_column("target_location_id", ForeignKey("pose.id"))

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    pose: Mapped[Pose] = relationship(viewonly=True, lazy="selectin")
    object_designator_id: Mapped[int] = synonym("object_id")
    object_designator: Mapped[Object] = synonym("object")
    target_location_id: Mapped[int] = synonym("pose_id")
    target_location: Mapped[Pose] = synonym("pose")


class LookAtAction(Action):
    """Turn the head to a point."""

    __tablename__ = "look_at_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    pose_id: Mapped[int] = mapped_column("target_id", ForeignKey("pose.id"))

    pose: Mapped[Pose] = relationship(viewonly=True, lazy="selectin")
    target_id: Mapped[int] = synonym("pose_id")
    target: Mapped[Pose] = synonym("pose")


class DetectAction(Action):
    """Look for an object."""

    __tablename__ = "detect_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"))

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    object_designator_id: Mapped[int] = synonym("object_id")
    object_designator: Mapped[Object] = synonym("object")


class OpenAction(Action):
    """Open the container that `object`, a handle, belongs to."""

    __tablename__ = "open_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"))
    arm: Mapped[Arms]

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    object_designator_id: Mapped[int] = synonym("object_id")
    object_designator: Mapped[Object] = synonym("object")


class CloseAction(Action):
    """Close the container that `object`, a handle, belongs to."""

    __tablename__ = "close_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"))
    arm: Mapped[Arms]

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    object_designator_id: Mapped[int] = synonym("object_id")
    object_designator: Mapped[Object] = synonym("object")


class GraspingAction(Action):
    """Grasp a handle."""

    __tablename__ = "grasping_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    arm: Mapped[Arms]
    object_id: Mapped[int] = mapped_column("object_desig_id", ForeignKey("object.id"))

    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    object_desig_id: Mapped[int] = synonym("object_id")
    object_desig: Mapped[Object] = synonym("object")


class FaceAtAction(Action):
    """Turn the base and the head to a point."""

    __tablename__ = "face_at_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    pose_id: Mapped[int] = mapped_column(ForeignKey("pose.id"))

    pose: Mapped[Pose] = relationship(viewonly=True, lazy="selectin")


class MoveAndPickUpAction(Action):
    """Drive to a place, face the object and pick it up."""

    __tablename__ = "move_and_pick_up_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    pose_id: Mapped[int] = mapped_column("standing_position_id", ForeignKey("pose.id"))
    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"))
    arm: Mapped[Arms]
    grasp: Mapped[Grasp]

    pose: Mapped[Pose] = relationship(viewonly=True, lazy="selectin")
    object: Mapped[Object] = relationship(viewonly=True, lazy="selectin")
    standing_position_id: Mapped[int] = synonym("pose_id")
    standing_position: Mapped[Pose] = synonym("pose")
    object_designator_id: Mapped[int] = synonym("object_id")
    object_designator: Mapped[Object] = synonym("object")


class BatchRolloutAction(Action):
    """Try one action many times, each chosen by a policy (`pycrorm_async.learning.batch_rollout`).

    Attributes:
        policy: its name, which describes it.
        scene: a description of the world.
        seed: of the random numbers; seed and index determine a rollout.
        first: the index of the first rollout; later ones count on from it.
        count: the number of rollouts requested; an interrupted batch has fewer children.
    """

    __tablename__ = "batch_rollout_action"

    id: Mapped[int] = mapped_column(ForeignKey("action.id"), primary_key=True)
    policy: Mapped[str]
    scene: Mapped[str]
    seed: Mapped[int]
    first: Mapped[int]
    count: Mapped[int]
