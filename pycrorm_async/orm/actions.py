"""Map the built-in actions: those of the thesis' table 4.1, and further ones of this package.

Columns have the names of the designators' fields; `orm.designators` has those of poses and objects. Enum columns return
and accept members.
"""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, synonym

from pycrorm_async.orm.designators import (
    Action,
    ObjectDesignatorParameter,
    ObjectParameter,
    PoseParameter,
    TargetLocationParameter,
    TargetParameter,
)
from pycrorm_async.orm.episodes import Pose
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
    "LearnPolicyAction",
]


class NavigateAction(TargetLocationParameter, Action):
    """Drive to a place."""

    __tablename__ = "navigate_action"


class ParkArmsAction(Action):
    """Fold an arm, or both, out of the way."""

    __tablename__ = "park_arms_action"

    arm: Mapped[Arms]


class MoveTorsoAction(Action):
    """Lift or lower the torso to `position` (m)."""

    __tablename__ = "move_torso_action"

    position: Mapped[float]


class SetGripperAction(Action):
    """Open or close a gripper."""

    __tablename__ = "set_gripper_action"

    gripper: Mapped[Arms]
    motion: Mapped[GripperState]


class ReleaseAction(ObjectDesignatorParameter, Action):
    """Release an object."""

    __tablename__ = "release_action"

    gripper: Mapped[Arms] = mapped_column(sort_order=-1)


class GripAction(ObjectDesignatorParameter, Action):
    """Hold an object with `effort` (N)."""

    __tablename__ = "grip_action"

    gripper: Mapped[Arms] = mapped_column(sort_order=-1)
    effort: Mapped[float]


class PickUpAction(ObjectDesignatorParameter, Action):
    """Grasp an object and lift it; `object` is its row from before the action."""

    __tablename__ = "pick_up_action"

    arm: Mapped[Arms]
    grasp: Mapped[Grasp]


class PlaceAction(ObjectDesignatorParameter, TargetLocationParameter, Action):
    """Place a grasped object at a pose."""

    __tablename__ = "place_action"

    arm: Mapped[Arms]


class TransportAction(ObjectDesignatorParameter, TargetLocationParameter, Action):
    """Fetch an object and bring it to a place."""

    __tablename__ = "transport_action"

    arm: Mapped[Arms]


class LookAtAction(TargetParameter, Action):
    """Turn the head to a point."""

    __tablename__ = "look_at_action"


class DetectAction(ObjectDesignatorParameter, Action):
    """Look for an object."""

    __tablename__ = "detect_action"


class OpenAction(ObjectDesignatorParameter, Action):
    """Open the container that `object`, a handle, belongs to."""

    __tablename__ = "open_action"

    arm: Mapped[Arms]


class CloseAction(ObjectDesignatorParameter, Action):
    """Close the container that `object`, a handle, belongs to."""

    __tablename__ = "close_action"

    arm: Mapped[Arms]


class GraspingAction(ObjectParameter, Action):
    """Grasp a handle."""

    __tablename__ = "grasping_action"

    arm: Mapped[Arms]

    object_id: Mapped[int] = mapped_column("object_desig_id", ForeignKey("object.id"))
    object_desig_id: Mapped[int] = synonym("object_id")
    object_desig: Mapped[Object] = synonym("object")


class FaceAtAction(PoseParameter, Action):
    """Turn the base and the head to a point."""

    __tablename__ = "face_at_action"

    pose_id: Mapped[int] = mapped_column(ForeignKey("pose.id"))


class MoveAndPickUpAction(PoseParameter, ObjectDesignatorParameter, Action):
    """Drive to a place, face the object and pick it up.

    Attributes:
        policy: name of the policy that chose place, arm and grasp; None if none did.
    """

    __tablename__ = "move_and_pick_up_action"

    arm: Mapped[Arms]
    grasp: Mapped[Grasp]
    policy: Mapped[str | None]

    pose_id: Mapped[int] = mapped_column("standing_position_id", ForeignKey("pose.id"), sort_order=-1)
    standing_position_id: Mapped[int] = synonym("pose_id")
    standing_position: Mapped[Pose] = synonym("pose")


class BatchRolloutAction(Action):
    """Try one action many times, each chosen by a policy (`pycrorm_async.learning.batch_rollout`).

    Attributes:
        policy: its name, for `read_policy`.
        scene: a description of the world.
        seed: of the random numbers; seed and index determine a rollout.
        first: the index of the first rollout; later ones count on from it.
        count: the number of rollouts requested; an interrupted batch has fewer children.
        arms, grasps: names of those to which the policy was limited; empty if it was not.
    """

    __tablename__ = "batch_rollout_action"

    policy: Mapped[str]
    scene: Mapped[str]
    seed: Mapped[int]
    first: Mapped[int]
    count: Mapped[int]

    @property
    def arms(self) -> list[str]:
        return self.entries("arms")

    @property
    def grasps(self) -> list[str]:
        return self.entries("grasps")


class LearnPolicyAction(Action):
    """A policy was learned (`pycrorm_async.learning.record_policy`); `read_policy` returns it by its name.

    Attributes:
        policy: its name, which is the hash of its content and the `policy` of the rollouts under it.
        successes: number of samples from which it was learned.
        min_samples_leaf: the setting of `learn`.
        rollouts, scene: of the rollouts that the samples come from; None if they come from other episodes.
        episode_count: number of the episodes that hold the samples.
    """

    __tablename__ = "learn_policy_action"

    policy: Mapped[str]
    successes: Mapped[int]
    min_samples_leaf: Mapped[int]
    rollouts: Mapped[int | None]
    scene: Mapped[str | None]
    episode_count: Mapped[int]

    @property
    def seeds(self) -> list[int]:
        """The seeds of the rollouts that the samples come from, one for each round."""
        return self.entries("seeds")

    @property
    def training_episodes(self) -> list[str]:
        """The ids of the first 10,000 episodes that hold the samples."""
        return self.entries("episodes")
