"""Costmaps rate positions on the floor or on a surface: square grids of values in [0, 1] that can be multiplied.

>>> ground = Pose([1.3, 0.7, 0.0])
>>> places = OccupancyCostmap(world, ground) * GaussianCostmap(ground)
>>> places.best(1)[0].distance(Pose([0.69, 0.75, 0.0])) < 1e-9
True

`map[i, j]` is the cell whose middle is i + 0.5 - size/2 cells along x and j + 0.5 - size/2 along y from the origin. The
grid is aligned with the axes of "map" whatever the origin's orientation. Maps are deterministic. Obstacles are the
boxes around links, so a map may mark free cells as occupied but not the reverse. As in the thesis' system, cells are
2 cm wide by default.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.errors import CostmapMismatch
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, Vector
from pycrorm_async.world.queries.bounding_boxes import BoundingBox
from pycrorm_async.world.robots.acting_robot import acting_robot

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld

Map = NDArray[np.float64]
_TALLEST_M = 2.0  # boxes that begin above this height are above every robot
_ROUNDING = 1e-9
"""Tolerates the rounding of coordinates in cells."""


class Costmap:
    """A square grid of values; 0 excludes a cell, 1 is best.

    Attributes:
        map: values in [0, 1], shape (size, size), read-only.
        origin: the middle of the square; poses from `best` have its height and orientation.
        resolution_m: the edge length of a cell, m.
    """

    def __init__(self, values: Map, origin: Pose, *, resolution_m: float) -> None:
        self.map = np.array(values, dtype=np.float64)
        self.map.setflags(write=False)
        self.origin = origin
        self.resolution_m = resolution_m

    @property
    def size_cells(self) -> int:
        """Number of cells along an edge."""
        return len(self.map)

    def __mul__(self, other: Costmap) -> Costmap:
        """Multiply cell by cell. Raises `CostmapMismatch` unless origin, size and resolution are the same."""
        mine = (self.origin.position, self.size_cells, self.resolution_m)
        theirs = (other.origin.position, other.size_cells, other.resolution_m)
        if mine != theirs:
            raise CostmapMismatch(f"cannot multiply costmaps {mine} and {theirs} (origin, cells, m per cell)")
        return Costmap(self.map * other.map, self.origin, resolution_m=self.resolution_m)

    def value_at(self, x: float, y: float) -> float:
        """Return the value of the cell that contains the point; 0 outside the square."""
        middle = self.origin.position
        row = math.floor((x - middle.x) / self.resolution_m + self.size_cells / 2)
        column = math.floor((y - middle.y) / self.resolution_m + self.size_cells / 2)
        if not (0 <= row < self.size_cells and 0 <= column < self.size_cells):
            return 0.0
        return float(self.map[row, column])

    def best(self, count_max: int) -> list[Pose]:
        """Return the middles of the best cells, the highest value first; cells of value 0 are left out.

        Cells of equal value are ordered by their distance from the origin, then by x, then by y.
        """
        return list(islice(self.ranked(), count_max))

    def ranked(self, *, every: int = 1) -> Iterator[Pose]:
        """Yield the middle of each cell, or of one cell in `every`, in the order of `best`.

        Poses are made one by one: those of a whole map take 0.3 s, and most searches end at an early one.
        """
        values = self.map.ravel()
        steps = cell_steps(self.size_cells)
        distance = (steps[:, None] ** 2 + steps[None, :] ** 2).ravel()
        order = np.lexsort((distance, -values))
        rows, columns = np.divmod(order[values[order] > 0][::every], self.size_cells)
        x, y, z = self.origin.position
        middles = zip(
            (x + steps[rows] * self.resolution_m).tolist(),
            (y + steps[columns] * self.resolution_m).tolist(),
            strict=True,
        )
        for place_x, place_y in middles:
            yield Pose((place_x, place_y, z), self.origin.orientation)


class OccupancyCostmap(Costmap):
    """1 where the floor is free, 0 where a link's box, grown sideways by the distance, covers the cell's middle.

    A box that begins above 2 m, or does not rise above the floor, is not an obstacle. `ignore` defaults to the robot
    and the objects it carries; `also` holds additional boxes, for example of an open door.
    """

    def __init__(
        self,
        world: BulletWorld,
        origin: Pose,
        *,
        distance_to_obstacle_m: float = 0.32,
        size_cells: int = 200,
        resolution_m: float = 0.02,
        ignore: Iterable[Object] | None = None,
        also: Iterable[BoundingBox] = (),
    ) -> None:
        values = np.ones((size_cells, size_cells))
        for box in (*_obstacles(world, ignore), *filter(is_obstacle, also)):
            cells = _cells(box, origin, size_cells, resolution_m, grown_m=distance_to_obstacle_m)
            values[cells] = 0.0
        super().__init__(values, origin, resolution_m=resolution_m)


class GaussianCostmap(Costmap):
    """1 at the origin, decreasing with the distance like a normal density of width `sigma_cells`."""

    def __init__(
        self, origin: Pose, *, sigma_cells: float = 15.0, size_cells: int = 200, resolution_m: float = 0.02
    ) -> None:
        along = np.exp(-0.5 * (cell_steps(size_cells) / sigma_cells) ** 2)
        super().__init__(np.outer(along, along), origin, resolution_m=resolution_m)


class VisibilityCostmap(Costmap):
    """The share of five evenly spaced camera heights above each cell from which the target's middle is visible.

    Obstacles are the boxes around the links of all objects except the target and those in `ignore`, which defaults to
    the robot and the objects it carries. The origin defaults to the point on the floor below the target.
    """

    def __init__(
        self,
        world: BulletWorld,
        target: Object | Pose,
        *,
        min_height_m: float,
        max_height_m: float,
        origin: Pose | None = None,
        size_cells: int = 200,
        resolution_m: float = 0.02,
        ignore: Iterable[Object] | None = None,
    ) -> None:
        target_point = target.bounding_box().centre if isinstance(target, Object) else target.position
        origin = origin if origin is not None else Pose((target_point.x, target_point.y, 0.0))
        ignored = ignored_objects(world, ignore) | ({target} if isinstance(target, Object) else set())
        boxes = list(_obstacles(world, ignored))
        x = origin.position.x + cell_steps(size_cells)[:, None] * resolution_m
        y = origin.position.y + cell_steps(size_cells)[None, :] * resolution_m
        heights = np.linspace(min_height_m, max_height_m, 5)
        visible = [~_hidden(x, y, float(height), target_point, boxes) for height in heights]
        super().__init__(np.mean(visible, axis=0), origin, resolution_m=resolution_m)


class SemanticCostmap(Costmap):
    """1 on top of a link's box, 0 outside it; the origin is the middle of the top, so poses lie on the surface.

    The square's edge is the longer side of the surface.
    """

    def __init__(self, obj: Object, link: str, *, resolution_m: float = 0.02) -> None:
        box = obj.bounding_box(link)
        origin = Pose((box.centre.x, box.centre.y, box.max.z))
        size_cells = max(1, math.ceil(max(box.size.x, box.size.y) / resolution_m - _ROUNDING))
        values = np.zeros((size_cells, size_cells))
        values[_cells(box, origin, size_cells, resolution_m)] = 1.0
        super().__init__(values, origin, resolution_m=resolution_m)


def cell_steps(size_cells: int) -> Map:
    """Return the distances of the cells' middles from the origin along one axis, in cells."""
    return np.arange(size_cells, dtype=np.float64) + (0.5 - size_cells / 2)


def _cells(
    box: BoundingBox, origin: Pose, size_cells: int, resolution_m: float, *, grown_m: float = 0.0
) -> tuple[slice, slice]:
    """Return the cells whose middles lie inside the box or on its edge, viewed from above."""
    slices = []
    for low, high, middle in zip(box.min[:2], box.max[:2], origin.position[:2], strict=True):
        first = (low - grown_m - middle) / resolution_m + size_cells / 2 - 0.5
        last = (high + grown_m - middle) / resolution_m + size_cells / 2 - 0.5
        slices.append(slice(max(0, math.ceil(first - _ROUNDING)), max(0, math.floor(last + _ROUNDING) + 1)))
    return slices[0], slices[1]


def _obstacles(world: BulletWorld, ignore: Iterable[Object] | None) -> Iterator[BoundingBox]:
    """Yield the boxes of all links that are obstacles."""
    ignored = ignored_objects(world, ignore)
    for obj in world.objects:
        if obj not in ignored:
            for link in obj.links:
                box = obj.bounding_box(link)
                if is_obstacle(box):
                    yield box


def is_obstacle(box: BoundingBox) -> bool:
    """Return whether a box rises above the floor, begins at most 2 m above it, and has a size."""
    return any(box.size) and box.max.z > 0.0 and box.min.z < _TALLEST_M


def ignored_objects(world: BulletWorld, ignore: Iterable[Object] | None) -> set[Object]:
    """Return the objects to ignore as obstacles; None means the robot and the objects it carries."""
    if ignore is not None:
        return set(ignore)
    robot = acting_robot(world)
    return set() if robot is None else {robot, *world.attachments.below(robot)}


def _hidden(x: Map, y: Map, height: float, target: Vector, boxes: Iterable[BoundingBox]) -> NDArray[np.bool_]:
    """Return for every cell whether a box intersects the segment from (x, y, height) to the target."""
    hidden = np.zeros(np.broadcast_shapes(x.shape, y.shape), dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        for box in boxes:
            enter, leave = np.zeros(1), np.ones(1)
            eye = (x, y, np.full(1, height))
            for start, end, low, high in zip(eye, target, box.min, box.max, strict=True):
                way = end - start
                to_low, to_high = (low - start) / way, (high - start) / way
                # A segment parallel to the faces gives 0/0: it is between them exactly if its start is.
                inside = (start > low) & (start < high)
                near = np.where(way == 0, np.where(inside, -np.inf, np.inf), np.minimum(to_low, to_high))
                far = np.where(way == 0, np.where(inside, np.inf, -np.inf), np.maximum(to_low, to_high))
                enter, leave = np.maximum(enter, near), np.minimum(leave, far)
            hidden |= leave - enter > _ROUNDING
    return hidden
