"""Compute all postures that bring an arm's tool frame to a target, as a curve over the angle of its first joint.

An arm of seven joints has one more than a pose needs. For a fixed shoulder pan the rest follows in closed form: the
distance of the wrist from the shoulder determines the elbow, the wrist's sideways offset the roll of the upper arm (two
solutions), its height the lift, and the hand's orientation the last three joints. `pan_windows` returns the ranges of
pan to search, `curve` computes the postures for an array of pans, `wrist_angles` completes a posture. The module is
pure geometry in the axes of the torso; `kinematics` chooses among the postures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.pose import Quaternion, Vector, product, rotated, yaw_quaternion
from pycrorm_async.world.robots.robot_description import Bounds, PR2Arm

Floats = NDArray[np.float64]
PAN, LIFT, ROLL, ELBOW, FOREARM_ROLL, FLEX, WRIST_ROLL = range(7)
ROUNDING = 1e-9
"""Bounds the rounding error of a margin (rad) or a cosine; a posture beyond a limit by less counts as inside."""
_TINY = 1e-12
"""Replaces a length of 0 m in a divisor, where the result then does not matter."""


class Reach(NamedTuple):
    """A target in the axes of the torso."""

    wrist: Vector
    """Position of the wrist relative to the origin of the pan joint, m."""
    turn: Quaternion
    """Orientation of the hand."""
    ahead: Vector
    """Unit vector along the hand."""


class Curve(NamedTuple):
    """Postures, rad: one column per pan, one row for each of the two rolls of the upper arm."""

    lift: Floats
    roll: Floats
    elbow: Floats
    """One row, because the elbow is the same for both rolls."""
    margin: Floats
    """Distance of the joint nearest to a limit from that limit, rad; negative if a joint is outside its limits."""


def reach(arm_description: PR2Arm, tool: Vector, turn: Quaternion) -> Reach:
    """Convert a tool frame at `tool` (m from the origin of the pan joint) with rotation `turn` to a `Reach`."""
    ahead = rotated(turn, (1.0, 0.0, 0.0))
    wrist = Vector(*(at - arm_description.tool_m * along for at, along in zip(tool, ahead, strict=True)))
    return Reach(wrist, turn, ahead)


def hand(arm_description: PR2Arm, angles: Sequence[float]) -> tuple[Vector, Quaternion]:
    """Return the tool frame's position (m from the origin of the pan joint) and rotation at seven joint angles."""
    pan, lift, _, _, forearm_roll, flex, wrist_roll = angles
    at_pan = yaw_quaternion(pan)
    at_elbow = _elbow_turn(angles)
    at_wrist = product(at_elbow, product(product(_about_x(forearm_roll), _about_y(flex)), _about_x(wrist_roll)))
    x = y = z = 0.0
    for turn, length in (
        (at_pan, arm_description.shoulder_offset_m),
        (product(at_pan, _about_y(lift)), arm_description.upper_arm_m),
        (at_elbow, arm_description.forearm_m),
        (at_wrist, arm_description.tool_m),
    ):
        step = rotated(turn, (length, 0.0, 0.0))
        x, y, z = x + step.x, y + step.y, z + step.z
    return Vector(x, y, z), at_wrist


def pan_windows(arm_description: PR2Arm, wrist: Vector, bounds: Sequence[Bounds]) -> list[Bounds]:
    """Return the ranges of pan, within its limits, at which the elbow is within its limits.

    The lift axis moves on a circle around the pan axis, so its distance from the wrist, and with it the elbow angle,
    depends only on the absolute angle between pan and the direction of the wrist.
    """
    swing = _swing(arm_description, wrist, bounds)
    if swing is None:
        return []
    towards = math.atan2(wrist.y, wrist.x)
    lower, upper = bounds[PAN]
    windows = []
    for centre in (towards - math.tau, towards, towards + math.tau):
        for start, end in (
            (centre - swing.upper, centre - swing.lower),
            (centre + swing.lower, centre + swing.upper),
        ):
            if max(start, lower) <= min(end, upper):
                windows.append(Bounds(max(start, lower), min(end, upper)))
    return windows


def _swing(arm_description: PR2Arm, wrist: Vector, bounds: Sequence[Bounds]) -> Bounds | None:
    """Return the least and greatest angle between pan and wrist that the elbow's limits allow; None if none does."""
    folded, stretched = stretches_m(arm_description, bounds)
    across, offset = math.hypot(wrist.x, wrist.y), arm_description.shoulder_offset_m
    middle = across * across + wrist.z * wrist.z + offset * offset
    scale = max(2 * offset * across, _TINY)
    least, most = (middle - stretched**2) / scale, (middle - folded**2) / scale
    if least > 1 + ROUNDING or most < -1 - ROUNDING:
        return None
    return Bounds(math.acos(max(-1.0, min(1.0, most))), math.acos(max(-1.0, min(1.0, least))))


def stretches_m(arm_description: PR2Arm, bounds: Sequence[Bounds]) -> tuple[float, float]:
    """Return the distances from shoulder to wrist with the elbow at its lower and at its upper limit, m."""
    a, b = arm_description.upper_arm_m, arm_description.forearm_m
    folded, stretched = (math.sqrt(a * a + b * b + 2 * a * b * math.cos(angle)) for angle in bounds[ELBOW])
    return folded, stretched


def curve(arm_description: PR2Arm, reach: Reach, pan: Floats, bounds: Sequence[Bounds]) -> Curve:
    """Return for every pan the joints up to the elbow, and the margin of these and of the wrist's flex.

    Where no posture exists, the nearest one is returned with a negative margin.
    """
    a, b = arm_description.upper_arm_m, arm_description.forearm_m
    (x, y, z), (ahead_x, ahead_y, ahead_z) = reach.wrist, reach.ahead
    cos_pan, sin_pan = np.cos(pan), np.sin(pan)
    forward, sideways = cos_pan * x + sin_pan * y - arm_description.shoulder_offset_m, cos_pan * y - sin_pan * x

    cos_elbow = _within_one((forward * forward + sideways * sideways + (z * z - a * a - b * b)) / (2 * a * b))
    elbow = -np.arccos(cos_elbow)
    sin_elbow = -np.sqrt(1.0 - cos_elbow * cos_elbow)

    # The wrist's distance from the upper arm's axis; the roll turns part of it sideways.
    offset = np.maximum(-b * sin_elbow, _TINY)
    sin_roll = -sideways / offset
    missing = 1.0 - np.abs(sin_roll)
    sin_roll = _within_one(sin_roll)
    cos_roll = np.sqrt(1.0 - sin_roll * sin_roll)
    cos_roll = np.array((cos_roll, -cos_roll))
    roll, roll_margin = _nearest_turn(np.arctan2(sin_roll, cos_roll), bounds[ROLL])
    lift = np.arctan2(offset * cos_roll, a + b * cos_elbow) - np.arctan2(z, forward)
    lift, lift_margin = _nearest_turn(lift, bounds[LIFT])

    # Flex is the angle between forearm and hand, computed in axes that rotate with pan.
    cos_lift, sin_lift = np.cos(lift), np.sin(lift)
    out = -sin_elbow * cos_roll
    cos_flex = (
        (cos_lift * cos_elbow + sin_lift * out) * (cos_pan * ahead_x + sin_pan * ahead_y)
        + sin_elbow * sin_roll * (cos_pan * ahead_y - sin_pan * ahead_x)
        + (cos_lift * out - sin_lift * cos_elbow) * ahead_z
    )
    flex = -np.arccos(_within_one(cos_flex))

    margin = np.minimum(_margin(pan, bounds[PAN]), _margin(elbow, bounds[ELBOW]))
    margin = np.where(missing < 0, np.minimum(margin, missing), margin)
    margin = np.minimum(np.minimum(margin, lift_margin), np.minimum(roll_margin, _margin(flex, bounds[FLEX])))
    return Curve(lift, roll, elbow, margin)


def wrist_angles(upper: Sequence[float], turn: Quaternion) -> tuple[float, float, float]:
    """Return the forearm roll, flex (<= 0) and wrist roll that rotate the hand to `turn`, rad.

    `upper` holds pan, lift, roll and elbow. The rolls are in [-π, π].
    """
    x, y, z, w = _elbow_turn(upper)
    x, y, z, w = product((-x, -y, -z, w), turn)
    # Rotations about x, y, x: the quaternion gives half the sum and half the difference of the outer two angles.
    total, difference = math.atan2(x, w), math.atan2(-z, -y)
    flex = -2 * math.atan2(math.hypot(y, z), math.hypot(x, w))
    return math.remainder(total + difference, math.tau), flex, math.remainder(total - difference, math.tau)


def _elbow_turn(angles: Sequence[float]) -> Quaternion:
    """Return the rotation of the forearm before its own roll."""
    upper = product(product(yaw_quaternion(angles[PAN]), _about_y(angles[LIFT])), _about_x(angles[ROLL]))
    return product(upper, _about_y(angles[ELBOW]))


def _within_one(value: Floats) -> Floats:
    """Clip to [-1, 1]; np.clip is slower on small arrays."""
    return np.minimum(np.maximum(value, -1.0), 1.0)


def _margin(angle: Floats, bound: Bounds) -> Floats:
    return (bound.upper - bound.lower) / 2 - np.abs(angle - (bound.upper + bound.lower) / 2)


def _nearest_turn(angle: Floats, bound: Bounds) -> tuple[Floats, Floats]:
    """Shift the angles by whole turns as near to the middle of the range as possible; return them and their margins."""
    middle = (bound.upper + bound.lower) / 2
    away = angle - middle
    away -= math.tau * np.rint(away / math.tau)
    return away + middle, (bound.upper - bound.lower) / 2 - np.abs(away)


def _about_x(angle: float) -> Quaternion:
    return Quaternion(math.sin(angle / 2), 0.0, 0.0, math.cos(angle / 2))


def _about_y(angle: float) -> Quaternion:
    return Quaternion(0.0, math.sin(angle / 2), 0.0, math.cos(angle / 2))
