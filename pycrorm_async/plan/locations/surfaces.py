"""Find poses for an object on a surface: the middle first, then all over the surface in a fixed random order."""

from __future__ import annotations

import random
from collections.abc import Iterator

from pycrorm_async.plan.execution.observer import Refusal
from pycrorm_async.plan.motions.robot_choice import collisions_count
from pycrorm_async.plan.object_designators import ObjectLike, in_world
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, Quaternion, Vector, yaw_quaternion
from pycrorm_async.world.queries.bounding_boxes import BoundingBox, box_around

STEP_M = 0.02
"""The distance in m between two candidates along each axis."""
_POINT = BoundingBox(Vector(0.0, 0.0, 0.0), Vector(0.0, 0.0, 0.0))


def surface_poses(link: str, whole: ObjectLike, obj: ObjectLike | None) -> Iterator[Pose | Refusal]:
    """Yield poses for `obj` on top of the link, with the link's heading, and refusals of occupied places."""
    support = in_world(whole)
    obj_to_put = in_world(obj) if obj is not None else None
    heading = yaw_quaternion(support.link_pose(link).yaw)
    extent = _extent(obj_to_put, heading) if obj_to_put is not None else _POINT
    surface = support.bounding_box(link)
    z = surface.max.z - extent.min.z
    occupied = [
        (each.name, each.bounding_box())
        for each in support.world.objects
        if each is not support and not _moves_along(each, obj_to_put)
    ]
    if collisions_count():
        others = (each for each in support.links if each != link and support.body.solids[each])
        occupied += [(each, support.bounding_box(each)) for each in others]
    for x, y in _grid_points(surface, extent):
        placed_box = _translate(extent, x, y, z)
        pose = Pose((x, y, z), heading)
        obstacles = (name for name, box in occupied if obj_to_put is not None and _overlap(placed_box, box))
        obstacle = next(obstacles, None)
        yield pose if obstacle is None else Refusal(pose, f"{obstacle} is in the way")


def _grid_points(surface: BoundingBox, extent: BoundingBox) -> Iterator[tuple[float, float]]:
    """Yield the points at which a box of that extent stays on the surface; only the middle if it is too large."""
    ranges = []
    for low, high, below, above in zip(surface.min[:2], surface.max[:2], extent.min[:2], extent.max[:2], strict=True):
        middle = (low - below + high - above) / 2
        steps = int(max(0.0, (high - above) - (low - below)) / 2 / STEP_M)
        ranges.append([middle + STEP_M * step for step in range(-steps, steps + 1)])
    middle_point = (ranges[0][len(ranges[0]) // 2], ranges[1][len(ranges[1]) // 2])
    yield middle_point
    points = [(x, y) for x in ranges[0] for y in ranges[1] if (x, y) != middle_point]
    random.Random(0).shuffle(points)  # noqa: S311  a fixed seed: the order is random but reproducible
    yield from points


def _extent(obj: Object, turn: Quaternion) -> BoundingBox:
    """Return the object's box at the origin with this rotation, independent of its current pose."""
    pose = obj.pose
    placed = []
    for link in obj.links:
        frame = Pose((0.0, 0.0, 0.0), turn) @ obj.link_pose(link).relative_to(pose)
        placed.append(((frame.position, frame.orientation), obj.body.solids[link]))
    return box_around(placed) or _POINT


def _translate(box: BoundingBox, x: float, y: float, z: float) -> BoundingBox:
    return BoundingBox(
        Vector(box.min.x + x, box.min.y + y, box.min.z + z), Vector(box.max.x + x, box.max.y + y, box.max.z + z)
    )


def _overlap(a: BoundingBox, b: BoundingBox) -> bool:
    """Return whether the boxes share more than a face."""
    return all(
        low + 1e-6 < high and other + 1e-6 < over
        for low, high, other, over in zip(a.min, b.max, b.min, a.max, strict=True)
    )


def _moves_along(each: Object, obj_to_put: Object | None) -> bool:
    """Return whether `each` is the object to place, carries it, or is carried by it, and so is no obstacle."""
    if obj_to_put is None:
        return False
    chain = {obj_to_put}
    above = obj_to_put.attached_to
    while above is not None:
        chain.add(above)
        above = above.attached_to
    below: Object | None = each
    while below is not None:
        if below in chain:
            return True
        below = below.attached_to
    return False
