"""Where a robot can stand to open a drawer or a door by its handle, and to close it again.

What is tried is what `OpenAction` and `CloseAction` will do (`plan.accessing`): taking the handle where it is
closed, where it is open and where it is now, and following it all the way, with the torso as it is now and
within the limits of the chosen robot. Nothing is moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from pycrorm_async.plan.current_robot import CurrentRobot
from pycrorm_async.plan.geometry.articulation import Handle, closed_position, hand_poses, handle_of, opened_position
from pycrorm_async.plan.geometry.grasp_poses import approach
from pycrorm_async.plan.locations.base_poses import face, reaching_arms, resolve_robot
from pycrorm_async.plan.object_designators import ObjectLike
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.queries.bounding_boxes import BoundingBox, box_around
from pycrorm_async.world.queries.costmaps import Costmap, GaussianCostmap, OccupancyCostmap

__all__ = ["opening_poses"]

CLEARANCE_M = 0.4
CELLS_MAX = 600
HEADINGS = 8
CELL_M = 0.05
_CELLS = 80
_SIGMA_CELLS = 6.0  # 0.3 m, as for picking up
_SWEEP_STEPS = 10


def opening_poses(
    part: ObjectLike, robot: ObjectLike, arm: Arms | None
) -> Iterator[tuple[Pose, tuple[Arms, ...] | None]]:
    """Poses of the base, best first, each with the arms that can do it all from there; None if it will not do.

    First the places that what is opened does not sweep, facing the handle; then turned from that by each
    multiple of 45 degrees; then the same for the places that it does sweep.
    """
    handle, reacher = handle_of(part), resolve_robot(robot)
    there = handle.whole.link_pose_at(handle.link, {handle.joint: closed_position(handle)})
    goals = _goals(handle)
    for costmap in _costmaps(handle, there, reacher):
        cells = costmap.best(CELLS_MAX)
        for number in range(HEADINGS):
            for cell in cells:
                stand = face(cell, there, turned=number * math.tau / HEADINGS)
                yield stand, reaching_arms(reacher, arm, stand, lambda _: goals)


def _goals(handle: Handle) -> list[Pose]:
    """All that the tool frame has to reach; the ends first, for they are what most places fail at."""
    opened, closed, now = opened_position(handle), closed_position(handle), handle.position
    way = hand_poses(handle, opened, closed)
    ways = [*way[1:-1]]
    ends = [way[0], way[-1]]
    if now not in (opened, closed):
        from_here = hand_poses(handle, opened)
        ends.append(from_here[0])
        ways += [*from_here[1:], *hand_poses(handle, closed)[1:]]
    return [*ends, *(approach(each) for each in ends), *ways]


def _costmaps(handle: Handle, there: Pose, robot: CurrentRobot) -> Iterator[Costmap]:
    """Near the handle and clear of all that is there: first what is not swept, then what is."""
    world, origin = handle.whole.world, Pose((there.position.x, there.position.y, 0.0))
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
    yield unswept * near
    yield Costmap(free.map - unswept.map, origin, resolution_m=CELL_M) * near


def _swept(handle: Handle) -> Iterator[BoundingBox]:
    """The boxes that the links which move with the handle's joint have on its way."""
    whole, opened, closed = handle.whole, opened_position(handle), closed_position(handle)
    moving = [link for link in whole.links if handle.joint in whole.joints_above(link)]
    for number in range(_SWEEP_STEPS + 1):
        at = {handle.joint: closed + (opened - closed) * number / _SWEEP_STEPS}
        for link in moving:
            frame = whole.link_pose_at(link, at)
            box = box_around([((frame.position, frame.orientation), whole.body.solids[link])])
            if box is not None:
                yield box
