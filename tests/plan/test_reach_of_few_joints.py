"""An arm of few joints reaches with the orientation that it can hold, and places are checked with the arm."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from pycrorm_async.plan.actions import (
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
)
from pycrorm_async.plan.locations import CostmapLocation
from pycrorm_async.plan.motions import simulated_robot_within
from pycrorm_async.world import (
    Arms,
    BulletWorld,
    Drive,
    Grasp,
    Limits,
    Object,
    ObjectType,
    Pose,
    describe_arm,
    describe_robot,
)
from pycrorm_async.world.arms import Held
from pycrorm_async.world.kinematics import chain_of, solve
from pycrorm_async.world.pose import rotated, yaw_quaternion


def arm_of(*joints: tuple[str, str, str]) -> str:
    """Return a chain of joints, each given as type, axis and origin."""
    links = "".join(f'<link name="{number}"/>' for number in range(len(joints) + 1))
    parts = [
        f'<joint name="j{number}" type="{kind}"><parent link="{number}"/>'
        f'<child link="{number + 1}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        f'<limit lower="{0 if kind == "prismatic" else -2}" upper="2"/></joint>'
        for number, (kind, axis, xyz) in enumerate(joints)
    ]
    return f'<robot name="arm">{links}{"".join(parts)}</robot>'


ARMS = {
    Held.AHEAD: arm_of(
        ("revolute", "0 0 1", "0 0 0.2"),
        ("revolute", "0 1 0", "0 0 0.1"),
        ("revolute", "0 1 0", "0.3 0 0"),
        ("revolute", "0 1 0", "0.3 0 0"),
        ("revolute", "1 0 0", "0.1 0 0"),
    ),
    Held.NONE: arm_of(
        ("prismatic", "0 0 1", "0 0 0.2"),
        ("revolute", "0 0 1", "0.1 0 0"),
        ("revolute", "0 0 1", "0.3 0 0"),
        ("revolute", "0 0 1", "0.3 0 0"),
    ),
}


@pytest.mark.parametrize("held", ARMS)
def test_an_arm_of_four_or_five_joints_reaches_with_what_it_can_hold_of_the_orientation(held: Held) -> None:
    text = ARMS[held]
    tool = str(text.count("<joint"))
    rng = random.Random(4)
    with BulletWorld():
        robot = Object(
            "robot",
            ObjectType.ROBOT,
            robot=describe_robot("robot", text, arms={Arms.RIGHT: describe_arm(text, "", tool)}),
        )
        assert chain_of(robot, Arms.RIGHT).held is held
        reached = 0
        for _ in range(20):
            there = robot.link_pose_at(tool, {joint: rng.uniform(0.1, 1.2) for joint in robot.joints})
            turned = there @ Pose(orientation=(math.sin(0.4), 0, 0, math.cos(0.4)))  # about the fingers
            here = robot.link_pose_at(tool, solve(robot, Arms.RIGHT, turned, limits=Limits.HARD))
            reached += here.distance(there) < 1e-6
            if held is Held.AHEAD:
                ahead = [rotated(each.orientation, (1, 0, 0)) for each in (here, there)]
                assert math.dist(*ahead) < 1e-6
        assert reached == 20


SIDEWAYS = (  # a lift, a telescope of four parts to the right of the base, and a wrist that turns
    ("prismatic", "0 0 1", "-0.07 0.1 0.2"),
    *(("prismatic", "0 -0.065 0", "0 -0.05 0"),) * 4,
    ("revolute", "0 0 -1", "0.03 -0.1 0"),
)
AHEAD = (  # a lift beside the middle of the base, and the joints of an arm whose last one turns about the fingers
    ("prismatic", "0 0 1", "0.14 0.08 0.34"),
    ("revolute", "0 1 0", "0 0 0"),
    ("revolute", "0 0 1", "0 0 0.345"),
    ("revolute", "0 1 0", "0 0 0"),
    ("revolute", "0 0 1", "0 0 0"),
)


@pytest.mark.parametrize(
    ("joints", "tool", "yaws"), [(SIDEWAYS, "0 -0.23 0", (4, 0.5)), (AHEAD, "0.012 0 0.2", (0, 2))]
)
async def test_a_lift_and_few_joints_find_places_and_headings_from_which_they_pick_up_and_place(
    joints: tuple[tuple[str, str, str], ...], tool: str, yaws: tuple[float, float]
) -> None:
    text = arm_of(*joints)
    turn = "0 0 -1.570796" if joints is SIDEWAYS else "0 -1.570796 0"
    text = text.replace(
        "</robot>",
        f'<link name="tool"/><joint name="end" type="fixed"><parent link="{len(joints)}"/><child link="tool"/>'
        f'<origin xyz="{tool}" rpy="{turn}"/></joint><link name="finger"/><joint name="grip" type="prismatic">'
        '<parent link="tool"/><child link="finger"/><axis xyz="0 1 0"/><limit lower="0" upper="0.1"/></joint></robot>',
    ).replace('lower="0" upper="2"', 'lower="0" upper="0.9"' if joints is AHEAD else 'lower="0" upper="1"', 1)
    text = text.replace('lower="0" upper="2"', 'lower="0" upper="0.13"')
    robot_described = describe_robot(
        "robot", text, arms={Arms.RIGHT: describe_arm(text, "", "tool")}, torso_joint="j0", drive=Drive.DIFFERENTIAL
    )
    with BulletWorld(), simulated_robot_within(Limits.SOFT):
        robot = Object("robot", ObjectType.ROBOT, robot=robot_described)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.85, 0.1, 0.85], yaw_quaternion(yaws[0])))
        there = Pose([-1, -1, 0.8], yaw_quaternion(yaws[1]))
        place = CostmapLocation(target=milk, reachable_for=robot).resolve()
        await NavigateActionPerformable(place.pose).perform()
        await PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT).perform()
        assert milk.attached_to is robot
        second = CostmapLocation(target=there, reachable_for=robot).resolve()
        await NavigateActionPerformable(second.pose).perform()
        await PlaceActionPerformable(milk, Arms.RIGHT, there).perform()
        assert math.dist(milk.pose.position, there.position) < 1e-5


async def test_each_place_offered_for_the_milk_lets_the_arm_pick_it_up_among_obstacles() -> None:
    with BulletWorld() as world, simulated_robot_within(Limits.SOFT, collisions=True):
        robot = Object("pr2", ObjectType.ROBOT)
        Object("kitchen", ObjectType.ENVIRONMENT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9]))
        await ParkArmsActionPerformable(Arms.BOTH).perform()
        await MoveTorsoActionPerformable(0.3).perform()
        before = world.save_state()
        places = list(itertools.islice(CostmapLocation(target=milk, reachable_for=robot), 9))
        assert len(places) == 9
        for place in places:
            await NavigateActionPerformable(place.pose).perform()
            await PickUpActionPerformable(milk, place.reachable_arms[0], Grasp.FRONT).perform()
            world.restore_state(before)
