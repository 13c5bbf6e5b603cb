"""Compute an arm's tool frame from joint angles (`forward`), and joint angles for a pose of the tool frame (`solve`).

For an arm of the PR2's build there is a closed form: a reachable pose has a curve of postures over the shoulder pan
(`world.arms`), which is sampled, both ends included, in steps of at most 0.01 rad, finer where it misses narrowly; the
result is the posture that stays farthest from every limit. Continuous joints have no limits. A refused target is out of
reach, except for rare ones at the rim of the workspace (about 1 in 10,000 of the reachable ones there) whose only
postures lie in a narrow range between limits. Any other arm is solved numerically (`world.arms`). An arm that cannot
turn its tool freely, such as one of four or five joints, brings it to the position and, with five directions of motion,
to the direction of the fingers where it can; the rest of the orientation stays free.

The result is deterministic: on one machine the same arguments yield the same result, to the bit. `solve` verifies it by
forward kinematics to 1e-6 m and 1e-6 rad. Collisions, with the robot itself or with objects, are not checked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.world import arms as arm_ik
from pycrorm_async.world.arms import Chain, Floats, Held, Reach
from pycrorm_async.world.pose import Arms, Pose, Quaternion, Vector, product, rotated, yaw_quaternion
from pycrorm_async.world.urdf import ArmDescription, Bounds, Limits, PR2Arm, PR2Description, RobotDescription

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import Object

A = TypeVar("A")

PAN_STEP_RAD = 0.01
"""Largest step between two sampled pans."""
NEAR_MISS_RAD = 0.02
"""A best posture at most this far outside the limits is searched again in steps fifty times finer."""
EXACT_M = EXACT_RAD = 1e-6
"""Greatest difference between the target and the tool frame at the returned angles."""


class Unreachable(Exception):
    """No posture within the limits brings the arm's tool frame to the target; `reason` names the obstacle.

    It is an outcome and not a fault of the caller: plans convert it to a plan failure.
    """

    def __init__(self, target: Pose, arm: Arms, reason: str) -> None:
        super().__init__(f"the {arm.name} arm cannot reach {target!r}: {reason}")
        self.target = target
        self.arm = arm
        self.reason = reason


def forward(
    description: PR2Description, arm: Arms, joints: Mapping[str, float], *, torso_height: float, base: Pose
) -> Pose:
    """Return the pose of the arm's tool frame, in the frame of `base`.

    Args:
        joints: angles by joint name, rad; all seven of the arm, others are ignored.
        torso_height: the torso joint's position, m.
        base: pose of the robot's root link.
    """
    arm_description = _one_arm(description.arms, description, arm)
    tool, turn = arm_ik.hand(arm_description, [joints[name] for name in arm_description.joints])
    shoulder = _shoulder(description, arm_description, torso_height)
    return base @ Pose([a + b for a, b in zip(shoulder, tool, strict=True)], turn, base.frame)


def solve(
    robot: Object,
    arm: Arms,
    target: Pose,
    *,
    base: Pose | None = None,
    torso_height: float | None = None,
    limits: Limits = Limits.SOFT,
) -> dict[str, float]:
    """Return joint angles by name, rad, that bring the arm's tool frame to the target; moves nothing.

    The robot is taken at its current pose and torso height unless `base` (the pose of its base link) or `torso_height`
    (m) is passed. For hard limits the narrower of the loaded model's and the description's apply.

    Raises:
        Unreachable: no posture within the limits reaches the target.
        CallerError: the robot has no description or one that does not fit its model, `arm` is not a single arm, or the
            target is in another frame or not finite.
        MissingExtra: the arm has no closed form, and the library for other arms is not installed.
    """
    return next(postures(robot, arm, target, base=base, torso_height=torso_height, limits=limits))


def postures(
    robot: Object,
    arm: Arms,
    target: Pose,
    *,
    base: Pose | None = None,
    torso_height: float | None = None,
    limits: Limits = Limits.SOFT,
    starts: int = arm_ik.STARTS_MAX,
) -> Iterator[dict[str, float]]:
    """Yield what `solve` returns, then further postures for the target, with which an arm may be clear of obstacles.

    An arm with a closed form has one: that farthest from all limits. With fewer `starts` other arms are refused sooner,
    and may be refused a target that they reach. Raises what `solve` raises, before the first.
    """
    description = robot.robot_description
    if description is None:
        raise CallerError(f"{robot.name!r} has no robot description, so its arms are unknown")
    root = robot.root_pose(base)
    if isinstance(description, PR2Description):
        height = robot.joint_position(description.torso_joint) if torso_height is None else torso_height
        narrower = robot.joint_limits if limits is Limits.HARD else None
        yield solve_from(description, arm, target, base=root, torso_height=height, limits=limits, narrower=narrower)
        return
    arm_description = _one_arm(description.arms, description, arm)
    _check(target, root)
    chain = chain_of(robot, arm)
    positions = robot.joint_positions()
    if torso_height is not None and description.torso_joint is not None:
        positions[description.torso_joint] = torso_height
    goal = target.relative_to(root)
    point, reach_m = chain.held_point(goal)
    distance = math.dist(chain.first_joint(positions), point)
    if distance > reach_m:
        raise Unreachable(target, arm, f"too far: {distance:.3f} m from its first joint, it reaches {reach_m:.3f} m")
    is_reached = False
    for joints in chain.postures(goal, positions, _chain_bounds(chain, arm_description, limits), starts):
        reached = chain.forward(positions | joints)
        turned = _angle_between(reached.orientation, goal.orientation) if chain.held is Held.ALL else 0.0
        if reached.distance(goal) <= EXACT_M and turned <= EXACT_RAD:
            is_reached = True
            yield joints
    if not is_reached:
        raise Unreachable(target, arm, f"no posture within its {limits.name.lower()} limits was found")


def solve_from(
    description: PR2Description,
    arm: Arms,
    target: Pose,
    *,
    base: Pose,
    torso_height: float,
    limits: Limits = Limits.SOFT,
    narrower: Callable[[str], tuple[float, float]] | None = None,
) -> dict[str, float]:
    """Return the joint angles of `solve` for a root link at `base` and a torso at `torso_height` m, without a world.

    The torso height is not checked against its limits. The rolls of forearm and wrist are in [-π, π]. `narrower`
    returns the limits of a joint in a loaded model, which narrow the described ones.

    >>> from pycrorm_async.world.urdf import PR2
    >>> target = Pose([0.6, 0.2, 0.9])
    >>> joints = solve_from(PR2, Arms.LEFT, target, base=Pose(), torso_height=0.0)
    >>> forward(PR2, Arms.LEFT, joints, torso_height=0.0, base=Pose()).distance(target) < 1e-9
    True
    """
    arm_description = _one_arm(description.arms, description, arm)
    bounds = _bounds(arm_description, limits, narrower)
    reach = _reach(description, arm_description, target, root=base, torso_height=torso_height)
    windows = arm_ik.pan_windows(arm_description, reach.wrist, bounds)
    if not windows:
        raise Unreachable(target, arm, _why_no_pan(arm_description, reach.wrist, bounds, limits))
    pans = np.concatenate([_steps(window, PAN_STEP_RAD) for window in windows])
    upper, margin = _best(arm_description, reach, pans, bounds)
    if -NEAR_MISS_RAD < margin < 0:
        around = _narrow(bounds[arm_ik.PAN], (upper[0] - PAN_STEP_RAD, upper[0] + PAN_STEP_RAD))
        upper, margin = _best(arm_description, reach, _steps(around, PAN_STEP_RAD / 50), bounds)
    angles = [*upper, *arm_ik.wrist_angles(upper, reach.turn)]
    if margin < -arm_ik.ROUNDING:
        raise Unreachable(target, arm, _why_no_posture(arm_description, angles, bounds, limits))
    angles = [min(max(angle, lower), upper) for angle, (lower, upper) in zip(angles, bounds, strict=True)]
    tool, turn = arm_ik.hand(arm_description, angles)
    if math.dist(tool, reach.tool) > EXACT_M or _angle_between(turn, reach.turn) > EXACT_RAD:
        raise Unreachable(target, arm, "the target is at the limit of the arm's reach, less than 1e-6 m away from it")
    return dict(zip(arm_description.joints, angles, strict=True))


def within_reach(
    robot: Object,
    arm: Arms,
    targets: Sequence[Pose],
    *,
    bases: Sequence[Pose],
    torso_heights: Sequence[float | None],
    limits: Limits = Limits.SOFT,
) -> NDArray[np.bool_]:
    """Return whether no target is too far from the arm's first joint, or too near, shape (bases, torso heights).

    Where it is False, `solve` refuses a target; where it is True, it may. It takes a hundredth of the time.
    """
    description = robot.robot_description
    assert description is not None, "a robot that searches has a description"
    ranges, offset, firsts = (0.0, math.inf), 0.0, []
    if isinstance(description, PR2Description):
        described = _one_arm(description.arms, description, arm)
        bounds = _bounds(described, limits, robot.joint_limits if limits is Limits.HARD else None)
        ranges, offset = arm_ik.stretches_m(described, bounds), described.shoulder_offset_m
        wrists = [(each @ Pose((-described.tool_m, 0.0, 0.0))).position for each in targets]
        now = robot.joint_position(description.torso_joint)
        firsts = [_shoulder(description, described, now if each is None else each) for each in torso_heights]
    else:
        chain, positions, torso = chain_of(robot, arm), robot.joint_positions(), description.torso_joint
        held = [chain.held_point(each) for each in targets]
        wrists, ranges = [point for point, _ in held], (0.0, max(reach_m for _, reach_m in held))
        for height in torso_heights:
            lifted = {} if torso is None or height is None else {torso: height}
            firsts.append(chain.first_joint(positions | lifted))
    root = robot.root_pose(Pose())  # in the frame of the base link
    at = np.array([each.position for each in bases]).reshape(-1, 1, 3)
    turns = np.array([each.orientation for each in bases]).reshape(-1, 1, 4)
    first = at + _turned(turns, np.array([(root @ Pose(each)).position for each in firsts]))
    up = _turned(turns, np.array(rotated(root.orientation, (0.0, 0.0, 1.0))))
    reached = np.ones((len(bases), len(torso_heights)), dtype=bool)
    for each in wrists:
        way = np.array(each) - first
        height = (way * up).sum(axis=-1)
        across = np.sqrt(np.maximum((way**2).sum(axis=-1) - height**2, 0.0))
        reached &= np.hypot(across - offset, height) <= ranges[1] + EXACT_M
        reached &= np.hypot(across + offset, height) >= ranges[0] - EXACT_M
    return reached


def _turned(turns: Floats, vectors: Floats) -> Floats:
    """Rotate the vectors, shape (..., 3), by unit quaternions, shape (..., 4)."""
    axis, w = turns[..., :3], turns[..., 3:]
    across = 2 * np.cross(axis, vectors)
    return np.asarray(vectors + w * across + np.cross(axis, across))


def headings(robot: Object, arm: Arms, target: Pose, *, base: Pose, limits: Limits) -> Iterator[Pose]:
    """Yield poses of the base link at the place of `base` from which an arm may reach a target in "map".

    An arm that turns its tool freely is expected ahead: for it this is `base` alone. Any other one, such as one that
    reaches sideways, is solved with the base as its first joint. An arm that moves the base has no other heading.
    """
    described = robot.robot_description.arms[arm] if robot.robot_description is not None else None
    if described is None or isinstance(described, PR2Arm):
        yield base
        return
    chain = chain_of(robot, arm)
    if chain.held is Held.ALL or not {*robot.joints_above(None)}.isdisjoint(chain.joints):
        yield base
        return
    in_root = base.relative_to(robot.root_pose(base))
    bounds = _chain_bounds(chain, described, limits)
    for turn in chain.turns_to(target.relative_to(base), in_root, robot.joint_positions(), bounds):
        yield base @ Pose(orientation=yaw_quaternion(turn))


def chain_of(robot: Object, arm: Arms) -> Chain:
    """Return the chain of one of the robot's arms, read from its model at the first call.

    Raises `CallerError` if the description does not fit the model.
    """
    chain = robot.chains.get(arm)
    if chain is None:
        assert robot.robot_description is not None
        described = robot.robot_description.arms[arm]
        chain = Chain(
            robot.model,
            base_link=described.base_link,
            tool_link=described.tool_frame,
            tool_in_link=described.tool_in_link,
        )
        joints = robot.model.joints
        if chain.joints != tuple(each for each in described.joints if each not in joints or joints[each].moves_freely):
            between = f"between {described.base_link or 'the root link'!r} and {described.tool_frame!r}"
            raise CallerError(
                f"the joints of {robot.name!r} {between} are {', '.join(chain.joints) or 'none'}, but its description"
                f" has {', '.join(described.joints) or 'none'}: correct it, or use describe_arm"
            )
        robot.chains[arm] = chain
    return chain


def _chain_bounds(chain: Chain, described: ArmDescription, limits: Limits) -> dict[str, Bounds]:
    """Return the model's limits, narrowed by the described ones."""
    bounds = dict(chain.bounds)
    for ranges in (described.hard_limits, described.soft_limits if limits is Limits.SOFT else {}):
        for name, narrower in ranges.items():
            if name in bounds:
                lower, upper = bounds[name]
                bounds[name] = Bounds(max(lower, narrower.lower), min(upper, narrower.upper))
    return bounds


def _best(arm_description: PR2Arm, reach: Reach, pans: Floats, bounds: Sequence[Bounds]) -> tuple[list[float], float]:
    """Return pan, lift, roll and elbow of the posture with the largest margin, and that margin."""
    curve = arm_ik.curve(arm_description, reach, pans, bounds)
    row, column = divmod(int(curve.margin.argmax()), len(pans))
    upper = (pans[column], curve.lift[row, column], curve.roll[row, column], curve.elbow[column])
    return [float(angle) for angle in upper], float(curve.margin[row, column])


def _steps(window: Bounds, step: float) -> Floats:
    """Return equally spaced angles from one end of the window to the other, both included."""
    return np.linspace(*window, max(2, 1 + math.ceil((window.upper - window.lower) / step)))


def _reach(
    description: PR2Description, arm_description: PR2Arm, target: Pose, *, root: Pose, torso_height: float
) -> Reach:
    """Convert the target to the axes of the torso."""
    _check(target, root)
    x, y, z, w = root.orientation
    back = Quaternion(-x, -y, -z, w)
    from_root = rotated(back, [a - b for a, b in zip(target.position, root.position, strict=True)])
    shoulder = _shoulder(description, arm_description, torso_height)
    tool = Vector(*(a - b for a, b in zip(from_root, shoulder, strict=True)))
    turn = product(back, target.orientation)
    ahead = rotated(turn, (1.0, 0.0, 0.0))
    wrist = Vector(*(at - arm_description.tool_m * along for at, along in zip(tool, ahead, strict=True)))
    return Reach(tool, wrist, turn, ahead)


def _shoulder(description: PR2Description, arm_description: PR2Arm, torso_height: float) -> Vector:
    """Return the origin of the pan joint in the root link's frame."""
    torso, shoulder = description.torso_origin, arm_description.shoulder
    return Vector(torso.x + shoulder.x, torso.y + shoulder.y, torso.z + torso_height + shoulder.z)


def _why_no_pan(arm_description: PR2Arm, wrist: Vector, bounds: Sequence[Bounds], limits: Limits) -> str:
    folded, stretched = arm_ik.stretches_m(arm_description, bounds)
    across, offset = math.hypot(wrist.x, wrist.y), arm_description.shoulder_offset_m
    nearest, farthest = math.hypot(across - offset, wrist.z), math.hypot(across + offset, wrist.z)
    if nearest > stretched:
        return f"too far: from shoulder to wrist {nearest:.3f} m or more, but the arm reaches {stretched:.3f} m"
    if farthest < folded:
        return f"too near: from shoulder to wrist {farthest:.3f} m or less, but the arm needs {folded:.3f} m"
    return f"its wrist would reach the target only with {_outside(arm_description, arm_ik.PAN, bounds, limits)}"


def _why_no_posture(arm_description: PR2Arm, angles: Sequence[float], bounds: Sequence[Bounds], limits: Limits) -> str:
    """Name the joint that is farthest outside its limits in the best posture."""
    beyond = [max(lower - angle, angle - upper) for angle, (lower, upper) in zip(angles, bounds, strict=True)]
    worst = beyond.index(max(beyond))
    if beyond[worst] <= 0:
        return "its wrist would have to be farther to the side than the bent elbow allows"
    return f"the best posture has {_outside(arm_description, worst, bounds, limits)}, at {angles[worst]:.3f}"


def _outside(arm_description: PR2Arm, joint: int, bounds: Sequence[Bounds], limits: Limits) -> str:
    lower, upper = bounds[joint]
    return f"{arm_description.joints[joint]} outside its {limits.name.lower()} limits {lower:.3f}..{upper:.3f} rad"


def _angle_between(a: Quaternion, b: Quaternion) -> float:
    x, y, z, w = product((-a.x, -a.y, -a.z, a.w), b)
    return 2 * math.atan2(math.hypot(x, y, z), abs(w))


def _one_arm(arms: Mapping[Arms, A], description: RobotDescription, arm: Arms) -> A:
    arm_description = arms.get(arm)
    if arm_description is None:
        raise CallerError(f"{description.name} has no single arm {arm.name}: pass one arm at a time")
    return arm_description


def _check(target: Pose, root: Pose) -> None:
    if target.frame != root.frame:
        raise CallerError(f"the target is in frame {target.frame!r}, the robot in {root.frame!r}")
    if not math.isfinite(sum(target.position) + sum(target.orientation)):
        raise CallerError(f"the target is not finite: {target!r}")


def _bounds(
    arm_description: PR2Arm, limits: Limits, narrower: Callable[[str], tuple[float, float]] | None
) -> list[Bounds]:
    """Return the limits in the order of the joints, narrowed by those of a loaded model."""
    by_name = arm_description.limits(limits)
    bounds = [by_name[name] for name in arm_description.joints]
    if narrower is None:
        return bounds
    return [_narrow(each, narrower(name)) for name, each in zip(arm_description.joints, bounds, strict=True)]


def _narrow(bound: Bounds, model: tuple[float, float]) -> Bounds:
    """Intersect both ranges; a continuous joint stays continuous whatever range the model declares."""
    if math.isinf(bound.upper):
        return bound
    return Bounds(max(bound.lower, model[0]), min(bound.upper, model[1]))
