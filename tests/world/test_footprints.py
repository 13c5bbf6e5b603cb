"""The outline of a base against the outlines of obstacles: exact for rotated boxes, and never free where Bullet
hits.
"""

from __future__ import annotations

import math
import random

import pytest

from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.models import box_urdf, pr2_mesh_urdf_path
from pycrorm_async.world.pose import yaw_quaternion
from pycrorm_async.world.queries import Footprint, Obstacles, footprint_of
from tests import bullet

SQUARE = Footprint((-0.3, 0.3), (-0.3, 0.3))


def box(world: BulletWorld, name: str, pose: Pose, *, z: tuple[float, float] = (0.0, 0.7)) -> Object:
    urdf = box_urdf(name, x=(-0.6, 0.6), y=(-0.4, 0.4), z=z)
    return Object(name, ObjectType.GENERIC_OBJECT, urdf, pose, world=world)


@pytest.mark.parametrize("mesh", [False, True])
def test_the_footprint_of_a_base_is_read_from_its_model(world: BulletWorld, mesh: bool) -> None:
    pose = Pose([1.0, 2.0, 0.0], yaw_quaternion(0.7))
    robot = Object("pr2", ObjectType.ROBOT, pr2_mesh_urdf_path() if mesh else None, pose, world=world)
    side = 0.334 if mesh else 0.325
    footprint = footprint_of(robot, ["base_link"])
    assert [*footprint.x, *footprint.y] == pytest.approx([-side, side, -side, side], abs=2e-4)
    assert footprint.inner_radius_m == pytest.approx(side, abs=2e-4)


def test_objects_on_the_base_widen_its_footprint(world: BulletWorld) -> None:
    robot = Object("pr2", ObjectType.ROBOT, world=world)
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
    for _ in range(2_000):
        base = Pose([rng.uniform(-3, 3), rng.uniform(-3, 3), 0], yaw_quaternion(rng.uniform(-3, 3)))
        robot.set_pose(base)
        hit = any(
            point[8] < -1e-3
            for table in tables
            for point in bullet.getClosestPoints(
                robot.body.number, table.body.number, 0.0, robot.body.link_number("base_link"),
                physicsClientId=world.client,
            )
        )  # fmt: skip
        counts[hit] += 1
        overlapped = obstacles.overlapping(footprint, base) is not None
        deeper = obstacles.overlapping(Footprint((-0.32, 0.32), (-0.32, 0.32)), base) is not None
        assert overlapped or not hit
        assert hit or not deeper  # upright boxes have exact outlines
    assert min(counts) > 400
