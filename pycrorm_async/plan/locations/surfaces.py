"""Where on a surface a thing can be put: the middle first, then everywhere in a fixed, scattered order."""

from __future__ import annotations

import random
from collections.abc import Iterator

from pycrorm_async.plan.object_designators import ObjectLike, in_world
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, Quaternion, Vector, yaw_quaternion
from pycrorm_async.world.queries.bounding_boxes import BoundingBox, box_around

__all__ = ["surface_poses"]

STEP_M = 0.02
_POINT = BoundingBox(Vector(0.0, 0.0, 0.0), Vector(0.0, 0.0, 0.0))


def surface_poses(link: str, whole: ObjectLike, thing: ObjectLike | None) -> Iterator[Pose | None]:
    """Poses for `thing` on top of the link, turned as the link is; None for a place where something is already."""
    support = in_world(whole)
    put = in_world(thing) if thing is not None else None
    heading = yaw_quaternion(support.link_pose(link).yaw)
    extent = _extent(put, heading) if put is not None else _POINT
    surface = support.bounding_box(link)
    z = surface.max.z - extent.min.z
    occupied = [
        each.bounding_box() for each in support.world.objects if each is not support and not _moves_along(each, put)
    ]
    for x, y in _grid_points(surface, extent):
        there = _translate(extent, x, y, z)
        if put is not None and any(_overlap(there, box) for box in occupied):
            yield None
        else:
            yield Pose((x, y, z), heading)


def _grid_points(surface: BoundingBox, extent: BoundingBox) -> Iterator[tuple[float, float]]:
    """Points at which a thing of that extent does not stick out; only the middle, if it does everywhere."""
    ranges = []
    for low, high, below, above in zip(surface.min[:2], surface.max[:2], extent.min[:2], extent.max[:2], strict=True):
        middle = (low - below + high - above) / 2
        steps = int(max(0.0, (high - above) - (low - below)) / 2 / STEP_M)
        ranges.append([middle + STEP_M * step for step in range(-steps, steps + 1)])
    middle_point = (ranges[0][len(ranges[0]) // 2], ranges[1][len(ranges[1]) // 2])
    yield middle_point
    points = [(x, y) for x in ranges[0] for y in ranges[1] if (x, y) != middle_point]
    random.Random(0).shuffle(points)  # noqa: S311  the order is to be scattered, and the same every time
    yield from points


def _extent(thing: Object, turn: Quaternion) -> BoundingBox:
    """The box it would take at the origin, turned so; wherever and however it is now."""
    here = thing.pose
    placed = []
    for link in thing.links:
        frame = Pose((0.0, 0.0, 0.0), turn) @ thing.link_pose(link).relative_to(here)
        placed.append(((frame.position, frame.orientation), thing.body.solids[link]))
    return box_around(placed) or _POINT


def _translate(box: BoundingBox, x: float, y: float, z: float) -> BoundingBox:
    return BoundingBox(
        Vector(box.min.x + x, box.min.y + y, box.min.z + z), Vector(box.max.x + x, box.max.y + y, box.max.z + z)
    )


def _overlap(a: BoundingBox, b: BoundingBox) -> bool:
    """Whether they share more than a face."""
    return all(
        low + 1e-6 < high and other + 1e-6 < over
        for low, high, other, over in zip(a.min, b.max, b.min, a.max, strict=True)
    )


def _moves_along(each: Object, put: Object | None) -> bool:
    """Whether it is the thing itself, what carries it, or what it carries: that will be gone or come along."""
    if put is None:
        return False
    chain = {put}
    above = put.attached_to
    while above is not None:
        chain.add(above)
        above = above.attached_to
    below: Object | None = each
    while below is not None:
        if below in chain:
            return True
        below = below.attached_to
    return False
