"""Collision queries for an arm at other joint positions: boxes beside and inside it, and nothing moves."""

from __future__ import annotations

import pytest

from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.queries import collisions_at
from tests.world.fakes import ChangeLog

BOX = """<robot name="box"><link name="box">
<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link></robot>"""
TOOL, FOREARM = "l_gripper_tool_frame", "l_forearm_link"
ARM = ("l_upper_arm_link", "l_elbow_flex_link", FOREARM, "l_wrist_flex_link", "l_gripper_palm_link")
STRAIGHT = {"l_shoulder_pan_joint": 0.0}
ASIDE = {"l_shoulder_pan_joint": 1.5}


@pytest.fixture
def robot(world: BulletWorld) -> Object:
    """Return the robot with its arms stretched ahead, as after a reset; the left one in a line at y 0.188, 0.79 m
    up.
    """
    return Object("pr2", ObjectType.ROBOT, world=world)


def links(robot: Object) -> list[str]:
    return [each for each in ARM if each in robot.links]


def box_at(world: BulletWorld, x: float, y: float, z: float, name: str = "box") -> Object:
    return Object(name, ObjectType.GENERIC_OBJECT, BOX, Pose([x, y, z]), world=world)


def test_an_arm_collides_with_a_box_on_its_line_and_not_with_one_beside_it(world: BulletWorld, robot: Object) -> None:
    along = robot.link_pose(FOREARM).position
    box = box_at(world, along.x + 0.1, along.y, along.z)
    met = collisions_at(robot, STRAIGHT, links=links(robot))
    assert (FOREARM, box) in met
    assert {obstacle for _, obstacle in met} == {box}
    assert collisions_at(robot, ASIDE, links=links(robot)) == []
    box.set_pose(Pose([along.x + 0.1, along.y + 0.3, along.z]))
    assert collisions_at(robot, STRAIGHT, links=links(robot)) == []
    box.set_pose(Pose([along.x + 0.1, along.y, along.z]))
    assert collisions_at(robot, STRAIGHT, links=[]) == []


def test_a_carried_object_counts_as_the_arm_does(world: BulletWorld, robot: Object) -> None:
    tool = robot.link_pose(TOOL).position
    held = box_at(world, tool.x + 0.05, tool.y, tool.z, "held")
    robot.attach(held, TOOL)
    wall = box_at(world, tool.x + 0.12, tool.y, tool.z, "wall")
    assert collisions_at(robot, STRAIGHT, links=[], carried=[held]) == [("held", wall)]
    assert collisions_at(robot, ASIDE, links=[], carried=[held]) == []
    assert (
        collisions_at(robot, STRAIGHT, links=links(robot)) == []
    )  # it reaches as far as an object that the hand alone holds


def test_a_collision_query_moves_nothing_and_notifies_no_observer(
    world: BulletWorld, robot: Object, change_log: ChangeLog
) -> None:
    tool = robot.link_pose(TOOL)
    held = box_at(world, *tool.position, "held")
    robot.attach(held, TOOL)
    before = (robot.joint_positions(), held.pose, robot.link_pose(TOOL), held.bounding_box())
    change_log.notes.clear()
    collisions_at(robot, ASIDE, links=links(robot), carried=[held])
    assert (robot.joint_positions(), held.pose, robot.link_pose(TOOL), held.bounding_box()) == before
    assert change_log.notes == []


def test_a_contact_is_no_collision(world: BulletWorld, robot: Object) -> None:
    tool = robot.link_pose(TOOL).position
    held = box_at(world, tool.x + 0.05, tool.y, tool.z, "held")
    robot.attach(held, TOOL)
    table = box_at(world, tool.x + 0.05, tool.y, tool.z - 0.1, "table")
    assert collisions_at(robot, STRAIGHT, links=[], carried=[held]) == []
    table.set_pose(Pose([tool.x + 0.05, tool.y, tool.z - 0.09]))
    assert collisions_at(robot, STRAIGHT, links=[], carried=[held]) == [("held", table)]
