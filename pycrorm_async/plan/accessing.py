"""Which joint a handle moves, how far it opens, and where the handle and the hand on it pass on the way.

The same functions serve the motions that open and close and the search for a place to stand, so that what is
offered is what will be done. Pure geometry in the map, metres and rad; nothing is moved.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pycrorm_async.plan.failures import EnvironmentManipulationImpossible
from pycrorm_async.plan.objects import ObjectLike, ObjectPart, in_world
from pycrorm_async.world.enums import JointType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose

__all__ = [
    "OPENING_MARGIN",
    "STEP_M_MAX",
    "STEP_RAD_MAX",
    "Handle",
    "closed_position",
    "handle_of",
    "handle_poses",
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


def _limits(handle: Handle) -> tuple[float, float]:
    lower, upper = handle.whole.joint_limits(handle.joint)
    if not math.isfinite(upper - lower):
        message = f"{handle.joint} turns without end: there is no open and no closed"
        raise EnvironmentManipulationImpossible(message, handle.link, handle.joint)
    return lower, upper
