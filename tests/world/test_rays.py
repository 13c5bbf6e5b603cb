"""Rays hit the first object in their way, and an object is visible as far as no other one hides it."""

from __future__ import annotations

import math

import pytest

from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.world.fakes import CRANE


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
