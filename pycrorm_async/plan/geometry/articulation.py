"""Compute the joint of a handle, its open and closed positions, its grasp, and the paths of handle and hand.

The opening motions and the search for base poses use the same functions, so that an offered base pose suits the motion.
Pure geometry in the map, metres and rad; nothing is moved.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pycrorm_async.plan.failures import EnvironmentManipulationImpossible
from pycrorm_async.plan.object_designators import ObjectLike, ObjectPart, in_world
from pycrorm_async.world.enums import JointType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, dot, rotated

OPENING_MARGIN = 0.05
"""Distance that opening leaves between the joint and its upper limit, m or rad."""
STEP_M_MAX = 0.05
"""Bounds the distance in m between two poses of the hand along the path of a drawer."""
STEP_RAD_MAX = 0.1
"""Greatest distance between two checked points on a handle's path."""
_ROUNDING = 1e-9
"""Tolerates the rounding of joint positions."""


class Handle(NamedTuple):
    """A link to hold, and the joint that moves it."""

    whole: Object
    link: str
    joint: str

    @property
    def position(self) -> float:
        """The joint's current position, m or rad."""
        return self.whole.joint_position(self.joint)


def handle_of(part: ObjectLike, joint: str | None = None) -> Handle:
    """Return the handle with the nearest movable joint above it, or with the named joint.

    Raises:
        EnvironmentManipulationImpossible: `part` is not an `ObjectPart`, no joint moves it, or the named one does not.
        PerceptionObjectNotInWorld: the object it is part of is not in the world.
        UnknownLink: that object has no such link.
    """
    if not isinstance(part, ObjectPart):
        raise EnvironmentManipulationImpossible(
            f"{part.name} is not part of an object: pass the handle as ObjectPart(handle, object)", part.name
        )
    whole = in_world(part.part_of)
    joints = whole.joints_above(part.name)
    if not joints or joint not in (None, *joints):
        mover = "no joint" if joint is None else f"no joint {joint}"
        raise EnvironmentManipulationImpossible(f"{mover} of {whole.name} moves {part.name}", part.name, whole.name)
    return Handle(whole, part.name, joint or joints[0])


def opened_position(handle: Handle) -> float:
    """Return the joint's open position: `OPENING_MARGIN` below its upper limit, but not below the current position.

    Raises:
        EnvironmentManipulationImpossible: the joint has no limits.
    """
    _, upper = _limits(handle)
    return max(handle.position, upper - OPENING_MARGIN)


def closed_position(handle: Handle) -> float:
    """Return the joint's lower limit. Raises `EnvironmentManipulationImpossible` if the joint has no limits."""
    lower, _ = _limits(handle)
    return lower


def moved_position(handle: Handle, distance: float) -> float:
    """Return the joint's position after a motion by `distance`, m or rad.

    Raises:
        EnvironmentManipulationImpossible: that position is outside the joint's limits.
    """
    lower, upper = handle.whole.joint_limits(handle.joint)
    goal = handle.position + distance
    if not lower - _ROUNDING <= goal <= upper + _ROUNDING:
        limits = f"its limits are {lower:g} to {upper:g}"
        message = f"{handle.joint} at {handle.position:g} cannot move by {distance:g}: {limits}"
        raise EnvironmentManipulationImpossible(message, handle.link, handle.joint, distance)
    return min(max(goal, lower), upper)


def handle_poses(handle: Handle, goal: float, start: float | None = None) -> list[Pose]:
    """Return poses of the handle's frame while its joint moves to `goal`: the start, points between, the goal.

    Args:
        start: the joint's first position; None means the current one.
    """
    begin = handle.position if start is None else start
    step = STEP_M_MAX if handle.whole.joint_type(handle.joint) is JointType.PRISMATIC else STEP_RAD_MAX
    count = max(1, math.ceil(abs(goal - begin) / step - _ROUNDING))
    return [
        handle.whole.link_pose_at(handle.link, {handle.joint: begin + (goal - begin) * number / count})
        for number in range(count + 1)
    ]


def hold_pose(handle: Handle) -> Pose:
    """Return the pose of the tool frame relative to the handle's frame in a grasp.

    A drawer's handle is grasped from the front, with the handle's orientation. A door's handle is grasped from the side
    of the hinge: the hand is rotated by 90 degrees about the hinge's axis and points away from the hinge. The moving
    door rotates the hand, and a hand that starts straight could not follow it from any base pose.
    """
    if handle.whole.joint_type(handle.joint) is JointType.PRISMATIC:
        return Pose()
    # Half a turn of the joint would bring the handle to the opposite side of the hinge: this locates the hinge.
    current = handle.whole.link_pose(handle.link)
    opposite = handle.whole.link_pose_at(handle.link, {handle.joint: handle.position + math.pi}).relative_to(current)
    x, y, z, _ = opposite.orientation
    from_hinge = [-across / 2 for across in opposite.position]
    for side in (1.0, -1.0):
        turn = Pose(orientation=(side * x, side * y, side * z, 1.0))
        if dot(rotated(turn.orientation, (1.0, 0.0, 0.0)), from_hinge) > 0.0:
            break
    return turn


def hand_poses(handle: Handle, goal: float, start: float | None = None) -> list[Pose]:
    """Return poses as `handle_poses` does, but of the tool frame of a hand that holds the handle."""
    grip = hold_pose(handle)
    return [each @ grip for each in handle_poses(handle, goal, start)]


def grasp_pose(target: ObjectLike) -> Pose:
    """Return the tool frame's pose for grasping: an object's own frame, or a handle's `hold_pose`.

    Raises:
        PerceptionObjectNotInWorld: the object, or the object that has the part, is not in the world.
        UnknownLink: the object has no such part.
    """
    if not isinstance(target, ObjectPart):
        return in_world(target).pose
    whole = in_world(target.part_of)
    if not whole.joints_above(target.name):
        return whole.link_pose(target.name)
    return whole.link_pose(target.name) @ hold_pose(handle_of(target))


def _limits(handle: Handle) -> tuple[float, float]:
    lower, upper = handle.whole.joint_limits(handle.joint)
    if not math.isfinite(upper - lower):
        message = f"{handle.joint} has no limits, so it has no open and no closed position"
        raise EnvironmentManipulationImpossible(message, handle.link, handle.joint)
    return lower, upper
