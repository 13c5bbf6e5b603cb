"""Compute the joints of a robot's head that point its camera at a target: in closed form for the PR2, else by turns.

The general method turns the head's joints one after the other, each so that the camera's axis comes as near to the
target as that joint brings it, until nothing changes. Joints are clamped to their limits, so a target outside them is
not looked at exactly, and no error is raised.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pycrorm_async.plan.current_robot import CurrentRobot
from pycrorm_async.world.pose import Pose, Vector, dot, rotated
from pycrorm_async.world.robots.chain_ik import Chain
from pycrorm_async.world.robots.robot_description import PR2Description

ROUNDS_MAX = 50
"""Bounds the rounds over the joints; a camera near its axes needs about ten."""
_TURN_MIN_RAD = 1e-9
"""The largest turn in rad of a round at which the iteration ends."""


def head_joints(robot: CurrentRobot, target: Pose) -> dict[str, float]:
    """Return joint positions (rad) that point the camera's axis at the target, clamped to the joints' limits.

    Raises `CapabilityAbsenceFailure` if the robot has no camera, or no joint that turns it.
    """
    if not robot.description.head_joints:
        raise robot.absence("head to turn")
    if isinstance(robot.description, PR2Description):
        return _pan_and_tilt(robot, robot.description, target)
    return _turned(robot, target)


def _pan_and_tilt(robot: CurrentRobot, description: PR2Description, target: Pose) -> dict[str, float]:
    """Pan about z of the pan link, tilt about y of the tilt link.

    The origin of the tilt link moves with pan, so tilt is computed for the head after panning.
    """
    body = robot.body
    pan_pose = body.link_pose(description.head_pan_link)
    tilt_origin = body.link_pose(description.head_tilt_link).relative_to(pan_pose).position
    point = target.relative_to(pan_pose).position
    turn = math.atan2(point.y, point.x)
    pan = math.remainder(body.joint_position(description.head_pan_joint) + turn, math.tau)
    ahead = math.hypot(point.x, point.y) - tilt_origin.x
    tilt = -math.atan2(point.z - tilt_origin.z, ahead)
    return {
        description.head_pan_joint: _clamp(pan, body.joint_limits(description.head_pan_joint)),
        description.head_tilt_joint: _clamp(tilt, body.joint_limits(description.head_tilt_joint)),
    }


def _turned(robot: CurrentRobot, target: Pose) -> dict[str, float]:
    body, description = robot
    if description.camera_link is None:
        raise robot.absence("camera")
    head = Chain(
        body.description_text,
        base_link="",
        tool_link=description.camera_link,
        tool_in_link=description.camera_in_link,
    )
    point = target.relative_to(body.root_pose()).position
    positions = body.joint_positions()
    for _ in range(ROUNDS_MAX):
        largest = 0.0
        for joint in description.head_joints:
            camera = head.forward(positions)
            towards = [to - at for to, at in zip(point, camera.position, strict=True)]
            turn = _angle_about(head.axes(positions)[joint], rotated(camera.orientation, (0.0, 0.0, 1.0)), towards)
            before = positions[joint]
            positions[joint] = _clamp(before + turn, body.joint_limits(joint))
            largest = max(largest, abs(positions[joint] - before))
        if largest < _TURN_MIN_RAD:
            break
    return {joint: positions[joint] for joint in description.head_joints}


def _angle_about(axis: Vector, one: Sequence[float], other: Sequence[float]) -> float:
    """Return the angle about the axis from one direction to the other, -π to π."""
    (ax, ay, az), (x, y, z) = axis, one
    along_one, along_other = dot(axis, one), dot(axis, other)
    across = (ay * z - az * y, az * x - ax * z, ax * y - ay * x)
    return math.atan2(dot(across, other), dot(one, other) - along_one * along_other)


def _clamp(value: float, limits: tuple[float, float]) -> float:
    return max(limits[0], min(limits[1], value))
