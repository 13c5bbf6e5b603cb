"""The kitchen agrees with its drawing, its doors and drawers move, and its objects can be reached."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pycrorm_async.world import BulletWorld, JointType, Object, ObjectType, OccupancyCostmap, Pose
from pycrorm_async.world.pose import JointLimitExceeded, rotated


@pytest.fixture
def kitchen(world: BulletWorld) -> Object:
    return Object("kitchen", ObjectType.ENVIRONMENT)


def cereal_and_milk() -> tuple[Object, Object]:
    return (
        Object("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.3, 0.7, 0.95])),
        Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9])),
    )


@pytest.mark.parametrize(
    ("surface", "low", "high"),
    [
        ("kitchen_counter_surface", (1.05, -0.55, 0.808), (1.65, 0.85, 0.848)),
        ("sink_area_surface", (1.05, 0.85, 0.772), (1.65, 1.75, 0.812)),
        ("kitchen_island_surface", (-1.80, 0.20, 0.860), (-1.10, 1.80, 0.900)),
    ],
)
def test_surfaces_are_where_the_drawing_has_them_with_their_frame_on_top(
    kitchen: Object, surface: str, low: tuple[float, ...], high: tuple[float, ...]
) -> None:
    np.testing.assert_allclose(kitchen.bounding_box(surface), [low, high], atol=1e-9)
    middle = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[2])
    np.testing.assert_allclose(kitchen.link_pose(surface).position, middle, atol=1e-9)


def test_cereal_and_milk_of_the_thesis_are_on_the_worktops(kitchen: Object) -> None:
    cereal, milk = cereal_and_milk()
    for packet, surface in ((cereal, "kitchen_counter_surface"), (milk, "sink_area_surface")):
        box, top = packet.bounding_box(), kitchen.bounding_box(surface)
        assert box.min.z == pytest.approx(top.max.z, abs=1e-9)
        assert top.min[:2] < box.min[:2]
        assert box.max[:2] < top.max[:2]


def test_the_floor_is_free_at_the_robots_start_and_at_the_targets_of_the_thesis(
    world: BulletWorld, kitchen: Object
) -> None:
    cereal_and_milk()
    for place in ([0.0, 0.0, 0.0], [0.6, 0.4, 0.0]):
        middle = OccupancyCostmap(world, Pose(place), size_cells=2).map
        np.testing.assert_array_equal(middle, np.ones((2, 2)))


DRAWERS = (
    "kitchen_counter_upper_drawer",
    "kitchen_counter_lower_drawer",
    "sink_area_drawer",
    "kitchen_island_upper_drawer",
    "kitchen_island_lower_drawer",
)


@pytest.mark.parametrize("drawer", DRAWERS)
def test_a_drawer_slides_towards_the_base_pose_in_front_of_it(kitchen: Object, drawer: str) -> None:
    joint, handle = f"{drawer}_joint", f"{drawer}_handle"
    assert kitchen.joint_type(joint) is JointType.PRISMATIC
    assert kitchen.joint_limits(joint) == (0.0, 0.35)
    assert kitchen.joints_above(handle) == (joint,)
    closed = kitchen.link_pose(handle)
    into = rotated(closed.orientation, (1, 0, 0))
    assert into.x == pytest.approx(-1.0 if "island" in drawer else 1.0)
    kitchen.set_joint_position(joint, 0.35)
    opened = kitchen.link_pose(handle)
    np.testing.assert_allclose(opened.position, np.array(closed.position) - 0.35 * np.array(into), atol=1e-9)
    assert opened.orientation == pytest.approx(closed.orientation)
    for beyond in (-0.01, 0.36):
        with pytest.raises(JointLimitExceeded, match=joint):
            kitchen.set_joint_position(joint, beyond)


def test_an_object_in_an_open_drawer_is_visible_from_above_and_moves_along(world: BulletWorld, kitchen: Object) -> None:
    kitchen.set_joint_position("kitchen_counter_upper_drawer_joint", 0.35)
    inside = kitchen.link_pose("kitchen_counter_upper_drawer").position
    spoon = Object("spoon", ObjectType.SPOON, pose=Pose([inside.x + 0.15, inside.y, inside.z + 0.03]))
    eye = (inside.x, inside.y, 1.4)
    assert world.visible(spoon, eye) == 1.0
    kitchen.attach(spoon, "kitchen_counter_upper_drawer")
    kitchen.set_joint_position("kitchen_counter_upper_drawer_joint", 0.0)
    assert spoon.pose.position == pytest.approx((inside.x + 0.5, inside.y, inside.z + 0.03), abs=1e-9)
    assert world.visible(spoon, eye) == 0.0


def test_the_fridge_door_rotates_into_the_room_about_its_right_edge(kitchen: Object) -> None:
    joint, handle = "fridge_door_joint", "fridge_door_handle"
    assert kitchen.joint_type(joint) is JointType.REVOLUTE
    assert kitchen.joint_limits(joint) == (0.0, 1.9)
    assert kitchen.link_pose(handle).position == pytest.approx((0.95, -0.66, 0.95), abs=1e-9)
    kitchen.set_joint_position(joint, math.pi / 2)
    assert kitchen.link_pose(handle).position == pytest.approx((1.05 - 0.59, -1.25 - 0.10, 0.95), abs=1e-9)
