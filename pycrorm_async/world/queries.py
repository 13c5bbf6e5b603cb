"""Query a world without changing it: bounding boxes, collisions, visibility, free space.

**Costmaps.** Costmaps rate positions on the floor or on a surface: square grids of values in [0, 1] that can be
multiplied.

>>> ground = Pose([1.3, 0.7, 0.0])
>>> places = OccupancyCostmap(world, ground) * GaussianCostmap(ground)
>>> places.best(1)[0].distance(Pose([0.69, 0.75, 0.0])) < 1e-9
True

`map[i, j]` is the cell whose middle is i + 0.5 - size/2 cells along x and j + 0.5 - size/2 along y from the origin. The
grid is aligned with the axes of "map" whatever the origin's orientation. Maps are deterministic. Obstacles are the
boxes around links, so a map may mark free cells as occupied but not the reverse. As in the thesis' system, cells are
2 cm wide by default.

**Footprints.** Compare the outline of a robot's base, with its heading, with the outlines of obstacles, viewed from
above.

An outline is the smallest rectangle around a shape with the heading of its link, so upright furniture keeps its exact
outline whatever its heading. Heights are not compared: a base counts as overlapping an outline even if it would fit
below or above the shape. A base that overlaps no outline collides with nothing.

>>> obstacles = Obstacles(world, ignore=[robot])
>>> obstacles.overlapping(footprint_of(robot, links), Pose([1.0, 0.7, 0.0]))
('kitchen', 'kitchen_counter')
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.bounding_boxes import BoundingBox, box_around
from pycrorm_async.world.bullet import Object
from pycrorm_async.world.engines import FLOOR, SKY, Floats, Part
from pycrorm_async.world.engines import Camera as Camera  # one of the names of this module
from pycrorm_async.world.pose import CostmapMismatch, Pose, Vector, product, rotated, yaw_quaternion
from pycrorm_async.world.world_copy import acting_robot

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld


# === collision queries ========================================================================================
#
# Compute the collisions a robot would have at given joint positions, without notifying observers.

TOUCH_M = 1e-3
"""Penetrations up to this depth count as contact, not as collision: an object on a table has one."""


def collisions_at(
    robot: Object,
    positions: Mapping[str, float],
    *,
    links: Collection[str],
    carried: Iterable[Object] = (),
    base: Pose | None = None,
) -> list[tuple[str, Object]]:
    """Return the objects that the links and carried objects would collide with at these joint positions (rad or m).

    The robot is taken at its current pose unless `base` is passed. The result holds pairs of a link's name, or a
    carried object's name, and the object it collides with. The floor, the robot itself and objects attached to it do
    not count. All joints and poses are restored.
    """
    world = robot.world
    attached = world.attachments.below(robot)
    others = {obj.body.number: obj for obj in world.objects if obj is not robot and obj not in attached}
    carried = tuple(carried)
    parts = [Part(robot.body.number, link) for link in links] + [Part(obj.body.number) for obj in carried]
    names = [*links, *(obj.name for obj in carried)]
    body, original_base, base = robot.body, robot.pose, robot.pose if base is None else base
    original_positions = {joint: body.positions[joint] for joint in positions}
    originals = [(obj, obj.pose, robot.attachments[obj]) for obj in carried]
    relative_poses = [pose.relative_to(robot.link_pose(link)) for _, pose, link in originals]
    try:
        if positions:
            body.turn(positions)
        if base is not original_base:
            body.place(base)
        for (obj, _, link), relative_pose in zip(originals, relative_poses, strict=True):
            obj.body.place(robot.link_pose(link) @ relative_pose)
        near = world.engine.nearest(parts, others, 0.0)
    finally:
        if original_positions:
            body.turn(original_positions)
        if robot.pose is not original_base:
            body.place(original_base)
        for obj, pose, _ in originals:
            obj.body.place(pose)
    collisions = {(each.other, each.part) for each in near if each.distance_m < -TOUCH_M}
    return [
        (names[part], obj) for other, obj in others.items() for part in range(len(parts)) if (other, part) in collisions
    ]


# === costmaps =================================================================================================

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


# === footprints ===============================================================================================

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
        outlines: list[tuple[str, str, float, BoundingBox]] = []
        for obj in (each for each in world.objects if each not in ignored):
            for link in (each for each in obj.links if obj.body.solids[each]):
                frame = obj.link_pose(link)
                heading, back = frame.yaw, yaw_quaternion(-frame.yaw)
                turned = rotated(back, frame.position), product(back, frame.orientation)
                boxes = (box_around([(turned, [solid])]) for solid in obj.body.solids[link])
                outlines += [(obj.name, link, heading, box) for box in boxes if box is not None and is_obstacle(box)]
        self._names = [(name, link) for name, link, _, _ in outlines]
        self._headings = np.array([heading for _, _, heading, _ in outlines])
        lows = np.array([box.min[:2] for *_, box in outlines]).reshape(-1, 2)
        highs = np.array([box.max[:2] for *_, box in outlines]).reshape(-1, 2)
        self._half = (highs - lows) / 2
        self._middles = _turned((lows + highs) / 2, self._headings)

    def overlapping(self, footprint: Footprint, base: Pose) -> tuple[str, str] | None:
        """Return object and link of the first outline that a base at this pose overlaps; None if there is none."""
        [overlaps] = self._overlaps(footprint, [base])
        return self._names[int(overlaps.argmax())] if overlaps.any() else None

    def clear(self, footprint: Footprint, bases: Sequence[Pose]) -> NDArray[np.bool_]:
        """Return for each of these poses whether a base there overlaps no outline, shape (bases,)."""
        return np.asarray(~self._overlaps(footprint, bases).any(axis=1))

    def _overlaps(self, footprint: Footprint, bases: Sequence[Pose]) -> NDArray[np.bool_]:
        """Return whether a base at each pose overlaps each outline, shape (bases, outlines)."""
        at = np.array([(*base.position[:2], base.yaw) for base in bases]).reshape(-1, 1, 3)
        position, yaw = at[..., :2], at[..., 2]
        half = np.array([footprint.x[1] - footprint.x[0], footprint.y[1] - footprint.y[0]]) / 2
        ahead = np.array([sum(footprint.x), sum(footprint.y)]) / 2
        away = self._middles - (position + _turned(ahead, yaw))
        relative = self._headings - yaw
        cos, sin = np.abs(np.cos(relative))[..., None], np.abs(np.sin(relative))[..., None]
        # Two rectangles are apart if they are apart along one of the four directions of their sides.
        along_base = np.abs(_turned(away, -yaw)) - half - cos * self._half - sin * self._half[:, ::-1]
        along_outline = np.abs(_turned(away, -self._headings)) - self._half - cos * half - sin * half[::-1]
        return np.asarray((np.maximum(along_base, along_outline) < -_ROUNDING_M).all(axis=-1))

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


def _turned(points: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate the points, shape (..., 2), about the origin."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = points[..., 0], points[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


# === photograph ===============================================================================================
#
# Photograph a world, without a display.

_SKY = (238.0, 241.0, 245.0)
_FLOOR_LIGHT, _FLOOR_CONTRAST = 225.0, 0.35
"""An engine's floor is a chessboard; it is repainted in pale greys, so that it does not outshine the objects."""


class Photograph(NamedTuple):
    """A picture of a world.

    Attributes:
        pixels: red, green, blue, shape (height, width, 3).
        bodies: `Object.body.number` of the object at each pixel, shape (height, width); other numbers: floor and sky.
        depths: distance from the camera along its axis at each pixel, m, shape (height, width).
    """

    pixels: NDArray[np.uint8]
    bodies: NDArray[np.int32]
    depths: Floats


def photograph(world: BulletWorld, camera: Camera, width: int, height: int, *, smooth: bool = True) -> Photograph:
    """Return a picture of the world. With `smooth`, each pixel is the mean of 4 points, and objects cast shadows.

    A smooth picture of 640 x 480 takes about 1 s of CPU time, one of 80 x 60 without it 10 ms. Without Bullet nothing
    casts a shadow.
    """
    scale = 2 if smooth else 1
    image = world.engine.render(camera, width * scale, height * scale, shadows=smooth)
    pixels, floor = image.colors, image.bodies == FLOOR
    pixels[image.bodies == SKY] = _SKY
    brightness = pixels[floor].mean(axis=1, keepdims=True)
    pixels[floor] = _FLOOR_LIGHT + (brightness - _FLOOR_LIGHT) * _FLOOR_CONTRAST
    smoothed = pixels.reshape(height, scale, width, scale, 3).mean(axis=(1, 3))
    numbers, depths = image.bodies[::scale, ::scale], image.depths[::scale, ::scale]
    return Photograph(smoothed.round().astype(np.uint8), numbers, depths)
