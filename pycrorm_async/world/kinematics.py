"""Where an arm's tool frame is (`forward`), and which joint angles bring it to a pose (`solve`).

An arm of seven joints has one more than a pose needs, so a reachable pose has a curve of postures. With the shoulder
pan given the rest follows in closed form: the distance of the wrist from the shoulder fixes the elbow, the wrist's
sideways offset the upper arm's roll (two ways), its height the lift, and the hand's orientation the last three joints.
`solve` follows pan, in steps of at most 0.01 rad, through all angles at which the elbow is within its limits, both ends
included, and takes the posture that stays farthest from every limit; continuous joints have none.

No clock and no chance is in it: on one machine the same question has the same answer, to the bit. What it returns is
checked by forward kinematics to 1e-6 m and 1e-6 rad. What it refuses is out of reach but for rare targets (about 1 in
20,000 of those a random posture reaches) whose only postures lie squeezed between limits, within one step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.pose import Pose, Quaternion, Vector, product, rotated
from pycrorm_async.world.robot import ArmDescription, Bounds, Limits, RobotDescription

if TYPE_CHECKING:
    from pycrorm_async.world.objects import Object

__all__ = ["Limits", "Unreachable", "forward", "solve", "solve_from"]

PAN_STEP_RAD = 0.01
EXACT = 1e-6
"""Metres and rad between the target and where forward kinematics says the answer leads."""
ROUNDING_RAD = 1e-9
"""How far beyond a limit an angle may come out and still be the limit itself."""

_PAN, _LIFT, _ROLL, _ELBOW, _, _FLEX, _ = range(7)
_Floats = NDArray[np.float64]


class Unreachable(Exception):
    """No posture within the limits brings the arm's tool frame to the target; `reason` says what stands against it.

    An outcome, not anyone's fault: plans turn it into a failure of their own.
    """

    def __init__(self, target: Pose, arm: Arms, reason: str) -> None:
        super().__init__(f"the {arm.name} arm cannot reach {target!r}: {reason}")
        self.target = target
        self.arm = arm
        self.reason = reason


def forward(
    description: RobotDescription, arm: Arms, joints: Mapping[str, float], *, torso_height: float, base: Pose
) -> Pose:
    """The pose of the arm's tool frame, in the frame `base` is given in.

    Args:
        joints: name → rad, all seven of the arm; others are passed over.
        torso_height: m, the torso joint's position.
        base: where the robot's root link is.
    """
    part = _one_arm(description, arm)
    place, turn = _hand(description, part, [joints[name] for name in part.joints], torso_height)
    return base @ Pose(place, turn, base.frame, base.time_ns)


def solve(robot: Object, arm: Arms, target: Pose, *, limits: Limits = Limits.SOFT) -> dict[str, float]:
    """Joint name → rad for the arm of the robot as it stands in its world; moves nothing.

    Hard limits are those of the loaded model where they are narrower than the description's.

    Raises:
        Unreachable: no posture within the limits leads to the target.
        CallerError: a robot without a description, not one arm, a target in another frame or not finite.
    """
    description = robot.robot_description
    if description is None:
        raise CallerError(f"{robot.name!r} has no robot description, so nothing is known of its arms")
    bounds = _bounds(_one_arm(description, arm), limits)
    if limits is Limits.HARD:
        bounds = {name: _narrowed(bound, robot.joint_limits(name)) for name, bound in bounds.items()}
    height = robot.joint_position(description.torso_joint)
    return _solved(description, arm, target, base=robot.pose, torso_height=height, bounds=bounds, limits=limits)


def solve_from(
    description: RobotDescription,
    arm: Arms,
    target: Pose,
    *,
    base: Pose,
    torso_height: float,
    limits: Limits = Limits.SOFT,
) -> dict[str, float]:
    """As `solve`, for a robot whose root link is at `base` and whose torso is `torso_height` m up; needs no world.

    The torso is taken as it is, also outside its own range. The rolls of forearm and wrist are in [-π, π].

    >>> from pycrorm_async.world.robot import PR2
    >>> target = Pose([0.6, 0.2, 0.9])
    >>> joints = solve_from(PR2, Arms.LEFT, target, base=Pose(), torso_height=0.0)
    >>> forward(PR2, Arms.LEFT, joints, torso_height=0.0, base=Pose()).distance(target) < 1e-9
    True
    """
    bounds = _bounds(_one_arm(description, arm), limits)
    return _solved(description, arm, target, base=base, torso_height=torso_height, bounds=bounds, limits=limits)


# --- the search ---------------------------------------------------------------------------------------------------


class _Reach(NamedTuple):
    """A target as the arm sees it, in the axes of the torso."""

    tool: Vector
    """From the root link, m."""
    turn: Quaternion
    wrist: Vector
    """From the origin of the pan joint, m."""
    ahead: Vector
    """Along the hand, length one."""


class _Curve(NamedTuple):
    """The postures that lead to a target, by pan (columns) and by the two ways to roll the upper arm (rows)."""

    lift: _Floats
    roll: _Floats
    elbow: _Floats
    """One row: the same both ways."""
    margin: _Floats
    """How far the joint nearest to a limit is inside it, rad; negative: how far outside."""


def _solved(
    description: RobotDescription,
    arm: Arms,
    target: Pose,
    *,
    base: Pose,
    torso_height: float,
    bounds: Mapping[str, Bounds],
    limits: Limits,
) -> dict[str, float]:
    part = _one_arm(description, arm)
    reach = _as_seen(description, part, target, base, torso_height)
    ranges = tuple(bounds.values())
    windows = _pan_windows(part, reach.wrist, ranges)
    if not windows:
        raise Unreachable(target, arm, _why_no_pan(part, reach.wrist, ranges, limits))
    pans = np.concatenate([_steps(window) for window in windows])
    curve = _curve(part, reach, pans, ranges)
    row, column = divmod(int(curve.margin.argmax()), len(pans))
    upper = (
        float(pans[column]),
        float(curve.lift[row, column]),
        float(curve.roll[row, column]),
        float(curve.elbow[column]),
    )
    angles = (*upper, *_wrist(upper, reach.turn))
    if curve.margin[row, column] < -ROUNDING_RAD:
        raise Unreachable(target, arm, _why_no_posture(part, angles, ranges, limits))
    angles = tuple(
        min(max(angle, lower), upper) for angle, (lower, upper) in zip(angles, ranges, strict=True)
    )
    place, turn = _hand(description, part, angles, torso_height)
    if math.dist(place, reach.tool) > EXACT or _angle_between(turn, reach.turn) > EXACT:
        raise Unreachable(target, arm, "the arm would have to be stretched to the last micrometre")
    return dict(zip(part.joints, angles, strict=True))


def _as_seen(
    description: RobotDescription, part: ArmDescription, target: Pose, base: Pose, torso_height: float
) -> _Reach:
    if target.frame != base.frame:
        raise CallerError(f"the target is in frame {target.frame!r}, the robot in {base.frame!r}")
    if not math.isfinite(sum(target.position) + sum(target.orientation)):
        raise CallerError(f"the target is not finite: {target!r}")
    x, y, z, w = base.orientation
    back = Quaternion(-x, -y, -z, w)
    turn = product(back, target.orientation)
    ahead = rotated(turn, (1.0, 0.0, 0.0))
    tool = rotated(back, [there - here for there, here in zip(target.position, base.position, strict=True)])
    shoulder = _shoulder(description, part, torso_height)
    return _Reach(
        tool,
        turn,
        Vector(
            tool.x - shoulder.x - part.tool_m * ahead.x,
            tool.y - shoulder.y - part.tool_m * ahead.y,
            tool.z - shoulder.z - part.tool_m * ahead.z,
        ),
        ahead,
    )


def _pan_windows(part: ArmDescription, wrist: Vector, bounds: Sequence[Bounds]) -> list[Bounds]:
    """The ranges of pan, within its limits, at which the elbow is within its own.

    The lift axis circles round the pan axis; its distance from the wrist, and with it the elbow, depends on how far pan
    is turned away from the wrist, to either side.
    """
    swing = _swing(part, wrist, bounds)
    if swing is None:
        return []
    towards = math.atan2(wrist.y, wrist.x)
    windows = []
    for centre in (towards - math.tau, towards, towards + math.tau):
        for start, end in ((centre - swing.upper, centre - swing.lower), (centre + swing.lower, centre + swing.upper)):
            window = _narrowed(bounds[_PAN], (start, end))
            if window.lower <= window.upper:
                windows.append(window)
    return windows


def _swing(part: ArmDescription, wrist: Vector, bounds: Sequence[Bounds]) -> Bounds | None:
    """How far pan may and must be turned away from the wrist for the elbow's sake; None: no turn is right."""
    folded, stretched = _stretches_m(part, bounds)
    across, offset = math.hypot(wrist.x, wrist.y), part.shoulder_offset_m
    middle = across * across + wrist.z * wrist.z + offset * offset
    scale = max(2 * offset * across, 1e-12)
    least, most = (middle - stretched**2) / scale, (middle - folded**2) / scale
    if least > 1 + ROUNDING_RAD or most < -1 - ROUNDING_RAD:
        return None
    return Bounds(math.acos(max(-1.0, min(1.0, most))), math.acos(max(-1.0, min(1.0, least))))


def _stretches_m(part: ArmDescription, bounds: Sequence[Bounds]) -> tuple[float, float]:
    """Shoulder to wrist with the elbow at its lower and its upper limit."""
    a, b = part.upper_arm_m, part.forearm_m
    folded, stretched = (math.sqrt(a * a + b * b + 2 * a * b * math.cos(angle)) for angle in bounds[_ELBOW])
    return folded, stretched


def _steps(window: Bounds) -> _Floats:
    """Both ends of the window and equal steps between them."""
    count = max(1, math.ceil((window.upper - window.lower) / PAN_STEP_RAD))
    steps = np.arange(count + 1) * ((window.upper - window.lower) / count) + window.lower
    steps[-1] = window.upper
    return steps


def _curve(part: ArmDescription, reach: _Reach, pan: _Floats, bounds: Sequence[Bounds]) -> _Curve:
    """For every pan the four joints up to the elbow, and the margin of these and the wrist's flex."""
    a, b = part.upper_arm_m, part.forearm_m
    (x, y, z), (ahead_x, ahead_y, ahead_z) = reach.wrist, reach.ahead
    cos_pan, sin_pan = np.cos(pan), np.sin(pan)
    forth, aside = cos_pan * x + sin_pan * y - part.shoulder_offset_m, cos_pan * y - sin_pan * x

    cos_elbow = (forth * forth + aside * aside + (z * z - a * a - b * b)) / (2 * a * b)
    cos_elbow = np.minimum(np.maximum(cos_elbow, -1.0), 1.0)
    elbow = -np.arccos(cos_elbow)
    sin_elbow = -np.sqrt(1.0 - cos_elbow * cos_elbow)

    # The forearm leaves the upper arm's axis by this much; rolling turns it aside.
    leaves = np.maximum(-b * sin_elbow, 1e-12)
    sin_roll = -aside / leaves
    aside_margin = 1.0 - np.abs(sin_roll)
    sin_roll = np.minimum(np.maximum(sin_roll, -1.0), 1.0)
    cos_roll = np.sqrt(1.0 - sin_roll * sin_roll)
    cos_roll = np.array((cos_roll, -cos_roll))
    roll, roll_margin = _towards_middle(np.arctan2(sin_roll, cos_roll), bounds[_ROLL])
    lift, lift_margin = _towards_middle(
        np.arctan2(leaves * cos_roll, a + b * cos_elbow) - np.arctan2(z, forth), bounds[_LIFT]
    )

    # Flex is the angle between forearm and hand, here in axes that turn with pan.
    cos_lift, sin_lift = np.cos(lift), np.sin(lift)
    out = -sin_elbow * cos_roll
    cos_flex = (
        (cos_lift * cos_elbow + sin_lift * out) * (cos_pan * ahead_x + sin_pan * ahead_y)
        + sin_elbow * sin_roll * (cos_pan * ahead_y - sin_pan * ahead_x)
        + (cos_lift * out - sin_lift * cos_elbow) * ahead_z
    )
    flex = -np.arccos(np.minimum(np.maximum(cos_flex, -1.0), 1.0))

    margin = np.minimum(_margin(pan, bounds[_PAN]), _margin(elbow, bounds[_ELBOW]))
    margin = np.minimum(margin, aside_margin)
    margin = np.minimum(np.minimum(margin, lift_margin), np.minimum(roll_margin, _margin(flex, bounds[_FLEX])))
    return _Curve(lift, roll, elbow, margin)


def _margin(angle: _Floats, bound: Bounds) -> _Floats:
    return (bound.upper - bound.lower) / 2 - np.abs(angle - (bound.upper + bound.lower) / 2)


def _towards_middle(angle: _Floats, bound: Bounds) -> tuple[_Floats, _Floats]:
    """The same angles with the whole turns that bring them nearest to the middle of the range; and their margins."""
    away = angle - (bound.upper + bound.lower) / 2
    away -= math.tau * np.rint(away / math.tau)
    return away + (bound.upper + bound.lower) / 2, (bound.upper - bound.lower) / 2 - np.abs(away)


def _wrist(upper: Sequence[float], turn: Quaternion) -> tuple[float, float, float]:
    """Forearm roll, flex (not above 0) and wrist roll that turn the hand from the elbow on."""
    x, y, z, w = _elbow_turn(upper)
    x, y, z, w = product((-x, -y, -z, w), turn)
    total, difference = math.atan2(x, w), math.atan2(-z, -y)
    flex = -2 * math.atan2(math.hypot(y, z), math.hypot(x, w))
    return math.remainder(total + difference, math.tau), flex, math.remainder(total - difference, math.tau)


# --- why not ------------------------------------------------------------------------------------------------------


def _why_no_pan(part: ArmDescription, wrist: Vector, bounds: Sequence[Bounds], limits: Limits) -> str:
    folded, stretched = _stretches_m(part, bounds)
    across, offset = math.hypot(wrist.x, wrist.y), part.shoulder_offset_m
    nearest, farthest = math.hypot(across - offset, wrist.z), math.hypot(across + offset, wrist.z)
    if nearest > stretched:
        return f"too far: shoulder to wrist would be {nearest:.3f} m or more, at most {stretched:.3f} m is possible"
    if farthest < folded:
        return f"too near: shoulder to wrist would be {farthest:.3f} m or less, at least {folded:.3f} m is possible"
    lower, upper = bounds[_PAN]
    return f"the wrist's place is within reach only with {part.joints[_PAN]} outside {_range(lower, upper, limits)}"


def _why_no_posture(
    part: ArmDescription, angles: Sequence[float], bounds: Sequence[Bounds], limits: Limits
) -> str:
    """Names the joint that is farthest out in the posture that comes nearest to being possible."""
    worst = max(
        range(len(angles)), key=lambda i: max(bounds[i].lower - angles[i], angles[i] - bounds[i].upper)
    )
    (lower, upper), angle = bounds[worst], angles[worst]
    if lower <= angle <= upper:
        return "the wrist's place is beside what the elbow can swing to, at every pan within limits"
    return (
        f"the posture that comes nearest needs {part.joints[worst]} at {angle:.3f}, "
        f"outside {_range(lower, upper, limits)}"
    )


def _range(lower: float, upper: float, limits: Limits) -> str:
    return f"{lower:.3f}..{upper:.3f} ({limits.name.lower()} limits, rad)"


# --- the chain ----------------------------------------------------------------------------------------------------


def _hand(
    description: RobotDescription, part: ArmDescription, angles: Sequence[float], torso_height: float
) -> tuple[Vector, Quaternion]:
    """Where the tool frame is and how it is turned, as seen from the root link."""
    pan, lift, roll, elbow, forearm_roll, flex, wrist_roll = angles
    at_pan = _about_z(pan)
    at_lift = product(at_pan, _about_y(lift))
    at_elbow = _elbow_turn((pan, lift, roll, elbow))
    hand = product(at_elbow, product(product(_about_x(forearm_roll), _about_y(flex)), _about_x(wrist_roll)))
    place = [*_shoulder(description, part, torso_height)]
    for turn, length in (
        (at_pan, part.shoulder_offset_m),
        (at_lift, part.upper_arm_m),
        (at_elbow, part.forearm_m),
        (hand, part.tool_m),
    ):
        for axis, step in enumerate(rotated(turn, (length, 0.0, 0.0))):
            place[axis] += step
    return Vector(*place), hand


def _elbow_turn(angles: Sequence[float]) -> Quaternion:
    """How the forearm is turned, as seen from the torso."""
    pan, lift, roll, elbow = angles
    return product(product(product(_about_z(pan), _about_y(lift)), _about_x(roll)), _about_y(elbow))


def _shoulder(description: RobotDescription, part: ArmDescription, torso_height: float) -> Vector:
    torso, shoulder = description.torso_origin, part.shoulder
    return Vector(torso.x + shoulder.x, torso.y + shoulder.y, torso.z + torso_height + shoulder.z)


def _about_x(angle: float) -> Quaternion:
    return Quaternion(math.sin(angle / 2), 0.0, 0.0, math.cos(angle / 2))


def _about_y(angle: float) -> Quaternion:
    return Quaternion(0.0, math.sin(angle / 2), 0.0, math.cos(angle / 2))


def _about_z(angle: float) -> Quaternion:
    return Quaternion(0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))


def _angle_between(a: Quaternion, b: Quaternion) -> float:
    x, y, z, w = product((-a.x, -a.y, -a.z, a.w), b)
    return 2 * math.atan2(math.hypot(x, y, z), abs(w))


def _one_arm(description: RobotDescription, arm: Arms) -> ArmDescription:
    try:
        return description.arms[arm]
    except KeyError:
        raise CallerError(f"{description.name} has no single arm {arm.name}: ask for one arm at a time") from None


def _bounds(part: ArmDescription, limits: Limits) -> dict[str, Bounds]:
    """In the order of the joints."""
    by_name = part.limits(limits)
    return {name: by_name[name] for name in part.joints}


def _narrowed(bound: Bounds, other: tuple[float, float]) -> Bounds:
    return Bounds(max(bound.lower, other[0]), min(bound.upper, other[1]))
