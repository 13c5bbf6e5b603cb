"""Compute the places around an object that are free for the robot's base and from which its camera sees the object.

The places are rectangles in the object's own frame.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.learning.policies.evidence import Rectangle, Region
from pycrorm_async.plan.current_robot import CurrentRobot
from pycrorm_async.plan.locations.base_clearance import base_clearance
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.queries.costmaps import Costmap, OccupancyCostmap, VisibilityCostmap

CLEARANCE_M = 0.3
"""Minimum distance between the middle of the robot's base and any obstacle, the thesis' value."""
REACH_M = 2.0
"""Half the side of the square of places around the object: the same as the range of the default policy."""
_RESOLUTION_M = 0.05
_CELLS = round(2 * REACH_M / _RESOLUTION_M)
_VISIBLE_SHARE_MIN = 0.5
"""The least share of the object that must be visible from a place."""


def free_and_visible(robot: CurrentRobot, target: Object) -> Region:
    """Return the places where the robot's base is clear of obstacles and its camera sees the object. Moves nothing.

    Where collisions count, the base is clear of the places outside with any heading; `MoveAndPickUp` checks the heading
    of each of its samples.
    """
    world, ignored = target.world, robot.with_load()
    ground = Pose((target.pose.position.x, target.pose.position.y, 0.0))
    low, high = robot.camera_heights_m()
    # The maps are not turned with the object, so the square in its frame needs up to √2 times the side: 1.5 is enough.
    size = {"size_cells": 2 * round(0.75 * _CELLS), "resolution_m": _RESOLUTION_M}
    clearance = base_clearance([robot])
    free = (
        OccupancyCostmap(world, ground, distance_to_obstacle_m=CLEARANCE_M, ignore=ignored, **size)  # type: ignore[arg-type]
        if clearance is None
        else clearance.costmap(ground, **size)  # type: ignore[arg-type]
    )
    visible = VisibilityCostmap(
        world,
        target,
        min_height_m=low,
        max_height_m=high,
        origin=ground,
        ignore=ignored,
        **size,  # type: ignore[arg-type]
    )
    middles = (np.arange(_CELLS) + 0.5) * _RESOLUTION_M - REACH_M
    places = _values(free, target.pose.yaw, middles) > 0
    places &= _values(visible, target.pose.yaw, middles) >= _VISIBLE_SHARE_MIN
    return Region(tuple(rectangles(places)))


def _values(costmap: Costmap, yaw: float, middles: NDArray[np.floating]) -> NDArray[np.float64]:
    """Sample the map at the cells of a grid that is turned by `yaw` about the map's origin."""
    x, y = np.meshgrid(middles, middles, indexing="ij")
    turned = (np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y)
    row, column = (np.floor(each / costmap.resolution_m + costmap.size_cells / 2).astype(int) for each in turned)
    return np.asarray(costmap.map[row, column])


def rectangles(cells: NDArray[np.bool_]) -> Iterator[Rectangle]:
    """Cover the true cells with disjoint rectangles; equal runs along y in consecutive rows become one rectangle."""
    open_runs: dict[tuple[int, int], int] = {}
    for row in range(len(cells) + 1):
        runs = set(_runs(cells[row])) if row < len(cells) else set()
        for run in [each for each in open_runs if each not in runs]:
            yield _rectangle(open_runs.pop(run), row, run)
        for run in runs:
            open_runs.setdefault(run, row)


def _runs(cells: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the start and the end (exclusive) of each run of true cells."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], cells, [False]])))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def _rectangle(first_row: int, end_row: int, run: tuple[int, int]) -> Rectangle:
    return Rectangle(*(each * _RESOLUTION_M - REACH_M for each in (first_row, end_row, *run)))
