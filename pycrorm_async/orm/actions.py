"""Map the built-in actions: those of the thesis' table 4.1, and further ones of this package.

Columns have the names of the designators' fields; `orm.rows` has those of poses and objects. Enum columns return
and accept members.

**Language.** Map the expressions of the plan language.

Each expression is a node of the task tree, and the nodes of its operands are its children (`TaskTreeNode.parent_id`).
`select(Language)` returns all expressions; `select(Action)` and `select(Motion)` return none.

>>> interrupted = select(Monitor).join(Monitor.node).where(TaskTreeNode.status == TaskStatus.INTERRUPTED)
"""

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, synonym

from pycrorm_async.orm import rows as row_classes
from pycrorm_async.orm.episodes import Pose
from pycrorm_async.world.pose import Arms, Grasp, GripperState, ObjectType


class NavigateAction(row_classes.TargetLocationParameter, row_classes.Action):
    """Drive to a place."""


class ParkArmsAction(row_classes.Action):
    """Fold an arm, or both, out of the way."""

    arm: Mapped[Arms]


class MoveTorsoAction(row_classes.Action):
    """Lift or lower the torso to `position` (m)."""

    position: Mapped[float]


class SetGripperAction(row_classes.Action):
    """Open or close a gripper."""

    gripper: Mapped[Arms]
    motion: Mapped[GripperState]


class ReleaseAction(row_classes.ObjectDesignatorParameter, row_classes.Action):
    """Release an object."""

    gripper: Mapped[Arms] = mapped_column(sort_order=-1)


class GripAction(row_classes.ObjectDesignatorParameter, row_classes.Action):
    """Hold an object with `effort` (N)."""

    gripper: Mapped[Arms] = mapped_column(sort_order=-1)
    effort: Mapped[float]


class PickUpAction(row_classes.ObjectDesignatorParameter, row_classes.Action):
    """Grasp an object and lift it; `object` is its row from before the action."""

    arm: Mapped[Arms]
    grasp: Mapped[Grasp]


class PlaceAction(row_classes.ObjectDesignatorParameter, row_classes.TargetLocationParameter, row_classes.Action):
    """Place a grasped object at a pose."""

    arm: Mapped[Arms]


class TransportAction(row_classes.ObjectDesignatorParameter, row_classes.TargetLocationParameter, row_classes.Action):
    """Fetch an object and bring it to a place."""

    arm: Mapped[Arms]


class LookAtAction(row_classes.TargetParameter, row_classes.Action):
    """Turn the head to a point."""


class DetectAction(row_classes.ObjectDesignatorParameter, row_classes.Action):
    """Look for an object."""


class OpenAction(row_classes.ObjectDesignatorParameter, row_classes.Action):
    """Open the container that `object`, a handle, belongs to."""

    arm: Mapped[Arms]


class CloseAction(row_classes.ObjectDesignatorParameter, row_classes.Action):
    """Close the container that `object`, a handle, belongs to."""

    arm: Mapped[Arms]


class GraspingAction(row_classes.ObjectParameter, row_classes.Action):
    """Grasp a handle."""

    arm: Mapped[Arms]

    object_id: Mapped[int] = mapped_column("object_desig_id", ForeignKey("object.id"))
    object_desig_id: Mapped[int] = synonym("object_id")
    object_desig: Mapped[row_classes.Object] = synonym("object")


class FaceAtAction(row_classes.PoseParameter, row_classes.Action):
    """Turn the base and the head to a point."""

    pose_id: Mapped[int] = mapped_column(ForeignKey("pose.id"))


class MoveAndPickUpAction(row_classes.PoseParameter, row_classes.ObjectDesignatorParameter, row_classes.Action):
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


class BatchRolloutAction(row_classes.Action):
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


class LearnPolicyAction(row_classes.Action):
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


class Sequential(row_classes.Language):
    """Performs its operands in order, up to the first that fails."""


class TryInOrder(row_classes.Language):
    """Performs its operands in order, up to the first that succeeds."""


class Parallel(row_classes.Language):
    """Performs its operands concurrently; succeeds if all do."""


class TryAll(row_classes.Language):
    """Performs its operands concurrently; succeeds if one does."""


class Repeat(row_classes.Language):
    """Performs its operand `times` times."""

    times: Mapped[int]


class Monitor(row_classes.Language):
    """Performs its operand until that ends or a condition holds; in the latter case its node becomes INTERRUPTED.

    Attributes:
        condition: the qualified name of the condition.
        interval_s: the time between two evaluations of it.
    """

    condition: Mapped[str]
    interval_s: Mapped[float]


class Code(row_classes.Language):
    """Calls a function.

    Attributes:
        function: its qualified name.
    """

    function: Mapped[str]

    @property
    def arguments(self) -> dict[str, str]:
        """The call's arguments by name, each as a short text."""
        return self.mapping("arguments")


class Retry(row_classes.Language):
    """Repeats its operand, or its next alternative, until one succeeds, at most `max_tries` times."""

    max_tries: Mapped[int]


# === motions ==================================================================================================
#
# Map the built-in motions: those of the thesis' table 4.1, and those that set joints.
#
# The joints of `MoveArmJointsMotion` and `MoveJointsMotion` are rows of `parameter_item`.


class MoveMotion(row_classes.TargetParameter, row_classes.Motion):
    """Drive the base to a pose."""


class MoveTCPMotion(row_classes.TargetParameter, row_classes.Motion):
    """Bring the tool frame of one arm to a pose."""

    arm: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]


class LookingMotion(row_classes.TargetParameter, row_classes.Motion):
    """Turn the head to a point."""


class MoveGripperMotion(row_classes.Motion):
    """Open or close a gripper."""

    motion: Mapped[GripperState]
    gripper: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]


class MoveArmJointsMotion(row_classes.Motion):
    """Move arm joints to positions (rad), by name."""

    @property
    def left_arm_poses(self) -> dict[str, float]:
        """Target positions of the left arm by joint name, rad."""
        return self.mapping("left_arm_poses")

    @property
    def right_arm_poses(self) -> dict[str, float]:
        """Target positions of the right arm by joint name, rad."""
        return self.mapping("right_arm_poses")


class MoveJointsMotion(row_classes.Motion):
    """Move joints to positions (rad or m)."""

    @property
    def names(self) -> list[str]:
        """The joints' names, in the designator's order."""
        return self.entries("names")

    @property
    def positions(self) -> list[float]:
        """The target positions, in the order of `names`."""
        return self.entries("positions")


class DetectingMotion(row_classes.Motion):
    """Look for objects of a type."""

    object_type: Mapped[ObjectType]


class OpeningMotion(row_classes.ObjectPartParameter, row_classes.Motion):
    """Move an arm so that the container whose handle it grasps opens."""

    arm: Mapped[Arms]


class ClosingMotion(row_classes.ObjectPartParameter, row_classes.Motion):
    """Move an arm so that the container whose handle it grasps closes."""

    arm: Mapped[Arms]


class WorldStateDetectingMotion(row_classes.Motion):
    """Read objects of a type from the state of the world instead of a camera."""

    object_type: Mapped[ObjectType]


class AccessingMotion(row_classes.ObjectParameter, row_classes.Motion):
    """Open or close a drawer by its handle."""

    arm: Mapped[Arms]
    gripper: Mapped[str]
    drawer_joint: Mapped[str]
    drawer_handle: Mapped[str]
    distance: Mapped[float]

    object_id: Mapped[int] = mapped_column("part_of_id", ForeignKey("object.id"), sort_order=-1)
    part_of_id: Mapped[int] = synonym("object_id")
    part_of: Mapped[row_classes.Object] = synonym("object")
