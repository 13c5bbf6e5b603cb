"""A failed reach names the object for which the arm reached, and a gripper refuses what is wider than its opening."""

from __future__ import annotations

import copy
import pickle

import pytest

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
)
from pycrorm_async.plan.failures import (
    CapabilityAbsenceFailure,
    IKError,
    ManipulationGoalInCollision,
    ManipulationGoalNotReached,
    PlanFailure,
)
from pycrorm_async.plan.motions import SimulatedModules, simulated_robot_within
from pycrorm_async.plan.task import collected_tree
from pycrorm_async.world import Arms, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.urdf import Limits
from tests.plan.conftest import Scene

FAR = Pose([0.0, 0.0, 3.0])


async def test_a_pick_up_out_of_reach_names_the_object_in_message_and_arguments(scene: Scene) -> None:
    with collected_tree() as tree, pytest.raises(IKError, match=r", reaching for milk$") as failed:
        await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    assert failed.value.args[-1] == "milk"
    assert failed.value.args[1] is Arms.LEFT
    assert {str(node.failure) for node in tree} == {str(failed.value)}  # the motion's record names it too


async def test_a_copy_of_a_named_reach_is_the_same_failure(scene: Scene) -> None:
    with pytest.raises(IKError) as failed:
        await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
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
