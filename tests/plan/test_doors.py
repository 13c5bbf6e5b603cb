"""Drawers and doors open and close with the hand on their handles; frames are computed from the kitchen's drawing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest

from pycrorm_async.plan import (
    AccessingMotion,
    CloseActionPerformable,
    ClosingMotion,
    GraspingActionPerformable,
    IKError,
    MoveMotion,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    ObjectPart,
    OpenAction,
    OpenActionPerformable,
    OpeningMotion,
    ResolutionError,
    Retry,
    SimulatedTaskTree,
    collected_tree,
)
from pycrorm_async.plan.failures import (
    CapabilityAbsenceFailure,
    EnvironmentManipulationImpossible,
    IllPosedGoalFailure,
    PerceptionObjectNotInWorld,
)
from pycrorm_async.world import Arms, Pose
from pycrorm_async.world.pose import yaw_quaternion
from tests.plan.bullet_frames import bullet_frame
from tests.plan.conftest import Scene
from tests.plan.test_actions import shape
from tests.world.fakes import ChangeLog, Matrix, Z, shifted, turned

TOOL = {Arms.LEFT: "l_gripper_tool_frame", Arms.RIGHT: "r_gripper_tool_frame"}


class Furniture(NamedTuple):
    """A drawer or door, the base pose to open it from, and the frames of its handle and of the hand for a joint
    position.
    """

    name: str
    arm: Arms
    stand: tuple[float, float, float]
    goal: float

    def handle(self, position: float) -> Matrix:
        if self.name == "fridge_door":
            return shifted(1.05, -1.25, 0) @ turned(Z, position) @ shifted(-0.10, 0.59, 0.95)
        if self.name == "sink_area_drawer":
            return shifted(1.05 - 0.05 - position, 1.30, (0.57 + 0.76) / 2)
        return shifted(-1.10 + 0.05 + position, 1.0, (0.64 + 0.84) / 2) @ turned(Z, math.pi)

    def hand(self, position: float) -> Matrix:
        grip = turned(Z, math.pi / 2) if self.name == "fridge_door" else np.eye(4)
        return self.handle(position) @ grip

    async def base_placed_by(self, scene: Scene) -> ObjectPart:
        x, y, yaw = self.stand
        await MoveMotion(Pose([x, y, 0], yaw_quaternion(yaw))).perform()
        await MoveTorsoActionPerformable(0.1).perform()
        return ObjectPart(f"{self.name}_handle", scene.kitchen)


SINK = Furniture("sink_area_drawer", Arms.LEFT, (0.1, 1.1, 0.0), 0.30)
ISLAND = Furniture("kitchen_island_upper_drawer", Arms.RIGHT, (-0.3, 1.3, math.pi), 0.30)
FRIDGE = Furniture("fridge_door", Arms.LEFT, (0.0, -1.0, -math.pi / 2), 1.85)
FRIDGE_RIGHT = Furniture("fridge_door", Arms.RIGHT, (0.2, -0.8, 0.0), 1.85)
ALL = pytest.mark.parametrize(
    "which", [SINK, ISLAND, FRIDGE, FRIDGE_RIGHT], ids=lambda each: f"{each[0]}-{each[1].name}"
)


def check(scene: Scene, which: Furniture, position: float) -> None:
    """Check the joint's position, the handle's frame in Bullet against the drawing, and the hand on it."""
    assert scene.kitchen.joint_position(f"{which.name}_joint") == pytest.approx(position, abs=1e-12)
    np.testing.assert_allclose(bullet_frame(scene.kitchen, f"{which.name}_handle"), which.handle(position), atol=1e-5)
    np.testing.assert_allclose(bullet_frame(scene.robot, TOOL[which.arm]), which.hand(position), atol=1e-5)


def fingers(scene: Scene, arm: Arms) -> set[float]:
    prefix = TOOL[arm][0]
    return {scene.robot.joint_position(f"{prefix}_gripper_{finger}_finger_joint") for finger in "lr"}


@ALL
async def test_furniture_that_opens_and_closes_moves_with_the_hand_on_its_handle(
    scene: Scene, which: Furniture
) -> None:
    part = await which.base_placed_by(scene)
    with collected_tree() as tree:
        await OpenActionPerformable(part, which.arm).perform()
    check(scene, which, which.goal)
    assert fingers(scene, which.arm) == {0.548}
    with collected_tree() as closing:
        await CloseActionPerformable(part, which.arm).perform()
    check(scene, which, 0.0)
    assert fingers(scene, which.arm) == {0.548}
    steps = ["    MoveTCPMotion", "    MoveGripperMotion", "    MoveTCPMotion", "    MoveGripperMotion"]
    for done, name in ((tree, "Open"), (closing, "Clos")):
        assert shape(done) == [
            f"{name.removesuffix('s')}{'' if name == 'Open' else 'se'}ActionPerformable",
            "  GraspingActionPerformable",
            *steps,
            f"  {name}ingMotion",
            "  MoveGripperMotion",
        ]


@ALL
async def test_opening_is_one_motion_of_the_arm_and_one_of_the_furniture(scene: Scene, which: Furniture) -> None:
    part = await which.base_placed_by(scene)
    await GraspingActionPerformable(which.arm, part).perform()
    check(scene, which, 0.0)
    assert fingers(scene, which.arm) == {0.0}
    change_log = ChangeLog()
    scene.world.observe(change_log)
    await OpeningMotion(part, which.arm).perform()
    check(scene, which, which.goal)
    assert change_log.names() == [("joints", "pr2"), ("joints", "kitchen")]
    assert change_log.notes[1][2] == {f"{which.name}_joint": pytest.approx(which.goal)}
    assert set(change_log.notes[0][2]) == set(scene.robot.robot_description.arms[which.arm].joints)  # type: ignore[union-attr]  # the pr2 has one


async def test_the_approach_follows_the_direction_of_the_grasp(scene: Scene) -> None:
    part = await SINK.base_placed_by(scene)
    with collected_tree() as tree:
        await GraspingActionPerformable(SINK.arm, part).perform()
    before, at = (node.designator.target for node in tree if isinstance(node.designator, MoveTCPMotion))
    np.testing.assert_allclose([before.position, at.position], [(0.9, 1.3, 0.665), (1.0, 1.3, 0.665)], atol=1e-9)


async def test_the_hand_keeps_its_grip(scene: Scene) -> None:
    """2 cm beside the middle of the handle, rotated by 0.2 rad."""
    part = await SINK.base_placed_by(scene)
    await MoveTCPMotion(Pose([1.0, 1.32, 0.665], yaw_quaternion(0.2)), SINK.arm).perform()
    await OpeningMotion(part, SINK.arm).perform()
    expected = shifted(0.7, 1.32, 0.665) @ turned(Z, 0.2)
    np.testing.assert_allclose(bullet_frame(scene.robot, TOOL[SINK.arm]), expected, atol=1e-5)


async def test_a_joint_that_is_open_further_stays_and_the_content_of_a_drawer_moves_along(scene: Scene) -> None:
    part = await ISLAND.base_placed_by(scene)
    scene.kitchen.attach(scene.milk, "kitchen_island_upper_drawer")
    await OpenActionPerformable(part, ISLAND.arm).perform()
    assert scene.milk.pose.position == pytest.approx((1.6, 1, 0.9), abs=1e-9)
    scene.kitchen.set_joint_position("kitchen_island_upper_drawer_joint", 0.32)
    before = scene.world.save_state()
    await OpeningMotion(part, ISLAND.arm).perform()
    assert scene.kitchen.joint_position("kitchen_island_upper_drawer_joint") == 0.32
    assert scene.world.save_state().objects["milk"] == before.objects["milk"]


@pytest.mark.parametrize(
    ("which", "stand"),
    [
        (FRIDGE, (0.1, -1.15, -math.pi / 2)),  # the hand reaches both ends and not the middle of the path
        (FRIDGE, (0.5, -0.9, 0.0)),
        (SINK, (0.4, 1.3, 0.0)),
    ],
)
async def test_a_path_that_the_hand_cannot_follow_moves_nothing(
    scene: Scene, which: Furniture, stand: tuple[float, float, float]
) -> None:
    which = which._replace(stand=stand)
    part = await which.base_placed_by(scene)
    await MoveTorsoActionPerformable(0.0).perform()
    await GraspingActionPerformable(which.arm, part).perform()
    before, change_log = scene.world.save_state(), ChangeLog()
    scene.world.observe(change_log)
    with pytest.raises(IKError) as caught:
        await OpeningMotion(part, which.arm).perform()
    assert (caught.value.arm, caught.value.tip_frame) == (which.arm, TOOL[which.arm])
    assert (scene.world.save_state(), change_log.notes) == (before, [])
    if stand[0] == 0.1:
        await MoveTCPMotion(_pose(which.hand(which.goal)), which.arm).perform()
        assert caught.value.pose.position != pytest.approx(which.hand(which.goal)[:3, 3], abs=0.01)


def _pose(matrix: Matrix) -> Pose:
    """Return the pose of a matrix that rotates about z."""
    return Pose(matrix[:3, 3].tolist(), yaw_quaternion(math.atan2(matrix[1, 0], matrix[0, 0])))


@pytest.mark.parametrize("motion", [OpeningMotion, ClosingMotion])
async def test_a_hand_that_is_not_on_the_handle_moves_nothing(
    scene: Scene, motion: type[OpeningMotion | ClosingMotion]
) -> None:
    part = await SINK.base_placed_by(scene)
    before = scene.world.save_state()
    with pytest.raises(EnvironmentManipulationImpossible, match=r"l_gripper_tool_frame is not on sink_area") as caught:
        await motion(part, Arms.LEFT).perform()
    # The tool frame with all joints at 0: 1.001 m before the shoulder at (-0.05, 0.188) of the base.
    x, y, z = 0.1 - 0.05 + 0.1 + 0.4 + 0.321 + 0.18, 1.1 + 0.188, 0.051 + 0.739675 + 0.1
    apart = math.dist((x, y, z), (min(max(x, 0.992), 1.008), min(max(y, 1.23), 1.37), 0.673))
    assert caught.value.data == ("sink_area_drawer_handle", pytest.approx(apart, abs=1e-6))
    assert scene.world.save_state() == before


@pytest.mark.parametrize("action", [OpenActionPerformable, CloseActionPerformable, OpeningMotion, ClosingMotion])
async def test_a_part_without_a_joint_is_neither_opened_nor_closed(
    scene: Scene, action: type[OpenActionPerformable | CloseActionPerformable | OpeningMotion | ClosingMotion]
) -> None:
    before = scene.world.save_state()
    with pytest.raises(EnvironmentManipulationImpossible, match="no joint of kitchen moves sink_area_tap"):
        await action(ObjectPart("sink_area_tap", scene.kitchen), Arms.LEFT).perform()
    with pytest.raises(IllPosedGoalFailure, match="does not work with BOTH"):
        await action(ObjectPart("fridge_door_handle", scene.kitchen), Arms.BOTH).perform()
    assert scene.world.save_state() == before
    scene.world.remove(scene.kitchen)
    with pytest.raises(PerceptionObjectNotInWorld, match="kitchen"):
        await action(ObjectPart("fridge_door_handle", scene.kitchen), Arms.LEFT).perform()
    with pytest.raises(ResolutionError, match="expected ObjectPart, got Object"):
        action(scene.kitchen, Arms.LEFT)  # type: ignore[arg-type]  # the fault this test is about


@pytest.mark.parametrize(("which", "distances"), [(SINK, (0.2, -0.05)), (FRIDGE_RIGHT, (1.2, -0.7))])
async def test_accessing_moves_a_joint_by_a_distance(
    scene: Scene, which: Furniture, distances: Sequence[float]
) -> None:
    part = await which.base_placed_by(scene)
    await GraspingActionPerformable(which.arm, part).perform()
    position = 0.0
    for distance in distances:
        position += distance
        await AccessingMotion(
            scene.kitchen, which.arm, TOOL[which.arm], f"{which.name}_joint", part.name, distance
        ).perform()
        check(scene, which, position)


@pytest.mark.parametrize(
    ("changed", "failure", "message"),
    [
        ({"distance": 0.36}, EnvironmentManipulationImpossible, "at 0 cannot move by 0.36: its limits are 0 to 0.35"),
        ({"distance": -0.01}, EnvironmentManipulationImpossible, "at 0 cannot move by -0.01: its limits are 0 to 0.35"),
        ({"distance": math.nan}, EnvironmentManipulationImpossible, "cannot move by nan"),
        ({"gripper": "left"}, IllPosedGoalFailure, "the gripper of the LEFT arm is l_gripper_tool_frame, not left"),
        (
            {"drawer_joint": "fridge_door_joint"},
            EnvironmentManipulationImpossible,
            "no joint fridge_door_joint of kitchen moves sink_area_drawer_handle",
        ),
        ({"arm": Arms.BOTH}, IllPosedGoalFailure, "does not work with BOTH"),
    ],
)
async def test_an_impossible_access_names_the_reason_and_moves_nothing(
    scene: Scene, changed: dict[str, object], failure: type[Exception], message: str
) -> None:
    part = await SINK.base_placed_by(scene)
    await GraspingActionPerformable(SINK.arm, part).perform()
    before = scene.world.save_state()
    arguments: dict[str, object] = {
        "part_of": scene.kitchen,
        "arm": Arms.LEFT,
        "gripper": TOOL[Arms.LEFT],
        "drawer_joint": "sink_area_drawer_joint",
        "drawer_handle": part.name,
        "distance": 0.1,
    }
    with pytest.raises(failure, match=message):
        await AccessingMotion(**arguments | changed).perform()  # type: ignore[arg-type]  # by name
    assert scene.world.save_state() == before


async def test_an_arm_that_the_robot_lacks_opens_nothing(scene: Scene, one_armed: None) -> None:
    part = await SINK.base_placed_by(scene)
    before = scene.world.save_state()
    for action in (OpenActionPerformable, CloseActionPerformable, OpeningMotion, ClosingMotion):
        with pytest.raises(CapabilityAbsenceFailure, match="pr2 has no RIGHT arm"):
            await action(part, Arms.RIGHT).perform()
    assert scene.world.save_state() == before
    await OpenActionPerformable(part, Arms.LEFT).perform()
    check(scene, SINK, SINK.goal)


async def test_a_plan_continues_with_the_next_arm(scene: Scene, one_armed: None) -> None:
    part = await SINK.base_placed_by(scene)
    right, left = OpenAction(part, [Arms.RIGHT]), OpenAction(part, [Arms.LEFT])
    with collected_tree() as tree:
        await (right - left).perform()
    check(scene, SINK, SINK.goal)
    tried = [node.failure for node in tree if isinstance(node.designator, OpenActionPerformable)]
    assert [type(each) for each in tried] == [CapabilityAbsenceFailure, type(None)]
    scene.kitchen.set_joint_position("sink_area_drawer_joint", 0.0)
    with collected_tree() as tree:
        await Retry(OpenAction(part, [Arms.BOTH, Arms.RIGHT, Arms.LEFT]), max_tries=3).perform()
    check(scene, SINK, SINK.goal)
    tried = [node.failure for node in tree if isinstance(node.designator, OpenActionPerformable)]
    assert [type(each) for each in tried] == [IllPosedGoalFailure, CapabilityAbsenceFailure, type(None)]


async def test_opening_in_a_simulation_opens_nothing(scene: Scene) -> None:
    part = await SINK.base_placed_by(scene)
    before = scene.world.save_state()
    with SimulatedTaskTree():
        await OpenActionPerformable(part, SINK.arm).perform()
        assert part.pose.position == pytest.approx((0.7, 1.3, 0.665), abs=1e-9)
    assert scene.world.save_state() == before
    assert part.pose.position == pytest.approx((1.0, 1.3, 0.665), abs=1e-9)
