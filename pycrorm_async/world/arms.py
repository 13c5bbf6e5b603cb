"""Solve the inverse kinematics of arms: in closed form, or numerically for any chain."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import MissingExtra
from pycrorm_async.world.pose import JointType, Pose, Quaternion, Vector, product, rotated, yaw_quaternion
from pycrorm_async.world.urdf import PR2Arm
from pycrorm_async.world.urdf_model import ENDLESS, Bounds, Joint, Model, along, joint_lines

if TYPE_CHECKING:
    import optik


#
# Compute all postures that bring an arm's tool frame to a target, as a curve over the angle of its first joint.
#
# An arm of seven joints has one more than a pose needs. For a fixed shoulder pan the rest follows in closed form: the
# distance of the wrist from the shoulder determines the elbow, the wrist's sideways offset the roll of the upper arm
# (two solutions), its height the lift, and the hand's orientation the last three joints. `pan_windows` returns the
# ranges of pan to search, `curve` computes the postures for an array of pans, `wrist_angles` completes a posture. The
# module is pure geometry in the axes of the torso; `kinematics` chooses among the postures.

Floats = NDArray[np.float64]
PAN, LIFT, ROLL, ELBOW, FOREARM_ROLL, FLEX, WRIST_ROLL = range(7)
ROUNDING = 1e-9
"""Bounds the rounding error of a margin (rad) or a cosine; a posture beyond a limit by less counts as inside."""
_TINY = 1e-12
"""Replaces a length of 0 m in a divisor, where the result then does not matter."""


class Reach(NamedTuple):
    """A target in the axes of the torso."""

    tool: Vector
    """Position of the tool frame relative to the origin of the pan joint, m."""
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
    folded, stretched = stretches_m(arm_description, bounds)
    across, offset = math.hypot(wrist.x, wrist.y), arm_description.shoulder_offset_m
    middle = across * across + wrist.z * wrist.z + offset * offset
    scale = max(2 * offset * across, _TINY)
    least, most = (middle - stretched**2) / scale, (middle - folded**2) / scale
    if least > 1 + ROUNDING or most < -1 - ROUNDING:
        return []
    nearest, farthest = (math.acos(max(-1.0, min(1.0, cosine))) for cosine in (most, least))
    towards = math.atan2(wrist.y, wrist.x)
    lower, upper = bounds[PAN]
    windows = []
    for centre in (towards - math.tau, towards, towards + math.tau):
        for start, end in (
            (centre - farthest, centre - nearest),
            (centre + nearest, centre + farthest),
        ):
            if max(start, lower) <= min(end, upper):
                windows.append(Bounds(max(start, lower), min(end, upper)))
    return windows


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


# === chain ik =================================================================================================
#
# Solve the inverse kinematics of any chain of revolute, continuous and prismatic joints, numerically.
#
# `Chain` reads the joints between a robot's root link and an arm's tool from the URDF. The library optik minimises the
# distance between the tool and the target from up to `STARTS_MAX` starts; this module prepares the chain for it, and
# `kinematics` checks the answer. One thread and a fixed order of starts make the answer the same for the same
# arguments. The library ends the process when a joint of the chain is prismatic, so such chains are solved here, by
# damped least squares, which is slower and refuses more: of 100 reachable poses of a TIAGo whose torso counts as a
# joint of its arm it refused 8, in 0.15 s each. A torso that is the description's `torso_joint` belongs to no arm.
#
# An arm of fewer joints than a pose has coordinates, or with parallel ones, such as a lift and a telescope, is solved
# here too, for the part of the orientation that it can hold (`Held`).
#
# The library refused none of 2,000 random reachable poses, neither for the arm of a Panda nor for that of a TIAGo (with
# 20 starts 1 and 2), in 0.3 ms each; a refusal takes some 10 ms. Bullet's solver, with 10 starts, reached two thirds of
# the Panda's poses to 1 mm, in 5 ms.

STARTS_MAX = 100
"""Bounds the starts of a search: with 20, one of a thousand reachable poses was refused, with 100 none of 4,000."""
STARTS_OF_SEARCH = 20
"""Bounds the starts where many places are searched: a refusal takes 5 ms instead of 22 ms, and a TIAGo Pro, whose
limits are narrow, is refused 4 % of the poses that it reaches. The answers are those that more starts give too."""
TIME_MAX_S = 1.0
"""Bounds a search, because the library never ends one whose first step is not a number. That happens at postures where
joints are in line with each other and with the target, which `_start` avoids; a search takes some milliseconds."""
POSTURES_MAX = 8
"""Bounds the postures for one target: more are tried only where those before collide."""
_ALIKE = 1e-3
"""The greatest difference of the joints, rad or m, of two answers that count as one posture."""
_ERROR_MAX = 1e-14
"""Square of the distance, m² and rad², at which a search ends; `kinematics` checks the answer."""
DESCENTS_MAX, STEPS_MAX = 20, 60
"""Bound the damped least squares: 20 starts of 60 steps take half a second when the target is out of reach."""
HEADINGS_MAX = 3
"""Bounds the headings of the base that are tried at one place for an arm that cannot turn its tool freely."""
_EXACT, _DAMPING_MIN, _DAMPING_MAX = 1e-9, 1e-9, 1e2
"""With less damping the equations of an arm of few directions are singular."""
_STALLED, _STALLED_DAMPING = 0.999, 1e-3
"""A step with this damping or less that leaves more than this part of the squared way ends a descent."""
_PARALLEL = 1e-9
_GOLDEN = (math.sqrt(5) - 1) / 2


class Held(Enum):
    """The part of a target's orientation that an arm brings its tool to."""

    ALL = "ALL"
    """All of it: the arm moves and turns its tool in six directions."""
    AHEAD = "AHEAD"
    """The direction of the fingers, about which the tool may be turned: five directions, as with five joints.

    Where the arm cannot hold it, nothing but the position: many an arm of five joints points its fingers only away from
    its base.
    """
    NONE = "NONE"
    """Nothing but the position: four directions or fewer."""


class Chain:
    """The joints from a robot's root link to the tool of one arm.

    Args:
        model: the robot's model.
        base_link: the link at which the arm begins; empty for the root link.
        tool_link: the link that carries the tool.
        tool_in_link: the tool's frame in that link; None: the link's own.

    Raises `CallerError` if the model has no such links, or the tool link is not below the base link.
    """

    def __init__(self, model: Model, *, base_link: str, tool_link: str, tool_in_link: Pose | None) -> None:
        self._above, self._arm = model.divided(base_link, tool_link)
        self._tool = tool_in_link
        self._solvers: dict[tuple[Bounds, ...], optik.Robot] = {}
        self.joints = tuple(each.name for each in self._arm if each.moves_freely)
        """The movable joints of the arm that follow no other, from the base to the tool."""
        self.bounds = {each.name: each.bounds for each in self._arm if each.moves_freely}
        """The limits of the model."""
        last = max((number for number, each in enumerate(self._arm) if each.kind is not JointType.FIXED), default=-1)
        self._moving = self._arm[: last + 1]
        behind = along(self._arm[last + 1 :], {})
        self._behind = behind if tool_in_link is None else behind @ tool_in_link
        """The tool's frame in the link that the last joint moves."""
        first = next((number for number, each in enumerate(self._arm) if each.kind is not JointType.FIXED), 0)
        self._to_first = self._arm[: first + 1]
        slides = sum(max(map(abs, each.bounds)) for each in self._arm if each.kind is JointType.PRISMATIC)
        self._wrist_reach_m = slides + sum(_norm(each.origin) for each in self._moving[first + 1 :])
        fixed = sum(_norm(each.origin) for each in self._arm[last + 1 :])
        self.reach_m = self._wrist_reach_m + fixed + (_norm(tool_in_link) if tool_in_link else 0.0)
        """The greatest distance of the tool from the first joint, in any posture."""

    @cached_property
    def held(self) -> Held:
        """The part of a target's orientation that the arm holds, by the directions in which it moves and turns."""
        start = _start([_within_a_turn(bounds) for bounds in self.bounds.values()], 0)
        _, jacobian = _Descent(self._arm, (), {}, self._behind, Pose()).miss(start, Held.ALL)
        directions = int(np.linalg.matrix_rank(jacobian, tol=_EXACT))
        return Held.ALL if directions == 6 else Held.AHEAD if directions == 5 else Held.NONE

    def forward(self, positions: Mapping[str, float]) -> Pose:
        """Return the tool's frame in the root link at these joint positions; joints that are left out are at 0."""
        tool = along((*self._above, *self._arm), positions)
        return tool if self._tool is None else tool @ self._tool

    def axes(self, positions: Mapping[str, float]) -> dict[str, Vector]:
        """Return the axis of each revolute joint of the arm, in the root link, at these joint positions."""
        return {
            each.name: rotated(along((*self._above, *self._arm[: number + 1]), positions).orientation, each.axis)
            for number, each in enumerate(self._arm)
            if each.kind in (JointType.REVOLUTE, JointType.CONTINUOUS)
        }

    def first_joint(self, positions: Mapping[str, float]) -> Vector:
        """Return the position of the first joint of the arm in the root link, with that joint at 0."""
        return along((*self._above, *self._to_first), {**positions, **dict.fromkeys(self.joints, 0.0)}).position

    def held_point(self, target: Pose) -> tuple[Vector, float]:
        """Return the point at which a target holds the arm, and its greatest distance from the first joint, m.

        Of an arm that holds the whole orientation it is the last joint, the wrist, of any other the tool.
        """
        if self.held is Held.ALL:
            return (target @ self._behind.inverse()).position, self._wrist_reach_m
        return target.position, self.reach_m

    def postures(
        self, target: Pose, positions: Mapping[str, float], bounds: Mapping[str, Bounds], starts: int = STARTS_MAX
    ) -> Iterator[dict[str, float]]:
        """Yield different positions of the arm's joints for a target in the root link; none if no start leads to it.

        Args:
            positions: of the joints above the arm; those of the arm have no effect.
            bounds: the range of each joint of the arm; a joint that is endless stays within half a turn of 0.
            starts: bounds the starts of the library, for each posture.
        """
        ranges = tuple(_within_a_turn(bounds[name]) for name in self.joints)
        if any(lower > upper for lower, upper in ranges):
            return
        goal = target.relative_to(along(self._above, positions))
        moving = self._moving
        slides = any(each.kind is JointType.PRISMATIC or each.mimic is not None for each in moving)
        answers: Iterator[Sequence[float]]
        if slides or self.held is not Held.ALL:
            answers = _Descent(moving, ranges, positions, self._behind, goal).postures(self.held, DESCENTS_MAX)
        else:
            answers = self._from_starts(goal @ self._behind.inverse(), ranges, starts)
        earlier: list[NDArray[np.float64]] = []
        for angles in answers:
            if all(np.abs(np.subtract(angles, each)).max() > _ALIKE for each in earlier):
                earlier.append(np.array(angles))
                yield {
                    name: min(max(angle, lower), upper)
                    for name, angle, (lower, upper) in zip(self.joints, angles, ranges, strict=True)
                }

    def _from_starts(self, wrist: Pose, ranges: tuple[Bounds, ...], starts: int) -> Iterator[Sequence[float]]:
        """Yield the answers of the library for a frame of the last joint, each from another start."""
        solver = self._solvers.get(ranges)
        if solver is None:
            self._solvers[ranges] = solver = _solver(self._moving, ranges)
        config = _optik().SolverConfig(max_time=TIME_MAX_S, max_restarts=starts, tol_f=_ERROR_MAX)
        for start in range(POSTURES_MAX):
            answer = solver.ik(config, _matrix(wrist), _start(ranges, start))
            if answer is None:
                return
            yield answer[0]

    def turns_to(
        self, target: Pose, base: Pose, positions: Mapping[str, float], bounds: Mapping[str, Bounds]
    ) -> Iterator[float]:
        """Yield angles by which a base would turn so that the arm reaches a target: the base is its first joint.

        Args:
            target: in the frame of the base link, before it turns.
            base: the base link in the root link.
            positions, bounds: as for `solve`.
        """
        ranges = (_within_a_turn(ENDLESS), *(_within_a_turn(bounds[name]) for name in self.joints))
        mount = Joint("", JointType.FIXED, "", "", base.inverse() @ along(self._above, positions), *_NO_TURN)
        descent = _Descent((_BASE, mount, *self._moving), ranges, positions, self._behind, target)
        yield from (angles[0] for angles in descent.postures(self.held, HEADINGS_MAX))


_NO_TURN = ((0.0, 0.0, 0.0), Vector(0.0, 0.0, 1.0), ENDLESS)
_BASE = Joint("", JointType.CONTINUOUS, "", "", Pose(), *_NO_TURN)
"""Turns the base of a robot about its vertical axis."""


def _norm(pose: Pose) -> float:
    return math.hypot(*pose.position)


def _start(ranges: Sequence[Bounds], start: int) -> list[float]:
    """Return a posture without symmetry: in the middle of the ranges an arm is often straight, and its axes in line."""
    return [
        lower + (upper - lower) * (0.1 + 0.8 * math.modf((number + start * len(ranges)) * _GOLDEN)[0])
        for number, (lower, upper) in enumerate(ranges, 1)
    ]


class _Descent(NamedTuple):
    """The search for postures of a chain by damped least squares.

    Attributes:
        joints: of the chain; those that follow no other are searched within `ranges`.
        positions: of joints outside the chain that others follow.
        behind: the tool's frame in the link that the last joint moves.
        goal: of the tool, in the chain's first link.
    """

    joints: Sequence[Joint]
    ranges: Sequence[Bounds]
    positions: Mapping[str, float]
    behind: Pose
    goal: Pose

    def postures(self, held: Held, starts: int) -> Iterator[list[float]]:
        """Yield the postures to which descents lead.

        Where the direction of the fingers cannot be held, the position is reached from the postures nearest to both.
        """
        ends = []
        for start in range(starts):
            miss, angles = self.lowest(held, _start(self.ranges, start))
            if miss < _EXACT:
                yield angles
            ends.append((miss, angles))
        if held is Held.AHEAD and min(ends)[0] >= _EXACT:
            for _, nearest in sorted(ends)[:HEADINGS_MAX]:
                miss, angles = self.lowest(Held.NONE, nearest)
                if miss < _EXACT:
                    yield angles

    def lowest(self, held: Held, start: Sequence[float]) -> tuple[float, list[float]]:
        """Return the greatest part of the way that is left where a descent ends, and the posture there."""
        lower, upper = np.array(self.ranges).T
        angles = np.array(start)
        miss, jacobian = self.miss(angles, held)
        damping = 1e-2
        for _ in range(STEPS_MAX):
            if np.abs(miss).max() < _EXACT:
                break
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), miss)
            tried = np.clip(angles + step, lower, upper)
            tried_miss, tried_jacobian = self.miss(tried, held)
            if tried_miss @ tried_miss < miss @ miss:
                stalls = tried_miss @ tried_miss > _STALLED * (miss @ miss) and damping < _STALLED_DAMPING
                angles, miss, jacobian, damping = tried, tried_miss, tried_jacobian, max(damping / 4, _DAMPING_MIN)
                if stalls:  # a local minimum, not the goal
                    break
            elif (damping := damping * 4) > _DAMPING_MAX:
                break
        return float(np.abs(miss).max()), [float(angle) for angle in angles]

    def miss(self, angles: Sequence[float] | Floats, held: Held) -> tuple[Floats, Floats]:
        """Return the way from the tool to the goal (m and rad), and its derivative by the joints that are searched."""
        free = {each.name: number for number, each in enumerate(each for each in self.joints if each.moves_freely)}
        positions = {**self.positions, **{name: float(angles[number]) for name, number in free.items()}}
        frame = Pose()
        frames: list[Pose] = []
        for each in self.joints:
            frame = frame @ along([each], positions)
            frames.append(frame)
        tool = frame @ self.behind
        ahead = np.array(rotated(tool.orientation, (1.0, 0.0, 0.0)))
        jacobian = np.zeros((6, len(free)))
        for each, at in zip(self.joints, frames, strict=True):
            leader, factor = (each.name, 1.0) if each.mimic is None else each.mimic[:2]
            if each.kind is JointType.FIXED or leader not in free:
                continue
            axis = np.array(rotated(at.orientation, each.axis))
            if each.kind is JointType.PRISMATIC:
                jacobian[:3, free[leader]] += factor * axis
            else:
                arm = [to - start for to, start in zip(tool.position, at.position, strict=True)]
                turn = {Held.ALL: axis, Held.AHEAD: axis - ahead * (ahead @ axis), Held.NONE: 0.0 * axis}[held]
                jacobian[:, free[leader]] += factor * np.concatenate([np.cross(axis, arm), turn])
        return np.array(_difference(tool, self.goal, held)), jacobian


def _difference(tool: Pose, goal: Pose, held: Held) -> list[float]:
    """Return the way between two frames, m, and the rotation vector between what is held of their orientations, rad."""
    way = [to - at for to, at in zip(goal.position, tool.position, strict=True)]
    if held is Held.NONE:
        return [*way, 0.0, 0.0, 0.0]
    if held is Held.AHEAD:
        one, other = (np.array(rotated(each.orientation, (1.0, 0.0, 0.0))) for each in (tool, goal))
        turn = np.cross(one, other)
        sine = math.hypot(*turn)
        scale = math.atan2(sine, float(one @ other)) / sine if sine else 0.0
        return [*way, *(float(each) * scale for each in turn)]
    x, y, z, w = tool.orientation
    qx, qy, qz, qw = product(goal.orientation, (-x, -y, -z, w))
    sine = math.copysign(math.hypot(qx, qy, qz), qw)
    scale = 2 * math.atan2(abs(sine), abs(qw)) / sine if sine else 0.0
    return [*way, qx * scale, qy * scale, qz * scale]


def _within_a_turn(bounds: Bounds) -> Bounds:
    return Bounds(-math.pi, math.pi) if math.isinf(bounds.upper - bounds.lower) else bounds


def _matrix(pose: Pose) -> list[list[float]]:
    axes = [rotated(pose.orientation, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    rows = [[axis[row] for axis in axes] + [pose.position[row]] for row in range(3)]
    return [*rows, [0.0, 0.0, 0.0, 1.0]]


def _solver(joints: Sequence[Joint], ranges: Sequence[Bounds]) -> optik.Robot:
    """Load a model of this chain alone, whose last joint is movable, with these ranges.

    The library supports no continuous joint: each becomes a revolute one with its range. The library leaves out fixed
    joints: each is made part of the next movable joint.
    """
    lines, fixed, number = ["<robot name='chain'>", "<link name='0'/>"], list[Joint](), 0
    for each in joints:
        if each.kind is JointType.FIXED:
            fixed.append(each)
            continue
        origin, rpy = each.origin, each.rpy
        if fixed:
            origin = along(fixed, {}) @ each.origin
            rpy = _rpy(origin)
            fixed.clear()
        parent, child = f"{number}", f"{number + 1}"
        joint = Joint(child, JointType.REVOLUTE, parent, child, origin, rpy, each.axis, ranges[number])
        lines += [f"<link name='{child}'/>", *joint_lines(joint)]
        number += 1
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", encoding="utf-8") as file:
        file.write("\n".join([*lines, "</robot>"]))
        file.flush()
        solver: optik.Robot = _optik().Robot.from_urdf_file(file.name, "0", f"{number}")
    solver.set_parallelism(1)
    return solver


def _optik() -> Any:
    """Import the library when the first chain is solved. Raises `MissingExtra`."""
    try:
        import optik
    except ImportError:
        raise MissingExtra("the posture of this arm needs optik: pip install 'pycrorm-async[world]'") from None
    return optik


def _rpy(pose: Pose) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of an orientation."""
    (xx, xy, _, _), (yx, yy, _, _), (zx, zy, zz, _), _ = _matrix(pose)
    flat = math.hypot(xx, yx)
    if flat < _PARALLEL:  # roll and yaw turn about one axis: let roll be 0
        return 0.0, math.atan2(-zx, flat), math.atan2(-xy, yy)
    return math.atan2(zy, zz), math.atan2(-zx, flat), math.atan2(yx, xx)
