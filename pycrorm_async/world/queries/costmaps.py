"""Where is a good place: square grids of values in [0, 1] over the floor or a surface, to be multiplied and asked.

>>> ground = Pose([1.3, 0.7, 0.0])
>>> places = OccupancyCostmap(world, ground) * GaussianCostmap(ground)
>>> places.best(1)[0].distance(Pose([0.69, 0.75, 0.0])) < 1e-9
True

`map[i, j]` is the cell whose middle is i + 0.5 - size/2 cells along x and j + 0.5 - size/2 along y from the origin. The
grid lies along the axes of "map", however the origin is turned. The same world gives the same map. Obstacles are the
boxes around links, so the maps err on the side of the obstacle. As in the thesis' system, cells are 2 cm by default.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.errors import CostmapMismatch
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, Vector
from pycrorm_async.world.queries.bounding_boxes import BoundingBox

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld

__all__ = ["Costmap", "OccupancyCostmap", "GaussianCostmap", "VisibilityCostmap", "SemanticCostmap"]

Map = NDArray[np.float64]
_TALLEST_M = 2.0  # what begins above this is over every robot's head
_ROUNDING = 1e-9


class Costmap:
    """A square of values; 0 is out of the question, 1 is best.

    Attributes:
        map: (size, size) values in [0, 1], read-only.
        origin: the middle of the square; its height and its orientation are those of the poses given.
        resolution_m: the edge of a cell.
    """

    def __init__(self, values: Map, origin: Pose, *, resolution_m: float) -> None:
        self.map = np.array(values, dtype=np.float64)
        self.map.setflags(write=False)
        self.origin = origin
        self.resolution_m = resolution_m

    @property
    def size_cells(self) -> int:
        """Cells along an edge."""
        return len(self.map)

    def __mul__(self, other: Costmap) -> Costmap:
        """Cell by cell; raises `CostmapMismatch` unless origin, size and resolution are the same."""
        mine = (self.origin.position, self.size_cells, self.resolution_m)
        theirs = (other.origin.position, other.size_cells, other.resolution_m)
        if mine != theirs:
            raise CostmapMismatch(f"maps at {mine} and {theirs} (origin, cells, metres a cell) do not fit")
        return Costmap(self.map * other.map, self.origin, resolution_m=self.resolution_m)

    def value_at(self, x: float, y: float) -> float:
        """The value of the cell in which the point lies; 0 outside the square."""
        middle = self.origin.position
        row = math.floor((x - middle.x) / self.resolution_m + self.size_cells / 2)
        column = math.floor((y - middle.y) / self.resolution_m + self.size_cells / 2)
        if not (0 <= row < self.size_cells and 0 <= column < self.size_cells):
            return 0.0
        return float(self.map[row, column])

    def best(self, count_max: int) -> list[Pose]:
        """The middles of the best cells, the highest value first, those of value 0 never.

        Cells of one value come by their distance from the origin, then by x, then by y.
        """
        values = self.map.ravel()
        steps = _steps(self.size_cells)
        distance = (steps[:, None] ** 2 + steps[None, :] ** 2).ravel()
        order = np.lexsort((distance, -values))[:count_max]
        chosen = order[values[order] > 0]
        rows, columns = np.divmod(chosen, self.size_cells)
        x, y, z = self.origin.position
        return [
            Pose((place_x, place_y, z), self.origin.orientation)
            for place_x, place_y in zip(
                (x + steps[rows] * self.resolution_m).tolist(),
                (y + steps[columns] * self.resolution_m).tolist(),
                strict=True,
            )
        ]


class OccupancyCostmap(Costmap):
    """1 where the floor is free, 0 where a link's box, grown sideways by the distance, covers the cell's middle.

    What begins above 2 m or does not rise above the floor is no obstacle. Left out, `ignore` is the robot and what it
    carries; `also` are boxes to stay clear of although nothing is there now.
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
        for box in (*_obstacles(world, ignore), *filter(_in_the_way, also)):
            cells = _cells(box, origin, size_cells, resolution_m, grown_m=distance_to_obstacle_m)
            values[cells] = 0.0
        super().__init__(values, origin, resolution_m=resolution_m)


class GaussianCostmap(Costmap):
    """Falls off from 1 at the origin with the distance, as a normal density of that width does."""

    def __init__(
        self, origin: Pose, *, sigma_cells: float = 15.0, size_cells: int = 200, resolution_m: float = 0.02
    ) -> None:
        along = np.exp(-0.5 * (_steps(size_cells) / sigma_cells) ** 2)
        super().__init__(np.outer(along, along), origin, resolution_m=resolution_m)


class VisibilityCostmap(Costmap):
    """From which share of the heights between two limits the middle of the target can be seen above each cell.

    Five heights, evenly spaced. What is in the way are the boxes around the links of all objects but the target and
    those in `ignore` (left out: the robot and what it carries). The origin, left out, is on the floor below the target.
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
        seen = target.bounding_box().centre if isinstance(target, Object) else target.position
        origin = origin if origin is not None else Pose((seen.x, seen.y, 0.0))
        ignored = _or_robot(world, ignore) | ({target} if isinstance(target, Object) else set())
        boxes = list(_obstacles(world, ignored))
        x = origin.position.x + _steps(size_cells)[:, None] * resolution_m
        y = origin.position.y + _steps(size_cells)[None, :] * resolution_m
        heights = np.linspace(min_height_m, max_height_m, 5)
        free = [~_hidden(x, y, float(height), seen, boxes) for height in heights]
        super().__init__(np.mean(free, axis=0), origin, resolution_m=resolution_m)


class SemanticCostmap(Costmap):
    """1 on top of a link's box, 0 beside it; the origin is the middle of the top, so poses lie on the surface.

    As large as the surface's longer side.
    """

    def __init__(self, thing: Object, link: str, *, resolution_m: float = 0.02) -> None:
        box = thing.bounding_box(link)
        origin = Pose((box.centre.x, box.centre.y, box.max.z))
        size_cells = max(1, math.ceil(max(box.size.x, box.size.y) / resolution_m - _ROUNDING))
        values = np.zeros((size_cells, size_cells))
        values[_cells(box, origin, size_cells, resolution_m)] = 1.0
        super().__init__(values, origin, resolution_m=resolution_m)


def _steps(size_cells: int) -> Map:
    """How many cells the middles of the cells are from the origin, along one axis."""
    return np.arange(size_cells, dtype=np.float64) + (0.5 - size_cells / 2)


def _cells(
    box: BoundingBox, origin: Pose, size_cells: int, resolution_m: float, *, grown_m: float = 0.0
) -> tuple[slice, slice]:
    """The cells whose middles lie in the box, or on its edge, seen from above."""
    slices = []
    for low, high, middle in zip(box.min[:2], box.max[:2], origin.position[:2], strict=True):
        first = (low - grown_m - middle) / resolution_m + size_cells / 2 - 0.5
        last = (high + grown_m - middle) / resolution_m + size_cells / 2 - 0.5
        slices.append(slice(max(0, math.ceil(first - _ROUNDING)), max(0, math.floor(last + _ROUNDING) + 1)))
    return slices[0], slices[1]


def _obstacles(world: BulletWorld, ignore: Iterable[Object] | None) -> Iterator[BoundingBox]:
    """The boxes of the links that stand on the floor or hang below 2 m."""
    ignored = _or_robot(world, ignore)
    for thing in world.objects:
        if thing not in ignored:
            for link in thing.links:
                box = thing.bounding_box(link)
                if _in_the_way(box):
                    yield box


def _in_the_way(box: BoundingBox) -> bool:
    return any(box.size) and box.max.z > 0.0 and box.min.z < _TALLEST_M


def _or_robot(world: BulletWorld, ignore: Iterable[Object] | None) -> set[Object]:
    if ignore is not None:
        return set(ignore)
    robot = world.robot
    return set() if robot is None else {robot, *world.attachments.below(robot)}


def _hidden(x: Map, y: Map, height: float, seen: Vector, boxes: Iterable[BoundingBox]) -> NDArray[np.bool_]:
    """For every cell whether a box is met on the straight way from (x, y, height) to the point to be seen."""
    hidden = np.zeros(np.broadcast_shapes(x.shape, y.shape), dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        for box in boxes:
            enter, leave = np.zeros(1), np.ones(1)
            eye = (x, y, np.full(1, height))
            for start, end, low, high in zip(eye, seen, box.min, box.max, strict=True):
                way = end - start
                to_low, to_high = (low - start) / way, (high - start) / way
                # a way along the faces gives 0/0: it is inside exactly when the start is
                inside = (start > low) & (start < high)
                near = np.where(way == 0, np.where(inside, -np.inf, np.inf), np.minimum(to_low, to_high))
                far = np.where(way == 0, np.where(inside, np.inf, -np.inf), np.maximum(to_low, to_high))
                enter, leave = np.maximum(enter, near), np.minimum(leave, far)
            hidden |= leave - enter > _ROUNDING
    return hidden
