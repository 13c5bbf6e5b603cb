"""Where an arm's tool frame is (`forward`), and which joint angles bring it to a pose (`solve`).

A reachable pose has a curve of postures over the shoulder pan (`world.postures`). `solve` looks along it, both ends
included, in steps of at most 0.01 rad, and finer where it just misses, and takes the posture that stays farthest from
every limit; continuous joints have none.

No clock and no chance is in it: on one machine the same question has the same answer, to the bit. What it returns was
checked by forward kinematics to 1e-6 m and 1e-6 rad; bodies, the robot's own or others, are not looked at. What it
refuses is out of reach, but for rare targets at the rim of the workspace (about 1 in 10,000 of the reachable ones
there) whose only postures lie squeezed between limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pycrorm_async.errors import CallerError
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.pose import Pose, Quaternion, Vector, product, rotated
from pycrorm_async.world.robots import arm_ik
from pycrorm_async.world.robots.arm_ik import Floats, Reach
from pycrorm_async.world.robots.robot_description import ArmDescription, Bounds, Limits, RobotDescription

if TYPE_CHECKING:
    from pycrorm_async.world.objects import Object

__all__ = ["Limits", "Unreachable", "forward", "solve", "solve_from"]

PAN_STEP_RAD = 0.01
NEAR_MISS_RAD = 0.02
"""What lies no farther outside the limits than this is looked at again in steps fifty times finer."""
EXACT_M = EXACT_RAD = 1e-6
"""At most this is between the target and where the answer leads."""


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
    arm_description = _one_arm(description, arm)
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
    """Joint name → rad for the arm of the robot as it is in its world, or as it would be at `base`; moves nothing.

    With `torso_height` (m) also as it would be with the torso there.

    Hard limits are those of the loaded model where they are narrower than the description's.

    Raises:
        Unreachable: no posture within the limits leads to the target.
        CallerError: a robot without a description, not one arm, a target in another frame or not finite.
    """
    description = robot.robot_description
    if description is None:
        raise CallerError(f"{robot.name!r} has no robot description, so nothing is known of its arms")
    arm_description = _one_arm(description, arm)
    bounds = _bounds(arm_description, limits)
    if limits is Limits.HARD:
        bounds = [
            _narrowed(bound, robot.joint_limits(name))
            for name, bound in zip(arm_description.joints, bounds, strict=True)
        ]
    height = robot.joint_position(description.torso_joint) if torso_height is None else torso_height
    reach = _reach(description, arm_description, target, base=robot.pose if base is None else base, torso_height=height)
    return _solved(arm_description, arm, target, reach, bounds, limits)


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

    >>> from pycrorm_async.world.robots.robot_description import PR2
    >>> target = Pose([0.6, 0.2, 0.9])
    >>> joints = solve_from(PR2, Arms.LEFT, target, base=Pose(), torso_height=0.0)
    >>> forward(PR2, Arms.LEFT, joints, torso_height=0.0, base=Pose()).distance(target) < 1e-9
    True
    """
    arm_description = _one_arm(description, arm)
    reach = _reach(description, arm_description, target, base=base, torso_height=torso_height)
    return _solved(arm_description, arm, target, reach, _bounds(arm_description, limits), limits)


def _solved(
    arm_description: ArmDescription, arm: Arms, target: Pose, reach: Reach, bounds: Sequence[Bounds], limits: Limits
) -> dict[str, float]:
    windows = arm_ik.pan_windows(arm_description, reach.wrist, bounds)
    if not windows:
        raise Unreachable(target, arm, _why_no_pan(arm_description, reach.wrist, bounds, limits))
    pans = np.concatenate([_steps(window, PAN_STEP_RAD) for window in windows])
    upper, margin = _best(arm_description, reach, pans, bounds)
    if -NEAR_MISS_RAD < margin < 0:
        around = _narrowed(bounds[arm_ik.PAN], (upper[0] - PAN_STEP_RAD, upper[0] + PAN_STEP_RAD))
        upper, margin = _best(arm_description, reach, _steps(around, PAN_STEP_RAD / 50), bounds)
    angles = [*upper, *arm_ik.wrist_angles(upper, reach.turn)]
    if margin < -arm_ik.ROUNDING:
        raise Unreachable(target, arm, _why_no_posture(arm_description, angles, bounds, limits))
    angles = [min(max(angle, lower), upper) for angle, (lower, upper) in zip(angles, bounds, strict=True)]
    if not _leads_to(arm_description, angles, reach):
        raise Unreachable(target, arm, "only the arm stretched out to the last micrometre would come there")
    return dict(zip(arm_description.joints, angles, strict=True))


def _best(
    arm_description: ArmDescription, reach: Reach, pans: Floats, bounds: Sequence[Bounds]
) -> tuple[list[float], float]:
    """Pan, lift, roll and elbow of the posture with the largest margin, and that margin."""
    curve = arm_ik.curve(arm_description, reach, pans, bounds)
    row, column = divmod(int(curve.margin.argmax()), len(pans))
    upper = (pans[column], curve.lift[row, column], curve.roll[row, column], curve.elbow[column])
    return [float(angle) for angle in upper], float(curve.margin[row, column])


def _steps(window: Bounds, step: float) -> Floats:
    """Both ends of the window, and equal steps between them."""
    return np.linspace(*window, max(2, 1 + math.ceil((window.upper - window.lower) / step)))


def _leads_to(arm_description: ArmDescription, angles: Sequence[float], reach: Reach) -> bool:
    tool, turn = arm_ik.hand(arm_description, angles)
    wanted = [at + arm_description.tool_m * along for at, along in zip(reach.wrist, reach.ahead, strict=True)]
    return math.dist(tool, wanted) <= EXACT_M and _angle_between(turn, reach.turn) <= EXACT_RAD


def _reach(
    description: RobotDescription, arm_description: ArmDescription, target: Pose, *, base: Pose, torso_height: float
) -> Reach:
    """The target in the axes of the torso."""
    if target.frame != base.frame:
        raise CallerError(f"the target is in frame {target.frame!r}, the robot in {base.frame!r}")
    if not math.isfinite(sum(target.position) + sum(target.orientation)):
        raise CallerError(f"the target is not finite: {target!r}")
    x, y, z, w = base.orientation
    back = Quaternion(-x, -y, -z, w)
    from_base = rotated(back, [a - b for a, b in zip(target.position, base.position, strict=True)])
    shoulder = _shoulder(description, arm_description, torso_height)
    tool = Vector(*(a - b for a, b in zip(from_base, shoulder, strict=True)))
    return arm_ik.reach(arm_description, tool, product(back, target.orientation))


def _shoulder(description: RobotDescription, arm_description: ArmDescription, torso_height: float) -> Vector:
    """The origin of the pan joint, as seen from the root link."""
    torso, shoulder = description.torso_origin, arm_description.shoulder
    return Vector(torso.x + shoulder.x, torso.y + shoulder.y, torso.z + torso_height + shoulder.z)


def _why_no_pan(arm_description: ArmDescription, wrist: Vector, bounds: Sequence[Bounds], limits: Limits) -> str:
    folded, stretched = arm_ik.stretches_m(arm_description, bounds)
    across, offset = math.hypot(wrist.x, wrist.y), arm_description.shoulder_offset_m
    nearest, farthest = math.hypot(across - offset, wrist.z), math.hypot(across + offset, wrist.z)
    if nearest > stretched:
        return f"too far: from shoulder to wrist {nearest:.3f} m or more, where the arm has {stretched:.3f} m"
    if farthest < folded:
        return f"too near: from shoulder to wrist {farthest:.3f} m or less, where the arm needs {folded:.3f} m"
    return f"its wrist would come there only with {_outside(arm_description, arm_ik.PAN, bounds, limits)}"


def _why_no_posture(
    arm_description: ArmDescription, angles: Sequence[float], bounds: Sequence[Bounds], limits: Limits
) -> str:
    """Names the joint that is farthest out in the posture that comes nearest to being possible."""
    beyond = [max(lower - angle, angle - upper) for angle, (lower, upper) in zip(angles, bounds, strict=True)]
    worst = beyond.index(max(beyond))
    if beyond[worst] <= 0:
        return "its wrist would have to be farther aside than the elbow can swing it"
    return (
        f"the posture that comes nearest has {_outside(arm_description, worst, bounds, limits)}, at {angles[worst]:.3f}"
    )


def _outside(arm_description: ArmDescription, joint: int, bounds: Sequence[Bounds], limits: Limits) -> str:
    lower, upper = bounds[joint]
    return f"{arm_description.joints[joint]} outside its {limits.name.lower()} limits {lower:.3f}..{upper:.3f} rad"


def _angle_between(a: Quaternion, b: Quaternion) -> float:
    x, y, z, w = product((-a.x, -a.y, -a.z, a.w), b)
    return 2 * math.atan2(math.hypot(x, y, z), abs(w))


def _one_arm(description: RobotDescription, arm: Arms) -> ArmDescription:
    arm_description = description.arms.get(arm)
    if arm_description is None:
        raise CallerError(f"{description.name} has no single arm {arm.name}: ask for one arm at a time")
    return arm_description


def _bounds(arm_description: ArmDescription, limits: Limits) -> list[Bounds]:
    """In the order of the joints."""
    by_name = arm_description.limits(limits)
    return [by_name[name] for name in arm_description.joints]


def _narrowed(bound: Bounds, model: tuple[float, float]) -> Bounds:
    """What both allow; a continuous joint stays one, whatever the model says of its range."""
    if math.isinf(bound.upper):
        return bound
    return Bounds(max(bound.lower, model[0]), min(bound.upper, model[1]))
