"""Plan failures: their class tree, their data, and their pickles."""

from __future__ import annotations

import pickle

import pytest

from pycrorm_async.errors import PycrormError
from pycrorm_async.plan import failures
from pycrorm_async.plan.failures import (
    IKError,
    ObjectLost,
    PlanFailure,
    PlanFailures,
    Resource,
    ResourceDeadlock,
    describe_error,
    is_plan_failure,
)
from pycrorm_async.world.pose import Arms, Pose

TREE = """
PlanFailure
  PlanFailures
  ResourceDeadlock
  NotALanguageExpression
  FailureDiagnosis
    LowLevelFailure
      ActionlibActionTimeout
      ManipulationLowLevelFailure
        EnvironmentManipulationGoalNotReached
        ManipulationGoalNotReached
        ManipulationPoseUnreachable
      GripperLowLevelFailure
        GripperClosedCompletely
        GripperGoalNotReached
      NavigationLowLevelFailure
        NavigationGoalNotReached
        NavigationPoseUnreachable
      PerceptionLowLevelFailure
        PerceptionObjectNotFound
        PerceptionObjectNotInWorld
      TorsoLowLevelFailure
        TorsoGoalNotReached
        TorsoGoalUnreachable
    HighLevelFailure
      DeliveringFailed
      EnvironmentManipulationImpossible
      EnvironmentUnreachable
      FetchingFailed
      LookingHighLevelFailure
      ManipulationGoalInCollision
      NavigationHighLevelFailure
        NavigationGoalInCollision
      ObjectNowhereToBeFound
      ObjectUndeliverable
      ObjectUnfetchable
      ObjectUnreachable
      SearchingFailed
  IKError
  Task
    Grasping
    Looking
  ObjectPoseMisestimation
  SuccessfulCompletion
  ObjectNotFound
  LocomotorFailure
  ArmFailure
  ObjectLost
  SensorFailure
  IllPosedGoalFailure
  CapabilityAbsenceFailure
  ReachabilityFailure
  TorsoFailure
  ConfigurationNotReached
  Timeout
  EndEffectorFailure
  ObjectUnavailable
  SustainedFailure
  ReasoningError
  CollisionError
"""


def parents() -> dict[str, str]:
    """Return class name → name of its base, read off the indentation above."""
    above: list[str] = ["Exception"]
    classes = {}
    for line in TREE.strip().splitlines():
        depth = (len(line) - len(line.lstrip())) // 2
        del above[depth + 1 :]
        classes[line.strip()] = above[-1]
        above.append(line.strip())
    return classes


def test_the_tree_of_classes_is_the_documented_one() -> None:
    classes = {
        name: kind.__bases__[0].__name__
        for name, kind in vars(failures).items()
        if isinstance(kind, type) and issubclass(kind, PlanFailure)
    }
    assert classes == parents()
    assert sorted(failures.__all__) == sorted(classes)


@pytest.mark.parametrize("name", sorted(set(parents()) - {"IKError", "PlanFailures", "ResourceDeadlock"}))
def test_every_failure_takes_a_message_and_data(name: str) -> None:
    kind: type[PlanFailure] = getattr(failures, name)
    failure = kind("the drawer is stuck", "drawer", 0.3)
    assert (str(failure), failure.message, failure.data) == (
        "the drawer is stuck",
        "the drawer is stuck",
        ("drawer", 0.3),
    )
    assert failure.args == ("the drawer is stuck", "drawer", 0.3)
    again = pickle.loads(pickle.dumps(failure))
    assert (type(again), again.args, str(again)) == (kind, failure.args, str(failure))
    assert (str(kind()), kind().data) == ("", ())
    assert kind.__doc__


def test_an_ik_error_names_the_arm_and_the_pose() -> None:
    failure = IKError(Pose([1, 2, 3]), Arms.LEFT, "l_gripper_tool_frame", "too far")
    assert str(failure) == "l_gripper_tool_frame cannot reach (1.000, 2.000, 3.000) with the LEFT arm: too far"
    assert (failure.pose, failure.arm, failure.tip_frame) == (Pose([1, 2, 3]), Arms.LEFT, "l_gripper_tool_frame")
    assert failure.args == (Pose([1, 2, 3]), Arms.LEFT, "l_gripper_tool_frame", "too far")
    again = pickle.loads(pickle.dumps(failure))
    assert (again.args, str(again)) == (failure.args, str(failure))


def test_a_plan_failure_is_an_outcome_and_no_fault_of_the_package() -> None:
    assert not issubclass(PlanFailure, PycrormError)
    assert issubclass(PlanFailure, Exception)


def test_several_failures_are_a_plan_failure_and_a_group() -> None:
    one, two = ObjectLost("gone", "milk"), IKError(Pose([1, 2, 3]), Arms.LEFT, "tool")
    both = PlanFailures("2 of 2 branches failed", [one, two])
    assert is_plan_failure(both)
    assert (str(both), both.message, both.data) == ("2 of 2 branches failed",) * 2 + ((one, two),)
    again = pickle.loads(pickle.dumps(both))
    assert (type(again), str(again), [type(each) for each in again.exceptions]) == (
        PlanFailures,
        str(both),
        [ObjectLost, IKError],
    )
    caught: list[BaseException] = []
    try:
        raise both
    except* IKError as unreachable:
        caught.append(unreachable)
    except* PlanFailure as rest:
        caught.append(rest)
    assert [(type(each), each.exceptions) for each in caught if isinstance(each, PlanFailures)] == [
        (PlanFailures, (two,)),
        (PlanFailures, (one,)),
    ]


def test_a_deadlock_names_the_part_and_the_three_nodes_involved() -> None:
    failure = ResourceDeadlock(Resource.BASE, "PickUpAction", "NavigateAction", "Tidying")
    assert str(failure) == (
        "NavigateAction would wait forever for BASE: PickUpAction holds it and waits, directly or indirectly,"
        " for Tidying, which contains NavigateAction"
    )
    again = pickle.loads(pickle.dumps(failure))
    assert (again.args, str(again)) == (failure.args, str(failure))


def test_any_exception_is_printed_in_a_short_line() -> None:
    class Broken(Exception):
        def __str__(self) -> str:
            raise ValueError

    assert describe_error(ObjectLost("the gripper\nis empty")) == "ObjectLost: the gripper is empty"
    assert describe_error(ObjectLost()) == "ObjectLost"
    assert describe_error(Broken()) == "Broken"
    assert describe_error(ObjectLost("x" * 300)) == f"ObjectLost: {'x' * 199}…"
