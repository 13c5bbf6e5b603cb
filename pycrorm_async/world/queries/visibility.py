"""Cast rays through a Bullet client, into the shapes of bodies and through transparent ones."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from pycrorm_async.world.bullet_body import Body
from pycrorm_async.world.bullet_loader import engine
from pycrorm_async.world.queries.bounding_boxes import rotation_matrix

_RAYS_AT_ONCE = 16_000  # Bullet accepts at most 16,384 rays per call


def first_met(
    client: int,
    starts: Sequence[Sequence[float]],
    ends: Sequence[Sequence[float]],
    *,
    transparent: Collection[Body],
) -> list[int]:
    """Return Bullet's number of the first body on every ray, see `BulletWorld.ray_test`."""
    if len(starts) != len(ends):
        raise ValueError(f"every ray needs a start and an end, got {len(starts)} starts and {len(ends)} ends")
    with _without_collisions(transparent):
        return _hits(client, starts, ends)


@contextmanager
def _without_collisions(transparent: Collection[Body]) -> Iterator[None]:
    """Let rays pass through these bodies inside the context, by removing them from all of Bullet's collision groups.

    Casting a new ray from behind each hit would not work: Bullet may let a ray that starts just inside a shape hit the
    same shape again and again.
    """
    try:
        for body in transparent:
            _group(body, 0)
        yield
    finally:
        for body in transparent:
            _group(body, 1)


def _group(body: Body, group: int) -> None:
    for link in range(-1, len(body.links) - 1):
        engine().setCollisionFilterGroupMask(body.number, link, group, -1, physicsClientId=body.client)


def inner_points(body: Body) -> list[list[float]]:
    """Return points in "map", m, that are spread through the shapes of a body; none for a body without shapes."""
    return [point for link, solids in body.solids.items() if solids for point in _inner_points(body, link)]


def _inner_points(body: Body, link: str) -> list[list[float]]:
    position, turn = body.link_frame(link)
    inner = np.concatenate([solid.inner_points for solid in body.solids[link]])
    placed: list[list[float]] = (inner @ rotation_matrix(turn).T + np.array(position)).tolist()
    return placed


def _hits(client: int, starts: Sequence[Sequence[float]], ends: Sequence[Sequence[float]]) -> list[int]:
    """Return Bullet's number of the first body on every ray."""
    numbers: list[int] = []
    for begin in range(0, len(starts), _RAYS_AT_ONCE):
        chunk = slice(begin, begin + _RAYS_AT_ONCE)
        numbers += [hit[0] for hit in engine().rayTestBatch(starts[chunk], ends[chunk], physicsClientId=client)]
    return numbers
