"""Compute pick-ups of the standard experiment by geometry and inverse kinematics alone: thousands a second, no
world.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import pandas as pd

from pycrorm_async.learning.policy import PickUpChoice
from pycrorm_async.plan.geometry import pick_up_poses
from pycrorm_async.world.kinematics import Unreachable, solve_from
from pycrorm_async.world.pose import Pose, yaw_quaternion
from pycrorm_async.world.urdf import PR2

MILK = Pose((1.3, 1.0, 0.9))


def succeeds(choice: PickUpChoice, milk: Pose = MILK) -> bool:
    """Return whether a PR2 that faces the milk from there, arms stretched ahead, picks it up; its torso is down, or as
    the choice has it.
    """
    floor = milk @ Pose((choice.relative_x, choice.relative_y, -milk.position.z))
    ahead = math.atan2(milk.position.y - floor.position.y, milk.position.x - floor.position.x)
    base = Pose(floor.position, yaw_quaternion(ahead))
    try:
        for goal in pick_up_poses(PR2, milk, choice.grasp, base):
            solve_from(PR2, choice.arm, goal, base=base, torso_height=choice.torso or 0.0)
    except Unreachable:
        return False
    return True


def frame_of(choices: Iterable[PickUpChoice]) -> pd.DataFrame:
    """Return them as a memory's `dataframe` does, with enum members by name."""
    return pd.DataFrame(
        [(each.arm.name, each.grasp.name, each.relative_x, each.relative_y) for each in choices],
        columns=["arm", "grasp", "object_x", "object_y"],
    )
