"""Save the state of a world as a frozen value and restore it: poses, joint positions and attachments by object name.

Bullet's own saving of states is not used: it costs ten times as much and does not include attachments.
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


@dataclass(frozen=True, slots=True)
class ObjectState:
    """The state of one object: pose, joint positions (rad or m), and parent's name and link if it was attached."""

    pose: Pose
    joints: Mapping[str, float]
    attached_to: tuple[str, str | None] | None


@dataclass(frozen=True, slots=True)
class WorldState:
    """The states of all objects by name; later changes of the world do not affect it."""

    objects: Mapping[str, ObjectState]


class _Differences(NamedTuple):
    joints: list[tuple[Object, dict[str, float]]]
    poses: list[Object]


def save(world: BulletWorld) -> WorldState:
    """Return the current state of the world."""
    parents = {each.child: (each.parent.name, each.link) for each in world.attachments}
    return WorldState(
        MappingProxyType(
            {
                obj.name: ObjectState(obj.pose, MappingProxyType(obj.joint_positions()), parents.get(obj))
                for obj in world.objects
            }
        )
    )


def restore(world: BulletWorld, state: WorldState) -> None:
    """Restore the objects of `state`; observers get the changes after all poses and joints are set.

    An object that was added since keeps its pose and is detached from the restored ones. Raises `ObjectNotInWorld` if
    an object of the state was removed, `UnknownJoint` if its name now belongs to an object without that joint,
    `PoseRefused` and `JointLimitExceeded` if a hand-made state has numbers that are not finite. These are raised
    before anything is changed.
    """
    states = {world.object(name): object_state for name, object_state in state.objects.items()}
    for obj, object_state in states.items():
        _check(obj, object_state)
    for each in world.attachments:
        if each.child in states or each.parent in states:
            attached_to = states[each.child].attached_to if each.child in states else None
            if attached_to != (each.parent.name, each.link):
                each.parent.detach(each.child)
    differences = _apply(states)
    for obj, joints in differences.joints:
        world.notify_joints(obj, joints)
    world.notify_moved(differences.poses)
    for child, object_state in states.items():
        if object_state.attached_to is not None:
            parent, link = world.object(object_state.attached_to[0]), object_state.attached_to[1]
            if child.attached_to is parent:
                world.attachments.put(parent, child, link)
            else:
                parent.attach(child, link)


def _check(obj: Object, object_state: ObjectState) -> None:
    """Raise if the object cannot take this state."""
    if not all(map(math.isfinite, (*object_state.pose.position, *object_state.pose.orientation))):
        raise PoseRefused(obj.name, object_state.pose, "its numbers must be finite")
    for joint, position in object_state.joints.items():
        limits = obj.joint_limits(joint)
        if not math.isfinite(position):
            raise JointLimitExceeded(obj.name, joint, position, limits)


def _apply(states: Mapping[Object, ObjectState]) -> _Differences:
    differences = _Differences([], [])
    for obj, object_state in states.items():
        positions, before = obj.body.positions, obj.pose
        joints = {joint: value for joint, value in object_state.joints.items() if positions[joint] != value}
        if joints:
            obj.body.turn(joints)
            differences.joints.append((obj, joints))
        if obj.pose != object_state.pose:
            obj.body.place(object_state.pose)
        if obj.pose != before:
            differences.poses.append(obj)
    return differences
