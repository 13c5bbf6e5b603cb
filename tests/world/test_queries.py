"""Rays, visibility, collisions and footprints agree with independent computations, and nothing moves."""

from __future__ import annotations

import math
import random

import pytest

from pycrorm_async.world import Arms, BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.kinematics import solve
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import yaw_quaternion
from pycrorm_async.world.queries import Footprint, Obstacles, collisions_at, footprint_of
from tests import bullet
from tests.world.fakes import CRANE, ChangeLog

# === rays =====================================================================================================
#
# Rays hit the first object in their way, and an object is visible as far as no other one hides it.


def cube(name: str, position: tuple[float, float, float]) -> Object:
    """Return a cube with edges of 10 cm."""
    return Object(name, ObjectType.GENERIC_OBJECT, pose=Pose(position))


def test_a_ray_hits_the_first_object_in_its_way(world: BulletWorld) -> None:
    near, far = cube("near", (1, 0, 1)), cube("far", (2, 0, 1))
    starts = [(0, 0, 1), (3, 0, 1), (0, 0.2, 1), (0, 0, 1), (0, 0, 1), (1.5, 0, 1)]
    ends = [(3, 0, 1), (0, 0, 1), (3, 0.2, 1), (0.9, 0, 1), (0, 0, -1), (1.5, 0, 2)]
    assert world.ray_test(starts, ends) == [near, far, None, None, None, None]
    assert world.ray_test(starts[:2], ends[:2], ignore=[near]) == [far, far]
    assert world.ray_test(starts[:2], ends[:2], ignore=[near, far]) == [None, None]


def test_rays_follow_objects_that_moved(world: BulletWorld) -> None:
    cube_object = cube("thing", (1, 0, 1))
    cube_object.set_pose(Pose([1, 5, 1]))
    assert world.ray_test([(0, 0, 1), (0, 5, 1)], [(3, 0, 1), (3, 5, 1)]) == [None, cube_object]
    crane = Object("crane", ObjectType.GENERIC_OBJECT, CRANE, Pose([0, -5, 0]))
    x, y, z = crane.link_pose("hook").position
    assert world.ray_test([(x, y, z + 1)], [(x, y, z - 0.09)]) == [crane]
    crane.set_joint_position("turning", math.pi)
    assert world.ray_test([(x, y, z + 1)], [(x, y, z - 0.09)]) == [None]
    x, y, z = crane.link_pose("hook").position
    assert world.ray_test([(x, y, z + 1)], [(x, y, z - 0.09)]) == [crane]


def test_more_rays_than_bullet_accepts_at_once_are_cast(world: BulletWorld) -> None:
    cube_object = cube("thing", (0, 0, 1))
    starts = [(0, 0, 2 + ray / 40_000) for ray in range(20_000)]
    assert world.ray_test(starts, [(0, 0, 0.5)] * 20_000) == [cube_object] * 20_000


def test_unequal_numbers_of_starts_and_ends_are_refused(world: BulletWorld) -> None:
    with pytest.raises(ValueError, match="2 starts and 1 ends"):
        world.ray_test([(0, 0, 1), (0, 0, 2)], [(1, 0, 1)])


def test_visibility_is_the_share_that_is_not_hidden(world: BulletWorld) -> None:
    cube_object, eye = cube("thing", (2, 0, 1)), (0.0, 0.0, 1.0)
    assert world.visible(cube_object, eye) == 1.0
    whole = Object("wall", ObjectType.GENERIC_OBJECT, wall(0.4), Pose([1, 0, 1]))
    assert world.visible(cube_object, eye) == 0.0
    assert world.visible(cube_object, eye, ignore=[whole]) == 1.0
    assert world.visible(whole, eye) == 1.0
    whole.set_pose(Pose([1, 0.2, 1]))
    assert world.visible(cube_object, eye) == 0.5
    whole.set_pose(Pose([3, 0, 1]))
    assert world.visible(cube_object, eye) == 1.0
    assert world.visible(cube_object, (2, 0, -1)) == 0.0


SHAPES = {
    "box": '<box size="0.3 0.1 0.2"/>',
    "sphere": '<sphere radius="0.1"/>',
    "cylinder": '<cylinder radius="0.05" length="0.4"/>',
    "capsule": '<capsule radius="0.05" length="0.4"/>',
}


@pytest.mark.parametrize("shape", SHAPES)
def test_an_object_without_obstacles_is_wholly_visible_from_everywhere(world: BulletWorld, shape: str) -> None:
    description = (
        '<robot name="a"><link name="l"><collision><origin xyz="0.1 0 0" rpy="0.3 0.2 0"/><geometry>'
        f"{SHAPES[shape]}</geometry></collision></link></robot>"
    )
    cube_object = Object("thing", ObjectType.GENERIC_OBJECT, description, Pose([0, 0, 2], [0.1, 0.5, -0.2, 0.7]))
    eyes = [(2, 0, 2), (-2, 0.1, 3), (0, 2, 1), (0.3, -2, 2), (0, 0, 4), (0.1, 0, 0.5)]
    assert [world.visible(cube_object, eye) for eye in eyes] == [1.0] * 6


def wall(width: float) -> str:
    return (
        '<robot name="wall"><link name="wall"><collision><geometry>'
        f'<box size="0.02 {width} {width}"/></geometry></collision></link></robot>'
    )


# === collision queries ========================================================================================
#
# Collision queries for an arm at other joint positions: boxes beside and inside it, and nothing moves.

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


# === footprints ===============================================================================================
#
# The outline of a base against the outlines of obstacles: exact for rotated boxes, and never free where Bullet hits.

SQUARE = Footprint((-0.3, 0.3), (-0.3, 0.3))


def box(world: BulletWorld, name: str, pose: Pose, *, z: tuple[float, float] = (0.0, 0.7)) -> Object:
    urdf = box_urdf(name, x=(-0.6, 0.6), y=(-0.4, 0.4), z=z)
    return Object(name, ObjectType.GENERIC_OBJECT, urdf, pose, world=world)


def test_objects_on_the_base_widen_its_footprint(world: BulletWorld) -> None:
    robot = Object("pr2", ObjectType.ROBOT, pose=Pose([0, 0, 0], yaw_quaternion(0.7)), world=world)
    assert footprint_of(robot, ["base_link"]).y == pytest.approx((-0.325, 0.325))
    robot.set_pose(Pose())
    crate = Object("crate", ObjectType.GENERIC_OBJECT, box_urdf("crate", x=(0.0, 0.5), y=(-0.1, 0.1), z=(0.4, 0.5)),
                   world=world)  # fmt: skip
    robot.attach(crate, "base_link")
    assert footprint_of(robot, ["base_link"]).x == pytest.approx((-0.325, 0.5))
    robot.detach(crate)
    robot.attach(crate, "l_gripper_tool_frame")
    assert footprint_of(robot, ["base_link"]).x == pytest.approx((-0.325, 0.325))


def test_a_rotated_base_needs_the_space_of_its_corners(world: BulletWorld) -> None:
    box(world, "table", Pose())
    obstacles = Obstacles(world)
    for gap, turned, free in ((0.001, 0.0, True), (-0.001, 0.0, False), (0.1, math.pi / 4, False),
                              (0.125, math.pi / 4, True)):  # fmt: skip
        base = Pose([0.6 + 0.3 + gap, 0.1, 0.0], yaw_quaternion(turned))
        assert (obstacles.overlapping(SQUARE, base) is None) is free, (gap, turned)


@pytest.mark.parametrize("yaw", [0.0, 0.5, math.pi / 4, -2.0])
def test_a_rotated_table_keeps_its_outline(world: BulletWorld, yaw: float) -> None:
    table = box(world, "table", Pose([2.0, -1.0, 0.0], yaw_quaternion(yaw)))
    obstacles = Obstacles(world)
    beside = table.pose @ Pose([0.0, 0.4 + 0.3 + 0.001, 0.0])
    assert obstacles.overlapping(SQUARE, beside) is None
    into = table.pose @ Pose([0.0, 0.4 + 0.3 - 0.001, 0.0])
    assert obstacles.overlapping(SQUARE, into) == ("table", "table")
    costmap = obstacles.costmap(Pose([2.0, -1.0, 0.0]), distance_m=0.3)
    for at, free in ((0.72, 1.0), (0.68, 0.0)):
        x, y, _ = (table.pose @ Pose([0.0, at, 0.0])).position
        assert costmap.value_at(x, y) == free


def test_an_empty_world_and_shapes_above_every_robot_have_no_outlines(world: BulletWorld) -> None:
    assert Obstacles(world).overlapping(SQUARE, Pose()) is None
    box(world, "lamp", Pose(), z=(2.1, 2.2))
    assert Obstacles(world).overlapping(SQUARE, Pose()) is None


def test_without_an_overlap_of_outlines_there_is_no_collision(world: BulletWorld) -> None:
    rng = random.Random(20261123)
    robot = Object("pr2", ObjectType.ROBOT, world=world)
    tables = [
        box(world, f"table {n}", Pose([rng.uniform(-2, 2), rng.uniform(-2, 2), 0], yaw_quaternion(rng.uniform(-3, 3))))
        for n in range(3)
    ]
    footprint, obstacles = footprint_of(robot, ["base_link"]), Obstacles(world)
    counts = [0, 0]
    for _ in range(400):
        base = Pose([rng.uniform(-3, 3), rng.uniform(-3, 3), 0], yaw_quaternion(rng.uniform(-3, 3)))
        robot.set_pose(base)
        hit = any(
            point[8] < -1e-3
            for table in tables
            for point in bullet.getClosestPoints(
                robot.body.number, table.body.number, 0.0, bullet.link_number(robot, "base_link"),
                physicsClientId=bullet.client_of(world),
            )
        )  # fmt: skip
        counts[hit] += 1
        overlapped = obstacles.overlapping(footprint, base) is not None
        deeper = obstacles.overlapping(Footprint((-0.32, 0.32), (-0.32, 0.32)), base) is not None
        assert overlapped or not hit
        assert hit or not deeper  # upright boxes have exact outlines
    assert min(counts) > 80


def test_many_bases_are_clear_where_each_alone_is(world: BulletWorld) -> None:
    rng = random.Random(4)
    footprint = Footprint((-0.3, 0.5), (-0.2, 0.2))
    assert Obstacles(world).clear(footprint, [Pose()]).tolist() == [True]
    for n in range(3):
        box(world, f"table {n}", Pose([rng.uniform(-2, 2), rng.uniform(-2, 2), 0], yaw_quaternion(rng.uniform(-3, 3))))
    obstacles = Obstacles(world)
    bases = [Pose([rng.uniform(-3, 3), rng.uniform(-3, 3), 0], yaw_quaternion(rng.uniform(-3, 3))) for _ in range(200)]
    alone = [obstacles.overlapping(footprint, each) is None for each in bases]
    assert obstacles.clear(footprint, bases).tolist() == alone
    assert min(alone.count(True), alone.count(False)) > 30


# === transparency =============================================================================================
#
# Transparent objects do not affect visibility: the same rays hit the same in a world without them.


def test_a_transparent_hand_in_front_of_an_object_does_not_hide_it(world: BulletWorld) -> None:
    """The rays pass a long way through the stretched arm and its load, and then into the counter."""
    Object("kitchen", ObjectType.ENVIRONMENT)
    cereal = Object("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.56, 1.022, 0.8]))
    eye = (0.65, 0.9455, 1.2573)
    without_hand = world.met_towards(cereal, eye)
    assert {None if each is None else each.name for each in without_hand} == {"cereal", "kitchen"}
    robot = Object("pr2", ObjectType.ROBOT, pose=Pose([0.6, 0.9, 0]))
    robot.set_joint_positions(solve(robot, Arms.LEFT, Pose([1.3, 1, 0.93])))
    milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.93]))
    assert world.met_towards(cereal, eye) != without_hand
    for _ in range(2):
        assert world.met_towards(cereal, eye, ignore={robot, milk}) == without_hand
    assert world.met_towards(cereal, eye, ignore={milk}) != without_hand
    world.remove(milk)
    assert world.met_towards(cereal, eye, ignore={robot, milk}) == without_hand
