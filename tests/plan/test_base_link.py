"""A robot whose base link is above the floor or moved by joints drives, looks, picks up and places like any other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import pytest

from pycrorm_async.learning.rollouts import MoveAndPickUp
from pycrorm_async.plan import (
    AccessingLocation,
    CostmapLocation,
    DatabaseCostmapLocation,
    FaceAtPerformable,
    LookAtActionPerformable,
    MoveJointsMotion,
    NavigateActionPerformable,
    ObjectPart,
    PickUpActionPerformable,
    PlaceActionPerformable,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.plan.failures import NavigationGoalInCollision
from pycrorm_async.plan.motions import simulated_robot_within
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.plan.task import PastSuccess
from pycrorm_async.world import PR2, Arms, BulletWorld, Grasp, Limits, Object, ObjectType, Pose, RobotDescription
from pycrorm_async.world.pose import yaw_quaternion
from tests.world.base_links import HEIGHT_M, RAILS, link_poses, rail_robot, raised_robot

ROBOTS = pytest.mark.parametrize("description", [raised_robot(), rail_robot()], ids=["raised", "railed"])


@pytest.fixture
def milk() -> Iterator[Object]:
    with BulletWorld(), simulated_robot:
        yield Object("milk", ObjectType.MILK, pose=Pose([3, 1, 1.0]))


def robot_of(description: RobotDescription) -> Object:
    robot = Object("robot", ObjectType.ROBOT, robot=description)
    if description.name == "railed":
        robot.set_joint_positions(RAILS)
    return robot


@ROBOTS
async def test_it_looks_at_its_target_exactly(milk: Object, description: RobotDescription) -> None:
    robot_of(description)
    await LookAtActionPerformable(milk.pose).perform()
    x, y, z = milk.pose.relative_to(require_robot().camera_pose()).position
    assert math.hypot(x, y) / z < 1e-6


@ROBOTS
async def test_it_fetches_from_a_place_where_its_base_has_the_same_height(
    milk: Object, description: RobotDescription
) -> None:
    robot = robot_of(description)
    height = robot.pose.position.z
    assert height == pytest.approx(HEIGHT_M)
    place = CostmapLocation(milk, reachable_for=robot, visible_for=robot).resolve()
    assert place.pose.position.z == CostmapLocation(milk).resolve().pose.position.z == height
    before = link_poses(robot)
    with SimulatedTaskTree():
        await NavigateActionPerformable(place.pose).perform()
        assert require_robot().body.pose == place.pose
        await FaceAtPerformable(milk.pose).perform()
        await PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT).perform()
    assert link_poses(robot) == before
    await NavigateActionPerformable(place.pose).perform()
    await FaceAtPerformable(milk.pose).perform()
    await PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT).perform()
    assert milk.attached_to is robot
    await NavigateActionPerformable(Pose([-1, 0, height], yaw_quaternion(2))).perform()
    goal = robot.pose @ Pose([0.7, 0.1, milk.pose.position.z - height])
    await PlaceActionPerformable(milk, Arms.RIGHT, goal).perform()
    assert milk.pose.distance(goal) < 1e-5


async def test_its_rails_bring_it_to_an_object_and_the_object_along(milk: Object) -> None:
    robot = Object("robot", ObjectType.ROBOT, pose=Pose([1.2, 0, HEIGHT_M]), robot=rail_robot())
    root = robot.root_pose()
    await MoveJointsMotion(["rail_x", "rail_y"], [1.1, 1.0]).perform()
    assert robot.pose.position == pytest.approx((2.3, 1, HEIGHT_M))
    await PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT).perform()
    held = milk.pose.relative_to(robot.pose)
    await MoveJointsMotion(["rail_turn"], [1.5]).perform()
    assert milk.pose.relative_to(robot.pose).distance(held) < 1e-6
    assert robot.root_pose().distance(root) < 1e-12


async def test_past_and_learned_places_and_those_at_a_drawer_have_the_height_of_the_base() -> None:
    class Known:
        async def successes(self, object_type: ObjectType, *, arm: Arms | None, **_: object) -> Sequence[PastSuccess]:
            return [PastSuccess(Arms.LEFT, Grasp.FRONT, 0.3, Pose([-0.7, 0, -0.9]), 0.5)]

    with BulletWorld(), simulated_robot:
        robot = Object("pr2", ObjectType.ROBOT, robot=replace(PR2, base_link="base_link"))
        kitchen = Object("kitchen", ObjectType.ENVIRONMENT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9]))
        assert robot.pose == Pose([0, 0, 0.051])
        robot.set_joint_position("torso_lift_joint", 0.3)
        past = await DatabaseCostmapLocation(milk, robot, experience=Known()).resolve()
        assert past is not None
        drawer = AccessingLocation(ObjectPart("kitchen_counter_upper_drawer_handle", kitchen), robot).resolve()
        learned = next(MoveAndPickUp(milk).plain()).standing_position
        assert {each.position.z for each in (past.pose, drawer.pose, learned)} == {0.051}
        assert robot.root_pose(learned).position.z == pytest.approx(0.0, abs=1e-12)


async def test_driving_into_an_object_with_what_the_base_carries_is_refused() -> None:
    with BulletWorld(), simulated_robot_within(Limits.SOFT, collisions=True):
        robot = robot_of(raised_robot())
        cargo = Object("cargo", ObjectType.BREAKFAST_CEREAL, pose=Pose([0, 0, 2.0]))
        robot.attach(cargo)
        Object("lamp", ObjectType.BREAKFAST_CEREAL, pose=Pose([2, 0, 2.0]))
        with pytest.raises(NavigationGoalInCollision, match="in lamp with cargo"):
            await NavigateActionPerformable(Pose([2, 0, HEIGHT_M])).perform()
        assert cargo.pose == Pose([0, 0, 2.0])
        await NavigateActionPerformable(Pose([2, 1, HEIGHT_M])).perform()
        assert cargo.pose.position == pytest.approx((2, 1, 2.0))
