"""A second world like the first, to try things out in: what is done there is done to nothing else.

>>> with BulletWorld() as world:
...     milk = Object("milk", ObjectType.MILK)
...     with copied(world) as copy:
...         counterpart(milk, copy).set_pose(Pose([1, 2, 3]))
...     milk.pose.position
Vector(x=0.0, y=0.0, z=0.0)
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from pycrorm_async.world.attachments import Attachment
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import WorldMode
from pycrorm_async.world.objects import Object

__all__ = ["copied", "counterpart", "original", "related"]


@contextmanager
def copied(world: BulletWorld) -> Iterator[BulletWorld]:
    """A copy of the world as it is now, without a window; `current_world` of this context inside, closed afterwards.

    Every object is there with its name, type, description, poses, joints and attachments, exactly, but for its colour.
    Copying is quiet: neither the watcher nor the observers of either world are told, until somebody observes the copy.
    A copy can be copied. The PR2 in its kitchen takes some 25 ms.

    Raises:
        WorldClosed: the world was left. WorldUnavailable: Bullet opens no further one.
    """
    _ = world.client
    with BulletWorld(WorldMode.DIRECT, copy_of=world) as copy:
        twins = {thing: _twin(thing, copy) for thing in world.objects}
        for each in world.attachments:
            copy.attachments.keep(Attachment(twins[each.parent], twins[each.child], each.link, each.relative))
        yield copy


def counterpart(thing: Object, world: BulletWorld) -> Object | None:
    """What stands for the object in that world: itself, its copy, or what it is a copy of, however often copied.

    None if there is nothing: it was removed there, or added only elsewhere, or the worlds have nothing in common.
    """
    if thing.world is world:
        return thing if world.has(thing) else None
    first = _first(thing)
    return next((each for each in world.objects if _first(each) is first), None)


def related(one: BulletWorld, other: BulletWorld) -> bool:
    """Whether they are the same world, or copies of the same one."""
    return original(one) is original(other)


def original(world: BulletWorld) -> BulletWorld:
    """The world that is no copy: this one, or what it is a copy of, however often copied."""
    while world.copy_of is not None:
        world = world.copy_of
    return world


def _twin(thing: Object, copy: BulletWorld) -> Object:
    twin = Object(thing.name, thing.object_type, thing.description_text, thing.original_pose, world=copy)
    twin.copy_of = thing
    twin.robot_description = thing.robot_description
    twin.body.place(thing.pose)
    twin.body.turn(thing.joint_positions())
    return twin


def _first(thing: Object) -> Object:
    while thing.copy_of is not None:
        thing = thing.copy_of
    return thing
