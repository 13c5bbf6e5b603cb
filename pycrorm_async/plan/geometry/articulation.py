"""Which joint a handle moves, how far it opens, how a hand takes it, and where handle and hand pass on the way.

The same functions serve the motions that open and close and the search for a place to stand, so that what is
offered is what will be done. Pure geometry in the map, metres and rad; nothing is moved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from pycrorm_async.plan.failures import EnvironmentManipulationImpossible
from pycrorm_async.plan.object_designators import ObjectLike, ObjectPart, in_world
from pycrorm_async.world.enums import JointType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, rotated

__all__ = [
    "OPENING_MARGIN",
    "STEP_M_MAX",
    "STEP_RAD_MAX",
    "Handle",
    "closed_position",
    "grasp_pose",
    "hand_poses",
    "handle_of",
    "handle_poses",
    "hold_pose",
    "moved_position",
    "opened_position",
]

OPENING_MARGIN = 0.05
"""What opening leaves between the joint and its upper limit, m or rad."""
STEP_M_MAX = 0.05
STEP_RAD_MAX = 0.1
"""So far apart, at most, are the points at which the way of a handle is looked at."""
_ROUNDING = 1e-9


class Handle(NamedTuple):
    """A link to hold on to, and the joint that moves it."""

    whole: Object
    link: str
    joint: str

    @property
    def position(self) -> float:
        """Where the joint stands now, m or rad."""
        return self.whole.joint_position(self.joint)


def handle_of(part: ObjectLike, joint: str | None = None) -> Handle:
    """The handle, with the nearest movable joint above it, or with the one that is named.

    Raises:
        EnvironmentManipulationImpossible: it is no part of an object; no joint moves it, or not the one that is
            named.
        PerceptionObjectNotInWorld: the object it is part of is not in the world.
        UnknownLink: that object has no such link.
    """
    if not isinstance(part, ObjectPart):
        raise EnvironmentManipulationImpossible(
            f"{part.name} is no part of an object: name the handle, ObjectPart(handle, object)", part.name
        )
    whole = in_world(part.part_of)
    joints = whole.joints_above(part.name)
    if not joints or joint not in (None, *joints):
        mover = "no joint" if joint is None else f"no joint {joint}"
        raise EnvironmentManipulationImpossible(f"{mover} of {whole.name} moves {part.name}", part.name, whole.name)
    return Handle(whole, part.name, joint or joints[0])


def opened_position(handle: Handle) -> float:
    """How far its joint opens: `OPENING_MARGIN` before its upper limit, and never less than it is open now.

    Raises:
        EnvironmentManipulationImpossible: the joint turns without end.
    """
    _, upper = _limits(handle)
    return max(handle.position, upper - OPENING_MARGIN)


def closed_position(handle: Handle) -> float:
    """The lower limit of its joint. Raises `EnvironmentManipulationImpossible` if the joint turns without end."""
    lower, _ = _limits(handle)
    return lower


def moved_position(handle: Handle, distance: float) -> float:
    """Where its joint is after it moved by `distance`, m or rad.

    Raises:
        EnvironmentManipulationImpossible: that is beyond its limits.
    """
    lower, upper = handle.whole.joint_limits(handle.joint)
    goal = handle.position + distance
    if not lower - _ROUNDING <= goal <= upper + _ROUNDING:
        message = f"{handle.joint} goes from {lower:g} to {upper:g}: from {handle.position:g} not by {distance:g}"
        raise EnvironmentManipulationImpossible(message, handle.link, handle.joint, distance)
    return min(max(goal, lower), upper)


def handle_poses(handle: Handle, goal: float, start: float | None = None) -> list[Pose]:
    """Where the handle's frame is on the way of its joint to `goal`: the start, points between, the goal.

    Args:
        start: where the joint begins; where it stands now, if left out.
    """
    begin = handle.position if start is None else start
    step = STEP_M_MAX if handle.whole.joint_type(handle.joint) is JointType.PRISMATIC else STEP_RAD_MAX
    count = max(1, math.ceil(abs(goal - begin) / step - _ROUNDING))
    return [
        handle.whole.link_pose_at(handle.link, {handle.joint: begin + (goal - begin) * number / count})
        for number in range(count + 1)
    ]


def hold_pose(handle: Handle) -> Pose:
    """How a hand takes the handle: the tool frame as seen from the handle's.

    What slides is taken from the front: the hand is turned as the handle is. What swings is taken from the side
    of the hinge: the hand is turned by a right angle about the hinge's axis, and points away from the hinge. For
    on its way a door turns the hand, and one that began straight could not follow it from any place before it.
    """
    if handle.whole.joint_type(handle.joint) is JointType.PRISMATIC:
        return Pose()
    # seen from the handle, half a turn of the joint brings it to the other side of the hinge
    now = handle.whole.link_pose(handle.link)
    opposite = handle.whole.link_pose_at(handle.link, {handle.joint: handle.position + math.pi}).relative_to(now)
    x, y, z, _ = opposite.orientation
    from_hinge = [-across / 2 for across in opposite.position]
    for side in (1.0, -1.0):
        turn = Pose(orientation=(side * x, side * y, side * z, 1.0))
        if _dot(rotated(turn.orientation, (1.0, 0.0, 0.0)), from_hinge) > 0.0:
            break
    return turn


def hand_poses(handle: Handle, goal: float, start: float | None = None) -> list[Pose]:
    """As `handle_poses`, of the tool frame of a hand that took the handle as `hold` says."""
    taken = hold_pose(handle)
    return [each @ taken for each in handle_poses(handle, goal, start)]


def grasp_pose(wanted: ObjectLike) -> Pose:
    """Where the tool frame has to be to grasp it: in the frame of an object; of a handle as `hold` says.

    Raises:
        PerceptionObjectNotInWorld: it is not in the world, or what it is part of is not.
        UnknownLink: there is no such part.
    """
    if not isinstance(wanted, ObjectPart):
        return in_world(wanted).pose
    whole = in_world(wanted.part_of)
    if not whole.joints_above(wanted.name):
        return whole.link_pose(wanted.name)
    return whole.link_pose(wanted.name) @ hold_pose(handle_of(wanted))


def _limits(handle: Handle) -> tuple[float, float]:
    lower, upper = handle.whole.joint_limits(handle.joint)
    if not math.isfinite(upper - lower):
        message = f"{handle.joint} turns without end: there is no open and no closed"
        raise EnvironmentManipulationImpossible(message, handle.link, handle.joint)
    return lower, upper


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))
