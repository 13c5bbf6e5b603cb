"""How a world was, as a value: poses, joint positions and attachments of its objects by name, and the way back to it.

Not Bullet's own saving of states, which costs ten times as much and knows no attachments.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from pycrorm_async.world.errors import JointLimitExceeded, PoseRefused
from pycrorm_async.world.pose import Pose

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.objects import Object

__all__ = ["WorldState", "ObjectState", "saved", "restore"]


@dataclass(frozen=True, slots=True)
class ObjectState:
    """One object: where it was, how its joints were, and what it hung on (parent's name, link), if on anything."""

    pose: Pose
    joints: Mapping[str, float]
    attached_to: tuple[str, str | None] | None


@dataclass(frozen=True, slots=True)
class WorldState:
    """All objects by name. Stays valid whatever happens to the world."""

    objects: Mapping[str, ObjectState]


class _Differences(NamedTuple):
    turned: list[tuple[Object, dict[str, float]]]
    moved: list[Object]


def saved(world: BulletWorld) -> WorldState:
    """How the world is now."""
    held = {each.child: (each.parent.name, each.link) for each in world.attachments}
    return WorldState(
        MappingProxyType(
            {
                thing.name: ObjectState(thing.pose, MappingProxyType(thing.joint_positions()), held.get(thing))
                for thing in world.objects
            }
        )
    )


def restore(world: BulletWorld, state: WorldState) -> None:
    """Make the objects of `state` as they were; tells what differed, after all of it is done.

    An object that was added since stays where it is, and is detached from the others. Raises `ObjectNotInWorld` if
    one of the state's objects is gone, `UnknownJoint` if another one has its name now, `PoseRefused` and
    `JointLimitExceeded` if a state that was made by hand holds what is not finite; then nothing was touched.
    """
    then = {world.object(name): was for name, was in state.objects.items()}
    for thing, was in then.items():
        _check(thing, was)
    for each in world.attachments:
        if each.child in then or each.parent in then:
            wanted = then[each.child].attached_to if each.child in then else None
            if wanted != (each.parent.name, each.link):
                each.parent.detach(each.child)
    differences = _apply(then)
    for thing, joints in differences.turned:
        world.tell_turned(thing, joints)
    world.tell_moved(differences.moved)
    for child, was in then.items():
        if was.attached_to is not None:
            parent, link = world.object(was.attached_to[0]), was.attached_to[1]
            if child.attached_to is parent:
                world.attachments.put(parent, child, link)
            else:
                parent.attach(child, link)


def _check(thing: Object, was: ObjectState) -> None:
    """Raise if the object cannot be so."""
    if not all(map(math.isfinite, (*was.pose.position, *was.pose.orientation))):
        raise PoseRefused(thing.name, was.pose, "its numbers must be finite")
    for joint, position in was.joints.items():
        limits = thing.joint_limits(joint)
        if not math.isfinite(position):
            raise JointLimitExceeded(thing.name, joint, position, limits)


def _apply(then: Mapping[Object, ObjectState]) -> _Differences:
    differences = _Differences([], [])
    for thing, was in then.items():
        now = thing.body.positions
        joints = {joint: value for joint, value in was.joints.items() if now[joint] != value}
        if joints:
            thing.body.turn(joints)
            differences.turned.append((thing, joints))
        if thing.pose != was.pose:
            thing.body.place(was.pose)
            differences.moved.append(thing)
    return differences
