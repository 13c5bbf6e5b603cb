"""The simulated robot: motions as exact jumps of the robot in the world. No time, no noise, no collisions.

A motion either has its whole effect, which the world tells as one motion, or fails and has none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pycrorm_async.plan.failures import ConfigurationNotReached, IKError, TorsoGoalUnreachable
from pycrorm_async.plan.here import RobotHere, robot_here
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.errors import JointLimitExceeded
from pycrorm_async.world.kinematics import Limits, Unreachable, solve
from pycrorm_async.world.pose import Pose

if TYPE_CHECKING:
    from pycrorm_async.plan.motions import (
        LookingMotion,
        MoveArmJointsMotion,
        MoveGripperMotion,
        MoveJointsMotion,
        MoveMotion,
        MoveTCPMotion,
    )

__all__ = ["SimulatedModules"]


class SimulatedModules:
    """The process modules of `with simulated_robot:`, with arms that keep to these limits when they are to reach."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits

    async def navigate(self, motion: MoveMotion) -> None:
        robot_here().body.set_pose(motion.target)

    async def move_tcp(self, motion: MoveTCPMotion) -> None:
        body, description = robot_here()
        try:
            joints = solve(body, motion.arm, motion.target, limits=self._limits)
        except Unreachable as unreachable:
            tip = description.arms[motion.arm].tool_frame
            raise IKError(motion.target, motion.arm, tip, unreachable.reason) from unreachable
        body.set_joint_positions(joints)

    async def looking(self, motion: LookingMotion) -> None:
        robot = robot_here()
        robot.body.set_joint_positions(head_joints(robot, motion.target))

    async def move_gripper(self, motion: MoveGripperMotion) -> None:
        body, description = robot_here()
        joints: dict[str, float] = {}
        for arm in single_arms(motion.gripper):
            joints |= description.arms[arm].gripper_joints[motion.motion]
        body.set_joint_positions(joints)

    async def move_arm_joints(self, motion: MoveArmJointsMotion) -> None:
        _set_joints(robot_here(), (motion.left_arm_poses or {}) | (motion.right_arm_poses or {}))

    async def move_joints(self, motion: MoveJointsMotion) -> None:
        _set_joints(robot_here(), dict(zip(motion.names, motion.positions, strict=True)))


def single_arms(arm: Arms) -> tuple[Arms, ...]:
    """LEFT and RIGHT for BOTH."""
    return (Arms.LEFT, Arms.RIGHT) if arm is Arms.BOTH else (arm,)


def head_joints(robot: RobotHere, target: Pose) -> dict[str, float]:
    """Pan and tilt (rad) with which the camera's axis goes towards the target, as far as the neck can turn.

    Pan turns about z of the pan link. Tilt turns about y of the tilt link, whose origin the pan carries
    around, so it is worked out as it will be after panning.
    """
    body, description = robot
    pan_pose = body.link_pose(description.head_pan_link)
    tilt_origin = body.link_pose(description.head_tilt_link).relative_to(pan_pose).position
    seen = target.relative_to(pan_pose).position
    turn = math.atan2(seen.y, seen.x)
    pan = math.remainder(body.joint_position(description.head_pan_joint) + turn, math.tau)
    ahead = math.hypot(seen.x, seen.y) - tilt_origin.x
    tilt = -math.atan2(seen.z - tilt_origin.z, ahead)
    return {
        description.head_pan_joint: _clamped(pan, body.joint_limits(description.head_pan_joint)),
        description.head_tilt_joint: _clamped(tilt, body.joint_limits(description.head_tilt_joint)),
    }


def _clamped(value: float, limits: tuple[float, float]) -> float:
    return max(limits[0], min(limits[1], value))


def _set_joints(robot: RobotHere, positions: Mapping[str, float]) -> None:
    body, description = robot
    try:
        body.set_joint_positions(positions)
    except JointLimitExceeded as exceeded:
        if description.torso_joint in positions and len(positions) == 1:
            raise TorsoGoalUnreachable(str(exceeded), positions[description.torso_joint]) from exceeded
        raise ConfigurationNotReached(str(exceeded), dict(positions)) from exceeded
