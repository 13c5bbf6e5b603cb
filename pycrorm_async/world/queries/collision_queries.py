"""Compute the collisions a robot would have at given joint positions, without notifying observers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pycrorm_async.world.bullet_loader import engine

if TYPE_CHECKING:
    from pycrorm_async.world.objects import Object
    from pycrorm_async.world.pose import Pose

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
    attached = robot.world.attachments.below(robot)
    others = [each for each in robot.world.objects if each is not robot and each not in attached]
    collisions: list[tuple[str, Object]] = []
    with _moved(robot, positions, carried, robot.pose if base is None else base):
        for other in others:
            collisions += [(link, other) for link in links if _overlap(robot, other, robot.body.link_number(link))]
            collisions += [(obj.name, other) for obj in carried if _overlap(obj, other)]
    return collisions


@contextmanager
def _moved(robot: Object, positions: Mapping[str, float], carried: Iterable[Object], base: Pose) -> Iterator[None]:
    """Move the robot and the carried objects in Bullet, and restore them at the end of the context."""
    body, original_base = robot.body, robot.pose
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
        yield
    finally:
        if original_positions:
            body.turn(original_positions)
        if robot.pose is not original_base:
            body.place(original_base)
        for obj, pose, _ in originals:
            obj.body.place(pose)


def _overlap(one: Object, other: Object, link: int | None = None) -> bool:
    number = {} if link is None else {"linkIndexA": link}
    points = engine().getClosestPoints(
        one.body.number, other.body.number, distance=0.0, physicsClientId=one.body.client, **number
    )
    return any(point[8] < -TOUCH_M for point in points)
