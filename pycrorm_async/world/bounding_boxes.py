"""Compute axis-aligned bounding boxes from collision shapes, without the margin that Bullet adds to its own.

They are exact; a mesh has the box around its vertices.
"""

import itertools
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.meshes import mesh_points
from pycrorm_async.world.pose import COORDINATE_MAX, IDENTITY, Quaternion, Vector
from pycrorm_async.world.urdf_model import Link, Shape, origin

Array = NDArray[np.float64]
Frame = tuple[Vector, Quaternion]
"""A position and a unit quaternion, used in inner loops where creating a `Pose` would be too slow."""


class BoundingBox(NamedTuple):
    """The smallest box along the axes of "map" around a shape: its lowest and its highest corner, m."""

    min: Vector
    max: Vector

    @property
    def centre(self) -> Vector:
        """The centre of the box, m."""
        return Vector(*((low + high) / 2 for low, high in zip(self.min, self.max, strict=True)))

    @property
    def size(self) -> Vector:
        """Edge lengths along x, y and z, m."""
        return Vector(*(high - low for low, high in zip(self.min, self.max, strict=True)))


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex shape in its link's frame: the hull of `points`, grown by `radius`.

    With an `axis` it grows only perpendicular to that direction (a cylinder: two points and their discs), otherwise in
    all directions.
    """

    points: Array
    radius: float = 0.0
    axis: Array | None = None
    is_box: bool = False
    """True if the points are in the order of `_CORNERS`."""

    def box(self, rotation: Array, position: Array) -> tuple[Array, Array]:
        """Return the lowest and the highest corner for a link's frame at this rotation matrix and position."""
        corners = self.points @ rotation.T + position
        growth: Array | float = self.radius
        if self.axis is not None:
            along = rotation @ self.axis
            growth = self.radius * np.sqrt(np.clip(1.0 - along * along, 0.0, 1.0))
        return corners.min(axis=0) - growth, corners.max(axis=0) + growth

    @cached_property
    def inner_points(self) -> Array:
        """Points spread evenly inside the shape, none on its surface; at most 128, deterministic."""
        middle = self.points.mean(axis=0)
        if self.is_box:
            return np.asarray(middle + _GRID @ (self.points[[4, 2, 1]] - self.points[0]) / 2)
        if self.radius:
            offsets = _BALL if self.axis is None else _BALL - np.outer(_BALL @ self.axis, self.axis)
            along = _ALONG if len(self.points) > 1 else _ALONG[:1]
            cores = self.points[0] + np.outer(along, self.points[-1] - self.points[0])
            return np.concatenate([core + self.radius * offsets for core in cores])
        anchors = self.points[:: max(1, len(self.points) // 15)][:15]
        pairs = itertools.combinations_with_replacement(anchors, 2)
        return np.array([middle + ((first + second) / 2 - middle) * 0.9 for first, second in pairs])


_ALONG = np.array([0.125, 0.375, 0.625, 0.875])
_GRID = np.array(list(itertools.product(2 * _ALONG - 1, repeat=3)))
_BALL = _GRID[np.linalg.norm(_GRID, axis=1) < 1]
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def solids_of(shapes: Iterable[Shape]) -> tuple[Solid, ...]:
    """Return the solids of a link's shapes in the link's frame. Raises `ValueError` for a mesh file or a length."""
    return tuple(map(_solid, shapes))


def _solid(shape: Shape) -> Solid:
    if shape.kind != "mesh" and not all(0 <= size <= COORDINATE_MAX for size in shape.sizes):
        raise ValueError(f"<{shape.kind}> holds {[*shape.sizes]}; a length is 0 to {COORDINATE_MAX:g} m")
    at = origin(shape.xyz, shape.rpy)
    rotation, centre = rotation_matrix(at.orientation), np.array(at.position)
    match shape.kind:
        case "mesh":
            return Solid(mesh_points(shape.file) * shape.sizes @ rotation.T + centre)
        case "box":
            return Solid(_CORNERS * np.array(shape.sizes) / 2 @ rotation.T + centre, is_box=True)
        case "sphere":
            return Solid(centre[None, :], shape.sizes[0])
    radius, length = shape.sizes
    axis = rotation[:, 2]
    ends = np.stack([centre - axis * length / 2, centre + axis * length / 2])
    return Solid(ends, radius, axis if shape.kind == "cylinder" else None)


def box_of(link: Link, *, visual: bool = True) -> BoundingBox | None:
    """Return the box around a link's collision shapes in its frame, without any around its visual shapes.

    Shapes whose mesh cannot be read are left out. None without shapes.
    """
    solids: list[Solid] = []
    for shape in link.collisions or (link.visuals if visual else ()):
        with suppress(ValueError):
            solids.append(_solid(shape))
    return box_around([((Vector(0.0, 0.0, 0.0), IDENTITY), solids)])


def box_around(placed: Iterable[tuple[Frame, Iterable[Solid]]]) -> BoundingBox | None:
    """Return the box around all solids, each at its link's frame; None without solids."""
    corners = [
        corner
        for (position, turn), solids in placed
        for solid in solids
        for corner in solid.box(rotation_matrix(turn), np.array(position))
    ]
    if not corners:
        return None
    stacked = np.array(corners)
    return BoundingBox(Vector(*stacked.min(axis=0).tolist()), Vector(*stacked.max(axis=0).tolist()))


def boxes_around(turns: Array, positions: Array, middles: Array, halves: Array) -> tuple[Array, Array]:
    """Return the lowest and the highest corners of the boxes around boxes of frames, (n, 3) each.

    Args:
        turns, positions: the frames, (n, 3, 3) and (n, 3).
        middles, halves: of the boxes in their frames: the centre and half of the edges, (n, 3).
    """
    centres = positions + np.einsum("nij,nj->ni", turns, middles)
    reaches = np.einsum("nij,nj->ni", np.abs(turns), halves)
    return centres - reaches, centres + reaches


def rotation_matrix(turn: Sequence[float]) -> Array:
    """Return the rotation matrix of a unit quaternion xyzw, shape (3, 3)."""
    x, y, z, w = turn
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
