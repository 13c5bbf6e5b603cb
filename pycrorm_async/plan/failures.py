"""How plans fail: `PlanFailure` and its kinds, the vocabulary of the CRAM family of robot plans.

A plan failure is an outcome, not a fault: it is recorded with its class, message and arguments, and plans
catch it to try something else. It is therefore no `PycrormError`.

>>> raise ObjectUnreachable("cereal is out of reach", "cereal", 1.7)
Traceback (most recent call last):
pycrorm_async.plan.failures.ObjectUnreachable: cereal is out of reach
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

from pycrorm_async.plan.language.resources import Resource
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.pose import Pose

__all__ = [
    "PlanFailure",
    "PlanFailures",
    "is_plan_failure",
    "in_words",
    "IKError",
    "ResourceDeadlock",
    "NotALanguageExpression",
    "FailureDiagnosis",
    "LowLevelFailure",
    "ActionlibActionTimeout",
    "ManipulationLowLevelFailure",
    "EnvironmentManipulationGoalNotReached",
    "ManipulationGoalNotReached",
    "ManipulationPoseUnreachable",
    "GripperLowLevelFailure",
    "GripperClosedCompletely",
    "GripperGoalNotReached",
    "NavigationLowLevelFailure",
    "NavigationGoalNotReached",
    "NavigationPoseUnreachable",
    "PerceptionLowLevelFailure",
    "PerceptionObjectNotFound",
    "PerceptionObjectNotInWorld",
    "TorsoLowLevelFailure",
    "TorsoGoalNotReached",
    "TorsoGoalUnreachable",
    "HighLevelFailure",
    "DeliveringFailed",
    "EnvironmentManipulationImpossible",
    "EnvironmentUnreachable",
    "FetchingFailed",
    "LookingHighLevelFailure",
    "ManipulationGoalInCollision",
    "NavigationHighLevelFailure",
    "NavigationGoalInCollision",
    "ObjectNowhereToBeFound",
    "ObjectUndeliverable",
    "ObjectUnfetchable",
    "ObjectUnreachable",
    "SearchingFailed",
    "Task",
    "Grasping",
    "Looking",
    "ObjectPoseMisestimation",
    "SuccessfulCompletion",
    "ObjectNotFound",
    "LocomotorFailure",
    "ArmFailure",
    "ObjectLost",
    "SensorFailure",
    "IllPosedGoalFailure",
    "CapabilityAbsenceFailure",
    "ReachabilityFailure",
    "TorsoFailure",
    "ConfigurationNotReached",
    "Timeout",
    "EndEffectorFailure",
    "ObjectUnavailable",
    "SustainedFailure",
    "ReasoningError",
    "CollisionError",
]


class PlanFailure(Exception):
    """A plan, action or motion did not succeed.

    Attributes:
        message: for people; also `str(failure)`.
        data: further values, as they were given; recorded with the message.
    """

    def __init__(self, message: str = "", *data: object) -> None:
        super().__init__(message, *data)
        self.message = message

    @property
    def data(self) -> tuple[object, ...]:
        return self.args[1:]

    def __str__(self) -> str:
        return self.message


class PlanFailures(PlanFailure, ExceptionGroup[Exception]):
    """Several plan failures that happened in one expression: `except PlanFailure` and `except* IKError` both work.

    Args:
        message: for people; names each.
        failures: plan failures, or groups of nothing else.
    """

    def __new__(cls, message: str, failures: Sequence[Exception]) -> Self:
        return super().__new__(cls, message, failures)

    def __init__(self, message: str, failures: Sequence[Exception]) -> None:
        # Not that of `PlanFailure`: a group has its message already.
        Exception.__init__(self, message, failures)

    @property
    def data(self) -> tuple[object, ...]:
        """The failures."""
        return self.exceptions

    def derive(self, failures: Sequence[Exception], /) -> PlanFailures:  # type: ignore[override]  # as documented
        return PlanFailures(self.message, failures)


def in_words(error: BaseException) -> str:
    """Class and message in one short line. Never raises.

    >>> in_words(ObjectLost("the gripper is empty"))
    'ObjectLost: the gripper is empty'
    """
    name = type(error).__name__
    try:
        message = " ".join(str(error).split())
    except Exception:  # noqa: BLE001  a user's __str__ may raise anything
        return name
    if len(message) > _WORDS_LENGTH_MAX:
        message = f"{message[: _WORDS_LENGTH_MAX - 1]}…"
    return f"{name}: {message}" if message else name


_WORDS_LENGTH_MAX = 200


def is_plan_failure(error: BaseException) -> bool:
    """Whether it says that a plan failed: a plan failure, or a group of nothing else (what a `TaskGroup` raises)."""
    if isinstance(error, ExceptionGroup):
        return all(map(is_plan_failure, error.exceptions))
    return isinstance(error, PlanFailure)


class IKError(PlanFailure):
    """The arm cannot bring its tool frame to the pose from where the base stands.

    Attributes:
        pose: the goal of the tool frame, in the map.
        arm: the arm that was asked.
        tip_frame: the link that should have got there.
    """

    def __init__(self, pose: Pose, arm: Arms, tip_frame: str, reason: str = "") -> None:
        x, y, z = pose.position
        because = f": {reason}" if reason else ""
        goal = f"({x:.3f}, {y:.3f}, {z:.3f})"
        super().__init__(f"{tip_frame} cannot reach {goal} with the {arm.name} arm{because}")
        self.args = (pose, arm, tip_frame, reason)
        self.pose = pose
        self.arm = arm
        self.tip_frame = tip_frame
        self.reason = reason


class ResourceDeadlock(PlanFailure):
    """A part of the robot can never be had: who holds it waits, in the end, for the one that wants it.

    Attributes:
        resource: the part.
        held_by, wanted_by: the designators' types.
        waits_for: the type of the one around `wanted_by` that cannot end before.
    """

    def __init__(self, resource: Resource, held_by: str, wanted_by: str, waits_for: str) -> None:
        super().__init__(
            f"{wanted_by} would wait for {resource.name} for ever: {held_by} holds it and waits, in the end, for"
            f" {waits_for}, which {wanted_by} is part of"
        )
        self.args = (resource, held_by, wanted_by, waits_for)
        self.resource = resource
        self.held_by = held_by
        self.wanted_by = wanted_by
        self.waits_for = waits_for


# --- diagnoses: what the plan can be told went wrong --------------------------------------------------------


class NotALanguageExpression(PlanFailure):
    """An operand of a plan expression is none."""


class FailureDiagnosis(PlanFailure):
    """A failure whose cause is known."""


# --- low level: one motion, one sensor ----------------------------------------------------------------------


class LowLevelFailure(FailureDiagnosis):
    """A single motion or perception went wrong."""


class ActionlibActionTimeout(LowLevelFailure):
    """A controller did not answer in time."""


class ManipulationLowLevelFailure(LowLevelFailure):
    """An arm did not do what it was told."""


class EnvironmentManipulationGoalNotReached(ManipulationLowLevelFailure):
    """A door or drawer did not get where it should."""


class ManipulationGoalNotReached(ManipulationLowLevelFailure):
    """The gripper stopped before its goal."""


class ManipulationPoseUnreachable(ManipulationLowLevelFailure):
    """No arm motion leads to the pose."""


class GripperLowLevelFailure(LowLevelFailure):
    """A gripper did not do what it was told."""


class GripperClosedCompletely(GripperLowLevelFailure):
    """The gripper closed on nothing."""


class GripperGoalNotReached(GripperLowLevelFailure):
    """The gripper stopped before its opening was reached."""


class NavigationLowLevelFailure(LowLevelFailure):
    """The base did not do what it was told."""


class NavigationGoalNotReached(NavigationLowLevelFailure):
    """The base stopped before its goal."""


class NavigationPoseUnreachable(NavigationLowLevelFailure):
    """No path leads to the pose."""


class PerceptionLowLevelFailure(LowLevelFailure):
    """Perception gave nothing that can be used."""


class PerceptionObjectNotFound(PerceptionLowLevelFailure):
    """The object was not seen."""


class PerceptionObjectNotInWorld(PerceptionLowLevelFailure):
    """The object that is meant is not in the world."""


class TorsoLowLevelFailure(LowLevelFailure):
    """The torso did not do what it was told."""


class TorsoGoalNotReached(TorsoLowLevelFailure):
    """The torso stopped before its goal."""


class TorsoGoalUnreachable(TorsoLowLevelFailure):
    """The torso cannot get to that height."""


# --- high level: a whole action -----------------------------------------------------------------------------


class HighLevelFailure(FailureDiagnosis):
    """An action as a whole went wrong."""


class DeliveringFailed(HighLevelFailure):
    """The object was not delivered."""


class EnvironmentManipulationImpossible(HighLevelFailure):
    """The door or drawer cannot be moved."""


class EnvironmentUnreachable(HighLevelFailure):
    """The door or drawer cannot be reached from anywhere."""


class FetchingFailed(HighLevelFailure):
    """The object was not fetched."""


class LookingHighLevelFailure(HighLevelFailure):
    """There is no place to see it from."""


class ManipulationGoalInCollision(HighLevelFailure):
    """Something is in the way of the gripper's goal."""


class NavigationHighLevelFailure(HighLevelFailure):
    """Going there failed."""


class NavigationGoalInCollision(NavigationHighLevelFailure):
    """Something stands where the base should."""


class ObjectNowhereToBeFound(HighLevelFailure):
    """The object was looked for everywhere."""


class ObjectUndeliverable(HighLevelFailure):
    """There is no way to deliver the object."""


class ObjectUnfetchable(HighLevelFailure):
    """There is no way to fetch the object."""


class ObjectUnreachable(HighLevelFailure):
    """No place to stand lets an arm reach the object."""


class SearchingFailed(HighLevelFailure):
    """The search ended without the object."""


# --- what the robot tried to do -----------------------------------------------------------------------------


class Task(PlanFailure):
    """A task could not be done."""


class Grasping(Task):
    """Grasping could not be done."""


class Looking(Task):
    """Looking could not be done."""


# --- capabilities and states --------------------------------------------------------------------------------


class ObjectPoseMisestimation(PlanFailure):
    """The object is not where it was believed to be."""


class SuccessfulCompletion(PlanFailure):
    """Raised to leave a plan early, its goal reached."""


class ObjectNotFound(PlanFailure):
    """No object answers the description."""


class LocomotorFailure(PlanFailure):
    """The base is out of order."""


class ArmFailure(PlanFailure):
    """An arm is out of order."""


class ObjectLost(PlanFailure):
    """The gripper does not hold the object."""


class SensorFailure(PlanFailure):
    """A sensor is out of order."""


class IllPosedGoalFailure(PlanFailure):
    """What was asked for leaves nothing that could be done."""


class CapabilityAbsenceFailure(PlanFailure):
    """This robot cannot do it."""


class ReachabilityFailure(PlanFailure):
    """No place to stand lets an arm reach the pose."""


class TorsoFailure(PlanFailure):
    """The torso is out of order."""


class ConfigurationNotReached(PlanFailure):
    """The joints did not reach their goal."""


class Timeout(PlanFailure):
    """It took longer than it may."""


class EndEffectorFailure(PlanFailure):
    """A gripper is out of order."""


class ObjectUnavailable(PlanFailure):
    """The object cannot be used now."""


class SustainedFailure(PlanFailure):
    """It keeps failing."""


class ReasoningError(PlanFailure):
    """No conclusion could be drawn."""


class CollisionError(PlanFailure):
    """Something was touched that should not be."""
