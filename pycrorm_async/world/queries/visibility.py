"""What is seen from where: rays cast through Bullet's world."""

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

__all__ = ["first_met", "met_towards", "visible_share"]

_RAYS_AT_ONCE = 16_000  # Bullet takes 16,384


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
    with _looked_through(world, ignore):
        return [by_number.get(number) for number in _hits(world.client, starts, ends)]


@contextmanager
def _looked_through(world: BulletWorld, ignore: AbstractSet[Object]) -> Iterator[None]:
    """Inside, rays pass through these objects.

    They are taken out of all of Bullet's groups. To begin a ray anew behind each surface it meets does not do: Bullet
    may let a ray that begins just inside a shape meet it at once, again and again.
    """
    through = [thing for thing in ignore if world.has(thing)]
    try:
        for thing in through:
            _group(thing, 0)
        yield
    finally:
        for thing in through:
            _group(thing, 1)


def _group(thing: Object, group: int) -> None:
    for link in range(-1, len(thing.body.links) - 1):
        engine().setCollisionFilterGroupMask(thing.body.number, link, group, -1, physicsClientId=thing.body.client)


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


def _hits(client: int, starts: Sequence[Sequence[float]], ends: Sequence[Sequence[float]]) -> list[int]:
    """For every ray the number of the body it meets first."""
    found: list[int] = []
    for begin in range(0, len(starts), _RAYS_AT_ONCE):
        chunk = slice(begin, begin + _RAYS_AT_ONCE)
        found += [hit[0] for hit in engine().rayTestBatch(starts[chunk], ends[chunk], physicsClientId=client)]
    return found
