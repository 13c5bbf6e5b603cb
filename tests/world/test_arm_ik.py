"""Inverse kinematics: exact solutions, correct refusals, arms without a closed form, agreement with other solvers."""

from __future__ import annotations

import hashlib
import math
import random
import subprocess
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import pycrorm_async
from pycrorm_async.errors import CallerError
from pycrorm_async.world import (
    COURIER,
    ArmDescription,
    Bounds,
    BulletWorld,
    Object,
    ObjectType,
    RobotDescription,
    copied,
)
from pycrorm_async.world.kinematics import Unreachable, chain_of, forward, solve, solve_from, within_reach
from pycrorm_async.world.models import built_in_model
from pycrorm_async.world.pose import Arms, Grasp, Pose, rotated, yaw_quaternion
from pycrorm_async.world.urdf import GRASP_ORIENTATIONS, PR2, Limits
from pycrorm_async.world.world_copy import counterpart
from tests.world.fakes import angle_between, random_arm, random_base_pose

# === arm ik ===================================================================================================
#
# Inverse kinematics: exact solutions, correct refusals, and the same answer every time.

ARMS = (Arms.LEFT, Arms.RIGHT)
EXACT = 1e-6
AHEAD = Pose([0.6, 0.2, 0.9])


def reached(arm: Arms, joints: dict[str, float], *, base: Pose, torso_height: float) -> Pose:
    return forward(PR2, arm, joints, torso_height=torso_height, base=base)


def least_margin(arm: Arms, joints: dict[str, float], limits: Limits) -> float:
    """Return the angle in rad between the joint nearest to a limit and that limit; negative if a joint is outside."""
    bounds = PR2.arms[arm].limits(limits)
    return min(min(joints[name] - lower, upper - joints[name]) for name, (lower, upper) in bounds.items())


@pytest.mark.parametrize("targets", [100, pytest.param(3_000, marks=pytest.mark.soak)])
@pytest.mark.parametrize("limits", Limits)
@pytest.mark.parametrize("arm", ARMS)
def test_a_target_that_a_posture_within_limits_reaches_is_solved_exactly_within_limits(
    arm: Arms, limits: Limits, targets: int
) -> None:
    rng = random.Random(31)
    for _ in range(targets):
        joints = random_arm(rng, arm, limits)
        base, torso_height = random_base_pose(rng)
        target = reached(arm, joints, base=base, torso_height=torso_height)
        answer = solve_from(PR2, arm, target, base=base, torso_height=torso_height, limits=limits)
        reached_pose = reached(arm, answer, base=base, torso_height=torso_height)
        assert reached_pose.distance(target) < EXACT
        assert angle_between(reached_pose.orientation, target.orientation) < EXACT
        assert least_margin(arm, answer, limits) >= 0
        assert tuple(answer) == PR2.arms[arm].joints


@pytest.mark.parametrize("limits", Limits)
def test_a_solution_stays_as_far_from_the_limits_as_any_other_posture(limits: Limits) -> None:
    rng = random.Random(33)
    for _ in range(1000):
        joints = random_arm(rng, Arms.LEFT, limits)
        target = reached(Arms.LEFT, joints, base=Pose(), torso_height=0.1)
        answer = solve_from(PR2, Arms.LEFT, target, base=Pose(), torso_height=0.1, limits=limits)
        one_step = 0.05
        assert least_margin(Arms.LEFT, answer, limits) > least_margin(Arms.LEFT, joints, limits) - one_step


def by_zeros() -> Pose:
    return reached(Arms.LEFT, dict.fromkeys(PR2.arms[Arms.LEFT].joints, 0.0), base=Pose(), torso_height=0.0)


def on_shoulder(grasp: Grasp) -> Pose:
    """Return a target that puts the wrist on the pan joint."""
    turn = GRASP_ORIENTATIONS[grasp]
    hand = rotated(turn, (0.18, 0.0, 0.0))
    return Pose([-0.05 + hand.x, 0.188 + hand.y, 0.790675 + hand.z], turn)


BEHIND = Pose([-0.05 + 0.97 * math.cos(-2), 0.188 + 0.97 * math.sin(-2), 0.79], yaw_quaternion(-2))
REFUSED = {
    "stretched": (
        by_zeros(),
        Limits.SOFT,
        "too far: from shoulder to wrist 0.721 m or more",
    ),
    "three metres away": (Pose([3.0, 0.0, 0.9]), Limits.HARD, "too far: from shoulder to wrist"),
    "in the shoulder": (on_shoulder(Grasp.TOP), Limits.HARD, "too near: from shoulder to wrist"),
    "in the shoulder, ahead": (on_shoulder(Grasp.FRONT), Limits.SOFT, "too near: from shoulder to wrist"),
    "at the shoulder": (
        Pose([0.23, 0.188, 0.79]),
        Limits.SOFT,
        "too near: from shoulder to wrist 0.200 m or less, but the arm needs 0.359 m",
    ),
    "behind": (BEHIND, Limits.SOFT, "its wrist would reach the target only with l_shoulder_pan_joint outside its soft"),
    "from above": (Pose([0.6, 0.2, 0.9], GRASP_ORIENTATIONS[Grasp.TOP]), Limits.SOFT, "the best posture has l_"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_a_refusal_names_the_limit_that_prevents_it(what: str) -> None:
    target, limits, reason = REFUSED[what]
    with pytest.raises(Unreachable) as refused:
        solve_from(PR2, Arms.LEFT, target, base=Pose(), torso_height=0.0, limits=limits)
    assert refused.value.reason.startswith(reason)
    assert (refused.value.target, refused.value.arm) == (target, Arms.LEFT)
    assert str(refused.value) == f"the LEFT arm cannot reach {target!r}: {refused.value.reason}"


def test_the_stretched_arm_is_within_hard_limits() -> None:
    answer = solve_from(PR2, Arms.LEFT, by_zeros(), base=Pose(), torso_height=0.0, limits=Limits.HARD)
    assert reached(Arms.LEFT, answer, base=Pose(), torso_height=0.0).distance(by_zeros()) < EXACT


@pytest.mark.parametrize(
    ("arm", "target", "says"),
    [
        (Arms.BOTH, AHEAD, "one arm at a time"),
        (Arms.LEFT, Pose(AHEAD.position, frame="kitchen"), "'kitchen'"),
        (Arms.LEFT, Pose([math.nan, 0, 0]), "not finite"),
        (Arms.LEFT, Pose([0, math.inf, 0]), "not finite"),
    ],
)
def test_an_invalid_request_is_the_callers_error(arm: Arms, target: Pose, says: str) -> None:
    with pytest.raises(CallerError, match=says):
        solve_from(PR2, arm, target, base=Pose(), torso_height=0.0)


FINGERPRINT = """
import hashlib, random
from pycrorm_async.world.kinematics import Unreachable, solve_from
from pycrorm_async.world.pose import Arms
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.urdf import PR2
rng, seen = random.Random(36), hashlib.sha256()
for _ in range(400):
    target = Pose([rng.uniform(0, 0.9), rng.uniform(-0.3, 0.8), rng.uniform(0.3, 1.2)],
                  [rng.gauss(0, 1) for _ in range(4)])
    try:
        answer = solve_from(PR2, Arms.LEFT, target, base=Pose(), torso_height=0.2)
        seen.update(" ".join(map(float.hex, answer.values())).encode())
    except Unreachable as refused:
        seen.update(refused.reason.encode())
"""


def test_the_same_request_has_the_same_answer_to_the_bit_here_again_and_in_another_process() -> None:
    def here() -> str:
        names: dict[str, hashlib._Hash] = {}
        exec(FINGERPRINT, names)
        return names["seen"].hexdigest()

    root = str(Path(pycrorm_async.__file__).parents[1])
    script = f"import sys; sys.path.insert(0, {root!r})\n{FINGERPRINT}print(seen.hexdigest())"
    elsewhere = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert here() == here() == elsewhere.stdout.strip()


# --- the robot of a world -------------------------------------------------------------------------------------------


def test_a_solution_uses_the_robots_pose_and_torso_or_those_passed_and_does_not_move_it() -> None:
    with BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT, pose=Pose([1.0, -0.5, 0.0], yaw_quaternion(0.7)))
        robot.set_joint_position("torso_lift_joint", 0.25)
        before = (robot.pose, robot.joint_positions())
        target = robot.pose @ Pose([0.65, -0.3, 1.0])
        answer = solve(robot, Arms.RIGHT, target)
        lower = solve(robot, Arms.RIGHT, target, torso_height=0.0)
        assert (robot.pose, robot.joint_positions()) == before
        assert answer == solve_from(PR2, Arms.RIGHT, target, base=robot.pose, torso_height=0.25)
        assert lower == solve_from(PR2, Arms.RIGHT, target, base=robot.pose, torso_height=0.0) != answer
        robot.set_joint_positions(answer)
        assert robot.link_pose("r_gripper_tool_frame").distance(target) < EXACT


def test_hard_limits_are_those_of_the_loaded_model_if_they_are_narrower() -> None:
    target = Pose([0.55, 0.3, 0.75], GRASP_ORIENTATIONS[Grasp.TOP])
    stiff = built_in_model("pr2").replace('lower="-2.18"', 'lower="-1.0"')
    with BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT)
        answer = solve(robot, Arms.LEFT, target, limits=Limits.HARD)
        assert answer["l_wrist_flex_joint"] < -1.0
    with BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT, stiff)
        with pytest.raises(Unreachable, match=r"l_wrist_flex_joint outside its hard limits -1\.000\.\.0\.000"):
            solve(robot, Arms.LEFT, target, limits=Limits.HARD)


@pytest.mark.parametrize(
    ("name", "arm", "limits"),
    [("pr2", Arms.LEFT, Limits.SOFT), ("pr2", Arms.RIGHT, Limits.HARD), ("courier", Arms.RIGHT, Limits.SOFT)],
)
def test_what_is_out_of_reach_has_no_solution_and_most_without_one_are_out_of_reach(
    name: str, arm: Arms, limits: Limits
) -> None:
    rng = np.random.default_rng(7)
    torsos = [None, 0.0, 0.33] if name == "pr2" else [None]
    counts = {(may, solved): 0 for may in (True, False) for solved in (True, False)}
    with BulletWorld():
        robot = Object(name, ObjectType.ROBOT, pose=Pose([1, 2, 0], [0, 0, 1, 1]))
        if name == "pr2":
            robot.set_joint_position("torso_lift_joint", 0.2)
        for _ in range(6):
            goal = Pose(rng.uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 1.2]).tolist(), rng.normal(size=4).tolist())
            at = rng.uniform(-1.1, 1.1, (10, 2)).tolist()
            bases = [Pose((x, y, 0.0), yaw_quaternion(-math.atan2(y, -x))) for x, y in at]
            reached = within_reach(robot, arm, [goal], bases=bases, torso_heights=torsos, limits=limits)
            for may, (base, torso) in zip(reached.ravel(), product(bases, torsos), strict=True):
                try:
                    solve(robot, arm, goal, base=base, torso_height=torso, limits=limits)
                    counts[bool(may), True] += 1
                except Unreachable:
                    counts[bool(may), False] += 1
        both = within_reach(robot, arm, [goal, Pose([0, 0, 9])], bases=bases, torso_heights=torsos, limits=limits)
        assert not both.any()
    assert counts[False, True] == 0
    assert counts[True, True] > 5
    assert counts[False, False] > counts[True, False] / 2, counts


# === chain ik =================================================================================================
#
# Inverse kinematics of arms without a closed form: reached poses, refusals, and agreement with Bullet.

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
    for _ in range(50):
        angles = dict(zip(chain.joints, map(float, rng.uniform(lower, upper)), strict=True))
        courier.set_joint_positions(angles)
        goal = courier.link_pose("tool_frame")
        courier.set_joint_positions(dict.fromkeys(chain.joints, 0.0))
        answer = solve(courier, Arms.RIGHT, goal)
        courier.set_joint_positions(answer)
        assert courier.link_pose("tool_frame").distance(goal) < 1e-5
        assert solve(courier, Arms.RIGHT, goal) == answer  # whatever its posture


def test_a_target_too_far_is_refused_with_both_distances(courier: Object) -> None:
    with pytest.raises(Unreachable, match=r"too far: 2.925 m from its first joint, it reaches 0.780 m"):
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
        unfit = RobotDescription(name="unfit", urdf=built_in_model("courier"), arms={Arms.LEFT: wrong})
        with BulletWorld(), pytest.raises(CallerError, match=named):
            solve(Object("unfit", ObjectType.ROBOT, robot=unfit), Arms.LEFT, Pose([0.6, 0, 0.8]))
    with BulletWorld(), pytest.raises(CallerError, match="cereal"):
        solve(Object("cereal", ObjectType.BREAKFAST_CEREAL), Arms.LEFT, AHEAD)
    with pytest.raises(CallerError, match="'tool_frame' has none"):
        ArmDescription(joints=(), tool_frame="tool_frame")


@pytest.mark.slow
@pytest.mark.parametrize(("targets", "reached_min"), [(20, 2), pytest.param(150, 20, marks=pytest.mark.soak)])
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
