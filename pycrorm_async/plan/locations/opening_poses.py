"""Search base poses from which a robot can open a drawer or a door by its handle and close it again.

Each check uses the goals of `OpenAction` and `CloseAction` (`geometry.articulation`): grasping the handle in its
closed, open and current position, and following its whole path, with the torso as it is now and within the limits of
the chosen robot. Nothing is moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from pycrorm_async.plan.current_robot import CurrentRobot
from pycrorm_async.plan.execution.observer import Cells
from pycrorm_async.plan.geometry.articulation import Handle, closed_position, hand_poses, handle_of, opened_position
from pycrorm_async.plan.geometry.grasp_poses import approach
from pycrorm_async.plan.locations.base_clearance import base_clearance
from pycrorm_async.plan.locations.base_poses import (
    Reach,
    base_height_m,
    cells_of,
    face,
    reaching_arms,
    resolve_robot,
)
from pycrorm_async.plan.object_designators import ObjectLike
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.queries.bounding_boxes import BoundingBox, box_around
from pycrorm_async.world.queries.costmaps import Costmap, GaussianCostmap, OccupancyCostmap

CLEARANCE_M = 0.4
"""The distance in m of the base from obstacles."""
CELLS_MAX = 600
"""Bounds the cells that are tried, the best first."""
HEADINGS = 8
"""The headings that are tried at each cell, in equal steps from that which faces the handle."""
CELL_M = 0.05
"""The side of a cell in m."""
_CELLS = 80
"""The cells along each axis of the costmap: 4 m around the handle."""
_SIGMA_CELLS = 6.0  # 0.3 m, as for picking up
_SWEEP_STEPS = 10
"""The steps of the joint at which the space that the drawer or door sweeps is computed."""


def opening_poses(part: ObjectLike, robot: ObjectLike, arm: Arms | None) -> Iterator[tuple[Pose, Reach] | Cells]:
    """Yield the cells of the costmaps, then base poses, best first, each with the arms that reach every goal or none.

    Places that the opening part does not sweep come first, facing the handle and then rotated by each multiple of 45
    degrees; the places that it sweeps follow in the same order.
    """
    handle, reacher = handle_of(part), resolve_robot(robot)
    handle_pose = handle.whole.link_pose_at(handle.link, {handle.joint: closed_position(handle)})
    goals = _goals(handle)
    clearance, height_m = base_clearance([reacher]), base_height_m(reacher)
    free, *costmaps = _costmaps(handle, handle_pose, reacher)
    yield cells_of(free)
    for costmap in costmaps:
        cells = costmap.best(CELLS_MAX)
        for number in range(HEADINGS):
            for cell in cells:
                base_pose = face(cell, handle_pose, height_m=height_m, turned=number * math.tau / HEADINGS)
                collision = clearance.refusal(base_pose) if clearance is not None else None
                if collision is not None:
                    yield base_pose, Reach(refusal=collision)
                else:
                    yield base_pose, reaching_arms(reacher, arm, base_pose, lambda _: goals)


def _goals(handle: Handle) -> list[Pose]:
    """Return all goals of the tool frame; the ends of the path first, because most places fail at them."""
    opened, closed, current = opened_position(handle), closed_position(handle), handle.position
    path = hand_poses(handle, opened, closed)
    between = [*path[1:-1]]
    ends = [path[0], path[-1]]
    if current not in (opened, closed):
        from_current = hand_poses(handle, opened)
        ends.append(from_current[0])
        between += [*from_current[1:], *hand_poses(handle, closed)[1:]]
    return [*ends, *(approach(each) for each in ends), *between]


def _costmaps(handle: Handle, handle_pose: Pose, robot: CurrentRobot) -> tuple[Costmap, ...]:
    """Return a map of free places, and two of those near the handle: the moving part does not sweep them, or does."""
    world, origin = handle.whole.world, Pose((handle_pose.position.x, handle_pose.position.y, 0.0))
    near = GaussianCostmap(origin, sigma_cells=_SIGMA_CELLS, size_cells=_CELLS, resolution_m=CELL_M)
    free, unswept = (
        OccupancyCostmap(
            world,
            origin,
            distance_to_obstacle_m=CLEARANCE_M,
            size_cells=_CELLS,
            resolution_m=CELL_M,
            ignore=robot.with_load(),
            also=boxes,
        )
        for boxes in ((), list(_swept(handle)))
    )
    return free, unswept * near, Costmap(free.map - unswept.map, origin, resolution_m=CELL_M) * near


def _swept(handle: Handle) -> Iterator[BoundingBox]:
    """Yield the boxes that the links moved by the handle's joint occupy along its path."""
    whole, opened, closed = handle.whole, opened_position(handle), closed_position(handle)
    moving = [link for link in whole.links if handle.joint in whole.joints_above(link)]
    for number in range(_SWEEP_STEPS + 1):
        at = {handle.joint: closed + (opened - closed) * number / _SWEEP_STEPS}
        for link in moving:
            frame = whole.link_pose_at(link, at)
            box = box_around([((frame.position, frame.orientation), whole.body.solids[link])])
            if box is not None:
                yield box
