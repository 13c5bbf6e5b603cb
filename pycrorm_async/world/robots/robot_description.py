"""Describe robots for plans: joints and frames by name, dimensions, limits, named postures.

A `RobotDescription` is a constant; the robot's current pose and joint positions are in the world. Lengths are in
metres, angles in rad. The PR2's dimensions are those of its public model, so that plans run on the built-in shape and
on the mesh model alike (`world.models.pr2`).

>>> PR2.arms[Arms.LEFT].tool_frame
'l_gripper_tool_frame'
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import NamedTuple

from pycrorm_async.world.enums import Arms, Grasp, GripperState
from pycrorm_async.world.pose import Quaternion, Vector

__all__ = [
    "RobotDescription",
    "ArmDescription",
    "Bounds",
    "FieldOfView",
    "Limits",
    "GRASP_ORIENTATIONS",
    "FINGER_OPEN_RAD",
    "PR2",
    "robot_description",
]


class Limits(Enum):
    """One of the two ranges of an arm's joints."""

    SOFT = "SOFT"
    """The range that the robot's own controllers and arm services use, inside the mechanical stops."""
    HARD = "HARD"
    """The range up to the mechanical stops, as declared in the model (URDF)."""


class Bounds(NamedTuple):
    """The closed range of a joint; infinite for a continuous one."""

    lower: float
    upper: float


@dataclass(frozen=True, slots=True, eq=False)
class ArmDescription:
    """An arm of seven joints: pan, lift, roll at the shoulder, flex, roll at the elbow, flex, roll at the wrist.

    Pan rotates about z, lift and both flexes about y, the rolls about x; with all joints 0 the arm points along x.
    """

    joints: tuple[str, str, str, str, str, str, str]
    """Ordered from the shoulder to the wrist."""
    tool_frame: str
    """The link that inverse kinematics brings to the target: between the finger tips, x along the fingers."""
    shoulder: Vector
    """Origin of the pan joint in the torso link."""
    shoulder_offset_m: float
    """Distance from the pan axis to the lift axis."""
    upper_arm_m: float
    forearm_m: float
    tool_m: float
    """Distance from the wrist to the tool frame."""
    soft_limits: Mapping[str, Bounds]
    hard_limits: Mapping[str, Bounds]
    gripper_joints: Mapping[GripperState, Mapping[str, float]]
    opening_m: float
    """Distance between the fingers of the open gripper; they close along y of the tool frame."""
    park: Mapping[str, float]
    """Posture with the arm folded. Continuous joints may be several turns from zero."""

    def limits(self, limits: Limits) -> Mapping[str, Bounds]:
        """Return the range of each joint by name."""
        return self.soft_limits if limits is Limits.SOFT else self.hard_limits


class FieldOfView(NamedTuple):
    """Full angles of a camera's image, rad; half of each is on either side of its axis."""

    horizontal: float
    vertical: float


@dataclass(frozen=True, slots=True, eq=False)
class RobotDescription:
    """A mobile robot with a lifting torso, arms and a head that pans and tilts; root link on the floor."""

    name: str
    torso_joint: str
    torso_origin: Vector
    """Origin of the torso link in the root link, at torso height 0."""
    torso_limits: Bounds
    """Hard limits; plans may use the whole range, also outside the torso's soft limits."""
    arms: Mapping[Arms, ArmDescription]
    head_pan_joint: str
    head_pan_link: str
    head_tilt_joint: str
    head_tilt_link: str
    camera_link: str
    """Optical frame: z points ahead, x to the right, y down."""
    camera_view_rad: FieldOfView
    camera_height_m: Bounds
    """Camera height above the floor with the torso at its lowest and at its highest position, m."""


FINGER_OPEN_RAD = 0.548
_TURN_FREE = Bounds(-math.inf, math.inf)


def _unit(x: float, y: float, z: float, w: float) -> Quaternion:
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return Quaternion(x / length, y / length, z / length, w / length)


GRASP_ORIENTATIONS: Mapping[Grasp, Quaternion] = MappingProxyType(
    {
        Grasp.FRONT: _unit(0, 0, 0, 1),
        Grasp.LEFT: _unit(0, 0, -1, 1),
        Grasp.RIGHT: _unit(0, 0, 1, 1),
        Grasp.TOP: _unit(0, 1, 0, 1),
    }
)
"""Orientation of the gripper in the object's axes: `object.orientation ⊗ GRASP_ORIENTATIONS[grasp]`.

The order matters: only in this order does TOP approach from above for every heading of the object.
"""


def _pr2_arm(prefix: str, side: float, park: tuple[float, ...]) -> ArmDescription:
    """Describe the left arm (side 1) or its mirror image, the right one (side -1)."""
    joints = (
        f"{prefix}_shoulder_pan_joint",
        f"{prefix}_shoulder_lift_joint",
        f"{prefix}_upper_arm_roll_joint",
        f"{prefix}_elbow_flex_joint",
        f"{prefix}_forearm_roll_joint",
        f"{prefix}_wrist_flex_joint",
        f"{prefix}_wrist_roll_joint",
    )

    def mirrored(lower: float, upper: float) -> Bounds:
        return Bounds(lower, upper) if side > 0 else Bounds(-upper, -lower)

    soft = (
        mirrored(-0.5646, 2.1354),
        Bounds(-0.3536, 1.2963),
        mirrored(-0.65, 3.75),
        Bounds(-2.1213, -0.15),
        _TURN_FREE,
        Bounds(-1.994, -0.1),
        _TURN_FREE,
    )
    hard = (
        mirrored(-0.7146, 2.2854),
        Bounds(-0.5236, 1.3963),
        mirrored(-0.8, 3.9),
        Bounds(-2.3213, 0.0),
        _TURN_FREE,
        Bounds(-2.18, 0.0),
        _TURN_FREE,
    )
    fingers = (f"{prefix}_gripper_l_finger_joint", f"{prefix}_gripper_r_finger_joint")
    return ArmDescription(
        joints=joints,
        tool_frame=f"{prefix}_gripper_tool_frame",
        shoulder=Vector(0.0, side * 0.188, 0.0),
        shoulder_offset_m=0.1,
        upper_arm_m=0.4,
        forearm_m=0.321,
        tool_m=0.18,
        soft_limits=MappingProxyType(dict(zip(joints, soft, strict=True))),
        hard_limits=MappingProxyType(dict(zip(joints, hard, strict=True))),
        gripper_joints=MappingProxyType(
            {
                GripperState.OPEN: MappingProxyType(dict.fromkeys(fingers, FINGER_OPEN_RAD)),
                GripperState.CLOSE: MappingProxyType(dict.fromkeys(fingers, 0.0)),
            }
        ),
        opening_m=0.086,
        park=MappingProxyType(dict(zip(joints, park, strict=True))),
    )


PR2 = RobotDescription(
    name="pr2",
    torso_joint="torso_lift_joint",
    torso_origin=Vector(-0.05, 0.0, 0.051 + 0.739675),
    torso_limits=Bounds(0.0, 0.33),
    arms=MappingProxyType(
        {
            Arms.LEFT: _pr2_arm("l", 1.0, (1.712, -0.264, 1.38, -2.12, 16.996, -0.073, 0.0)),
            Arms.RIGHT: _pr2_arm("r", -1.0, (-1.712, -0.256, -1.463, -2.12, 1.766, -0.07, 0.051)),
        }
    ),
    head_pan_joint="head_pan_joint",
    head_pan_link="head_pan_link",
    head_tilt_joint="head_tilt_joint",
    head_tilt_link="head_tilt_link",
    camera_link="wide_stereo_optical_frame",
    camera_view_rad=FieldOfView(0.99483, 0.75049),  # values of the reference systems for this camera
    camera_height_m=Bounds(1.27, 1.60),
)


def robot_description(name: str) -> RobotDescription | None:
    """Return the description of the robot of that name; None if there is no built-in description."""
    return PR2 if name == PR2.name else None
