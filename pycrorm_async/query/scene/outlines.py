"""Compute the outlines from above of the objects of a moment: the convex hull of each shape.

A mesh has the hull of its vertices where the moment has its file, otherwise that of the box around its link.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.query.scene.link_frames import Frame, link_frames, placed
from pycrorm_async.query.scene.mesh_triangles import triangles_of
from pycrorm_async.query.scene.object_model import assumed_model, object_model
from pycrorm_async.query.snapshot import ObjectThen, WorldThen

Point: TypeAlias = tuple[float, float]
_Points: TypeAlias = NDArray[np.floating]

_GREY = (0.62, 0.64, 0.68, 1.0)
_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
_DIRECTIONS = np.array([(math.cos(angle), math.sin(angle)) for angle in np.arange(128) * math.tau / 128])
"""The directions in which a mesh's outermost vertices are sought: a drawing of 460 pixels shows no more."""
_CIRCLE = np.c_[_DIRECTIONS[::4], np.zeros(len(_DIRECTIONS[::4]))]
"""The corners of a circle of radius 1 m."""
_DECIMALS = 6
"""Rounds corners to 1 µm, so that those above each other are one."""


class Outline(NamedTuple):
    """The outline of one shape: its corners and its highest point in "map", m, and red, green, blue, opacity."""

    object: ObjectThen
    corners: tuple[Point, ...]
    top: float
    color: tuple[float, ...]


class _Model(NamedTuple):
    """A model from `object_model`, and the vertices of the meshes that it draws, by their references."""

    model: Mapping[str, Any]
    meshes: Mapping[str, _Points]


def outlines(world: WorldThen) -> list[Outline]:
    """Return the outlines of all shapes of a world, the lowest first, so that higher ones are drawn over them."""
    models: dict[str, _Model] = {}
    every: list[Outline] = []
    for then in world.objects:
        fingerprint = then.description_fingerprint
        if fingerprint is None or fingerprint not in world.descriptions:
            model = _Model(assumed_model(then.name, then.object_type, set(then.joints)), {})
        else:
            if fingerprint not in models:
                models[fingerprint] = _recorded_model(world.descriptions[fingerprint], world.meshes)
            model = models[fingerprint]
        every.extend(_outlines(then, model))
    return sorted(every, key=lambda each: each.top)


def _recorded_model(description: DescriptionDeclared, contents: Mapping[str, bytes]) -> _Model:
    meshes: dict[str, _Points] = {}
    for mesh in description.meshes:
        if mesh.content is None or mesh.content.hash not in contents:
            continue
        with suppress(ValueError):  # a file that cannot be read is drawn as the box
            meshes[mesh.reference] = triangles_of(mesh.name, contents[mesh.content.hash]).vertices
    return _Model(object_model(description, drawn=frozenset(meshes)), meshes)


def _outlines(then: ObjectThen, model: _Model) -> Iterator[Outline]:
    frames = link_frames(model.model, then.pose, then.joints, then.base_link)
    for link, shapes in model.model["shapes"].items():
        if link not in frames:  # a description with two root links
            continue
        for kind, sizes, xyz, rpy, color in shapes:
            points = _points(kind, sizes, frames[link] @ placed(xyz, rpy), model.meshes)
            top = float(points[:, 2].max())
            yield Outline(then, _hull(_outermost(points[:, :2])), top, tuple(then.color or color or _GREY))


def _points(kind: str, sizes: Sequence[Any], frame: Frame, meshes: Mapping[str, _Points]) -> _Points:
    """Return points in "map" whose outline from above is that of the shape, the highest one among them."""
    points: _Points
    if kind in ("sphere", "capsule"):
        radius, half = sizes[0], sizes[1] / 2 if kind == "capsule" else 0.0
        ends = _moved(np.array([(0, 0, -half), (0, 0, half)]), frame)
        ball = radius * np.vstack([_CIRCLE, (0, 0, 1)])
        points = (ends[:, None] + ball).reshape(-1, 3)
        return points
    if kind == "cylinder":
        radius, height = sizes
        ends = np.array([(0, 0, -height / 2), (0, 0, height / 2)])
        return _moved((ends[:, None] + radius * _CIRCLE).reshape(-1, 3), frame)
    points = meshes[sizes[0]] * sizes[1:] if kind == "mesh" else _CORNERS * sizes
    return _moved(points, frame)


def _moved(points: _Points, frame: Frame) -> _Points:
    return np.asarray(points @ frame[:3, :3].T + frame[:3, 3])


def _outermost(points: _Points) -> list[Point]:
    """Return the points in the plane, each once; of many, those that lie outermost in one of some directions."""
    if len(points) > len(_DIRECTIONS):
        points = points[(points @ _DIRECTIONS.T).argmax(axis=0)]
    return [(float(x), float(y)) for x, y in np.unique(points.round(_DECIMALS), axis=0)]


def _hull(points: Sequence[Point]) -> tuple[Point, ...]:
    """Return the corners of the convex hull of points in the plane, counterclockwise (Andrew's monotone chain)."""
    ordered = sorted(points)

    def chain(passed: Sequence[Point]) -> list[Point]:
        corners: list[Point] = []
        for x, y in passed:
            while len(corners) > 1:
                (a, b), (c, d) = corners[-2:]
                if (c - a) * (y - b) - (d - b) * (x - a) > 0:
                    break
                corners.pop()
            corners.append((x, y))
        return corners[:-1]

    return (*chain(ordered), *chain(ordered[::-1]))
