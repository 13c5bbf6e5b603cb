"""The PR2's description agrees with its two models on joints, frames, limits and measures."""

from __future__ import annotations

import math
import random
from importlib.metadata import PackageNotFoundError

import numpy as np
import pytest

from pycrorm_async.errors import MissingExtra
from pycrorm_async.world import BulletWorld, Object, ObjectType
from pycrorm_async.world.kinematics import forward
from pycrorm_async.world.models import pr2_mesh_urdf_path
from pycrorm_async.world.pose import Arms, Grasp, GripperState, product, rotated, yaw_quaternion
from pycrorm_async.world.queries import footprint_of
from pycrorm_async.world.urdf import GRASP_ORIENTATIONS, PR2, Limits
from tests.world.fakes import angle_between, random_arm, random_base_pose

EXACT = 1e-9


@pytest.fixture
def robot(world: BulletWorld) -> Object:
    return Object("pr2", ObjectType.ROBOT)


def test_hard_limits_are_those_of_the_model_and_soft_limits_and_parked_arms_are_inside(robot: Object) -> None:
    for arm in PR2.arms.values():
        assert tuple(arm.soft_limits) == tuple(arm.hard_limits) == arm.joints
        assert arm.park.keys() == set(arm.joints)
        for name in arm.joints:
            soft, hard = arm.soft_limits[name], arm.hard_limits[name]
            assert hard == robot.joint_limits(name)
            if name.endswith(("forearm_roll_joint", "wrist_roll_joint")):
                assert soft == hard == (-math.inf, math.inf)
            else:
                assert hard.lower < soft.lower < soft.upper < hard.upper
            assert hard.lower <= arm.park[name] <= hard.upper


def test_floor_camera_fingers_and_parked_hands_are_where_the_robot_has_them(robot: Object) -> None:
    assert robot.links[0] == "base_footprint"
    assert robot.bounding_box().min.z == pytest.approx(0.051)
    assert robot.link_pose("torso_lift_link").position == pytest.approx((-0.05, 0, 0.790675))
    for torso, height in ((0.0, PR2.camera_height_m.lower), (0.33, PR2.camera_height_m.upper)):
        robot.set_joint_position(PR2.torso_joint, torso)
        camera = robot.link_pose(PR2.camera_link)
        assert camera.position.z == pytest.approx(height, abs=0.001)
        assert rotated(camera.orientation, (0, 0, 1)) == pytest.approx((1, 0, 0))
    for part, side in ((PR2.arms[Arms.LEFT], 1), (PR2.arms[Arms.RIGHT], -1)):
        left, right = (name.removesuffix("_joint") + "_link" for name in part.gripper_joints[GripperState.OPEN])
        gap = {}
        for state, fingers in part.gripper_joints.items():
            robot.set_joint_positions(fingers)
            gap[state] = robot.bounding_box(left).max.y - robot.bounding_box(right).min.y
        assert gap[GripperState.OPEN] > gap[GripperState.CLOSE] + 0.1
        robot.set_joint_positions(part.park)
        hand = robot.link_pose(part.tool_frame).position
        assert hand.x < 0.5
        assert side * hand.y > 0


@pytest.mark.parametrize("arm", [Arms.LEFT, Arms.RIGHT])
def test_forward_kinematics_equals_that_of_the_engine(robot: Object, arm: Arms) -> None:
    rng = random.Random(20)
    for _ in range(100):
        joints = random_arm(rng, arm, Limits.HARD)
        base, torso_height = random_base_pose(rng)
        robot.set_pose(base)
        robot.set_joint_positions({**joints, PR2.torso_joint: torso_height})
        ours = forward(PR2, arm, joints, torso_height=torso_height, base=base)
        of_engine = robot.link_pose(PR2.arms[arm].tool_frame)
        assert ours.distance(of_engine) < EXACT
        assert angle_between(ours.orientation, of_engine.orientation) < EXACT


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


def test_without_the_mesh_package_the_error_names_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise PackageNotFoundError(name)

    monkeypatch.setattr("pycrorm_async.world.models.distribution", missing)
    with pytest.raises(MissingExtra, match=r"pip install 'pycrorm-async\[pr2\]'"):
        pr2_mesh_urdf_path()


def test_the_mesh_model_has_every_joint_and_link_of_the_model_of_boxes_in_the_same_place(robot: Object) -> None:
    mesh = Object("mesh", ObjectType.ROBOT, pr2_mesh_urdf_path(), robot=PR2)
    np.testing.assert_allclose(mesh.bounding_box(), robot.bounding_box(), atol=0.03)
    for each, side in ((robot, 0.325), (mesh, 0.334)):
        footprint = footprint_of(each, ["base_link"])
        assert [*footprint.x, *footprint.y] == pytest.approx([-side, side, -side, side], abs=2e-4)
        assert footprint.inner_radius_m == pytest.approx(side, abs=2e-4)
    assert set(robot.links) <= set(mesh.links)
    differ = {
        name for name in robot.joints if mesh.joint_limits(name) != pytest.approx(robot.joint_limits(name), abs=1e-5)
    }
    assert differ == {"torso_lift_joint", "l_wrist_flex_joint", "r_wrist_flex_joint"}
    rng = random.Random(21)
    for _ in range(10):
        base, torso_height = random_base_pose(rng)
        joints = {
            **random_arm(rng, Arms.LEFT, Limits.SOFT),
            **random_arm(rng, Arms.RIGHT, Limits.SOFT),
            **PR2.arms[Arms.LEFT].gripper_joints[GripperState.OPEN],
            PR2.torso_joint: min(torso_height, 0.31),
            PR2.head_pan_joint: rng.uniform(-2, 2),
            PR2.head_tilt_joint: rng.uniform(-0.4, 1.2),
        }
        for each in (robot, mesh):
            each.set_pose(base)
            each.set_joint_positions(joints)
        for link in robot.links:
            ours, theirs = robot.link_pose(link), mesh.link_pose(link)
            assert ours.distance(theirs) < 1e-6, link
            assert angle_between(ours.orientation, theirs.orientation) < 1e-6, link
