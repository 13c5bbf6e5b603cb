"""The PR2's description agrees with its two models on joints, frames, limits and measures."""

from __future__ import annotations

import math
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import pycrorm_async
from pycrorm_async.world.kinematics import forward
from pycrorm_async.world.models import built_in_model, pr2_mesh_urdf_path
from pycrorm_async.world.pose import Arms, Grasp, GripperState, Pose, product, rotated, yaw_quaternion
from pycrorm_async.world.urdf import GRASP_ORIENTATIONS, PR2, Limits
from tests.world.loaded_model import LoadedModel, angle_between, random_arm, random_base_pose

BULLET_EXACT = 1e-6
"""The tolerance in metres and rad: Bullet returns link frames in single precision."""
BULLET_MARGIN = 0.0011
"""The metres by which Bullet's boxes are larger than the shapes."""
ARMS = (Arms.LEFT, Arms.RIGHT)

# From the robot's public model, not from the package's description.
LEFT_HARD_LIMITS = {
    "l_shoulder_pan_joint": (-0.7146, 2.2854),
    "l_shoulder_lift_joint": (-0.5236, 1.3963),
    "l_upper_arm_roll_joint": (-0.8, 3.9),
    "l_elbow_flex_joint": (-2.3213, 0.0),
    "l_wrist_flex_joint": (-2.18, 0.0),
}
RIGHT_HARD_LIMITS = {
    "r_shoulder_pan_joint": (-2.2854, 0.7146),
    "r_shoulder_lift_joint": (-0.5236, 1.3963),
    "r_upper_arm_roll_joint": (-3.9, 0.8),
    "r_elbow_flex_joint": (-2.3213, 0.0),
    "r_wrist_flex_joint": (-2.18, 0.0),
}
OTHER_LIMITS = {
    "torso_lift_joint": (0.0, 0.33),
    "head_pan_joint": (-3.007, 3.007),
    "head_tilt_joint": (-0.471238, 1.39626),
    "l_gripper_l_finger_joint": (0.0, 0.548),
    "l_gripper_r_finger_joint": (0.0, 0.548),
    "r_gripper_l_finger_joint": (0.0, 0.548),
    "r_gripper_r_finger_joint": (0.0, 0.548),
}
CONTINUOUS = {"l_forearm_roll_joint", "l_wrist_roll_joint", "r_forearm_roll_joint", "r_wrist_roll_joint"}


@pytest.fixture
def model(tmp_path: Path) -> Iterator[LoadedModel]:
    path = tmp_path / "pr2.urdf"
    path.write_text(built_in_model("pr2"), encoding="utf-8")
    loaded = LoadedModel(path)
    yield loaded
    loaded.close()


def test_the_model_has_the_pr2s_joints_and_hard_limits_and_no_others(model: LoadedModel) -> None:
    bounded = {name: limits for name, limits in model.limits.items() if name not in CONTINUOUS}
    assert bounded == LEFT_HARD_LIMITS | RIGHT_HARD_LIMITS | OTHER_LIMITS
    assert set(model.limits) - set(bounded) == CONTINUOUS
    for name in CONTINUOUS:
        lower, upper = model.limits[name]
        assert lower > upper, "Bullet's way to say that a joint has no limits"


def test_the_root_link_of_the_model_is_on_the_floor(model: LoadedModel) -> None:
    model.put(base=Pose(), joints={})
    assert model.root == "base_footprint"
    lowest = min(model.bounding_box(link)[0].z for link in model.links)
    assert lowest == pytest.approx(0.051, abs=BULLET_MARGIN)
    assert model.link_pose("torso_lift_link").position == pytest.approx((-0.05, 0, 0.790675), abs=BULLET_EXACT)


def test_the_camera_looks_ahead_from_its_lowest_height_to_its_highest(model: LoadedModel) -> None:
    for torso, height in ((0.0, PR2.camera_height_m.lower), (0.33, PR2.camera_height_m.upper)):
        model.put(base=Pose(), joints={PR2.torso_joint: torso})
        camera = model.link_pose(PR2.camera_link)
        assert camera.position.z == pytest.approx(height, abs=0.001)
        assert rotated(camera.orientation, (0, 0, 1)) == pytest.approx((1, 0, 0), abs=BULLET_EXACT)


def test_fingers_move_apart_when_opened(model: LoadedModel) -> None:
    for arm in ARMS:
        part = PR2.arms[arm]
        left, right = (name.removesuffix("_joint") + "_link" for name in part.gripper_joints[GripperState.OPEN])
        gap = {}
        for state in GripperState:
            model.put(base=Pose(), joints=part.gripper_joints[state])
            gap[state] = model.bounding_box(left)[1].y - model.bounding_box(right)[0].y
        assert gap[GripperState.OPEN] > gap[GripperState.CLOSE] + 0.1


@pytest.mark.parametrize("arm", ARMS)
def test_forward_kinematics_equals_bullets(model: LoadedModel, arm: Arms) -> None:
    rng = random.Random(20)
    for _ in range(300):
        joints = random_arm(rng, arm, Limits.HARD)
        base, torso_height = random_base_pose(rng)
        model.put(base=base, joints={**joints, PR2.torso_joint: torso_height})
        ours = forward(PR2, arm, joints, torso_height=torso_height, base=base)
        bullets = model.link_pose(PR2.arms[arm].tool_frame)
        assert ours.distance(bullets) < BULLET_EXACT
        assert angle_between(ours.orientation, bullets.orientation) < BULLET_EXACT


def test_soft_limits_are_inside_the_hard_ones_and_rolls_turn_freely() -> None:
    for arm in ARMS:
        part = PR2.arms[arm]
        assert tuple(part.soft_limits) == tuple(part.hard_limits) == part.joints
        for name in part.joints:
            soft, hard = part.soft_limits[name], part.hard_limits[name]
            if name in CONTINUOUS:
                assert soft == hard == (-math.inf, math.inf)
            else:
                assert hard.lower < soft.lower < soft.upper < hard.upper


def test_soft_limits_are_those_of_the_robots_controllers() -> None:
    left = [PR2.arms[Arms.LEFT].soft_limits[name] for name in LEFT_HARD_LIMITS]
    right = [PR2.arms[Arms.RIGHT].soft_limits[name] for name in RIGHT_HARD_LIMITS]
    assert left == [(-0.5646, 2.1354), (-0.3536, 1.2963), (-0.65, 3.75), (-2.1213, -0.15), (-1.994, -0.1)]
    assert right == [(-2.1354, 0.5646), (-0.3536, 1.2963), (-3.75, 0.65), (-2.1213, -0.15), (-1.994, -0.1)]


def test_parked_arms_are_within_the_hard_limits_and_folded(model: LoadedModel) -> None:
    for arm, side in ((Arms.LEFT, 1), (Arms.RIGHT, -1)):
        part = PR2.arms[arm]
        assert set(part.park) == set(part.joints)
        for name, value in part.park.items():
            lower, upper = part.hard_limits[name]
            assert lower <= value <= upper
        model.put(base=Pose(), joints=part.park)
        hand = model.link_pose(part.tool_frame).position
        assert hand.x < 0.5
        assert side * hand.y > 0
    assert PR2.arms[Arms.LEFT].park["l_forearm_roll_joint"] == 16.996


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, 2.5])
def test_a_grasp_comes_from_its_side_of_the_object_whatever_its_heading(heading: float) -> None:
    turned = yaw_quaternion(heading)
    forth = (math.cos(heading), math.sin(heading), 0)
    leftwards = (-math.sin(heading), math.cos(heading), 0)
    points_to = {grasp: rotated(product(turned, GRASP_ORIENTATIONS[grasp]), (1.0, 0.0, 0.0)) for grasp in Grasp}
    assert points_to[Grasp.FRONT] == pytest.approx(forth)
    assert points_to[Grasp.LEFT] == pytest.approx([-value for value in leftwards])
    assert points_to[Grasp.RIGHT] == pytest.approx(leftwards)
    assert points_to[Grasp.TOP] == pytest.approx((0, 0, -1))


def test_without_the_mesh_package_the_error_names_the_extra_to_install() -> None:
    root = str(Path(pycrorm_async.__file__).parents[1])
    script = f"""
import sys
sys.path.insert(0, {root!r})
from pycrorm_async.errors import MissingExtra
from pycrorm_async.world.models import pr2_mesh_urdf_path
try:
    pr2_mesh_urdf_path()
except MissingExtra as missing:
    print(missing)
"""
    without_packages = [sys.executable, "-I", "-S", "-c", script]
    done = subprocess.run(without_packages, capture_output=True, text=True, timeout=60, check=True)
    assert "pip install 'pycrorm-async[pr2]'" in done.stdout


def test_the_mesh_model_has_every_joint_and_link_of_the_model_of_boxes_in_the_same_place(model: LoadedModel) -> None:
    mesh = LoadedModel(pr2_mesh_urdf_path())
    try:
        assert set(model.limits) <= set(mesh.limits)
        assert set(model.links) <= set(mesh.links)
        differ = {name for name, limits in model.limits.items() if mesh.limits[name] != pytest.approx(limits, abs=1e-5)}
        assert differ == {"torso_lift_joint", "l_wrist_flex_joint", "r_wrist_flex_joint"}
        rng = random.Random(21)
        for _ in range(50):
            base, torso_height = random_base_pose(rng)
            joints = {
                **random_arm(rng, Arms.LEFT, Limits.SOFT),
                **random_arm(rng, Arms.RIGHT, Limits.SOFT),
                **PR2.arms[Arms.LEFT].gripper_joints[GripperState.OPEN],
                PR2.torso_joint: torso_height,
                PR2.head_pan_joint: rng.uniform(-2, 2),
                PR2.head_tilt_joint: rng.uniform(-0.4, 1.2),
            }
            model.put(base=base, joints=joints)
            mesh.put(base=base, joints=joints)
            for link in model.links:
                ours, theirs = model.link_pose(link), mesh.link_pose(link)
                assert ours.distance(theirs) < BULLET_EXACT, link
                assert angle_between(ours.orientation, theirs.orientation) < BULLET_EXACT, link
    finally:
        mesh.close()
