"""Costmaps agree in every cell with an independent computation, and list their best places in a fixed order."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pycrorm_async.world import (
    BulletWorld,
    Costmap,
    GaussianCostmap,
    Object,
    ObjectType,
    OccupancyCostmap,
    Pose,
    SemanticCostmap,
    VisibilityCostmap,
)
from pycrorm_async.world.bounding_boxes import BoundingBox
from pycrorm_async.world.pose import CostmapMismatch, UnknownLink, Vector, yaw_quaternion


def block(name: str, size: tuple[float, float, float], at: tuple[float, float, float], yaw: float = 0.0) -> Object:
    edges = " ".join(map(str, size))
    description = (
        f'<robot name="{name}"><link name="{name}"><collision><geometry><box size="{edges}"/></geometry>'
        "</collision></link></robot>"
    )
    return Object(name, ObjectType.GENERIC_OBJECT, description, Pose(at, yaw_quaternion(yaw)))


def middles(costmap: Costmap) -> list[tuple[int, int, float, float]]:
    """Return every cell with the x and y of its centre."""
    size, edge = len(costmap.map), costmap.resolution_m
    left = costmap.origin.position.x - size * edge / 2
    front = costmap.origin.position.y - size * edge / 2
    return [(i, j, left + (i + 0.5) * edge, front + (j + 0.5) * edge) for i in range(size) for j in range(size)]


def test_cells_inside_an_inflated_box_are_occupied_and_no_others(world: BulletWorld) -> None:
    block("table", (0.41, 0.83, 0.72), (0.5, 0.1, 0.36))
    block("post", (0.1, 0.1, 1.9), (-0.6, -0.7, 0.95), yaw=math.pi / 4)
    costmap = OccupancyCostmap(
        world, Pose([0.013, -0.021, 0]), distance_to_obstacle_m=0.25, size_cells=100, resolution_m=0.03
    )
    half = 0.05 * math.sqrt(2) + 0.25
    for i, j, x, y in middles(costmap):
        in_table = abs(x - 0.5) <= 0.205 + 0.25 and abs(y - 0.1) <= 0.415 + 0.25
        in_post = abs(x + 0.6) <= half and abs(y + 0.7) <= half
        assert costmap.map[i, j] == (0.0 if in_table or in_post else 1.0), (x, y)
    assert 0 < costmap.map.sum() < 100 * 100


def test_additional_boxes_count_as_obstacles(world: BulletWorld) -> None:
    kerb = BoundingBox(Vector(0.2, -0.1, 0.0), Vector(0.5, 0.3, 0.4))
    lamp = BoundingBox(Vector(-0.5, -0.5, 2.1), Vector(0.0, 0.0, 2.4))
    costmap = OccupancyCostmap(
        world, Pose(), distance_to_obstacle_m=0.25, size_cells=50, resolution_m=0.03, also=[kerb, lamp]
    )
    for i, j, x, y in middles(costmap):
        inside = -0.05 <= x <= 0.75 and -0.35 <= y <= 0.55
        assert costmap.map[i, j] == (0.0 if inside else 1.0), (x, y)


def test_the_value_at_a_point_is_that_of_its_cell_and_outside_the_map_it_is_zero(world: BulletWorld) -> None:
    costmap = Costmap(np.array([[0.1, 0.2], [0.3, 0.4]]), Pose([1.0, -2.0, 0]), resolution_m=0.5)
    inside = {(0.51, -2.49): 0.1, (0.99, -1.51): 0.2, (1.01, -2.01): 0.3, (1.49, -1.99): 0.4}
    assert {point: costmap.value_at(*point) for point in inside} == inside
    for point in ((0.49, -2.0), (1.51, -2.0), (1.0, -2.51), (1.0, -1.49)):
        assert costmap.value_at(*point) == 0.0


def test_the_links_of_an_object_count_one_by_one(world: BulletWorld) -> None:
    legs = "".join(
        f'<link name="leg{n}"><collision><geometry><box size="0.1 0.1 0.6"/></geometry></collision></link>'
        f'<joint name="j{n}" type="fixed"><parent link="frame"/><child link="leg{n}"/><origin xyz="{x} 0 0.3"/></joint>'
        for n, x in enumerate((-0.8, 0.8))
    )
    Object("trestles", ObjectType.GENERIC_OBJECT, f'<robot name="t"><link name="frame"/>{legs}</robot>')
    costmap = OccupancyCostmap(world, Pose(), distance_to_obstacle_m=0.2, size_cells=100)
    for i, j, x, y in middles(costmap):
        assert costmap.map[i, j] == (0.0 if abs(abs(x) - 0.8) <= 0.25 and abs(y) <= 0.25 else 1.0), (x, y)


def test_objects_that_are_too_high_too_low_or_ignored_are_no_obstacles(world: BulletWorld) -> None:
    free = OccupancyCostmap(world, Pose()).map
    lamp = block("lamp", (0.5, 0.5, 0.5), (0, 0, 2.26))
    block("cellar", (0.5, 0.5, 0.5), (0, 0, -0.251))
    robot = Object("pr2", ObjectType.ROBOT)
    held = block("held", (0.3, 0.3, 0.3), (0.3, 0, 1))
    robot.attach(held, "torso_lift_link")
    np.testing.assert_array_equal(OccupancyCostmap(world, Pose()).map, free)
    assert free.min() == 1.0
    assert OccupancyCostmap(world, Pose(), ignore=[robot]).map.min() == 0.0
    np.testing.assert_array_equal(OccupancyCostmap(world, Pose(), ignore=[robot, held]).map, free)
    lamp.set_pose(Pose([0, 0, 2.24]))
    assert OccupancyCostmap(world, Pose()).map.min() == 0.0


def test_obstacles_outside_the_map_or_across_its_edge_are_clipped(world: BulletWorld) -> None:
    block("far", (1, 1, 1), (10, 0, 0.5))
    block("near", (1, 1, 1), (-10, -10, 0.5))
    assert OccupancyCostmap(world, Pose()).map.min() == 1.0
    block("across", (1, 1, 1), (2, 2, 0.5))
    costmap = OccupancyCostmap(world, Pose(), distance_to_obstacle_m=0.0)
    cells = [(174, 199), (199, 174), (175, 175), (199, 199)]
    assert [costmap.map[cell] for cell in cells] == [1.0, 1.0, 0.0, 0.0]
    assert costmap.map.sum() == 200 * 200 - 25 * 25


def test_the_gaussian_decreases_with_the_distance_in_all_directions() -> None:
    costmap = GaussianCostmap(Pose([1, 2, 0]), sigma_cells=15, size_cells=201)
    assert costmap.map[100, 100] == 1.0
    for i, j in ((100, 115), (85, 100), (130, 60)):
        squared = (i - 100) ** 2 + (j - 100) ** 2
        assert costmap.map[i, j] == pytest.approx(math.exp(-squared / (2 * 15 * 15)))


def test_nothing_is_visible_from_behind_a_wall_and_only_high_objects_are_visible_over_it(world: BulletWorld) -> None:
    target = block("target", (0.1, 0.1, 0.1), (0, 0, 0.5))
    block("wall", (0.1, 10, 1.0), (0.5, 0, 0.5))
    costmap = VisibilityCostmap(world, target, min_height_m=0.6, max_height_m=1.8, size_cells=61, resolution_m=0.05)
    heights = [0.6, 0.9, 1.2, 1.5, 1.8]
    checked = {0.0: 0, 1.0: 0}
    for i, j, x, _ in middles(costmap):
        if abs(x - 0.5) < 0.06:
            continue
        # The ray from (x, h) to (0, 0.5) is at 0.5 + (h - 0.5) * s / x at the distance s in front of the target.
        seen = [not any(0.5 + (h - 0.5) * s / x < 1.0 for s in (0.45, 0.55)) if x > 0.5 else True for h in heights]
        assert costmap.map[i, j] == pytest.approx(sum(seen) / 5), x
        checked[0.0 if x > 0.5 else 1.0] += 1
    assert min(checked.values()) > 500
    assert {0.0, 1.0} < set(np.round(costmap.map.ravel(), 6).tolist())


def test_visibility_agrees_with_rays_through_bullet(world: BulletWorld) -> None:
    kitchen = Object("kitchen", ObjectType.ENVIRONMENT)
    kitchen.set_joint_position("kitchen_island_upper_drawer_joint", 0.2)
    milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
    block("pillar", (0.3, 0.2, 1.5), (0.5, 0.9, 0.75))
    costmap = VisibilityCostmap(
        world, milk, min_height_m=1.0, max_height_m=1.4, size_cells=60, resolution_m=0.1, origin=Pose()
    )
    centre = (1.3, 1.0, 0.909)
    agreed = 0
    cells = middles(costmap)
    for height in (1.0, 1.1, 1.2, 1.3, 1.4):
        met = world.ray_test([(x, y, height) for *_, x, y in cells], [centre] * len(cells))
        agreed += sum(hit is milk for hit in met)
    # A ray that begins inside a shape does not hit it, so that the two may differ in the cells of furniture.
    assert agreed / 5 == pytest.approx(costmap.map.sum(), rel=0.04)
    assert 0.2 < costmap.map.mean() < 0.95


def test_the_visibility_of_a_point_needs_no_object_there(world: BulletWorld) -> None:
    block("table", (1, 1, 0.5), (0, 0, 0.25))
    costmap = VisibilityCostmap(world, Pose([0, 0, 0.5]), min_height_m=1.0, max_height_m=1.5)
    assert costmap.map.min() == 1.0
    assert costmap.origin == Pose([0, 0, 0])
    below = VisibilityCostmap(world, Pose([0, 0, 0.4]), min_height_m=1.0, max_height_m=1.5)
    assert below.map.max() == 0.0


def test_the_top_of_a_link_has_the_value_one_everywhere_and_the_air_beside_it_zero(world: BulletWorld) -> None:
    shelf = block("shelf", (0.2, 0.5, 0.04), (1.0, 2.0, 0.9))
    costmap = SemanticCostmap(shelf, "shelf")
    assert costmap.map.shape == (25, 25)
    for i, j, x, y in middles(costmap):
        assert costmap.map[i, j] == (1.0 if abs(x - 1.0) <= 0.1 + 1e-9 and abs(y - 2.0) <= 0.25 else 0.0)
    best = costmap.best(10_000)
    assert len(best) == 11 * 25
    assert best[0].position == pytest.approx((1.0, 2.0, 0.92))
    assert {pose.position.z for pose in best} == {shelf.bounding_box().max.z}
    with pytest.raises(UnknownLink):
        SemanticCostmap(shelf, "drawer")


def test_the_best_cells_are_ordered_by_value_then_distance_to_the_origin_then_index() -> None:
    values = np.full((4, 4), 0.5)
    values[0, 0], values[3, 2], values[1, 1] = 0.9, 0.9, 0.0
    costmap = Costmap(values, Pose([10, 20, 3], yaw_quaternion(1.0)), resolution_m=1.0)
    best = costmap.best(5)
    assert [pose.position for pose in best] == [
        (11.5, 20.5, 3.0),
        (8.5, 18.5, 3.0),
        (9.5, 20.5, 3.0),
        (10.5, 19.5, 3.0),
        (10.5, 20.5, 3.0),
    ]
    assert {pose.orientation for pose in best} == {Pose([0, 0, 0], yaw_quaternion(1.0)).orientation}
    assert len(costmap.best(100)) == 15
    assert costmap.best(0) == []


def test_maps_multiply_cell_by_cell_if_place_size_and_resolution_are_the_same_and_are_read_only() -> None:
    first = Costmap(np.array([[0.5, 1.0], [0.0, 0.2]]), Pose([1, 1, 0]), resolution_m=0.1)
    second = Costmap(np.array([[0.5, 0.3], [1.0, 1.0]]), Pose([1, 1, 0]), resolution_m=0.1)
    np.testing.assert_allclose((first * second).map, [[0.25, 0.3], [0.0, 0.2]])
    assert (first * second).origin is first.origin
    with pytest.raises(ValueError, match="read-only"):
        first.map[0, 0] = 1.0
    for other in (
        Costmap(first.map, Pose([1, 0, 0]), resolution_m=0.1),
        Costmap(np.ones((3, 3)), first.origin, resolution_m=0.1),
        Costmap(first.map, first.origin, resolution_m=0.2),
    ):
        with pytest.raises(CostmapMismatch):
            first * other
