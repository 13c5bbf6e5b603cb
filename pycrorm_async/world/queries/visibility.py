"""Compute visibility by casting rays through Bullet's world."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from pycrorm_async.world.bullet_loader import engine
from pycrorm_async.world.queries.bounding_boxes import rotation_matrix

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.objects import Object

_RAYS_AT_ONCE = 16_000  # Bullet accepts at most 16,384 rays per call


def first_met(
    world: BulletWorld,
    starts: Sequence[Sequence[float]],
    ends: Sequence[Sequence[float]],
    *,
    ignore: AbstractSet[Object],
) -> list[Object | None]:
    """Return the first object on every ray, see `BulletWorld.ray_test`."""
    if len(starts) != len(ends):
        raise ValueError(f"every ray needs a start and an end, got {len(starts)} starts and {len(ends)} ends")
    by_number = {obj.body.number: obj for obj in world.objects}
    with _transparent(world, ignore):
        return [by_number.get(number) for number in _hits(world.client, starts, ends)]


@contextmanager
def _transparent(world: BulletWorld, ignore: AbstractSet[Object]) -> Iterator[None]:
    """Let rays pass through these objects inside the context, by removing them from all of Bullet's collision groups.

    Casting a new ray from behind each hit would not work: Bullet may let a ray that starts just inside a shape hit the
    same shape again and again.
    """
    transparent = [obj for obj in ignore if world.has(obj)]
    try:
        for obj in transparent:
            _group(obj, 0)
        yield
    finally:
        for obj in transparent:
            _group(obj, 1)


def _group(obj: Object, group: int) -> None:
    for link in range(-1, len(obj.body.links) - 1):
        engine().setCollisionFilterGroupMask(obj.body.number, link, group, -1, physicsClientId=obj.body.client)


def visible_share(world: BulletWorld, obj: Object, eye: Sequence[float], *, ignore: AbstractSet[Object]) -> float:
    """Return the share of rays into the object's shapes that reach it, see `BulletWorld.visible`."""
    hits = met_towards(world, obj, eye, ignore=ignore)
    return sum(hit is obj for hit in hits) / len(hits) if hits else 0.0


def met_towards(
    world: BulletWorld, obj: Object, eye: Sequence[float], *, ignore: AbstractSet[Object]
) -> list[Object | None]:
    """Return the first object on each ray from the eye into the object's shapes: the object itself or an occluder.

    None means the floor. The list is empty for an object without shapes.
    """
    obj.check_present()
    points = [point for link, solids in obj.body.solids.items() if solids for point in _inner_points(obj, link)]
    return first_met(world, [eye] * len(points), points, ignore=ignore - {obj}) if points else []


def _inner_points(obj: Object, link: str) -> list[list[float]]:
    """Return the inner points of a link's shapes in "map", m."""
    position, turn = obj.body.link_frame(link)
    inner = np.concatenate([solid.inner_points for solid in obj.body.solids[link]])
    placed: list[list[float]] = (inner @ rotation_matrix(turn).T + np.array(position)).tolist()
    return placed


def _hits(client: int, starts: Sequence[Sequence[float]], ends: Sequence[Sequence[float]]) -> list[int]:
    """Return Bullet's number of the first body on every ray."""
    numbers: list[int] = []
    for begin in range(0, len(starts), _RAYS_AT_ONCE):
        chunk = slice(begin, begin + _RAYS_AT_ONCE)
        numbers += [hit[0] for hit in engine().rayTestBatch(starts[chunk], ends[chunk], physicsClientId=client)]
    return numbers
