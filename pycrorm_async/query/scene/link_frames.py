"""Compute the frame of every link of a model from an object's pose and joint positions: forward kinematics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.pose import Pose
from pycrorm_async.world.queries.bounding_boxes import rotation_matrix

Frame: TypeAlias = NDArray[np.float64]
"""A pose as a matrix of 4 rows and 4 columns."""


def link_frames(
    model: Mapping[str, Any], pose: Pose, joints: Mapping[str, float], base_link: str | None = None
) -> dict[str, Frame]:
    """Return the frame of each link of a model from `object_model`; `pose` is that of `base_link`, or of the root."""
    frames = {model["root"]: np.eye(4)}
    for joint in model["joints"]:
        _, _, parent, child, *_ = joint
        frames[child] = frames[parent] @ joint_frame(joint, joints)
    root = _frame(pose.position, pose.orientation)
    if base_link in frames:
        root = root @ np.linalg.inv(frames[base_link])
    return {link: root @ frame for link, frame in frames.items()}


def joint_frame(joint: Sequence[Any], joints: Mapping[str, float]) -> Frame:
    """Return the frame of a joint's child link in that of its parent, at these positions."""
    name, kind, _, _, xyz, rpy, axis, mimic = joint
    source, multiplier, offset = (name, 1.0, 0.0) if name in joints or mimic is None else mimic
    return placed(xyz, rpy) @ _motion(kind, axis, joints.get(source, 0.0) * multiplier + offset)


def placed(xyz: Sequence[float], rpy: Sequence[float]) -> Frame:
    """Return the frame at a position, turned by roll, pitch and yaw as in URDF."""
    roll, pitch, yaw = rpy
    turn = _frame((0, 0, 0), _about((0, 0, 1), yaw)) @ _frame((0, 0, 0), _about((0, 1, 0), pitch))
    return _frame(xyz, (0, 0, 0, 1)) @ turn @ _frame((0, 0, 0), _about((1, 0, 0), roll))


def _motion(kind: str, axis: Sequence[float], position: float) -> Frame:
    length = math.hypot(*axis) or 1.0
    along = [each / length for each in axis]
    if kind == "fixed":
        return np.eye(4)
    if kind == "prismatic":
        return _frame([each * position for each in along], (0, 0, 0, 1))
    return _frame((0, 0, 0), _about(along, position))


def _about(axis: Sequence[float], angle: float) -> tuple[float, ...]:
    sine = math.sin(angle / 2)
    return (*(each * sine for each in axis), math.cos(angle / 2))


def _frame(position: Sequence[float], orientation: Sequence[float]) -> Frame:
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation_matrix(orientation), position
    return frame
