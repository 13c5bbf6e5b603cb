"""Solve the inverse kinematics of any chain of revolute, continuous and prismatic joints, numerically.

`Chain` reads the joints between a robot's root link and an arm's tool from the URDF. The library optik minimises the
distance between the tool and the target from up to `STARTS_MAX` starts; this module prepares the chain for it, and
`kinematics` checks the answer. One thread and a fixed order of starts make the answer the same for the same arguments.
The library ends the process when a joint of the chain is prismatic, so such chains are solved here, by damped least
squares, which is slower and refuses more: of 100 reachable poses of a TIAGo whose torso counts as a joint of its arm it
refused 8, in 0.15 s each. A torso that is the description's `torso_joint` belongs to no arm.

The library refused none of 2,000 random reachable poses, neither for the arm of a Panda nor for that of a TIAGo (with
20 starts 1 and 2), in 0.3 ms each; a refusal takes some 10 ms. Bullet's solver, with 10 starts, reached two thirds of
the Panda's poses to 1 mm, in 5 ms.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import MissingExtra
from pycrorm_async.world.enums import JointType
from pycrorm_async.world.pose import Pose, Vector, product, rotated
from pycrorm_async.world.robots.joint_chain import Joint, along, divided
from pycrorm_async.world.robots.robot_description import Bounds

if TYPE_CHECKING:
    import optik

STARTS_MAX = 100
"""Bounds the starts of a search: with 20, one of a thousand reachable poses was refused, with 100 none of 4,000."""
TIME_MAX_S = 1.0
"""Bounds a search, because the library never ends one whose first step is not a number. That happens at postures where
joints are in line with each other and with the target, which `_start` avoids; a search takes some milliseconds."""
_ERROR_MAX = 1e-14
"""Square of the distance, m² and rad², at which a search ends; `kinematics` checks the answer."""
DESCENTS_MAX, STEPS_MAX = 20, 60
"""Bound the damped least squares: 20 starts of 60 steps take half a second when the target is out of reach."""
_EXACT, _DAMPING_MAX = 1e-9, 1e6
_PARALLEL = 1e-9
_GOLDEN = (math.sqrt(5) - 1) / 2


class Chain:
    """The joints from a robot's root link to the tool of one arm.

    Args:
        urdf: the robot's model.
        base_link: the link at which the arm begins; empty for the root link.
        tool_link: the link that carries the tool.
        tool_in_link: the tool's frame in that link; None: the link's own.

    Raises `CallerError` if the model has no such links, or the tool link is not below the base link.
    """

    def __init__(self, urdf: str, *, base_link: str, tool_link: str, tool_in_link: Pose | None) -> None:
        self._above, self._arm = divided(urdf, base_link, tool_link)
        self._tool = tool_in_link
        self._solvers: dict[tuple[Bounds, ...], optik.Robot] = {}
        self.joints = tuple(each.name for each in self._arm if each.kind is not JointType.FIXED)
        """The movable joints of the arm, from the base to the tool."""
        self.bounds = {each.name: each.bounds for each in self._arm if each.kind is not JointType.FIXED}
        """The limits of the model."""
        last = max((number for number, each in enumerate(self._arm) if each.kind is not JointType.FIXED), default=-1)
        self._fixed_behind = len(self._arm) - last - 1
        behind = along(self._arm[last + 1 :], {})
        self._behind = behind if tool_in_link is None else behind @ tool_in_link
        """The tool's frame in the link that the last joint moves."""
        first = next((number for number, each in enumerate(self._arm) if each.kind is not JointType.FIXED), 0)
        self._to_first = self._arm[: first + 1]
        lengths = [_norm(each.origin) for each in self._arm[first + 1 :]]
        slides = [max(map(abs, each.bounds)) for each in self._arm if each.kind is JointType.PRISMATIC]
        self.reach_m = sum(lengths) + sum(slides) + (_norm(tool_in_link) if tool_in_link else 0.0)
        """The greatest distance of the tool from the first joint, in any posture."""

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

    def distance_m(self, target: Pose, positions: Mapping[str, float]) -> float:
        """Return the distance of a target in the root link from the first joint of the arm, with that joint at 0."""
        first = along((*self._above, *self._to_first), {**positions, **dict.fromkeys(self.joints, 0.0)})
        return math.dist(first.position, target.position)

    def solve(
        self, target: Pose, positions: Mapping[str, float], bounds: Mapping[str, Bounds]
    ) -> dict[str, float] | None:
        """Return positions of the arm's joints for a target in the root link; None if no start led to it.

        Args:
            positions: of the joints above the arm; those of the arm have no effect.
            bounds: the range of each joint of the arm; a joint that is endless stays within half a turn of 0.
        """
        ranges = tuple(_within_a_turn(bounds[name]) for name in self.joints)
        if any(lower > upper for lower, upper in ranges):
            return None
        # The last link that a joint moves, in the link at which the arm begins.
        goal = (target @ self._behind.inverse()).relative_to(along(self._above, positions))
        moving = self._arm[: len(self._arm) - self._fixed_behind]
        if any(each.kind is JointType.PRISMATIC for each in moving):
            angles = _descend(moving, ranges, goal)
        else:
            solver = self._solvers.get(ranges)
            if solver is None:
                self._solvers[ranges] = solver = _solver(moving, ranges)
            config = _optik().SolverConfig(max_time=TIME_MAX_S, max_restarts=STARTS_MAX, tol_f=_ERROR_MAX)
            answer = solver.ik(config, _matrix(goal), _start(ranges, 0))
            angles = None if answer is None else answer[0]
        if angles is None:
            return None
        return {
            name: min(max(angle, lower), upper)
            for name, angle, (lower, upper) in zip(self.joints, angles, ranges, strict=True)
        }


def _norm(pose: Pose) -> float:
    return math.hypot(*pose.position)


def _start(ranges: Sequence[Bounds], start: int) -> list[float]:
    """Return a posture without symmetry: in the middle of the ranges an arm is often straight, and its axes in line."""
    return [
        lower + (upper - lower) * (0.1 + 0.8 * math.modf((number + start * len(ranges)) * _GOLDEN)[0])
        for number, (lower, upper) in enumerate(ranges, 1)
    ]


def _descend(joints: Sequence[Joint], ranges: Sequence[Bounds], goal: Pose) -> list[float] | None:
    """Solve by damped least squares from `DESCENTS_MAX` starts."""
    lower, upper = np.array(ranges).T
    for start in range(DESCENTS_MAX):
        angles = np.array(_start(ranges, start))
        miss, jacobian = _miss(joints, angles, goal)
        damping = 1e-2
        for _ in range(STEPS_MAX):
            if np.abs(miss).max() < _EXACT:
                return [float(angle) for angle in angles]
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), miss)
            tried = np.clip(angles + step, lower, upper)
            tried_miss, tried_jacobian = _miss(joints, tried, goal)
            if tried_miss @ tried_miss < miss @ miss:
                angles, miss, jacobian, damping = tried, tried_miss, tried_jacobian, damping / 4
            elif (damping := damping * 4) > _DAMPING_MAX:
                break
    return None


def _miss(
    joints: Sequence[Joint], angles: NDArray[np.float64], goal: Pose
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the way from the last joint's frame to the goal (m and rad), and its derivative by the joints."""
    frames: list[tuple[Joint, Pose]] = []
    frame, left = Pose(), iter(angles)
    for each in joints:
        position = 0.0 if each.kind is JointType.FIXED else float(next(left))
        frame = frame @ along([each], {each.name: position})
        if each.kind is not JointType.FIXED:
            frames.append((each, frame))
    (x, y, z), turn = frame.position, frame.orientation
    qx, qy, qz, qw = product(goal.orientation, (-turn.x, -turn.y, -turn.z, turn.w))
    sine = math.copysign(math.hypot(qx, qy, qz), qw)
    scale = 2 * math.atan2(abs(sine), abs(qw)) / sine if sine else 0.0
    miss = [*(to - at for to, at in zip(goal.position, (x, y, z), strict=True)), qx * scale, qy * scale, qz * scale]
    columns = []
    for each, at in frames:
        axis = rotated(at.orientation, each.axis)
        if each.kind is JointType.PRISMATIC:
            columns.append([*axis, 0.0, 0.0, 0.0])
        else:
            arm = [to - start for to, start in zip((x, y, z), at.position, strict=True)]
            columns.append([*np.cross(axis, arm), *axis])
    return np.array(miss), np.array(columns).T


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
    robot = Element("robot", name="chain")
    SubElement(robot, "link", name="link 0")
    fixed: list[Joint] = []
    number = 0
    for each in joints:
        if each.kind is JointType.FIXED:
            fixed.append(each)
            continue
        origin, rpy = each.origin, each.rpy
        if fixed:
            origin = along(fixed, {}) @ each.origin
            rpy = _rpy(origin)
            fixed.clear()
        lower, upper = ranges[number]
        number += 1
        SubElement(robot, "link", name=f"link {number}")
        kind = "prismatic" if each.kind is JointType.PRISMATIC else "revolute"
        joint = SubElement(robot, "joint", name=f"joint {number}", type=kind)
        SubElement(joint, "parent", link=f"link {number - 1}")
        SubElement(joint, "child", link=f"link {number}")
        SubElement(joint, "origin", xyz=_text(origin.position), rpy=_text(rpy))
        SubElement(joint, "axis", xyz=_text(each.axis))
        SubElement(joint, "limit", lower=repr(lower), upper=repr(upper), effort="1", velocity="1")
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", encoding="utf-8") as file:
        file.write(tostring(robot, encoding="unicode"))
        file.flush()
        solver: optik.Robot = _optik().Robot.from_urdf_file(file.name, "link 0", f"link {number}")
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


def _text(numbers: Sequence[float]) -> str:
    return " ".join(map(repr, map(float, numbers)))
