"""Provide the courier as a model for Bullet, generated from boxes: a small robot of our own design.

A differential base carries a column; the arm of six joints is mounted at its front, the camera on its top. With all
joints 0 the arm points ahead, along x.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, indent, tostring

from pycrorm_async.world.enums import Arms
from pycrorm_async.world.models.urdf_elements import DARK, GREY, OPTICAL, WHITE, fixed, link, moving
from pycrorm_async.world.robots.robot_description import COURIER, Bounds

_X, _Y, _Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_AT_PARENT = (0.0, 0.0, 0.0)
_UPPER_ARM_M, _FOREARM_M, _TOOL_M = 0.42, 0.36, 0.17
_SHOULDER_HEIGHT_M, _CAMERA_HEIGHT_M = 0.85, 1.3


def courier_urdf() -> str:
    """Return the courier as URDF text; it refers to no other file."""
    robot = Element("robot", name=COURIER.name)
    link(robot, "base_footprint")
    fixed(robot, "base_footprint_joint", "base_footprint", "base_link", (0, 0, 0.03))
    link(robot, "base_link", (0.5, 0.44, 0.26), (0, 0, 0.13), WHITE)
    fixed(robot, "column_joint", "base_link", "column_link", (-0.05, 0, 0.26))
    link(robot, "column_link", (0.14, 0.14, 0.9), (0, 0, 0.45), GREY)
    _arm(robot)
    _camera(robot)
    indent(robot)  # Bullet cannot read a long file that has a single line
    return tostring(robot, encoding="unicode")


def _arm(robot: Element) -> None:
    yaw, shoulder, elbow, forearm_roll, wrist, wrist_roll = COURIER.arms[Arms.RIGHT].joints
    chain = (  # joint, parent, child, origin of the joint in the parent, axis, limits
        (yaw, "column_link", "arm_base_link", (0.13, 0, _SHOULDER_HEIGHT_M - 0.29), _Z, Bounds(-2.9, 2.9)),
        (shoulder, "arm_base_link", "upper_arm_link", _AT_PARENT, _Y, Bounds(-2.2, 2.2)),
        (elbow, "upper_arm_link", "elbow_link", (_UPPER_ARM_M, 0, 0), _Y, Bounds(-2.7, 2.7)),
        (forearm_roll, "elbow_link", "forearm_link", _AT_PARENT, _X, Bounds(-3.0, 3.0)),
        (wrist, "forearm_link", "wrist_link", (_FOREARM_M, 0, 0), _Y, Bounds(-2.1, 2.1)),
        (wrist_roll, "wrist_link", "palm_link", _AT_PARENT, _X, Bounds(-3.1, 3.1)),
    )
    for joint, parent, child, origin, axis, bounds in chain:
        moving(robot, joint, parent, child, origin, axis, bounds)
    link(robot, "arm_base_link", (0.12, 0.12, 0.14), _AT_PARENT, GREY)
    link(robot, "upper_arm_link", (0.36, 0.1, 0.1), (_UPPER_ARM_M / 2, 0, 0), WHITE)
    link(robot, "elbow_link", (0.11, 0.11, 0.11), _AT_PARENT, GREY)
    link(robot, "forearm_link", (0.28, 0.08, 0.08), (_FOREARM_M / 2, 0, 0), WHITE)
    link(robot, "wrist_link", (0.07, 0.07, 0.07), _AT_PARENT, GREY)
    link(robot, "palm_link", (0.08, 0.12, 0.05), (0.07, 0, 0), DARK)
    fixed(robot, "tool_joint", "palm_link", "tool_frame", (_TOOL_M, 0, 0))
    link(robot, "tool_frame")
    for name, side in (("left", 1), ("right", -1)):
        finger = f"{name}_finger_link"
        origin, axis = (0.11, side * 0.006, 0), (0, side, 0)
        moving(robot, f"{name}_finger_joint", "palm_link", finger, origin, axis, Bounds(0.0, 0.045), prismatic=True)
        link(robot, finger, (0.09, 0.012, 0.03), (0.045, 0, 0), GREY)


def _camera(robot: Element) -> None:
    pan, tilt = COURIER.head_joints
    height = _CAMERA_HEIGHT_M - 0.29
    moving(robot, pan, "column_link", "camera_pan_link", (0, 0, height), _Z, Bounds(-2.8, 2.8))
    link(robot, "camera_pan_link", (0.08, 0.08, 0.08), (0, 0, -0.06), DARK)
    moving(robot, tilt, "camera_pan_link", "camera_link", _AT_PARENT, _Y, Bounds(-0.8, 1.3))
    link(robot, "camera_link", (0.04, 0.14, 0.05), _AT_PARENT, WHITE)
    fixed(robot, "camera_optical_joint", "camera_link", COURIER.camera_link or "", (0.02, 0, 0), rotation=OPTICAL)
    link(robot, COURIER.camera_link or "")
