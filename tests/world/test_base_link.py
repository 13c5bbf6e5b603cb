"""The pose of a robot is that of its base link, which may be any link of its model, also one that joints move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.world import (
    COURIER,
    PR2,
    Arms,
    BulletWorld,
    Object,
    ObjectType,
    Pose,
    RobotDescription,
    describe_robot,
)
from pycrorm_async.world.kinematics import solve
from pycrorm_async.world.pose import ObjectRefused, UnknownLink, yaw_quaternion
from pycrorm_async.world.queries import collisions_at, footprint_of
from pycrorm_async.world.urdf import Limits
from pycrorm_async.world.world_copy import copied, counterpart
from tests import bullet
from tests.world.fakes import HEIGHT_M, RAILS, ChangeLog, link_poses, rail_robot, raised_robot

LEANING = Pose([0.3, -1.2, 0.7], [0.2, -0.4, 0.1, 0.8])
AHEAD = Pose([1, 2, 0.5], yaw_quaternion(0.4))


def robot_of(description: RobotDescription, pose: Pose | None = None, name: str = "robot") -> Object:
    return Object(name, ObjectType.ROBOT, pose=pose, robot=description)


def same_by_its_root(robot: Object) -> Object:
    """Return the same model at the same place, whose pose is that of its root link."""
    described = robot.robot_description
    assert described is not None
    twin = robot_of(replace(described, base_link=""), robot.root_pose(), "by its root")
    twin.set_joint_positions(robot.joint_positions())
    return twin


def assert_near(poses: Mapping[str, Pose], others: Mapping[str, Pose], error: float = 1e-6) -> None:
    assert poses.keys() == others.keys()
    for link, pose in poses.items():
        assert pose.distance(others[link]) < error, link
        assert pose.orientation == pytest.approx(others[link].orientation, abs=error), link


@pytest.mark.parametrize("description", [raised_robot(), rail_robot()], ids=["raised", "railed"])
def test_every_link_is_where_the_base_link_puts_it(world: BulletWorld, description: RobotDescription) -> None:
    robot = robot_of(description, LEANING)
    if description.name == "railed":
        robot.set_joint_positions(RAILS)
        robot.set_pose(LEANING)
    assert robot.pose is LEANING
    assert robot.link_pose() is LEANING
    assert robot.link_pose("base_link") is LEANING
    assert robot.base_link == "base_link"
    assert robot.link_pose(robot.links[0]) == robot.root_pose()
    assert_near(link_poses(same_by_its_root(robot)), link_poses(robot))
    assert same_by_its_root_box(robot) == pytest.approx([*sum(robot.bounding_box(), ())], abs=1e-6)


def same_by_its_root_box(robot: Object) -> list[float]:
    return [*sum(robot.world.object("by its root").bounding_box(), ())]


def test_without_a_pose_the_root_link_is_at_the_origin(world: BulletWorld) -> None:
    robot = robot_of(raised_robot())
    assert (robot.pose, robot.root_pose()) == (Pose([0, 0, HEIGHT_M]), Pose())
    assert robot.original_pose is robot.pose


def test_a_joint_above_the_base_moves_the_base_and_what_is_attached_to_it(
    world: BulletWorld, change_log: ChangeLog
) -> None:
    robot = robot_of(rail_robot())
    base, tool, hall = (Object(name, ObjectType.BOWL, pose=AHEAD) for name in ("base", "tool", "hall"))
    robot.attach(base)
    robot.attach(tool, "tool_frame")
    robot.attach(hall, "hall")
    relative = base.pose.relative_to(robot.pose)
    assert robot.joints_above(None) == tuple(reversed(RAILS))
    change_log.notes.clear()
    robot.set_joint_positions(RAILS)
    assert change_log.names() == [("joints", "robot"), ("moved", "robot"), ("moved", "base"), ("moved", "tool")]
    assert robot.root_pose().distance(Pose()) < 1e-15
    assert robot.pose.position == pytest.approx((0.4, -0.3, 0.2))
    assert robot.pose.yaw == pytest.approx(0.9)
    assert base.pose.distance(robot.pose @ relative) < 1e-9
    assert hall.pose is AHEAD
    assert_near(link_poses(same_by_its_root(robot)), link_poses(robot))
    change_log.notes.clear()
    pose = robot.pose
    robot.set_joint_position("rail_x", RAILS["rail_x"])
    robot.set_joint_position("arm_yaw_joint", 0.5)
    assert robot.pose is pose
    assert ("moved", "robot") not in change_log.names()


def test_a_robot_that_is_attached_stays_attached_where_its_rails_bring_it(world: BulletWorld) -> None:
    lift = Object("lift", ObjectType.GENERIC_OBJECT)
    robot = robot_of(rail_robot())
    lift.attach(robot)
    robot.set_joint_positions(RAILS)
    before = robot.pose
    lift.set_pose(Pose([0, 0, 1]))
    assert robot.pose.distance(Pose([0, 0, 1]) @ before) < 1e-12


def test_a_copy_and_a_restored_state_have_every_link_at_the_same_place(
    world: BulletWorld, change_log: ChangeLog
) -> None:
    robot = robot_of(rail_robot(), AHEAD)
    robot.set_joint_positions(RAILS)
    robot.set_pose(LEANING)
    robot.set_joint_positions({"rail_x": -0.7, "arm_yaw_joint": 1.0})
    poses, saved = link_poses(robot), world.save_state()
    with copied(world) as copy:
        twin = counterpart(robot, copy)
        assert twin is not None
        assert link_poses(twin) == poses
        assert (twin.base_link, twin.original_pose) == ("base_link", AHEAD)
    change_log.notes.clear()
    robot.set_joint_positions({"rail_x": 1.0})
    world.restore_state(saved)
    assert link_poses(robot) == poses
    assert change_log.names() == [("joints", "robot"), ("moved", "robot")] * 2
    change_log.notes.clear()
    robot.reset()
    assert change_log.names() == [("joints", "robot"), ("moved", "robot")]
    assert (robot.pose, set(robot.joint_positions().values())) == (AHEAD, {0.0})
    change_log.notes.clear()
    robot.reset()
    assert change_log.notes == []


@pytest.mark.parametrize("base", [None, Pose([2.0, 0, 0.2])])
def test_a_query_for_collisions_moves_base_and_joints_and_restores_them(world: BulletWorld, base: Pose | None) -> None:
    robot = robot_of(rail_robot())
    away = Object("away", ObjectType.GENERIC_OBJECT, pose=Pose([1.5 if base is None else 2.0, 0, 0.3]))
    before = link_poses(robot)
    assert collisions_at(robot, {}, links=["base_link"]) == []
    assert collisions_at(robot, {"rail_x": 1.5}, links=["base_link"], base=base) == [("base_link", away)]
    assert link_poses(robot) == before
    assert robot.joint_positions() == dict.fromkeys(robot.joints, 0.0)


def test_the_footprint_is_around_the_base_link(world: BulletWorld) -> None:
    robot = robot_of(rail_robot())
    robot.set_joint_positions(RAILS)
    plate = Object("plate", ObjectType.GENERIC_OBJECT, pose=robot.pose @ Pose([0.5, 0, 0]))
    robot.attach(plate)
    footprint = footprint_of(robot, ["base_link"])
    assert footprint.y == pytest.approx((-0.22, 0.22), abs=1e-6)
    assert footprint.x[0] == pytest.approx(-0.25, abs=1e-6)
    assert footprint.x[1] > 0.5


def test_the_arm_reaches_the_same_goal_with_the_same_joints(world: BulletWorld) -> None:
    for description, arm, base_link in ((rail_robot(), Arms.RIGHT, "base_link"), (PR2, Arms.LEFT, "torso_lift_link")):
        robot = robot_of(replace(description, base_link=base_link), AHEAD, f"{description.name} by another link")
        if description is PR2:
            robot.set_joint_position("torso_lift_joint", 0.2)
        else:
            robot.set_joint_positions(RAILS)
        goal = robot.link_pose("base_footprint") @ Pose([0.6, 0.1, 1.0])
        joints = solve(robot, arm, goal, limits=Limits.HARD)
        robot.set_joint_positions(joints)
        assert robot.link_pose(description.arms[arm].tool_frame).distance(goal) < 1e-5
        elsewhere = Pose([3, 1, 0.4], yaw_quaternion(-1))
        moved = elsewhere @ goal.relative_to(robot.pose)
        joints = solve(robot, arm, moved, base=elsewhere, limits=Limits.HARD)
        robot.set_pose(elsewhere)
        robot.set_joint_positions(joints)
        assert robot.link_pose(description.arms[arm].tool_frame).distance(moved) < 1e-5


def test_a_base_link_that_the_model_lacks_is_refused(world: BulletWorld) -> None:
    lacking = replace(COURIER, base_link="chassis")
    with pytest.raises(UnknownLink, match="'robot' has no link 'chassis'; its links are: base_footprint, base_link"):
        robot_of(lacking)
    with pytest.raises(CallerError, match="no link 'chassis'"):
        describe_robot("robot", raised_robot().urdf or "", base_link="chassis")
    with pytest.raises(ObjectRefused, match="only a robot has a base link"):
        Object("milk", ObjectType.MILK, base_link="milk")
    assert world.objects == ()
    assert bullet.getNumBodies(physicsClientId=bullet.client_of(world)) == 1  # the floor
    assert describe_robot("robot", raised_robot().urdf or "", base_link="base_link").base_link == "base_link"
