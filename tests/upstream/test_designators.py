"""PyCRAM's tests of its designators, of picking up and of retrying (July 2024), by name."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select

from pycrorm_async import Memory, plan
from pycrorm_async.learning import Evidence, MoveAndPickUp, PickUpChoice, Rectangle, Region, default_policy
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.plan.failures import GripperClosedCompletely
from pycrorm_async.world import Arms, Grasp, GripperState, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from pycrorm_async.world.urdf import PR2
from tests.plan.conftest import Scene, kitchen
from tests.promises.lab import statuses, url_of
from tests.upstream.conftest import Recorded

pytestmark = pytest.mark.slow


# === action designator ========================================================================================
#
# PyCRAM's tests of its action designators (July 2024), by name: the result of resolving a description, its SOMA
# concept, and its effect on the world.
#
# Where theirs end with resolving (gripping, releasing: not implemented there) these perform the action as well.

LEFT_TOOL = "l_gripper_tool_frame"
MILK = plan.ObjectDesignatorDescription(["milk"])


async def test_move_torso(scene: Scene) -> None:
    action = plan.MoveTorsoAction([0.3]).resolve()
    assert (action.position, action.concept) == (0.3, "MoveTorso")
    await action.perform()
    assert scene.robot.joint_position("torso_lift_joint") == 0.3


async def test_set_gripper(scene: Scene) -> None:
    description = plan.SetGripperAction([Arms.LEFT], [GripperState.OPEN, GripperState.CLOSE])
    action = description.resolve()
    assert (action.gripper, action.motion, action.concept) == (Arms.LEFT, GripperState.OPEN, "SettingGripper")
    assert len(list(description)) == 2
    await action.perform()
    for joint, position in PR2.arms[Arms.LEFT].gripper_joints[GripperState.OPEN].items():
        assert scene.robot.joint_position(joint) == position == 0.548


async def test_release(scene: Scene) -> None:
    action = plan.ReleaseAction([Arms.LEFT], MILK).resolve()
    assert (action.gripper, action.object_designator.name, action.concept) == (Arms.LEFT, "milk", "Releasing")
    scene.robot.attach(scene.milk, LEFT_TOOL)
    await action.perform()
    assert scene.robot.attachments == {}


async def test_grip(scene: Scene) -> None:
    action = plan.GripAction([Arms.LEFT], MILK, [0.5]).resolve()
    assert (action.gripper, action.object_designator.name, action.effort) == (Arms.LEFT, "milk", 0.5)
    assert action.concept == "Holding"
    scene.milk.set_pose(scene.robot.link_pose(LEFT_TOOL))
    await action.perform()
    assert scene.robot.attachments == {scene.milk: LEFT_TOOL}


async def test_park_arms(scene: Scene) -> None:
    action = plan.ParkArmsAction([Arms.BOTH]).resolve()
    assert (action.arm, action.concept) == (Arms.BOTH, "ParkingArms")
    await action.perform()
    for arm in (Arms.LEFT, Arms.RIGHT):
        for joint, position in PR2.arms[arm].park.items():
            assert scene.robot.joint_position(joint) == position


async def test_navigate(scene: Scene) -> None:
    action = plan.NavigateAction([Pose([0.3, 0, 0])]).resolve()
    assert (action.target_location, action.concept) == (Pose([0.3, 0, 0]), "Navigating")
    await action.perform()
    assert scene.robot.pose == Pose([0.3, 0, 0])


async def test_pick_up(scene: Scene) -> None:
    action = plan.PickUpAction(MILK, [Arms.LEFT], [Grasp.FRONT]).resolve()
    assert (action.object_designator.name, action.concept) == ("milk", "PickingUp")
    await plan.NavigateActionPerformable(Pose([0.6, 0.4, 0])).perform()
    await plan.MoveTorsoActionPerformable(0.3).perform()
    await action.perform()
    assert scene.milk in scene.robot.attachments


async def test_place(scene: Scene) -> None:
    action = plan.PlaceAction(MILK, [Pose([1.3, 1, 0.9])], [Arms.LEFT]).resolve()
    assert (action.object_designator.name, action.concept) == ("milk", "Placing")
    await plan.NavigateActionPerformable(Pose([0.6, 0.4, 0])).perform()
    await plan.MoveTorsoActionPerformable(0.3).perform()
    await plan.PickUpAction(MILK, [Arms.LEFT], [Grasp.FRONT]).resolve().perform()
    await action.perform()
    assert scene.milk not in scene.robot.attachments
    assert scene.milk.pose.distance(Pose([1.3, 1, 0.9])) < 1e-6


async def test_look_at(scene: Scene) -> None:
    action = plan.LookAtAction([Pose([1, 0, 1])]).resolve()
    assert (action.target, action.concept) == (Pose([1, 0, 1]), "LookingAt")
    await action.perform()
    # The tilt axis is where the head's description has it; the point is straight ahead of it, and lower.
    at = scene.robot.link_pose("head_tilt_link")
    seen = Pose([1, 0, 1]).relative_to(at).position
    assert [seen.y, seen.z] == pytest.approx([0, 0], abs=1e-6)
    assert seen.x > 0


async def test_detect(scene: Scene) -> None:
    scene.kitchen.remove()
    scene.cereal.remove()
    scene.milk.set_pose(Pose([1.5, 0, 1.2]))
    action = plan.DetectAction(MILK).resolve()
    assert (action.object_designator.name, action.concept) == ("milk", "LookingFor")
    result = await action.perform()
    assert (result.name, result.object_type, result.pose) == ("milk", ObjectType.MILK, Pose([1.5, 0, 1.2]))


async def test_open(scene: Scene) -> None:
    handle = plan.ObjectPart("sink_area_drawer_handle", scene.kitchen)
    action = plan.OpenAction(handle, [Arms.LEFT]).resolve()
    assert (action.object_designator.name, action.arm, action.concept) == (handle.name, Arms.LEFT, "Opening")
    await plan.NavigateActionPerformable(Pose([0.1, 1.1, 0])).perform()
    await plan.MoveTorsoActionPerformable(0.1).perform()
    await action.perform()
    # the drawer's limit is 0.35 m, and 0.05 m remain
    assert scene.kitchen.joint_limits("sink_area_drawer_joint") == (0.0, 0.35)
    assert scene.kitchen.joint_position("sink_area_drawer_joint") == pytest.approx(0.3)


async def test_close(scene: Scene) -> None:
    handle = plan.ObjectPart("sink_area_drawer_handle", scene.kitchen)
    action = plan.CloseAction(handle, [Arms.LEFT]).resolve()
    assert (action.object_designator.name, action.arm, action.concept) == (handle.name, Arms.LEFT, "Closing")
    scene.kitchen.set_joint_position("sink_area_drawer_joint", 0.3)
    await plan.NavigateActionPerformable(Pose([0.1, 1.1, 0])).perform()
    await plan.MoveTorsoActionPerformable(0.1).perform()
    await action.perform()
    assert scene.kitchen.joint_position("sink_area_drawer_joint") == 0.0


async def test_transport(scene: Scene) -> None:
    goal = Pose([-1.35, 0.78, 0.95], yaw_quaternion(math.pi))
    action = plan.TransportAction(MILK, [Arms.LEFT], [goal]).resolve()
    assert (action.object_designator.name, action.target_location, action.concept) == ("milk", goal, "Transporting")
    await plan.MoveTorsoActionPerformable(0.2).perform()
    await action.perform()
    assert scene.milk.pose.distance(goal) < 0.01
    assert scene.robot.attachments == {}


async def test_grasping(scene: Scene) -> None:
    action = plan.GraspingAction([Arms.RIGHT], MILK).resolve()
    assert (action.object_desig.name, action.arm, action.concept) == ("milk", Arms.RIGHT, "Grasping")
    await plan.NavigateActionPerformable(Pose([0.6, 1.1, 0])).perform()
    await action.perform()
    assert scene.robot.link_pose("r_gripper_tool_frame").distance(scene.milk.pose) < 0.01
    assert scene.robot.attachments == {}


async def test_facing(scene: Scene) -> None:
    await plan.FaceAtPerformable(scene.milk.pose).perform()
    seen = scene.milk.pose.relative_to(scene.robot.pose).position
    assert seen.y == pytest.approx(0, abs=1e-9)
    assert seen.x == pytest.approx(math.hypot(1.3, 1))


# === failure handling =========================================================================================
#
# PyCRAM's tests of retrying (July 2024), by name: the alternatives of a description are tried in turn.


async def test_retry_with_success(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
        with kitchen() as scene:
            await plan.Retry(plan.ParkArmsAction([Arms.LEFT]), max_tries=5).perform()
            # The right arm does not reach from there, the left one does: the second alternative.
            scene.robot.set_pose(Pose([0.6, 0.4, 0]))
            await plan.Retry(plan.PickUpAction(scene.milk, [Arms.RIGHT, Arms.LEFT], [Grasp.FRONT])).perform()
            assert scene.robot.attachments == {scene.milk: "l_gripper_tool_frame"}
    nodes = await Recorded(tmp_path).all(select(TaskTreeNode).order_by(TaskTreeNode.id))
    assert statuses(nodes) == [
        (None, "SUCCEEDED"),
        ("Retry", "SUCCEEDED"),
        ("ParkArmsAction", "SUCCEEDED"),
        ("MoveArmJointsMotion", "SUCCEEDED"),
        ("Retry", "SUCCEEDED"),
        ("PickUpAction", "FAILED"),
        ("MoveTCPMotion", "FAILED"),
        ("PickUpAction", "SUCCEEDED"),
        ("MoveTCPMotion", "SUCCEEDED"),
        ("MoveGripperMotion", "SUCCEEDED"),
        ("MoveTCPMotion", "SUCCEEDED"),
        ("MoveGripperMotion", "SUCCEEDED"),
        ("MoveTCPMotion", "SUCCEEDED"),
    ]


async def test_retry_with_failure(scene: Scene) -> None:
    with plan.collected_tree() as tree, pytest.raises(plan.PlanFailure) as caught:
        # From the origin no alternative can be reached.
        pick_up = plan.PickUpAction(scene.milk, [Arms.LEFT, Arms.RIGHT], [Grasp.FRONT, Grasp.TOP])
        await plan.Retry(pick_up, max_tries=3).perform()
    assert isinstance(caught.value, plan.IKError)
    assert not isinstance(caught.value, GripperClosedCompletely)
    tried = [node for node in tree if type(node.designator).__name__ == "PickUpActionPerformable"]
    assert [(node.designator.arm, node.designator.grasp) for node in tried] == [  # type: ignore[union-attr]  # they are
        (Arms.LEFT, Grasp.FRONT),
        (Arms.LEFT, Grasp.TOP),
        (Arms.RIGHT, Grasp.FRONT),
    ]
    assert {node.status for node in tree} == {plan.TaskStatus.FAILED}


# === move and pick up =========================================================================================
#
# PyCRAM's tests of moving and picking up (July 2024), by name, with their assertions.


def test_create_model() -> None:
    """No base pose is inside the object; there are four variables, and here a fifth, the torso."""
    centre = Region((Rectangle(-0.2, 0.2, -0.2, 0.2),))
    assert default_policy().probability(Evidence(region=centre)) == 0
    assert PickUpChoice._fields == ("arm", "grasp", "relative_x", "relative_y", "torso")


def test_grounding(scene: Scene) -> None:
    """The places that are free and see the object are disjoint pieces, and there is a policy for it in the scene."""
    grounded = MoveAndPickUp(scene.milk).grounded()
    region = grounded.evidence.region
    assert region is not None
    assert region.rectangles
    for one, other in combinations(region.rectangles, 2):
        apart_x = one.x_max <= other.x_min or other.x_max <= one.x_min
        assert apart_x or one.y_max <= other.y_min or other.y_max <= one.y_min
    assert grounded.sample(np.random.default_rng(69), 5)


@pytest.mark.parametrize("seed", [69, 420])
async def test_move_and_pick_up(scene: Scene, seed: int) -> None:
    """At least one of twenty samples for the scene succeeds."""
    rng = np.random.default_rng(seed)
    tries = iter(MoveAndPickUp(scene.milk, samples=20, rng=rng))
    for each in tries:
        try:
            await each.perform()
        except plan.PlanFailure:
            scene.world.reset()
        else:
            break
    assert scene.milk.attached_to is scene.robot
    scene.world.reset()
    await plan.Retry(MoveAndPickUp(scene.milk, rng=np.random.default_rng(seed)), max_tries=20).perform()
    assert scene.milk.attached_to is scene.robot


# === object designator ========================================================================================
#
# PyCRAM's tests of object designators (July 2024), by name.


def test_object_grounding(scene: Scene) -> None:
    designator = plan.ObjectDesignatorDescription(["milk"], [ObjectType.MILK]).resolve()
    assert (designator.name, designator.object_type) == ("milk", ObjectType.MILK)
    assert designator.world_object is scene.milk


def test_frozen_copy(scene: Scene) -> None:
    designator = plan.ObjectDesignatorDescription(["milk"], [ObjectType.MILK]).resolve()
    frozen = designator.frozen_copy()
    assert frozen.pose == designator.pose == Pose([1.3, 1, 0.9])
    scene.milk.set_pose(Pose([2, 2, 2]))
    assert (frozen.pose, designator.pose) == (Pose([1.3, 1, 0.9]), Pose([2, 2, 2]))
