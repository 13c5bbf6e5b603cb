"""What a plan has to know of a robot: its joints and frames by name, its measures, its limits, its named postures.

A `RobotDescription` is a constant; where the robot stands and how its joints are is the world's affair. Lengths are in
metres, angles in rad. The PR2's measures are those of its public model, so plans run on the built-in shape and on the
mesh model alike (`world.robot_urdf`).

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
    """Which of a joint's two ranges an arm keeps to."""

    SOFT = "SOFT"
    """The range the robot's own controllers and arm services keep to, some way inside the stops."""
    HARD = "HARD"
    """The range up to the mechanical stops; what the model (URDF) declares."""


class Bounds(NamedTuple):
    """The closed range of a joint; infinite for a continuous one."""

    lower: float
    upper: float


@dataclass(frozen=True, slots=True, eq=False)
class ArmDescription:
    """An arm of seven joints: pan, lift, roll at the shoulder, flex, roll at the elbow, flex, roll at the wrist.

    Pan turns about z, lift and both flexes about y, the rolls about x; with all joints 0 the arm is stretched along x.
    """

    joints: tuple[str, str, str, str, str, str, str]
    """From the shoulder to the wrist."""
    tool_frame: str
    """The link an inverse kinematics target is for: between the finger tips, x along the fingers."""
    shoulder: Vector
    """Origin of the pan joint in the torso link."""
    shoulder_offset_m: float
    """From the pan axis to the lift axis."""
    upper_arm_m: float
    forearm_m: float
    tool_m: float
    """From the wrist to the tool frame."""
    soft_limits: Mapping[str, Bounds]
    hard_limits: Mapping[str, Bounds]
    gripper_joints: Mapping[GripperState, Mapping[str, float]]
    park: Mapping[str, float]
    """The arm folded out of the way. Continuous joints may be several turns from zero."""

    def limits(self, limits: Limits) -> Mapping[str, Bounds]:
        """Joint name → range."""
        return self.soft_limits if limits is Limits.SOFT else self.hard_limits


class FieldOfView(NamedTuple):
    """Whole angles of a camera's picture, rad, half of each to either side of its axis."""

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
    """Hard limits; a plan may use all of it, also what lies outside the torso's soft range."""
    arms: Mapping[Arms, ArmDescription]
    head_pan_joint: str
    head_pan_link: str
    head_tilt_joint: str
    head_tilt_link: str
    camera_link: str
    """Optical frame: z looks ahead, x to the right, y down."""
    camera_view_rad: FieldOfView
    camera_height_m: Bounds
    """Between the lowest and the highest torso."""


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
"""How the gripper is turned, in the object's axes: `object.orientation ⊗ GRASP_ORIENTATIONS[grasp]`.

In this order, not the other: only so does TOP come from above whatever the object's heading is.
"""


def _pr2_arm(prefix: str, side: float, park: tuple[float, ...]) -> ArmDescription:
    """The left arm (side 1), or the right one (side -1), which is its mirror image."""
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
    camera_view_rad=FieldOfView(0.99483, 0.75049),  # those that reference systems give for this camera
    camera_height_m=Bounds(1.27, 1.60),
)


def robot_description(name: str) -> RobotDescription | None:
    """The description of the robot of that name; None for a robot not known here."""
    return PR2 if name == PR2.name else None
