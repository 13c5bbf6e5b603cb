"""What is seen from where: rays cast through Bullet's world."""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING

import numpy as np

from pycrorm_async.world.boxes import rotation_matrix
from pycrorm_async.world.engine import engine

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.objects import Object

__all__ = ["first_met", "met_towards", "visible_share"]

_RAYS_AT_ONCE = 16_000  # Bullet takes 16,384
_SHAPES_LOOKED_THROUGH = 64  # in one ray's way; it meets a convex shape once


def first_met(
    world: BulletWorld,
    starts: Sequence[Sequence[float]],
    ends: Sequence[Sequence[float]],
    *,
    ignore: AbstractSet[Object],
) -> list[Object | None]:
    """For every ray the first object it meets, as `BulletWorld.ray_test` promises."""
    if len(starts) != len(ends):
        raise ValueError(f"{len(starts)} starts and {len(ends)} ends are no rays")
    by_number = {thing.body.number: thing for thing in world.objects}
    met: list[Object | None] = [None] * len(starts)
    begins = [tuple(start) for start in starts]
    pending = list(range(len(starts)))
    for _ in range(1 + (_SHAPES_LOOKED_THROUGH if ignore else 0)):
        hits = _hits(world.client, [begins[ray] for ray in pending], [ends[ray] for ray in pending])
        again = []
        for ray, (number, point) in zip(pending, hits, strict=True):
            thing = by_number.get(number)
            if thing in ignore:
                begins[ray] = _just_behind(point, ends[ray])
                again.append(ray)
            else:
                met[ray] = thing
        pending = again
        if not pending:
            break
    return met


def visible_share(world: BulletWorld, thing: Object, eye: Sequence[float], *, ignore: AbstractSet[Object]) -> float:
    """The share of rays into the object's shapes that reach it, as `BulletWorld.visible` promises."""
    met = met_towards(world, thing, eye, ignore=ignore)
    return sum(found is thing for found in met) / len(met) if met else 0.0


def met_towards(
    world: BulletWorld, thing: Object, eye: Sequence[float], *, ignore: AbstractSet[Object]
) -> list[Object | None]:
    """What each ray from the eye into the object's shapes meets first: the object itself, or what hides it.

    None for the floor. Empty for an object without shapes.
    """
    thing.check_present()
    points = [point for link, solids in thing.body.solids.items() if solids for point in _placed(thing, link)]
    return first_met(world, [eye] * len(points), points, ignore=ignore - {thing}) if points else []


def _placed(thing: Object, link: str) -> list[list[float]]:
    """The inner points of a link's shapes, in "map"."""
    position, turn = thing.body.link_frame(link)
    inner = np.concatenate([solid.inner_points for solid in thing.body.solids[link]])
    placed: list[list[float]] = (inner @ rotation_matrix(turn).T + np.array(position)).tolist()
    return placed


def _hits(
    client: int, starts: Sequence[Sequence[float]], ends: Sequence[Sequence[float]]
) -> list[tuple[int, Sequence[float]]]:
    """For every ray the number of the body it meets first, and where."""
    found = []
    for begin in range(0, len(starts), _RAYS_AT_ONCE):
        chunk = slice(begin, begin + _RAYS_AT_ONCE)
        found += engine().rayTestBatch(starts[chunk], ends[chunk], physicsClientId=client)
    return [(hit[0], hit[3]) for hit in found]


def _just_behind(point: Sequence[float], end: Sequence[float]) -> tuple[float, ...]:
    """A little further along the way, so that the same surface is not met again."""
    way = np.subtract(end, point)
    length = float(np.linalg.norm(way))
    return tuple((np.array(point) + way * min(1.0, 1e-4 / length if length else 0.0)).tolist())
