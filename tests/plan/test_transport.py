"""An object is transported by the expected actions and locations, or the failure names the reason."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pycrorm_async.plan import (
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    PickUpActionPerformable,
    TransportAction,
    TransportActionPerformable,
    collected_tree,
)
from pycrorm_async.plan.failures import ObjectUnfetchable, ReachabilityFailure
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.world import Arms, Grasp, Pose
from pycrorm_async.world.pose import yaw_quaternion
from pycrorm_async.world.urdf import PR2
from tests.plan.conftest import Scene
from tests.plan.fake_observer import Recording
from tests.plan.test_actions import shape
from tests.world.fakes import matrix

LEFT_TOOL = "l_gripper_tool_frame"
ISLAND = Pose([-1.35, 1.0, 0.988], yaw_quaternion(math.pi))


def parked(scene: Scene, *arms: Arms) -> bool:
    joints = {name: value for arm in arms for name, value in PR2.arms[arm].park.items()}
    return all(scene.robot.joint_position(name) == value for name, value in joints.items())


@pytest.mark.parametrize("arm", [Arms.LEFT, Arms.RIGHT])
async def test_a_transported_object_is_at_its_target_and_the_arms_are_parked(scene: Scene, arm: Arms) -> None:
    await MoveTorsoActionPerformable(0.3).perform()
    with collected_tree() as tree, Recording().listening() as recording:
        await TransportActionPerformable(designator_of(scene.milk), arm, ISLAND).perform()
    np.testing.assert_allclose(matrix(scene.milk.pose), matrix(ISLAND), atol=1e-6)
    assert (scene.robot.attachments, scene.milk.attached_to) == ({}, None)
    assert parked(scene, Arms.LEFT, Arms.RIGHT)
    assert [line.strip() for line in shape(tree) if not line.startswith("    ")] == [
        "TransportActionPerformable",
        "ParkArmsActionPerformable",
        "NavigateActionPerformable",
        "PickUpActionPerformable",
        "ParkArmsActionPerformable",
        "NavigateActionPerformable",
        "PlaceActionPerformable",
        "ParkArmsActionPerformable",
    ]
    assert len(tree) == 1 + 2 + 2 + 6 + 2 + 2 + 4 + 2
    assert [place[0] for place in recording.places] == ["CostmapLocation"] * 2
    transport = next(iter(tree))
    for _, candidates, taken, _, node in recording.places:
        assert (taken, node) == (0, transport)
        assert arm in candidates[0].arms
    assert scene.robot.pose == recording.places[1][1][0].pose


async def test_an_object_in_the_hand_is_only_brought(scene: Scene) -> None:
    await MoveTorsoActionPerformable(0.3).perform()
    await NavigateActionPerformable(Pose([0.6, 0.9, 0])).perform()
    await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    with collected_tree() as tree:
        await TransportAction(scene.milk, [Arms.LEFT], [ISLAND]).resolve().perform()
    np.testing.assert_allclose(matrix(scene.milk.pose), matrix(ISLAND), atol=1e-6)
    assert "  PickUpActionPerformable" not in shape(tree)


async def test_an_object_that_cannot_be_picked_up_stays_in_place(scene: Scene) -> None:
    scene.milk.set_pose(Pose([1.3, 1, 3.0]))
    with pytest.raises(ObjectUnfetchable, match="no place to stand and pick up milk") as caught:
        await TransportActionPerformable(scene.milk, Arms.LEFT, ISLAND).perform()
    assert caught.value.data == ("milk",)
    assert (scene.milk.pose, scene.robot.pose, scene.robot.attachments) == (Pose([1.3, 1, 3.0]), Pose(), {})


async def test_an_object_that_cannot_be_delivered_stays_in_the_hand(scene: Scene) -> None:
    await MoveTorsoActionPerformable(0.3).perform()
    with pytest.raises(ReachabilityFailure, match="no place to stand and reach"):
        await TransportActionPerformable(scene.milk, Arms.LEFT, Pose([0, -3, 3.0])).perform()
    assert scene.robot.attachments == {scene.milk: LEFT_TOOL}
    assert parked(scene, Arms.LEFT, Arms.RIGHT)


async def test_a_robot_of_one_arm_transports_with_it(scene: Scene, one_armed: None) -> None:
    await MoveTorsoActionPerformable(0.3).perform()
    await TransportActionPerformable(scene.milk, Arms.LEFT, ISLAND).perform()
    np.testing.assert_allclose(matrix(scene.milk.pose), matrix(ISLAND), atol=1e-6)
    assert parked(scene, Arms.LEFT)
    assert not parked(scene, Arms.RIGHT)
