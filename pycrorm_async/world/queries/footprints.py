"""Compare the outline of a robot's base, with its heading, with the outlines of obstacles, viewed from above.

An outline is the smallest rectangle around a shape with the heading of its link, so upright furniture keeps its exact
outline whatever its heading. Heights are not compared: a base counts as overlapping an outline even if it would fit
below or above the shape. A base that overlaps no outline collides with nothing.

>>> obstacles = Obstacles(world, ignore=[robot])
>>> obstacles.overlapping(footprint_of(robot, links), Pose([1.0, 0.7, 0.0]))
('kitchen', 'kitchen_counter')
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.pose import Pose, product, rotated, yaw_quaternion
from pycrorm_async.world.queries.bounding_boxes import BoundingBox, Solid, box_around
from pycrorm_async.world.queries.costmaps import Costmap, cell_steps, ignored_objects, is_obstacle

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.objects import Object

_ROUNDING_M = 1e-9
"""Outlines that overlap by less than this only touch."""


class Footprint(NamedTuple):
    """A rectangle on the floor in the axes of the robot's base link, m."""

    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def inner_radius_m(self) -> float:
        """The radius of the largest circle around the base link's origin inside the rectangle; 0 if it is outside."""
        return max(0.0, min(-self.x[0], self.x[1], -self.y[0], self.y[1]))


def footprint_of(robot: Object, links: Collection[str]) -> Footprint:
    """Return the smallest rectangle around these links, and around the objects that are attached to them.

    The links are taken at their current joint positions, from the shapes of the loaded model.
    """
    origin = robot.pose
    parts: list[tuple[Object, str]] = [(robot, link) for link in links]
    for child, link in robot.attachments.items():
        if (link or robot.body.base) in links:
            parts += [(child, each) for each in child.links]
    placed = []
    for whole, link in parts:
        if whole.body.solids[link]:
            frame = whole.link_pose(link).relative_to(origin)
            placed.append(((frame.position, frame.orientation), whole.body.solids[link]))
    box = box_around(placed)
    if box is None:
        return Footprint((0.0, 0.0), (0.0, 0.0))
    return Footprint((box.min.x, box.max.x), (box.min.y, box.max.y))


class Obstacles:
    """The outlines of all obstacles of a world as they are now.

    `ignore` defaults to the robot and the objects it carries. As in costmaps, a shape that begins above 2 m, or does
    not rise above the floor, is not an obstacle.
    """

    def __init__(self, world: BulletWorld, *, ignore: Iterable[Object] | None = None) -> None:
        ignored = ignored_objects(world, ignore)
        outlines = [
            (obj.name, link, heading, _outline(frame, solid, heading))
            for obj in world.objects
            if obj not in ignored
            for link, frame, heading in _shaped_links(obj)
            for solid in obj.body.solids[link]
        ]
        outlines = [each for each in outlines if is_obstacle(each[3])]
        self._names = [(name, link) for name, link, _, _ in outlines]
        self._headings = np.array([heading for _, _, heading, _ in outlines])
        lows = np.array([box.min[:2] for *_, box in outlines]).reshape(-1, 2)
        highs = np.array([box.max[:2] for *_, box in outlines]).reshape(-1, 2)
        self._half = (highs - lows) / 2
        self._middles = _turned((lows + highs) / 2, self._headings)

    def overlapping(self, footprint: Footprint, base: Pose) -> tuple[str, str] | None:
        """Return object and link of the first outline that a base at this pose overlaps; None if there is none."""
        half = np.array([footprint.x[1] - footprint.x[0], footprint.y[1] - footprint.y[0]]) / 2
        ahead = np.array([sum(footprint.x), sum(footprint.y)]) / 2
        middle = np.array(base.position[:2]) + _turned(ahead, np.array(base.yaw))
        away = self._middles - middle
        relative = self._headings - base.yaw
        cos, sin = np.abs(np.cos(relative))[:, None], np.abs(np.sin(relative))[:, None]
        # Two rectangles are apart if they are apart along one of the four directions of their sides.
        along_base = np.abs(_turned(away, np.array(-base.yaw))) - half - cos * self._half - sin * self._half[:, ::-1]
        along_outline = np.abs(_turned(away, -self._headings)) - self._half - cos * half - sin * half[::-1]
        overlaps = (np.maximum(along_base, along_outline) < -_ROUNDING_M).all(axis=1)
        return self._names[int(overlaps.argmax())] if overlaps.any() else None

    def costmap(self, origin: Pose, *, distance_m: float, size_cells: int = 200, resolution_m: float = 0.02) -> Costmap:
        """Return a costmap of 1 where a cell's middle is at least this far from every outline, 0 elsewhere."""
        values = np.ones((size_cells, size_cells))
        along = cell_steps(size_cells) * resolution_m
        for middle, half, heading in zip(self._middles, self._half, self._headings, strict=True):
            x, y = along[:, None] + origin.position.x - middle[0], along[None, :] + origin.position.y - middle[1]
            cos, sin = math.cos(heading), math.sin(heading)
            beside = np.maximum(np.abs(cos * x + sin * y) - half[0], 0.0)
            ahead = np.maximum(np.abs(cos * y - sin * x) - half[1], 0.0)
            values[np.hypot(beside, ahead) < max(distance_m, _ROUNDING_M)] = 0.0
        return Costmap(values, origin, resolution_m=resolution_m)


def _shaped_links(obj: Object) -> Iterator[tuple[str, Pose, float]]:
    for link in obj.links:
        if obj.body.solids[link]:
            frame = obj.link_pose(link)
            yield link, frame, frame.yaw


def _outline(frame: Pose, solid: Solid, heading: float) -> BoundingBox:
    """Return the box around the solid in axes that are turned by the heading about the map's origin."""
    back = yaw_quaternion(-heading)
    box = box_around([((rotated(back, frame.position), product(back, frame.orientation)), [solid])])
    assert box is not None, "the box around one solid"
    return box


def _turned(points: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate the points, shape (..., 2), about the origin."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = points[..., 0], points[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
