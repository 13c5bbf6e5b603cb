"""Failures: their class tree, their data, their pickles, and what a failed reach or gripper names."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import pytest

from pycrorm_async.errors import EpisodeParked, FlushTimeout, PycrormError, SpoolFull, SpoolUnavailable
from pycrorm_async.plan import (
    ChosenRobot,
    GraspingActionPerformable,
    GripActionPerformable,
    MoveTCPMotion,
    NavigateActionPerformable,
    ObjectPart,
    OpenActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    TransportActionPerformable,
    failures,
)
from pycrorm_async.plan.failures import (
    CapabilityAbsenceFailure,
    IKError,
    ManipulationGoalInCollision,
    ManipulationGoalNotReached,
    NotResolved,
    ObjectLost,
    PlanFailure,
    PlanFailures,
    ResolutionError,
    Resource,
    ResourceDeadlock,
    describe_error,
    is_plan_failure,
)
from pycrorm_async.plan.motions import SimulatedModules, simulated_robot_within
from pycrorm_async.plan.task import collected_tree
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Grasp, Object, ObjectType
from pycrorm_async.world.pose import Arms, Pose
from pycrorm_async.world.urdf import Limits
from tests.plan.conftest import Scene

# === failures =================================================================================================
#
# Plan failures: their class tree, their data, and their pickles.


KINDS = [kind for kind in vars(failures).values() if getattr(kind, "__init__", None) is PlanFailure.__init__]
"""The classes of failures without arguments of their own."""


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_failure_takes_a_message_and_data(kind: type[PlanFailure]) -> None:
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


# === named reaches ============================================================================================
#
# A failed reach names the object for which the arm reached, and a gripper refuses what is wider than its opening.

FAR = Pose([0.0, 0.0, 3.0])


async def test_a_pick_up_out_of_reach_names_the_object_in_message_and_arguments(scene: Scene) -> None:
    with collected_tree() as tree, pytest.raises(IKError, match=r", reaching for milk$") as failed:
        await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    assert failed.value.args[-1] == "milk"
    assert failed.value.args[1] is Arms.LEFT
    assert {str(node.failure) for node in tree} == {str(failed.value)}  # the motion's record names it too
    assert {node.status for node in tree} == {TaskStatus.FAILED}
    assert scene.robot.attachments == {}
    for each in (copy.copy(failed.value), pickle.loads(pickle.dumps(failed.value))):
        assert (str(each), each.args, each.reason) == (str(failed.value), failed.value.args, failed.value.reason)


async def test_placing_grasping_and_opening_name_theirs(scene: Scene) -> None:
    await NavigateActionPerformable(Pose([0.6, 0.9, 0])).perform()
    await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    handle = ObjectPart("fridge_door_handle", scene.kitchen)
    for action, name in (
        (PlaceActionPerformable(scene.milk, Arms.LEFT, FAR), "milk"),
        (GraspingActionPerformable(Arms.RIGHT, handle), "fridge_door_handle"),
        (OpenActionPerformable(handle, Arms.RIGHT), "fridge_door_handle"),
    ):
        with pytest.raises(IKError, match=f", reaching for {name}$"):
            await action.perform()
    assert scene.milk.attached_to is scene.robot  # a place out of reach keeps it in the hand


async def test_a_motion_for_no_object_names_none(scene: Scene) -> None:
    with pytest.raises(IKError) as failed:
        await MoveTCPMotion(FAR, Arms.LEFT).perform()
    assert "reaching for" not in str(failed.value)
    assert len(failed.value.args) == 4


async def test_a_failure_of_a_users_robot_names_the_object_too(scene: Scene) -> None:
    class Stopping(SimulatedModules):
        async def move_tcp(self, motion: MoveTCPMotion) -> None:
            raise ManipulationGoalNotReached("the arm stopped 0.3 m before its goal", 0.3)

    with ChosenRobot("mine", Stopping(Limits.SOFT)), pytest.raises(ManipulationGoalNotReached) as failed:
        await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    assert failed.value.message == "the arm stopped 0.3 m before its goal, reaching for milk"
    assert failed.value.data == (0.3, "milk")


async def test_a_reach_in_collision_names_its_object(scene: Scene) -> None:
    await NavigateActionPerformable(Pose([0.63, 1.0, 0])).perform()
    with simulated_robot_within(Limits.SOFT, collisions=True), pytest.raises(ManipulationGoalInCollision) as failed:
        await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    assert failed.value.message.endswith(", reaching for milk")
    assert failed.value.data[1:] == ("kitchen", "milk")


@pytest.mark.parametrize(("grasp", "width"), [(Grasp.FRONT, None), (Grasp.LEFT, 0.148), (Grasp.TOP, None)])
async def test_a_gripper_refuses_what_is_wider_than_its_opening_where_collisions_count(
    scene: Scene, grasp: Grasp, width: float | None
) -> None:
    """The cereal is 0.058 m wide seen from the front and 0.148 m from the side; the PR2's grippers open 0.086 m."""
    pick_up = PickUpActionPerformable(scene.cereal, Arms.LEFT, grasp)
    with simulated_robot_within(Limits.SOFT, collisions=True), pytest.raises(PlanFailure) as failed:
        await pick_up.perform()
    assert isinstance(failed.value, CapabilityAbsenceFailure) is (width is not None)
    if width is not None:
        assert failed.value.message == "cereal is 0.148 m wide between the fingers, the LEFT gripper opens 0.086 m"
        assert failed.value.data == ("cereal", pytest.approx(width), 0.086)
    with pytest.raises(IKError):  # without collisions only kinematics counts
        await pick_up.perform()


async def test_closing_on_a_wide_object_and_transporting_it_are_refused_alike(scene: Scene) -> None:
    tool = scene.robot.link_pose("l_gripper_tool_frame")
    bowl = Object("bowl", ObjectType.BOWL, pose=tool)
    for action in (GripActionPerformable(Arms.LEFT, bowl, 10.0), TransportActionPerformable(bowl, Arms.LEFT, FAR)):
        with (
            simulated_robot_within(Limits.SOFT, collisions=True),
            pytest.raises(CapabilityAbsenceFailure, match=r"bowl is 0\.140 m wide"),
        ):
            await action.perform()
    assert bowl.attached_to is None
    await GripActionPerformable(Arms.LEFT, bowl, 10.0).perform()
    assert bowl.attached_to is scene.robot


# === errors ===================================================================================================
#
# Errors reach the user whole, also from another process.


@pytest.mark.parametrize(
    "error",
    [
        SpoolFull("the spool is full"),
        FlushTimeout(15.0, "no process drains this spool"),
        EpisodeParked({"an episode": "by hand"}),
        SpoolUnavailable(Path("spool"), "read-only file system"),
        ResolutionError("NavigateAction", missing=["target"]),
        NotResolved("NavigateAction", "perform"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_keeps_class_message_and_data_in_another_process(error: PycrormError) -> None:
    received = pickle.loads(pickle.dumps(error))
    assert (type(received), str(received), vars(received)) == (type(error), str(error), vars(error))
