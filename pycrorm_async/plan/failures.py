"""Define `PlanFailure` and its kinds, the failure vocabulary of the CRAM family of robot plans.

A plan failure is an outcome and not a fault: it is recorded with its class, message and arguments, and plans catch it
to try an alternative. Therefore it is not a `PycrormError`. Recorded events contain the module paths of the classes, so
the classes must stay in this module.

>>> raise ObjectUnreachable("cereal is out of reach", "cereal", 1.7)
Traceback (most recent call last):
pycrorm_async.plan.failures.ObjectUnreachable: cereal is out of reach

**Resources.** Parts of the robot that a designator uses exclusively while it runs, so that parallel branches take
turns.

A part is also needed if it only must not move: an arm that reaches for a place in the map needs the base and the torso.
Looking does not need the base, so a robot may turn its head while it drives. `execution` decides which
designator waits.

>>> PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT).resources() == reaching(Arms.LEFT)
True
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import Enum
from typing import TYPE_CHECKING, Final, Self

from pycrorm_async.errors import CallerError
from pycrorm_async.world.pose import Arms, Pose

if TYPE_CHECKING:
    from pycrorm_async.world.urdf import RobotDescription


class PlanFailure(Exception):
    """A plan, action or motion did not succeed.

    Attributes:
        message: human-readable; also `str(failure)`.
        data: the further arguments, unchanged; recorded with the message.
    """

    __is_plan_failure__ = True
    """A memory records it as an outcome, and not as a fault."""

    def __init__(self, message: str = "", *data: object) -> None:
        super().__init__(message, *data)
        self.message = message

    @property
    def data(self) -> tuple[object, ...]:
        return self.args[1:]

    def __str__(self) -> str:
        return self.message


class PlanFailures(PlanFailure, ExceptionGroup[Exception]):
    """Several plan failures of one expression: `except PlanFailure` and `except* IKError` both catch it.

    Args:
        message: human-readable; names each failure.
        failures: plan failures, or groups of plan failures only.
    """

    def __new__(cls, message: str, failures: Sequence[Exception]) -> Self:
        return super().__new__(cls, message, failures)

    def __init__(self, message: str, failures: Sequence[Exception]) -> None:
        # `PlanFailure.__init__` would set `message`, which is read-only in a group.
        Exception.__init__(self, message, failures)

    @property
    def data(self) -> tuple[object, ...]:
        """The contained failures."""
        return self.exceptions

    def derive(self, failures: Sequence[Exception], /) -> PlanFailures:  # type: ignore[override]  # as documented
        return PlanFailures(self.message, failures)


class IKError(PlanFailure):
    """The arm cannot bring its tool frame to the pose from the current pose of the base.

    Attributes:
        pose: the goal of the tool frame, in the map.
        arm: the arm that should reach it.
        tip_frame: the link of the tool frame.
        reason: the cause that inverse kinematics reports.
    """

    def __init__(self, pose: Pose, arm: Arms, tip_frame: str, reason: str = "", object_name: str = "") -> None:
        goal = "({:.3f}, {:.3f}, {:.3f})".format(*pose.position)
        message = f"{tip_frame} cannot reach {goal} with the {arm.name} arm{f': {reason}' if reason else ''}"
        super().__init__(f"{message}, reaching for {object_name}" if object_name else message)
        self.args = (pose, arm, tip_frame, reason, *([object_name] if object_name else []))
        self.pose = pose
        self.arm = arm
        self.tip_frame = tip_frame
        self.reason = reason


class ResourceDeadlock(PlanFailure):
    """A wait for a part of the robot would never end, because its holder waits for an ancestor of the waiting node.

    Attributes:
        resource: the part.
        held_by, wanted_by: the dtypes of the designators that hold it and wait for it.
        waits_for: the dtype of the ancestor of `wanted_by` for which `held_by` waits.
    """

    def __init__(self, resource: Resource, held_by: str, wanted_by: str, waits_for: str) -> None:
        super().__init__(
            f"{wanted_by} would wait forever for {resource.name}: {held_by} holds it and waits, directly or"
            f" indirectly, for {waits_for}, which contains {wanted_by}"
        )
        self.args = (resource, held_by, wanted_by, waits_for)
        self.resource = resource
        self.held_by = held_by
        self.wanted_by = wanted_by
        self.waits_for = waits_for


class NotALanguageExpression(PlanFailure):
    """An operand of a plan expression is not performable."""


class FailureDiagnosis(PlanFailure):
    """A failure whose cause is known."""


# --- low level: one motion, one sensor ----------------------------------------------------------------------


class LowLevelFailure(FailureDiagnosis):
    """A single motion or perception failed."""


class ActionlibActionTimeout(LowLevelFailure):
    """A controller did not answer in time."""


class ManipulationLowLevelFailure(LowLevelFailure):
    """An arm did not execute its command."""


class EnvironmentManipulationGoalNotReached(ManipulationLowLevelFailure):
    """A door or drawer did not reach its goal."""


class ManipulationGoalNotReached(ManipulationLowLevelFailure):
    """The gripper stopped before its goal."""


class ManipulationPoseUnreachable(ManipulationLowLevelFailure):
    """No arm motion leads to the pose."""


class GripperLowLevelFailure(LowLevelFailure):
    """A gripper did not execute its command."""


class GripperClosedCompletely(GripperLowLevelFailure):
    """The gripper closed without an object between its fingers."""


class GripperGoalNotReached(GripperLowLevelFailure):
    """The gripper stopped before its opening was reached."""


class NavigationLowLevelFailure(LowLevelFailure):
    """The base did not execute its command."""


class NavigationGoalNotReached(NavigationLowLevelFailure):
    """The base stopped before its goal."""


class NavigationPoseUnreachable(NavigationLowLevelFailure):
    """No path leads to the pose."""


class PerceptionLowLevelFailure(LowLevelFailure):
    """Perception returned no usable result."""


class PerceptionObjectNotFound(PerceptionLowLevelFailure):
    """The object was not perceived."""


class PerceptionObjectNotInWorld(PerceptionLowLevelFailure):
    """The designated object is not in the world."""


class TorsoLowLevelFailure(LowLevelFailure):
    """The torso did not execute its command."""


class TorsoGoalNotReached(TorsoLowLevelFailure):
    """The torso stopped before its goal."""


class TorsoGoalUnreachable(TorsoLowLevelFailure):
    """The torso cannot reach that height."""


# --- high level: a whole action -----------------------------------------------------------------------------


class HighLevelFailure(FailureDiagnosis):
    """An action as a whole failed."""


class DeliveringFailed(HighLevelFailure):
    """The object was not delivered."""


class EnvironmentManipulationImpossible(HighLevelFailure):
    """The door or drawer cannot be moved."""


class EnvironmentUnreachable(HighLevelFailure):
    """The door or drawer cannot be reached from anywhere."""


class FetchingFailed(HighLevelFailure):
    """The object was not fetched."""


class LookingHighLevelFailure(HighLevelFailure):
    """No place offers a view of the target."""


class ManipulationGoalInCollision(HighLevelFailure):
    """The arm or gripper would be in collision at its goal."""


class NavigationHighLevelFailure(HighLevelFailure):
    """The robot could not navigate to the goal."""


class NavigationGoalInCollision(NavigationHighLevelFailure):
    """The base would be in collision at its goal."""


class ObjectNowhereToBeFound(HighLevelFailure):
    """The object was not in any of the searched places."""


class ObjectUndeliverable(HighLevelFailure):
    """The object cannot be delivered."""


class ObjectUnfetchable(HighLevelFailure):
    """The object cannot be fetched."""


class ObjectUnreachable(HighLevelFailure):
    """No base pose lets an arm reach the object."""


class SearchingFailed(HighLevelFailure):
    """The search ended without the object."""


# --- advice -------------------------------------------------------------------------------------------------


class RefusedByPrediction(PlanFailure):
    """A memory predicts that none of the alternatives succeeds often enough, so none was tried (`Memory.advising`).

    Attributes:
        alternatives: their number.
        chance, low, high: of the one that is likeliest to succeed, with the interval, 0 to 1.
        minimum: the least chance with which an alternative is tried.
        reason: the failure that is most likely; None if it is not known.
    """

    def __init__(
        self, alternatives: int, chance: float, low: float, high: float, minimum: float, reason: str | None
    ) -> None:
        expected = f", most likely by {reason}" if reason is not None else ""
        count = "1 alternative was" if alternatives == 1 else f"{alternatives} alternatives were"
        super().__init__(
            f"{count} refused, because the memory expects a failure{expected}: the best one succeeds with"
            f" {chance:.0%} ({low:.0%} to {high:.0%}), less than {minimum:.0%}"
        )
        self.args = (alternatives, chance, low, high, minimum, reason)
        self.alternatives = alternatives
        self.chance = chance
        self.low = low
        self.high = high
        self.minimum = minimum
        self.reason = reason


# --- tasks --------------------------------------------------------------------------------------------------


class Task(PlanFailure):
    """A task failed."""


class Grasping(Task):
    """Grasping failed."""


class Looking(Task):
    """Looking failed."""


# --- capabilities and states --------------------------------------------------------------------------------


class ObjectPoseMisestimation(PlanFailure):
    """The object is not at its assumed pose."""


class SuccessfulCompletion(PlanFailure):
    """The plan ends early because its goal is reached."""


class ObjectNotFound(PlanFailure):
    """No object matches the description."""


class LocomotorFailure(PlanFailure):
    """The base is out of order."""


class ArmFailure(PlanFailure):
    """An arm is out of order."""


class ObjectLost(PlanFailure):
    """The gripper does not hold the object."""


class SensorFailure(PlanFailure):
    """A sensor is out of order."""


class IllPosedGoalFailure(PlanFailure):
    """The goal is contradictory or incomplete, so no execution could achieve it."""


class CapabilityAbsenceFailure(PlanFailure):
    """The robot lacks the capability."""


class ReachabilityFailure(PlanFailure):
    """No base pose lets an arm reach the pose."""


class TorsoFailure(PlanFailure):
    """The torso is out of order."""


class ConfigurationNotReached(PlanFailure):
    """The joints did not reach their goal."""


class Timeout(PlanFailure):
    """The time limit was exceeded."""


class EndEffectorFailure(PlanFailure):
    """A gripper is out of order or occupied."""


class ObjectUnavailable(PlanFailure):
    """The object or surface cannot be used at present."""


class SustainedFailure(PlanFailure):
    """The failure persists over repeated tries."""


class ReasoningError(PlanFailure):
    """No conclusion could be drawn."""


class CollisionError(PlanFailure):
    """The robot collided with an object."""


# === resources ================================================================================================


class Resource(Enum):
    """A part of the robot that one designator at a time can use."""

    LEFT_ARM = "LEFT_ARM"
    RIGHT_ARM = "RIGHT_ARM"
    BASE = "BASE"
    OTHER_ARM = "OTHER_ARM"
    """Any arm but the left and the right one: the further arms of a robot take turns."""
    TORSO = "TORSO"
    HEAD = "HEAD"


NOTHING: frozenset[Resource] = frozenset()
_ARMS = {
    Arms.LEFT: frozenset({Resource.LEFT_ARM}),
    Arms.RIGHT: frozenset({Resource.RIGHT_ARM}),
    Arms.BOTH: frozenset({Resource.LEFT_ARM, Resource.RIGHT_ARM}),
}
_OTHER_ARM = frozenset({Resource.OTHER_ARM})
_STANDING = frozenset({Resource.BASE, Resource.TORSO})


def arms(arm: Arms) -> frozenset[Resource]:
    """Return the arm, or both, with its gripper."""
    return _ARMS.get(arm, _OTHER_ARM)


def reaching(arm: Arms) -> frozenset[Resource]:
    """Return the parts for reaching a place in the map: the arm, and base and torso, which must not move."""
    return arms(arm) | _STANDING


def moving(joints: Iterable[str], robot: RobotDescription) -> frozenset[Resource]:
    """Return the parts that these joints belong to; a joint of no part is ignored."""
    parts = dict.fromkeys(robot.head_joints, Resource.HEAD)
    if robot.torso_joint is not None:
        parts[robot.torso_joint] = Resource.TORSO
    for arm, description in robot.arms.items():
        (part,) = arms(arm)
        parts |= dict.fromkeys(description.joints, part)
        for positions in description.gripper_joints.values():
            parts |= dict.fromkeys(positions, part)
    return frozenset(parts[joint] for joint in joints if joint in parts)


# === errors ===================================================================================================
#
# Errors in the code of a plan: designators that are declared or used in a wrong way.
#
# Three modules share the exceptions of plans. `errors` has the mistakes of a plan's author, which are a `CallerError`
# and need a change of code. `failures` has the outcomes of actions, such as an unreachable object, which a plan catches
# to try an alternative. The section "exceptions" defines no class; its functions classify and describe any exception.
#
# A *description*, such as `NavigateAction([pose_1, pose_2])`, lists alternatives. `resolve()` chooses one and returns a
# *designator*, such as `NavigateActionPerformable(pose_1)`, which can be performed.


class PerformNotAsync(CallerError, TypeError):
    """A designator class declares a `perform` that is not `async def perform(self)`."""

    def __init__(self, designator: str) -> None:
        super().__init__(f"{designator}.perform must be declared as `async def perform(self)`")
        self.designator = designator


class ResourcesNotAMethod(CallerError, TypeError):
    """A designator class declares `resources` as a field or value and not as a method."""

    def __init__(self, designator: str) -> None:
        super().__init__(
            f"{designator}.resources must be a method that returns a frozenset of Resource: rename the field"
        )
        self.designator = designator


class FieldHidesMethod(CallerError, TypeError):
    """A designator class has a field with the name of a method."""

    def __init__(self, designator: str, name: str) -> None:
        super().__init__(f"{designator}.{name} must not be a field, because {name}() is a method: rename the field")
        self.designator = designator
        self.name = name


class NotResolved(CallerError, AttributeError):
    """A description is used where a resolved designator is needed: `.resolve()` is missing."""

    def __init__(self, description: str, name: str) -> None:
        super().__init__(
            f"{description} is a description and has no {name!r}: resolve it first, as in {description}(…).resolve()"
            f"{'.perform()' if name == 'perform' else ''}"
        )
        self.description = description


class ResolutionError(CallerError):
    """The arguments of a designator do not fit its declared properties.

    Attributes:
        designator: the class name.
        missing: properties that are None and must not be.
        wrong: properties of another type than declared, each as "name: expected …, got …".
    """

    def __init__(self, designator: str, *, missing: Sequence[str] = (), wrong: Sequence[str] = ()) -> None:
        parts = []
        if missing:
            parts.append(f"missing: {', '.join(missing)}")
        if wrong:
            parts.append(f"wrong: {'; '.join(wrong)}")
        super().__init__(f"{designator} cannot be built; {'. '.join(parts)}")
        self.designator = designator
        self.missing = tuple(missing)
        self.wrong = tuple(wrong)


class NoRobotChosen(CallerError):
    """A motion was performed in a context without a chosen robot."""

    def __init__(self, motion: str) -> None:
        super().__init__(f"{motion} moves a robot: perform it inside `with simulated_robot:`")
        self.motion = motion


class NoRobotHere(CallerError):
    """The call needs an acting robot with a robot description in the current world."""


# === exceptions ===============================================================================================
#
# Classify exceptions of plans, describe them in a line, and name the object for which an arm reached.

_DESCRIPTION_LENGTH_MAX: Final = 200
"""Bounds the characters of a description, so that a list of failed alternatives stays readable."""


def describe_error(error: BaseException) -> str:
    """Describe an exception by class and message in one short line. Never raises.

    >>> describe_error(ObjectLost("the gripper is empty"))
    'ObjectLost: the gripper is empty'
    """
    name = type(error).__name__
    try:
        message = " ".join(str(error).split())
    except Exception:  # noqa: BLE001  a user's __str__ may raise anything
        return name
    if len(message) > _DESCRIPTION_LENGTH_MAX:
        message = f"{message[: _DESCRIPTION_LENGTH_MAX - 1]}…"
    return f"{name}: {message}" if message else name


def is_plan_failure(error: BaseException) -> bool:
    """Return whether it is a plan failure, or a group of plan failures only (as a `TaskGroup` raises)."""
    if isinstance(error, ExceptionGroup):
        return all(map(is_plan_failure, error.exceptions))
    return isinstance(error, PlanFailure)


@contextmanager
def reaching_for(name: str | None) -> Iterator[None]:
    """Add the object's name to the message and, as the last one, to the arguments of a failed reach; None adds nothing.

    Failed reaches are `IKError`, `ManipulationGoalInCollision` and the subclasses of `ManipulationLowLevelFailure`.

    >>> with reaching_for("milk"):
    ...     raise ManipulationGoalNotReached("the arm stopped at 0.3 m", 0.3)
    Traceback (most recent call last):
    pycrorm_async.plan.failures.ManipulationGoalNotReached: the arm stopped at 0.3 m, reaching for milk
    """
    try:
        yield
    except (IKError, ManipulationGoalInCollision, ManipulationLowLevelFailure) as failure:
        if name is not None:
            message = f"{failure.message}, reaching for {name}"
            first = failure.args[:1] if isinstance(failure, IKError) else (message,)
            failure.args = (*first, *failure.args[1:], name)
            failure.message = message
        raise
