"""Make a world with the objects of a snapshot, at the poses, joint positions and attachments of that moment.

>>> then = await memory.as_of("last", time=12.5)
>>> with world_of(then) as world:
...     world.object("milk").pose
Pose(position=[1.3, 1.0, 0.9], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from xml.etree.ElementTree import fromstring

from pycrorm_async.errors import CallerError
from pycrorm_async.query.snapshot import Moment, ObjectThen, WorldThen
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import ObjectType, WorldMode
from pycrorm_async.world.errors import DescriptionNotLoadable, DuplicateName
from pycrorm_async.world.models.catalog import built_in_urdf
from pycrorm_async.world.models.primitives import stand_in_urdf
from pycrorm_async.world.objects import Object

__all__ = ["world_of"]


def world_of(
    snapshot: Moment,
    *,
    descriptions: Mapping[str, str | Path] = MappingProxyType({}),
    mode: WorldMode = WorldMode.DIRECT,
) -> BulletWorld:
    """Return a world that has, once it is entered, the objects of the snapshot in their state of that moment.

    A memory does not record shapes. An object gets its description in `descriptions`, by name: URDF text, or the path
    of a .urdf file. Without one it gets the built-in shape for its name and type, if that has all recorded joints and
    the links that objects are attached to; otherwise a stand-in: a magenta box of 10 cm with these joints and links.

    Raises:
        CallerError: two objects have the same name, a type is unknown here, or a description is for no object.
        DescriptionNotLoadable, UnknownJoint, UnknownLink: on entering; a description does not fit its object.
    """
    then = snapshot.world
    names = [each.name for each in then.objects]
    if (unknown := next((name for name in descriptions if name not in names), None)) is not None:
        raise CallerError(f"the snapshot has no object {unknown!r} to describe; its objects: {', '.join(names)}")
    if (twice := next((name for name in names if names.count(name) > 1), None)) is not None:
        raise DuplicateName(twice)
    for each in then.objects:
        _object_type(each)

    def add_objects(world: BulletWorld) -> None:
        for each in then.objects:
            description = descriptions.get(each.name, _description(each, then))
            Object(each.name, _object_type(each), description, each.pose, world=world)
        world.restore_state(then.state)

    return BulletWorld(mode, set_up=add_objects)


def _object_type(then: ObjectThen) -> ObjectType:
    if then.object_type not in ObjectType.__members__:
        raise CallerError(
            f"object {then.name!r} was recorded with the type {then.object_type!r}, which ObjectType lacks here"
        )
    return ObjectType[then.object_type]


def _description(then: ObjectThen, world: WorldThen) -> str:
    """Return the built-in shape if the object's recorded state fits it, otherwise a stand-in that it fits."""
    links = {each.link for each in world.attachments if each.parent == then.name and each.link is not None}
    with contextlib.suppress(DescriptionNotLoadable):  # no robot or environment of that name is built in
        built_in = built_in_urdf(then.name, _object_type(then))
        if _fits(built_in, set(then.joints), links):
            return built_in
    return stand_in_urdf(then.name, joints=sorted(then.joints), links=sorted(links))


def _fits(urdf: str, joints: set[str], links: set[str]) -> bool:
    robot = fromstring(urdf)  # noqa: S314  our own text
    movable = {each.get("name") for each in robot.iter("joint") if each.get("type") != "fixed"}
    return joints <= movable and links <= {each.get("name") for each in robot.iter("link")}
