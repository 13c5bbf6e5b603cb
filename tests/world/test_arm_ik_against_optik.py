"""Compare refusals as unreachable with an independent numerical solver, optik, started from random postures."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import optik
import pytest

from pycrorm_async.learning import PickUpChoice, default_policy
from pycrorm_async.learning.rollouts import randomness
from pycrorm_async.plan.geometry import PickUpPoses, pick_up_poses
from pycrorm_async.world import Arms, Pose
from pycrorm_async.world.kinematics import Unreachable, solve_from
from pycrorm_async.world.models import pr2_urdf
from pycrorm_async.world.pose import yaw_quaternion
from pycrorm_async.world.urdf import PR2

pytestmark = pytest.mark.slow

ROLLOUTS = 400
RESTARTS = 60
MILK = Pose((1.3, 1.0, 0.9))


@pytest.fixture(scope="module")
def robots(tmp_path_factory: pytest.TempPathFactory) -> dict[Arms, optik.Robot]:
    """Return the arms of the model, from the torso to the tool frame, within soft limits; rolls within one turn."""
    model = ET.fromstring(pr2_urdf())
    soft = {joint: bounds for arm in PR2.arms.values() for joint, bounds in arm.soft_limits.items()}
    for joint in model.iter("joint"):
        bounds = soft.get(joint.get("name", ""))
        if bounds is not None:
            joint.set("type", "revolute")
            limit = joint.find("limit")
            limit = ET.SubElement(joint, "limit", effort="1", velocity="1") if limit is None else limit
            limit.set("lower", str(max(bounds.lower, -math.pi)))
            limit.set("upper", str(min(bounds.upper, math.pi)))
    path: Path = tmp_path_factory.mktemp("model") / "pr2.urdf"
    ET.ElementTree(model).write(path)
    solutions = {}
    for arm, description in PR2.arms.items():
        solutions[arm] = optik.Robot.from_urdf_file(str(path), "torso_lift_link", description.tool_frame)
        solutions[arm].set_parallelism(1)
    return solutions


def goals_of(choice: PickUpChoice) -> tuple[PickUpPoses, Pose]:
    """Return the three goals of the hand and the base pose for them, as in the standard experiment."""
    x, y = MILK.position.x + choice.relative_x, MILK.position.y + choice.relative_y
    base = Pose((x, y, 0.0), yaw_quaternion(math.atan2(MILK.position.y - y, MILK.position.x - x)))
    return pick_up_poses(MILK, choice.grasp, base), base


def reached_by_optik(robot: optik.Robot, goal: Pose, base: Pose, rng: np.random.Generator) -> bool:
    x, y, z, w = (seen := goal.relative_to(base @ Pose(PR2.torso_origin))).orientation
    target = np.eye(4)
    target[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    target[:3, 3] = seen.position
    config = optik.SolverConfig(max_time=0, max_restarts=RESTARTS, tol_f=1e-12)
    return robot.ik(config, target.tolist(), rng.uniform(*robot.joint_limits()).tolist()) is not None


@pytest.mark.soak  # test_arm_ik holds the closed form against its own kinematics
def test_few_rollouts_fail_at_a_target_that_another_solver_reaches(robots: dict[Arms, optik.Robot]) -> None:
    rng = np.random.default_rng(1)
    falsely, refused, agreed = 0, 0, 0
    for index in range(ROLLOUTS):
        choice = default_policy().sample(randomness(69, index))[0]
        goals, base = goals_of(choice)
        for goal in goals:
            try:
                solve_from(PR2, choice.arm, goal, base=base, torso_height=0.0)
            except Unreachable:
                refused += 1
                falsely += reached_by_optik(robots[choice.arm], goal, base, rng)
                break
            agreed += reached_by_optik(robots[choice.arm], goal, base, rng)
    assert refused > 300
    assert agreed > 150  # the other solver finds the existing solutions
    assert falsely <= 0.005 * ROLLOUTS
