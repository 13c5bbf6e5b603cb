"""Drawers and doors open and close with the hand on their handles: joints, paths, and poses of the base."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest

from pycrorm_async.plan import (
    AccessingLocation,
    AccessingMotion,
    CloseActionPerformable,
    ClosingMotion,
    GraspingActionPerformable,
    IKError,
    Location,
    MoveMotion,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    NoRobotHere,
    ObjectPart,
    OpenActionPerformable,
    OpeningMotion,
    ParkArmsActionPerformable,
    ResolutionError,
    collected_tree,
)
from pycrorm_async.plan.execution import Candidate
from pycrorm_async.plan.failures import (
    EnvironmentManipulationImpossible,
    EnvironmentUnreachable,
    IllPosedGoalFailure,
    PerceptionObjectNotInWorld,
)
from pycrorm_async.plan.geometry import (
    Handle,
    grasp_pose,
    hand_poses,
    handle_of,
    handle_poses,
)
from pycrorm_async.plan.locations import REFUSALS_MAX
from pycrorm_async.world import Arms, Object, ObjectType, Pose
from pycrorm_async.world.pose import UnknownLink, yaw_quaternion
from tests.plan.conftest import Scene
from tests.plan.fakes import Recording
from tests.plan.test_actions import shape
from tests.world.fakes import CRANE, ChangeLog, Matrix, Z, bullet_frame, matrix, shifted, turned

# === doors ====================================================================================================
#
# Drawers and doors open and close with the hand on their handles; frames are computed from the kitchen's drawing.

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
async def test_furniture_that_opens_and_closes_moves_in_one_motion_with_the_hand_on_its_handle(
    scene: Scene, which: Furniture
) -> None:
    part = await which.base_placed_by(scene)
    change_log = ChangeLog()
    scene.world.observe(change_log)
    with collected_tree() as tree:
        await OpenActionPerformable(part, which.arm).perform()
    check(scene, which, which.goal)
    assert fingers(scene, which.arm) == {0.548}
    arm, furniture, _ = change_log.notes[-3:]  # and the fingers that open
    assert [each[:2] for each in (arm, furniture)] == [("joints", "pr2"), ("joints", "kitchen")]
    assert furniture[2] == {f"{which.name}_joint": pytest.approx(which.goal)}
    assert set(arm[2]) == set(scene.robot.robot_description.arms[which.arm].joints)  # type: ignore[union-attr]  # the pr2 has one
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


# === articulation =============================================================================================
#
# The joint that a handle moves, its range, and its path, computed from the kitchen's drawing.

DRAWER, FRIDGE_HANDLE = "sink_area_drawer_handle", "fridge_door_handle"


def test_a_handle_moves_with_the_nearest_joint_above_it(scene: Scene) -> None:
    assert handle_of(ObjectPart(DRAWER, scene.kitchen)) == Handle(scene.kitchen, DRAWER, "sink_area_drawer_joint")
    assert handle_of(ObjectPart(FRIDGE_HANDLE, scene.kitchen)) == Handle(
        scene.kitchen, FRIDGE_HANDLE, "fridge_door_joint"
    )
    crane = Object("crane", ObjectType.GENERIC_OBJECT, CRANE)
    assert handle_of(ObjectPart("hook", crane)).joint == "reaching"
    assert handle_of(ObjectPart("flag", crane)).joint == "turning"


def test_a_drawers_handle_moves_straight_in_steps_of_five_centimetres(scene: Scene) -> None:
    drawer = handle_of(ObjectPart(DRAWER, scene.kitchen))
    way = handle_poses(drawer, 0.30)
    # The front is at x 1.05, the handle 5 cm before it, in the middle of z 0.57 to 0.76.
    expected = [(1.0 - 0.05 * number, 1.3, 0.665) for number in range(7)]
    np.testing.assert_allclose([each.position for each in way], expected, atol=1e-9)
    assert {each.orientation for each in way} == {(0.0, 0.0, 0.0, 1.0)}
    assert scene.kitchen.joint_position(drawer.joint) == 0.0


@pytest.mark.parametrize(("start", "goal", "steps"), [(0.0, 1.85, 19), (1.0, 0.0, 10), (0.3, 0.3, 1)])
def test_a_doors_handle_moves_around_the_hinge_and_rotates_with_the_door(
    scene: Scene, start: float, goal: float, steps: int
) -> None:
    scene.kitchen.set_pose(Pose([0.1, -0.2, 0.0], [0, 0, 0.6, 0.8]))
    door = handle_of(ObjectPart(FRIDGE_HANDLE, scene.kitchen))
    way = handle_poses(door, goal, start)
    assert len(way) == steps + 1
    for number, pose in enumerate(way):
        angle = start + (goal - start) * number / steps
        expected = matrix(scene.kitchen.pose) @ shifted(1.05, -1.25, 0) @ turned(Z, angle) @ shifted(-0.10, 0.59, 0.95)
        np.testing.assert_allclose(matrix(pose), expected, atol=1e-9)
    assert scene.kitchen.joint_position(door.joint) == 0.0


@pytest.mark.parametrize("angle", [0.0, 0.7, 1.85])
def test_a_hand_grasps_a_drawer_from_the_front_and_a_door_from_the_side_of_its_hinge(
    scene: Scene, angle: float
) -> None:
    scene.kitchen.set_pose(Pose([0.1, -0.2, 0.0], [0, 0, 0.6, 0.8]))
    scene.kitchen.set_joint_position("fridge_door_joint", angle)
    drawer = ObjectPart(DRAWER, scene.kitchen)
    assert grasp_pose(drawer) == drawer.pose
    hinge = matrix(scene.kitchen.pose) @ shifted(1.05, -1.25, 0)
    # in the closed door's axes x points into the fridge, y from the hinge to the handle
    taken = shifted(-0.10, 0.59, 0.95) @ turned(Z, math.pi / 2)
    np.testing.assert_allclose(
        matrix(grasp_pose(ObjectPart(FRIDGE_HANDLE, scene.kitchen))), hinge @ turned(Z, angle) @ taken, atol=1e-9
    )
    way = hand_poses(handle_of(ObjectPart(FRIDGE_HANDLE, scene.kitchen)), 1.0, 0.5)
    for number, pose in enumerate(way):
        np.testing.assert_allclose(matrix(pose), hinge @ turned(Z, 0.5 + 0.1 * number) @ taken, atol=1e-9)
    assert len(way) == 6


def test_a_door_with_its_hinge_on_the_other_side_is_grasped_from_there(scene: Scene) -> None:
    mirrored = scene.kitchen.description_text.replace('xyz="-0.1 0.59 0.95"', 'xyz="-0.1 -0.59 0.95"')
    cupboard = Object("cupboard", ObjectType.ENVIRONMENT, mirrored)
    expected = shifted(1.05, -1.25, 0) @ shifted(-0.10, -0.59, 0.95) @ turned(Z, -math.pi / 2)
    np.testing.assert_allclose(matrix(grasp_pose(ObjectPart(FRIDGE_HANDLE, cupboard))), expected, atol=1e-9)


def test_objects_and_parts_without_a_joint_are_grasped_at_their_pose(scene: Scene) -> None:
    scene.milk.set_pose(Pose([1.3, 1, 0.9], [0.1, 0.2, 0.3, 0.9]))
    assert grasp_pose(scene.milk) == scene.milk.pose
    tap = ObjectPart("sink_area_tap", scene.kitchen)
    assert grasp_pose(tap) == tap.pose
    scene.world.remove(scene.milk)
    with pytest.raises(PerceptionObjectNotInWorld, match="milk"):
        grasp_pose(scene.milk)


# === opening poses ============================================================================================
#
# Base poses for opening and closing: every candidate works, and an impossible request names its reason.

DRAWERS = [
    "kitchen_counter_upper_drawer",
    "kitchen_counter_lower_drawer",
    "sink_area_drawer",
    "kitchen_island_upper_drawer",
    "kitchen_island_lower_drawer",
]
TRAVEL = dict.fromkeys(DRAWERS, 0.35) | {"fridge_door": 1.9}
"""The range of each joint by the kitchen's own description, in m or rad."""
ABOUT = pytest.mark.parametrize("about", [4, pytest.param(12, marks=pytest.mark.soak)])
"""This many of the candidates are tried, spread over the whole order."""


def spread_candidates(places: list[Location], about: int) -> list[Location]:
    return places[:: max(1, len(places) // about)]


@pytest.mark.slow
@pytest.mark.soak_on(
    "kitchen_counter_upper_drawer", "kitchen_counter_lower_drawer", "kitchen_island_upper_drawer", "sink_area_drawer"
)
@ABOUT
@pytest.mark.parametrize(
    ("name", "torso"),
    [
        *((name, 0.3 if "lower" in name else 0.0) for name in TRAVEL),
        pytest.param("fridge_door", 0.3, marks=pytest.mark.soak),
    ],
)
async def test_from_every_candidate_the_furniture_can_be_opened_and_closed(
    scene: Scene, name: str, torso: float, about: int
) -> None:
    await MoveTorsoActionPerformable(torso).perform()
    handle, joint = ObjectPart(f"{name}_handle", scene.kitchen), f"{name}_joint"
    before = scene.world.save_state()
    places = list(AccessingLocation(handle, scene.robot))
    assert len(places) >= 90
    for place in spread_candidates(places, about):
        for arm in place.reachable_arms:
            await NavigateActionPerformable(place.pose).perform()
            await OpenActionPerformable(handle, arm).perform()
            assert scene.kitchen.joint_position(joint) == pytest.approx(TRAVEL[name] - 0.05)
            tool = scene.robot.link_pose(f"{'l' if arm is Arms.LEFT else 'r'}_gripper_tool_frame")
            assert tool.distance(scene.kitchen.link_pose(f"{name}_handle")) < 1e-5
            await ParkArmsActionPerformable(Arms.BOTH).perform()
            await CloseActionPerformable(handle, arm).perform()
            assert scene.kitchen.joint_position(joint) == 0
            scene.world.restore_state(before)


@pytest.mark.slow
@pytest.mark.soak_on("sink_area_drawer")
@ABOUT
@pytest.mark.parametrize(("name", "now"), [("sink_area_drawer", 0.13), ("fridge_door", 0.77)])
async def test_half_open_furniture_can_be_opened_or_closed_from_every_candidate(
    scene: Scene, name: str, now: float, about: int
) -> None:
    handle, joint = ObjectPart(f"{name}_handle", scene.kitchen), f"{name}_joint"
    scene.kitchen.set_joint_position(joint, now)
    before = scene.world.save_state()
    for place in spread_candidates(list(AccessingLocation(handle, scene.robot)), about):
        arm = place.reachable_arms[0]
        for action, there in ((OpenActionPerformable, TRAVEL[name] - 0.05), (CloseActionPerformable, 0.0)):
            await NavigateActionPerformable(place.pose).perform()
            await action(handle, arm).perform()
            assert scene.kitchen.joint_position(joint) == pytest.approx(there)
            scene.world.restore_state(before)


def gap(pose: Pose, low: tuple[float, float], high: tuple[float, float]) -> float:
    """Return the distance of a base from a rectangle along the axis in which it is larger, m."""
    x, y, _ = pose.position
    return max(low[0] - x, x - high[0], low[1] - y, y - high[1])


def assert_clear(places: list[Location], kitchen: Object) -> None:
    boxes = [box for link in kitchen.links if (box := kitchen.bounding_box(link)).size != (0, 0, 0)]
    for place in places:
        assert place.pose.position.z == 0
        for box in boxes:
            assert gap(place.pose, box.min[:2], box.max[:2]) >= 0.4 - 1e-9


@pytest.mark.slow
def test_the_first_candidates_are_clear_of_furniture_and_a_place_for_both_arms_is_reached_by_each(scene: Scene) -> None:
    lower, upper = (ObjectPart(f"{each}_handle", scene.kitchen) for each in (DRAWERS[1], DRAWERS[2]))
    assert_clear([*itertools.islice(AccessingLocation(lower, scene.robot), 100)], scene.kitchen)
    assert AccessingLocation(upper, scene.robot, Arms.BOTH).resolve().reachable_arms == (Arms.LEFT, Arms.RIGHT)


@pytest.mark.slow
@pytest.mark.soak  # the first hundred are checked before
def test_candidates_are_clear_of_furniture_and_those_in_the_path_of_the_drawer_come_last(scene: Scene) -> None:
    places = list(AccessingLocation(ObjectPart("kitchen_counter_lower_drawer_handle", scene.kitchen), scene.robot))
    assert_clear(places, scene.kitchen)
    # Pulled out by 0.3 m: the panel, 0.6 m wide, to 1.05 - 0.02 - 0.3, the handle to 1.05 - 0.05 - 0.008 - 0.3.
    panel, bar = ((0.73, 0.05), (1.05, 0.65)), ((0.692, 0.28), (1.05, 0.42))
    swept = [min(gap(place.pose, *panel), gap(place.pose, *bar)) < 0.4 for place in places]
    assert swept == sorted(swept)
    assert True in swept
    assert False in swept
    facing = [place for place in places if abs(_aside(place.pose, (1.0, 0.35))) < 1e-9]
    assert 0 < len(facing) < len(places)
    assert places[0] in facing


def _aside(pose: Pose, goal: tuple[float, float]) -> float:
    """Return the angle, in rad, between the pose's direction and the point."""
    towards = math.atan2(goal[1] - pose.position.y, goal[0] - pose.position.x)
    return math.remainder(pose.yaw - towards, math.tau)


@pytest.mark.slow
def test_resolving_moves_nothing_and_is_recorded_once(scene: Scene) -> None:
    handle = ObjectPart("sink_area_drawer_handle", scene.kitchen)
    before = scene.world.save_state()
    with Recording().listening() as recording:
        first, second = itertools.islice(AccessingLocation(handle, scene.robot), 2)
    assert scene.world.save_state() == before
    ((name, candidates, taken, considered, node),) = recording.places
    assert (name, taken, node) == ("AccessingLocation", 1, None)
    assert candidates == tuple(Candidate(each.pose, each.reachable_arms) for each in (first, second))
    assert considered >= 2


@pytest.mark.slow
def test_an_unreachable_handle_is_a_failure_and_is_recorded(scene: Scene) -> None:
    scene.kitchen.set_pose(Pose([0, 0, 1.5]))
    with Recording().listening() as recording, pytest.raises(EnvironmentUnreachable, match="no place") as caught:
        AccessingLocation(ObjectPart("sink_area_drawer_handle", scene.kitchen), scene.robot).resolve()
    assert caught.value.data == ("sink_area_drawer_handle",)
    ((name, candidates, taken, considered, _),) = recording.places
    assert (name, candidates, taken) == ("AccessingLocation", (), None)
    assert considered > REFUSALS_MAX == len(recording.refused[0])
    assert all(re.fullmatch("LEFT: .+; RIGHT: .+", each.reason) for each in recording.refused[0])


@pytest.mark.slow
def test_an_object_that_cannot_be_opened_is_refused_with_the_reason(scene: Scene) -> None:
    def request(part: ObjectPart) -> None:
        AccessingLocation(part, scene.robot).resolve()

    with pytest.raises(EnvironmentManipulationImpossible, match="no joint of kitchen moves sink_area_surface"):
        request(ObjectPart("sink_area_surface", scene.kitchen))
    with pytest.raises(UnknownLink, match="attic_handle"):
        request(ObjectPart("attic_handle", scene.kitchen))
    with pytest.raises(NoRobotHere, match="'milk' is not a robot"):
        AccessingLocation(ObjectPart("sink_area_drawer_handle", scene.kitchen), scene.milk).resolve()
    scene.world.remove(scene.kitchen)
    with pytest.raises(PerceptionObjectNotInWorld, match="kitchen"):
        request(ObjectPart("sink_area_drawer_handle", scene.kitchen))
