"""The abilities of one hand: hold and release, pick up rotated objects, transport them, and its failures."""

from __future__ import annotations

import itertools
import math
from collections.abc import Awaitable, Callable
from dataclasses import replace

import numpy as np
import pytest

from pycrorm_async.plan import (
    ActionAbstract,
    BaseMotion,
    BelieveObject,
    GraspingActionPerformable,
    GripActionPerformable,
    IKError,
    MoveGripperMotion,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectPart,
    OpeningMotion,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    ReleaseActionPerformable,
    SetGripperActionPerformable,
    TransportAction,
    TransportActionPerformable,
    collected_tree,
    simulated_robot_within,
)
from pycrorm_async.plan.failures import (
    CapabilityAbsenceFailure,
    EndEffectorFailure,
    GripperClosedCompletely,
    IllPosedGoalFailure,
    ObjectLost,
    ObjectUnfetchable,
    PerceptionObjectNotInWorld,
    ReachabilityFailure,
)
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.world import Arms, BulletWorld, Grasp, GripperState, Limits, Object, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from pycrorm_async.world.urdf import PR2
from tests.plan.conftest import Scene
from tests.plan.fakes import Recording
from tests.plan.test_actions import shape
from tests.world.fakes import CRANE, ChangeLog, Matrix, X, Y, Z, bullet_frame, matrix, shifted, turned

# === manipulation =============================================================================================
#
# The abilities of one hand: hold and release, pick up rotated objects, and its failures.

LEFT_TOOL, RIGHT_TOOL = "l_gripper_tool_frame", "r_gripper_tool_frame"


def fingers(scene: Scene, prefix: str = "l") -> set[float]:
    return {scene.robot.joint_position(f"{prefix}_gripper_{finger}_finger_joint") for finger in "lr"}


async def reached(scene: Scene, x: float) -> None:
    """Move the left tool frame to this x at the milk's height and side; the milk's box is 3.3 cm to each side."""
    await NavigateActionPerformable(Pose([0.6, 0.9, 0])).perform()
    await MoveTCPMotion(Pose([x, 1, 0.9]), Arms.LEFT).perform()


async def test_a_held_object_moves_with_the_hand_and_a_released_one_stays(scene: Scene) -> None:
    await reached(scene, 1.28)
    await SetGripperActionPerformable(Arms.LEFT, GripperState.OPEN).perform()
    witness = ChangeLog()
    scene.world.observe(witness)
    with collected_tree() as tree:
        await GripActionPerformable(Arms.LEFT, designator_of(scene.milk), 20.0).perform()
    assert witness.names() == [("joints", "pr2"), ("attached", "pr2")]
    assert (scene.robot.attachments, fingers(scene)) == ({scene.milk: LEFT_TOOL}, {0.0})
    assert scene.milk.pose == Pose([1.3, 1, 0.9])
    await MoveTCPMotion(Pose([1.1, 1.1, 1.0], yaw_quaternion(math.pi / 6)), Arms.LEFT).perform()
    # The milk is 2 cm before the hand, along the direction in which it points now.
    there = (1.1 + 0.02 * math.cos(math.pi / 6), 1.1 + 0.02 * 0.5, 1.0)
    assert scene.milk.pose.position == pytest.approx(there, abs=1e-6)
    with collected_tree() as released:
        await ReleaseActionPerformable(Arms.LEFT, scene.milk).perform()
    assert (scene.robot.attachments, scene.milk.attached_to, fingers(scene)) == ({}, None, {0.548})
    await ParkArmsActionPerformable(Arms.LEFT).perform()
    assert scene.milk.pose.position == pytest.approx(there, abs=1e-6)
    assert shape(tree) == ["GripActionPerformable", "  MoveGripperMotion"]
    assert shape(released) == ["ReleaseActionPerformable", "  MoveGripperMotion"]


@pytest.mark.parametrize(("gap", "held"), [(0.0, True), (0.029, True), (0.031, False), (0.1, False)])
async def test_only_an_object_within_three_centimetres_of_the_tool_frame_is_held(
    scene: Scene, gap: float, held: bool
) -> None:
    await reached(scene, 1.3 - 0.033 - gap)
    grip = GripActionPerformable(Arms.LEFT, scene.milk, 5.0)
    if held:
        await grip.perform()
        assert scene.robot.attachments == {scene.milk: LEFT_TOOL}
        return
    before = scene.world.save_state()
    with pytest.raises(GripperClosedCompletely, match=f"milk is {gap:.3f} m from it") as caught:
        await grip.perform()
    assert caught.value.data == ("milk", pytest.approx(gap, abs=1e-6))
    assert scene.world.save_state() == before


async def test_holding_again_changes_nothing_and_holding_detaches_an_object_from_another_parent(scene: Scene) -> None:
    tray = Object("tray", ObjectType.GENERIC_OBJECT, pose=Pose([1.3, 1, 0.75]))
    tray.attach(scene.milk)
    await reached(scene, 1.3)
    for _ in range(2):
        await GripActionPerformable(Arms.LEFT, scene.milk, 0.0).perform()
        assert (tray.attachments, scene.robot.attachments) == ({}, {scene.milk: LEFT_TOOL})


async def test_a_full_hand_neither_picks_up_nor_holds_nor_grasps_another_object(scene: Scene) -> None:
    await reached(scene, 1.3)
    scene.robot.attach(scene.cereal, LEFT_TOOL)
    before = scene.world.save_state()
    for action in (
        PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT),
        TransportActionPerformable(scene.milk, Arms.LEFT, Pose([-1.3, 1, 0.95])),
        GripActionPerformable(Arms.LEFT, scene.milk, 1.0),
        GraspingActionPerformable(Arms.LEFT, scene.milk),
        GraspingActionPerformable(Arms.LEFT, ObjectPart("sink_area_drawer_handle", scene.kitchen)),
    ):
        with pytest.raises(EndEffectorFailure, match="the LEFT gripper holds cereal") as caught:
            await action.perform()
        assert caught.value.data == ("cereal",)
    assert scene.world.save_state() == before
    with pytest.raises(GripperClosedCompletely):
        await GripActionPerformable(Arms.RIGHT, scene.milk, 1.0).perform()


async def test_only_what_this_gripper_holds_can_be_released(scene: Scene) -> None:
    before = scene.world.save_state()
    with pytest.raises(ObjectLost, match="the LEFT gripper does not hold milk") as caught:
        await ReleaseActionPerformable(Arms.LEFT, scene.milk).perform()
    assert (caught.value.data, scene.world.save_state()) == (("milk",), before)
    scene.robot.attach(scene.milk, RIGHT_TOOL)
    with pytest.raises(ObjectLost):
        await ReleaseActionPerformable(Arms.LEFT, scene.milk).perform()
    await ReleaseActionPerformable(Arms.RIGHT, scene.milk).perform()
    assert scene.robot.attachments == {}


async def test_grasping_closes_the_hand_around_an_object_and_attaches_nothing(scene: Scene) -> None:
    scene.milk.set_pose(Pose([1.25, 1, 0.9], yaw_quaternion(0.4)))
    await NavigateActionPerformable(Pose([0.6, 0.9, 0])).perform()
    with collected_tree() as tree:
        await GraspingActionPerformable(Arms.LEFT, scene.milk).perform()
    np.testing.assert_allclose(bullet_frame(scene.robot, LEFT_TOOL), shifted(1.25, 1, 0.9) @ turned(Z, 0.4), atol=1e-5)
    targets = [node.designator.target for node in tree if isinstance(node.designator, MoveTCPMotion)]
    before = shifted(1.25, 1, 0.9) @ turned(Z, 0.4) @ shifted(-0.1, 0, 0)
    np.testing.assert_allclose(matrix(targets[0]), before, atol=1e-9)
    assert (scene.robot.attachments, fingers(scene)) == ({}, {0.0})
    states = [node.designator.motion.name for node in tree if isinstance(node.designator, MoveGripperMotion)]
    assert states == ["OPEN", "CLOSE"]
    assert shape(tree)[0] == "GraspingActionPerformable"


GRASP: dict[Grasp, Matrix] = {
    Grasp.FRONT: np.eye(4),
    Grasp.LEFT: turned(Z, -math.pi / 2),
    Grasp.RIGHT: turned(Z, math.pi / 2),
    Grasp.TOP: turned(Y, math.pi / 2),
}
"""The gripper's x axis in the object's axes: along x, along -y, along y, along -z."""
YAWED = turned(Z, 0.7)
TILTED = turned(Z, 0.7) @ turned(X, 0.25) @ turned(Y, -0.2)


@pytest.mark.parametrize("turn", [YAWED, TILTED], ids=["yawed", "tilted"])
@pytest.mark.parametrize("grasp", list(Grasp), ids=lambda each: each.name)
async def test_a_rotated_object_is_picked_up_and_placed_in_its_own_axes(
    scene: Scene, grasp: Grasp, turn: Matrix
) -> None:
    place = shifted(0.0, 3.0, 0.95) @ turn
    target = shifted(0.0, 3.0, 1.0) @ turned(Z, 0.1) @ turn
    scene.milk.set_pose(pose_of(place))

    async def picked_up_and_placed() -> None:
        await PickUpActionPerformable(scene.milk, Arms.LEFT, grasp).perform()
        lifted = shifted(0, 0, 0.03) @ place
        np.testing.assert_allclose(bullet_frame(scene.robot, LEFT_TOOL), lifted @ GRASP[grasp], atol=1e-5)
        np.testing.assert_allclose(matrix(scene.milk.pose), lifted, atol=1e-6)
        await PlaceActionPerformable(scene.milk, Arms.LEFT, pose_of(target)).perform()

    with simulated_robot_within(Limits.HARD):
        await MoveTorsoActionPerformable(0.25).perform()
        assert await done_from_some_pose(scene, picked_up_and_placed)
    np.testing.assert_allclose(matrix(scene.milk.pose), target, atol=1e-6)
    behind = target @ GRASP[grasp] @ shifted(-0.07, 0, 0)
    np.testing.assert_allclose(bullet_frame(scene.robot, LEFT_TOOL), behind, atol=1e-5)
    assert scene.robot.attachments == {}


async def done_from_some_pose(scene: Scene, doing: Callable[[], Awaitable[None]]) -> bool:
    """Return whether it was done from a pose around the milk; what an arm could not reach from elsewhere is undone."""
    before, (x, y, _) = scene.world.save_state(), scene.milk.pose.position
    for away, side, aside in itertools.product((0.6, 0.5, 0.7), range(16), (0.0, 0.4, -0.4, -0.8)):
        angle = side * math.pi / 8
        stand = Pose([x - away * math.cos(angle), y - away * math.sin(angle), 0], yaw_quaternion(angle + aside))
        await NavigateActionPerformable(stand).perform()
        try:
            await doing()
        except IKError:
            scene.world.restore_state(before)
        else:
            return True
    return False


def pose_of(frame: Matrix) -> Pose:
    """Return the pose of a matrix that rotates by less than half a circle."""
    turn = frame[:3, :3]
    w = math.sqrt(1 + np.trace(turn)) / 2
    x, y, z = (turn - turn.T)[(2, 0, 1), (1, 2, 0)] / (4 * w)
    return Pose(frame[:3, 3].tolist(), (x, y, z, w))


# --- failures ---------------------------------------------------------------------------------------------------------


def one_handed(scene: Scene, arm: Arms) -> list[ActionAbstract | BaseMotion]:
    there = Pose([0.6, 0.2, 0.9])
    return [
        PickUpActionPerformable(scene.milk, arm, Grasp.FRONT),
        PlaceActionPerformable(scene.milk, arm, there),
        GripActionPerformable(arm, scene.milk, 1.0),
        ReleaseActionPerformable(arm, scene.milk),
        GraspingActionPerformable(arm, scene.milk),
        TransportActionPerformable(scene.milk, arm, there),
        MoveTCPMotion(there, arm),
    ]


async def test_both_arms_for_an_action_of_one_are_a_failure_and_move_nothing(scene: Scene) -> None:
    before = scene.world.save_state()
    for action in one_handed(scene, Arms.BOTH):
        with pytest.raises(IllPosedGoalFailure, match="one arm, LEFT or RIGHT, and does not work with BOTH") as caught:
            await action.perform()
        assert caught.value.data == (Arms.BOTH,)
    assert scene.world.save_state() == before


async def test_an_arm_that_the_robot_lacks_is_a_failure_and_moves_nothing(scene: Scene) -> None:
    scene.robot.robot_description = replace(PR2, arms={Arms.LEFT: PR2.arms[Arms.LEFT]})
    before = scene.world.save_state()
    missing = [
        *one_handed(scene, Arms.RIGHT),
        ParkArmsActionPerformable(Arms.RIGHT),
        ParkArmsActionPerformable(Arms.BOTH),
        SetGripperActionPerformable(Arms.RIGHT, GripperState.OPEN),
        SetGripperActionPerformable(Arms.BOTH, GripperState.OPEN),
        MoveGripperMotion(GripperState.OPEN, Arms.BOTH),
    ]
    for action in missing:
        with pytest.raises(CapabilityAbsenceFailure, match="pr2 has no RIGHT arm") as caught:
            await action.perform()
        assert caught.value.data == ("pr2", Arms.RIGHT)
    assert scene.world.save_state() == before
    await ParkArmsActionPerformable(Arms.LEFT).perform()
    await SetGripperActionPerformable(Arms.LEFT, GripperState.OPEN).perform()
    assert (scene.robot.joint_position("l_shoulder_pan_joint"), fingers(scene)) == (1.712, {0.548})


async def test_an_object_outside_the_world_is_neither_picked_up_nor_held_nor_grasped_nor_transported(
    scene: Scene,
) -> None:
    scene.world.remove(scene.milk)
    believed = BelieveObject("cup", ObjectType.JEROEN_CUP, Pose([1.3, 1, 0.9]))
    before = scene.world.save_state()
    for meant in (scene.milk, designator_of(scene.milk), believed):
        for action in (
            PickUpActionPerformable(meant, Arms.LEFT, Grasp.FRONT),
            GripActionPerformable(Arms.LEFT, meant, 1.0),
            ReleaseActionPerformable(Arms.LEFT, meant),
            GraspingActionPerformable(Arms.LEFT, meant),
            TransportActionPerformable(meant, Arms.LEFT, Pose([1.3, 0.6, 0.95])),
        ):
            with pytest.raises(PerceptionObjectNotInWorld, match=f"{meant.name} is not an object of the world"):
                await action.perform()
    assert scene.world.save_state() == before


async def test_an_object_of_several_links_is_held_only_at_its_nearest_link(scene: Scene) -> None:
    """The crane's whole box reaches up to its flag, its lowest link is 0.2 m high."""
    crane = Object("crane", ObjectType.GENERIC_OBJECT, CRANE, Pose([1.3, 1, 0.6]), mass_kg=1.0)
    await reached(scene, 1.2)
    assert crane.bounding_box().min.z < 0.9 < crane.bounding_box().max.z
    with pytest.raises(GripperClosedCompletely, match=r"crane is 0\.100 m from it"):
        await GripActionPerformable(Arms.LEFT, crane, 1.0).perform()
    crane.set_pose(Pose([1.3, 1, 0.8]))
    await GripActionPerformable(Arms.LEFT, crane, 1.0).perform()
    assert scene.robot.attachments == {crane: LEFT_TOOL}


async def test_an_effort_below_zero_holds_nothing(scene: Scene) -> None:
    await reached(scene, 1.3)
    for effort in (-1.0, math.nan):
        with pytest.raises(IllPosedGoalFailure, match=r"effort must be >= 0 N, got"):
            await GripActionPerformable(Arms.LEFT, scene.milk, effort).perform()
    assert scene.robot.attachments == {}


async def test_an_object_of_another_world_is_neither_held_nor_opened(scene: Scene) -> None:
    handle = ObjectPart("sink_area_drawer_handle", scene.kitchen)
    before = scene.world.save_state()
    with BulletWorld():
        Object("pr2", ObjectType.ROBOT, pose=Pose([0.6, 0.9, 0]))
        for action in (
            PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT),
            GripActionPerformable(Arms.LEFT, scene.milk, 1.0),
            TransportActionPerformable(scene.milk, Arms.LEFT, Pose([1.3, 0.9, 0.95])),
        ):
            with pytest.raises(PerceptionObjectNotInWorld, match="milk is in another world than pr2") as caught:
                await action.perform()
            assert caught.value.data == ("milk",)
        with simulated_robot_within(Limits.HARD), pytest.raises(PerceptionObjectNotInWorld, match="kitchen is in"):
            await OpeningMotion(handle, Arms.LEFT).perform()
    assert scene.world.save_state() == before


# === transport ================================================================================================
#
# An object is transported by the expected actions and locations, or the failure names the reason.

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
