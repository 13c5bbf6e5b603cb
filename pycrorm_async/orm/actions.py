"""Map the built-in actions: those of the thesis' table 4.1, and further ones of this package.

Columns have the names of the designators' fields; `orm.rows` has those of poses and objects. Enum columns return
and accept members.

**Language.** Map the expressions of the plan language.

Each expression is a node of the task tree, and the nodes of its operands are its children (`TaskTreeNode.parent_id`).
`select(Language)` returns all expressions; `select(Action)` and `select(Motion)` return none.

>>> interrupted = select(Monitor).join(Monitor.node).where(TaskTreeNode.status == TaskStatus.INTERRUPTED)
"""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, synonym

from pycrorm_async.orm.episodes import Pose
from pycrorm_async.orm.rows import (
    Action,
    Language,
    Motion,
    Object,
    ObjectDesignatorParameter,
    ObjectParameter,
    ObjectPartParameter,
    PoseParameter,
    TargetLocationParameter,
    TargetParameter,
)
from pycrorm_async.world.pose import Arms, Grasp, GripperState, ObjectType

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
    "Sequential",
    "TryInOrder",
    "Parallel",
    "TryAll",
    "Repeat",
    "Monitor",
    "Code",
    "Retry",
]


class NavigateAction(TargetLocationParameter, Action):
    """Drive to a place."""


class ParkArmsAction(Action):
    """Fold an arm, or both, out of the way."""

    arm: Mapped[Arms]


class MoveTorsoAction(Action):
    """Lift or lower the torso to `position` (m)."""

    position: Mapped[float]


class SetGripperAction(Action):
    """Open or close a gripper."""

    gripper: Mapped[Arms]
    motion: Mapped[GripperState]


class ReleaseAction(ObjectDesignatorParameter, Action):
    """Release an object."""

    gripper: Mapped[Arms] = mapped_column(sort_order=-1)


class GripAction(ObjectDesignatorParameter, Action):
    """Hold an object with `effort` (N)."""

    gripper: Mapped[Arms] = mapped_column(sort_order=-1)
    effort: Mapped[float]


class PickUpAction(ObjectDesignatorParameter, Action):
    """Grasp an object and lift it; `object` is its row from before the action."""

    arm: Mapped[Arms]
    grasp: Mapped[Grasp]


class PlaceAction(ObjectDesignatorParameter, TargetLocationParameter, Action):
    """Place a grasped object at a pose."""

    arm: Mapped[Arms]


class TransportAction(ObjectDesignatorParameter, TargetLocationParameter, Action):
    """Fetch an object and bring it to a place."""

    arm: Mapped[Arms]


class LookAtAction(TargetParameter, Action):
    """Turn the head to a point."""


class DetectAction(ObjectDesignatorParameter, Action):
    """Look for an object."""


class OpenAction(ObjectDesignatorParameter, Action):
    """Open the container that `object`, a handle, belongs to."""

    arm: Mapped[Arms]


class CloseAction(ObjectDesignatorParameter, Action):
    """Close the container that `object`, a handle, belongs to."""

    arm: Mapped[Arms]


class GraspingAction(ObjectParameter, Action):
    """Grasp a handle."""

    arm: Mapped[Arms]

    object_id: Mapped[int] = mapped_column("object_desig_id", ForeignKey("object.id"))
    object_desig_id: Mapped[int] = synonym("object_id")
    object_desig: Mapped[Object] = synonym("object")


class FaceAtAction(PoseParameter, Action):
    """Turn the base and the head to a point."""

    pose_id: Mapped[int] = mapped_column(ForeignKey("pose.id"))


class MoveAndPickUpAction(PoseParameter, ObjectDesignatorParameter, Action):
    """Drive to a place, face the object and pick it up.

    Attributes:
        policy: name of the policy that chose place, arm and grasp; None if none did.
    """

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
        rollouts: number of the rollouts that the samples come from; None if they come from other episodes.
        scene: of these rollouts, if any.
        episode_count: number of the episodes that hold the samples.
    """

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


# === language =================================================================================================


class Sequential(Language):
    """Performs its operands in order, up to the first that fails."""


class TryInOrder(Language):
    """Performs its operands in order, up to the first that succeeds."""


class Parallel(Language):
    """Performs its operands concurrently; succeeds if all do."""


class TryAll(Language):
    """Performs its operands concurrently; succeeds if one does."""


class Repeat(Language):
    """Performs its operand `times` times."""

    times: Mapped[int]


class Monitor(Language):
    """Performs its operand until that ends or a condition holds; in the latter case its node becomes INTERRUPTED.

    Attributes:
        condition: the qualified name of the condition.
        interval_s: the time between two evaluations of it.
    """

    condition: Mapped[str]
    interval_s: Mapped[float]


class Code(Language):
    """Calls a function.

    Attributes:
        function: its qualified name.
    """

    function: Mapped[str]

    @property
    def arguments(self) -> dict[str, str]:
        """The call's arguments by name, each as a short text."""
        return self.mapping("arguments")


class Retry(Language):
    """Repeats its operand, or its next alternative, until one succeeds, at most `max_tries` times."""

    max_tries: Mapped[int]


# === motions ==================================================================================================
#
# Map the built-in motions: those of the thesis' table 4.1, and those that set joints.
#
# The joints of `MoveArmJointsMotion` and `MoveJointsMotion` are rows of `parameter_item`.


class MoveMotion(TargetParameter, Motion):
    """Drive the base to a pose."""


class MoveTCPMotion(TargetParameter, Motion):
    """Bring the tool frame of one arm to a pose."""

    arm: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]


class LookingMotion(TargetParameter, Motion):
    """Turn the head to a point."""


class MoveGripperMotion(Motion):
    """Open or close a gripper."""

    motion: Mapped[GripperState]
    gripper: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]


class MoveArmJointsMotion(Motion):
    """Move arm joints to positions (rad), by name."""

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

    object_type: Mapped[ObjectType]


class OpeningMotion(ObjectPartParameter, Motion):
    """Move an arm so that the container whose handle it grasps opens."""

    arm: Mapped[Arms]


class ClosingMotion(ObjectPartParameter, Motion):
    """Move an arm so that the container whose handle it grasps closes."""

    arm: Mapped[Arms]


class WorldStateDetectingMotion(Motion):
    """Read objects of a type from the state of the world instead of a camera."""

    object_type: Mapped[ObjectType]


class AccessingMotion(ObjectParameter, Motion):
    """Open or close a drawer by its handle."""

    arm: Mapped[Arms]
    gripper: Mapped[str]
    drawer_joint: Mapped[str]
    drawer_handle: Mapped[str]
    distance: Mapped[float]

    object_id: Mapped[int] = mapped_column("part_of_id", ForeignKey("object.id"), sort_order=-1)
    part_of_id: Mapped[int] = synonym("object_id")
    part_of: Mapped[Object] = synonym("object")
