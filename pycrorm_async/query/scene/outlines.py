"""Compute the outlines from above of the objects of a moment: the convex hull of the box around each shape."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from pycrorm_async.query.scene.link_frames import link_frames, placed
from pycrorm_async.query.scene.object_model import assumed_model, object_model
from pycrorm_async.query.snapshot import ObjectThen, WorldThen

Point: TypeAlias = tuple[float, float]

_GREY = (0.62, 0.64, 0.68, 1.0)
_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


class Outline(NamedTuple):
    """The outline of one shape: its corners and its highest point in "map", m, and red, green, blue, opacity."""

    object: ObjectThen
    corners: tuple[Point, ...]
    top: float
    color: tuple[float, ...]


def outlines(world: WorldThen) -> list[Outline]:
    """Return the outlines of all shapes of a world, the lowest first, so that higher ones are drawn over them."""
    models: dict[str, dict[str, Any]] = {}
    every: list[Outline] = []
    for then in world.objects:
        fingerprint = then.description_fingerprint
        if fingerprint is None or fingerprint not in world.descriptions:
            model = assumed_model(then.name, then.object_type, set(then.joints))
        else:
            if fingerprint not in models:
                models[fingerprint] = object_model(world.descriptions[fingerprint])
            model = models[fingerprint]
        every.extend(_outlines(then, model))
    return sorted(every, key=lambda each: each.top)


def _outlines(then: ObjectThen, model: dict[str, Any]) -> Iterator[Outline]:
    frames = link_frames(model, then.pose, then.joints, then.base_link)
    for link, shapes in model["shapes"].items():
        if link not in frames:  # a description with two root links
            continue
        for kind, sizes, xyz, rpy, color in shapes:
            frame = frames[link] @ placed(xyz, rpy)
            corners = (_CORNERS * _edges(kind, sizes)) @ frame[:3, :3].T + frame[:3, 3]
            hull = _hull([(float(x), float(y)) for x, y, _ in corners])
            yield Outline(then, hull, float(corners[:, 2].max()), tuple(then.color or color or _GREY))


def _edges(kind: str, sizes: Sequence[float]) -> tuple[float, ...]:
    """Return the edges of the box around a shape."""
    if kind == "box":
        return tuple(sizes)
    diameter = 2 * sizes[0]
    if kind == "cylinder":
        return diameter, diameter, sizes[1]
    return diameter, diameter, diameter + (sizes[1] if kind == "capsule" else 0.0)


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
