"""Inverse kinematics of arms without a closed form: reached poses, refusals, and agreement with Bullet."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.world import (
    COURIER,
    PR2,
    ArmDescription,
    Arms,
    Bounds,
    BulletWorld,
    Limits,
    Object,
    ObjectType,
    Pose,
    RobotDescription,
    copied,
)
from pycrorm_async.world.kinematics import Unreachable, chain_of, solve
from pycrorm_async.world.models import courier_urdf
from pycrorm_async.world.world_copy import counterpart

SLIDER = """<robot name="slider">
<link name="rail"/><link name="carriage"/><link name="wheel"/><link name="hook"/>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="carriage"/><origin xyz="0 0 1" rpy="0 1.5708 0"/>
<axis xyz="0 0 1"/><limit lower="-0.5" upper="0.5" effort="1" velocity="1"/></joint>
<joint name="turn" type="continuous"><parent link="carriage"/><child link="wheel"/><axis xyz="0 0 2"/></joint>
<joint name="fix" type="fixed"><parent link="wheel"/><child link="hook"/><origin xyz="0.2 0 0.1" rpy="0.3 0 0"/></joint>
</robot>"""


@pytest.fixture
def courier() -> Iterator[Object]:
    with BulletWorld():
        yield Object("courier", ObjectType.ROBOT, pose=Pose([1, 2, 0], [0, 0, 1, 1]))


def test_reachable_poses_are_reached_to_a_micrometre_as_bullet_sees_them(courier: Object) -> None:
    rng = np.random.default_rng(3)
    chain = chain_of(courier, Arms.RIGHT)
    lower, upper = zip(*(chain.bounds[name] for name in chain.joints), strict=True)
    for _ in range(200):
        angles = dict(zip(chain.joints, map(float, rng.uniform(lower, upper)), strict=True))
        courier.set_joint_positions(angles)
        goal = courier.link_pose("tool_frame")
        courier.set_joint_positions(dict.fromkeys(chain.joints, 0.0))
        answer = solve(courier, Arms.RIGHT, goal)
        assert answer == solve(courier, Arms.RIGHT, goal)
        courier.set_joint_positions(answer)
        assert courier.link_pose("tool_frame").distance(goal) < 1e-5


def test_the_answer_does_not_depend_on_the_current_posture(courier: Object) -> None:
    goal = Pose([1, 2.6, 0.9], courier.pose.orientation)
    before = solve(courier, Arms.RIGHT, goal)
    courier.set_joint_positions(before)
    assert solve(courier, Arms.RIGHT, goal) == before


def test_a_target_too_far_is_refused_with_both_distances(courier: Object) -> None:
    with pytest.raises(Unreachable, match=r"too far: 2.920 m from its first joint, it reaches 0.950 m"):
        solve(courier, Arms.RIGHT, Pose([1, 5, 0.9]))
    with pytest.raises(Unreachable, match="no posture within its soft limits was found"):
        solve(courier, Arms.RIGHT, Pose([1.05, 2.08, 0.85], [0, -1, 0, 1]))


def test_soft_limits_are_kept_and_hard_ones_only_narrowed() -> None:
    arm = COURIER.arms[Arms.RIGHT]
    soft = {"arm_elbow_joint": Bounds(0.2, 0.4)}
    narrow = RobotDescription(
        name="courier",
        arms={
            Arms.LEFT: ArmDescription(
                joints=arm.joints, base_link=arm.base_link, tool_frame=arm.tool_frame, soft_limits=soft,
                hard_limits={"arm_wrist_joint": Bounds(-9.0, 0.5)},
            )
        },
    )  # fmt: skip
    with BulletWorld():
        robot = Object("narrow", ObjectType.ROBOT, robot=narrow)
        goal = Pose([0.9, 0.1, 0.95])
        for limits in Limits:
            try:
                answer = solve(robot, Arms.LEFT, goal, limits=limits)
            except Unreachable:
                assert limits is Limits.SOFT
                continue
            assert -2.1 <= answer["arm_wrist_joint"] <= 0.5
            assert limits is Limits.HARD or 0.2 <= answer["arm_elbow_joint"] <= 0.4
        reachable = robot.link_pose_at("tool_frame", {"arm_elbow_joint": 0.3})
        assert 0.2 <= solve(robot, Arms.LEFT, reachable)["arm_elbow_joint"] <= 0.4


def test_sliding_and_endless_joints_below_another_one_are_solved_at_its_position() -> None:
    hook = ArmDescription(joints=("turn",), base_link="carriage", tool_frame="hook", tool_in_link=Pose([0, 0, 0.3]))
    both = ArmDescription(joints=("slide", "turn"), tool_frame="hook")
    slider = RobotDescription(
        name="slider", urdf=SLIDER, torso_joint="slide", arms={Arms.LEFT: hook, Arms.named("BOTH_JOINTS"): both}
    )
    with BulletWorld():
        robot = Object("one", ObjectType.ROBOT, robot=slider)
        robot.set_joint_positions({"slide": 0.25, "turn": 2.0})
        held = robot.link_pose("hook") @ Pose([0, 0, 0.3])
        assert math.isclose(solve(robot, Arms.LEFT, held)["turn"], 2.0, abs_tol=1e-6)
        with pytest.raises(Unreachable):
            solve(robot, Arms.LEFT, held, torso_height=0.0)
        answer = solve(robot, Arms.named("BOTH_JOINTS"), robot.link_pose("hook"), torso_height=-0.4)
        assert answer == pytest.approx({"slide": 0.25, "turn": 2.0}, abs=1e-6)
        with copied(robot.world) as world:
            same = counterpart(robot, world)
            assert same is not None
            assert solve(same, Arms.LEFT, held) == solve(robot, Arms.LEFT, held)


def test_a_description_that_does_not_fit_the_model_is_refused_by_name() -> None:
    for base, tool, named in (
        ("", "hand", "'hand'"),
        ("no_link", "tool_frame", "'no_link'"),
        ("tool_frame", "camera_link", "is not below"),
        ("column_link", "elbow_link", "but its description has arm_yaw_joint: correct it"),
    ):
        wrong = ArmDescription(joints=("arm_yaw_joint",), base_link=base, tool_frame=tool)
        unfit = RobotDescription(name="unfit", urdf=courier_urdf(), arms={Arms.LEFT: wrong})
        with BulletWorld(), pytest.raises(CallerError, match=named):
            solve(Object("unfit", ObjectType.ROBOT, robot=unfit), Arms.LEFT, Pose([0.6, 0, 0.8]))


def test_an_arm_without_a_joint_is_refused() -> None:
    with pytest.raises(CallerError, match="'tool_frame' has none"):
        ArmDescription(joints=(), tool_frame="tool_frame")


@pytest.mark.slow
@pytest.mark.parametrize(("targets", "reached_min"), [(50, 6), pytest.param(150, 20, marks=pytest.mark.soak)])
def test_the_general_solver_reaches_what_the_closed_form_reaches(targets: int, reached_min: int) -> None:
    general = RobotDescription(
        name="pr2",
        torso_joint=PR2.torso_joint,
        arms={
            arm: ArmDescription(
                joints=each.joints, base_link="torso_lift_link", tool_frame=each.tool_frame,
                soft_limits=each.soft_limits, hard_limits=each.hard_limits,
            )
            for arm, each in PR2.arms.items()
        },
    )  # fmt: skip
    rng = np.random.default_rng(5)
    with BulletWorld():
        exact, other = Object("a", ObjectType.ROBOT, robot=PR2), Object("b", ObjectType.ROBOT, robot=general)
        both = []
        for x, y, z in rng.uniform((0.2, -0.6, 0.3), (0.9, 0.9, 1.5), (targets, 3)):
            reached = []
            for robot in (exact, other):
                try:
                    solve(robot, Arms.LEFT, Pose([x, y, z]), torso_height=0.2)
                except Unreachable:
                    reached.append(False)
                else:
                    reached.append(True)
            both.append(tuple(reached))
    assert both.count((True, True)) > reached_min
    assert both.count((True, False)) == 0
    assert both.count((False, True)) == 0
