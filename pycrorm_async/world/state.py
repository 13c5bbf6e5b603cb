"""Save the state of a world as a frozen value and restore it: poses, joint positions and attachments by object name.

`BulletWorld.restore_state` sets the states of bodies by the functions here, and restores the attachments itself.

Bullet's own saving of states is not used: it costs ten times as much and does not include attachments.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from pycrorm_async.world.errors import JointLimitExceeded, PoseRefused, UnknownJoint
from pycrorm_async.world.pose import Pose

if TYPE_CHECKING:
    from pycrorm_async.world.bullet_body import Body  # loads numpy


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


class StateChange(NamedTuple):
    """The differences that setting a state made: the joints that got another position, and whether the pose changed."""

    joints: dict[str, float]
    moved: bool


def check_state(name: str, body: Body, state: ObjectState) -> None:
    """Raise `UnknownJoint`, `PoseRefused` or `JointLimitExceeded` if the body of that object cannot take this state."""
    if not all(map(math.isfinite, (*state.pose.position, *state.pose.orientation))):
        raise PoseRefused(name, state.pose, "its numbers must be finite")
    for joint, position in state.joints.items():
        if joint not in body.limits:
            raise UnknownJoint(name, joint, tuple(body.positions))
        if not math.isfinite(position):
            raise JointLimitExceeded(name, joint, position, body.limits[joint])


def set_state(body: Body, state: ObjectState) -> StateChange:
    """Set pose and joint positions of a body, and return what has changed."""
    before = body.pose
    joints = {joint: value for joint, value in state.joints.items() if body.positions[joint] != value}
    if joints:
        body.turn(joints)
    if body.pose != state.pose:
        body.place(state.pose)
    return StateChange(joints, body.pose != before)
