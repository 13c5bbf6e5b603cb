"""What a robot would run into with its joints elsewhere: asked of Bullet, told to nobody."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pycrorm_async.world.bullet_loader import engine

if TYPE_CHECKING:
    from pycrorm_async.world.objects import Object

__all__ = ["touched_at", "TOUCH_M"]

TOUCH_M = 1e-3
"""Things that reach into each other by less only touch: what stands on a table does."""


def touched_at(
    robot: Object,
    positions: Mapping[str, float],
    *,
    links: Collection[str],
    carried: Iterable[Object] = (),
) -> list[tuple[str, Object]]:
    """What these links of the robot, and what they carry, would reach into with these joints (rad or m) there.

    Pairs of a link, or the name of what is carried, and the object it meets. Nothing is moved. The floor, the robot
    itself and what hangs on it do not count.
    """
    attached = robot.world.attachments.below(robot)
    others = [each for each in robot.world.objects if each is not robot and each not in attached]
    found: list[tuple[str, Object]] = []
    with _as_if(robot, positions, carried):
        for other in others:
            found += [(link, other) for link in links if _overlap(robot, other, robot.body.link_number(link))]
            found += [(thing.name, other) for thing in carried if _overlap(thing, other)]
    return found


@contextmanager
def _as_if(robot: Object, positions: Mapping[str, float], carried: Iterable[Object]) -> Iterator[None]:
    """Bullet has the joints there, and what they carry; afterwards all is where it was."""
    body = robot.body
    before = {joint: body.positions[joint] for joint in positions}
    held = [(thing, thing.pose, robot.attachments[thing]) for thing in carried]
    relative = [pose.relative_to(robot.link_pose(link)) for _, pose, link in held]
    try:
        body.turn(positions)
        for (thing, _, link), seen in zip(held, relative, strict=True):
            thing.body.place(robot.link_pose(link) @ seen)
        yield
    finally:
        body.turn(before)
        for thing, pose, _ in held:
            thing.body.place(pose)


def _overlap(one: Object, other: Object, link: int | None = None) -> bool:
    number = {} if link is None else {"linkIndexA": link}
    points = engine().getClosestPoints(
        one.body.number, other.body.number, distance=0.0, physicsClientId=one.body.client, **number
    )
    return any(point[8] < -TOUCH_M for point in points)
