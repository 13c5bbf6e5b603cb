"""Describe robots for plans: arms, grippers, torso, head, camera, limits and named postures.

A `RobotDescription` is a constant; the robot's current pose and joint positions are in the world. Lengths are in
metres, angles in rad, poses of links those of the loaded model (URDF). A part that a robot lacks is None or empty in
its description, and an action that needs it fails with `CapabilityAbsenceFailure`.

>>> PR2.arms[Arms.LEFT].tool_frame
'l_gripper_tool_frame'
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.world.enums import Arms, Grasp, GripperState
from pycrorm_async.world.pose import Pose, Quaternion, Vector


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


class Drive(Enum):
    """The kinematics of the base. A fixed base cannot navigate."""

    OMNIDIRECTIONAL = "OMNIDIRECTIONAL"
    DIFFERENTIAL = "DIFFERENTIAL"
    FIXED = "FIXED"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ArmDescription:
    """An arm: a chain of joints from `base_link` to the tool, and its gripper, if it has one.

    >>> ArmDescription(base_link="panda_link0", joints=("panda_joint1", ...), tool_frame="panda_hand_tcp")
    """

    joints: tuple[str, ...]
    """All movable joints between `base_link` and `tool_frame`, ordered from the base to the tool."""
    tool_frame: str
    """The link that carries the tool; held objects are attached to it."""
    base_link: str = ""
    """The link at which the chain begins, such as the torso; empty for the model's root link."""
    tool_in_link: Pose | None = None
    """The frame that inverse kinematics brings to the target, in the link `tool_frame`; None: the link's own frame.

    Its origin is between the finger tips; x points along the fingers, which close along y.
    """
    soft_limits: Mapping[str, Bounds] = field(default_factory=dict)
    """The range of each joint inside its hard limits; a joint that is left out has its hard limits only."""
    hard_limits: Mapping[str, Bounds] = field(default_factory=dict)
    """Hard limits that are narrower than those of the loaded model."""
    gripper_joints: Mapping[GripperState, Mapping[str, float]] = field(default_factory=dict)
    """Positions of the fingers' joints; empty for an arm without a gripper."""
    opening_m: float | None = None
    """Distance between the fingers of the open gripper; they close along y of the tool frame. None: not known."""
    payload_kg: float | None = None
    """The greatest mass that the arm lifts; None: not known, and nothing is refused. A URDF does not have it."""
    park: Mapping[str, float] = field(default_factory=dict)
    """Posture with the arm folded; empty if there is none. Continuous joints may be several turns from zero."""

    def __post_init__(self) -> None:
        if not self.joints:
            raise CallerError(f"an arm needs a joint, but the one with the tool {self.tool_frame!r} has none")
        if self.payload_kg is not None and not 0 < self.payload_kg < math.inf:
            raise CallerError(
                f"the payload of the arm with the tool {self.tool_frame!r} must be a number of kg > 0, got"
                f" {self.payload_kg!r}; None if it is not known"
            )

    def limits(self, limits: Limits) -> Mapping[str, Bounds]:
        """Return the described range of each joint by name."""
        return self.soft_limits if limits is Limits.SOFT else self.hard_limits


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PR2Arm(ArmDescription):
    """An arm of the PR2's build: pan, lift, roll at the shoulder, flex, roll at the elbow, flex, roll at the wrist.

    Pan rotates about z, lift and both flexes about y, the rolls about x; with all joints 0 the arm points along x. Its
    inverse kinematics has a closed form (`arm_ik`).
    """

    shoulder: Vector
    """Origin of the pan joint in the torso link."""
    shoulder_offset_m: float
    """Distance from the pan axis to the lift axis."""
    upper_arm_m: float
    forearm_m: float
    tool_m: float
    """Distance from the wrist to the tool frame."""


class FieldOfView(NamedTuple):
    """Full angles of a camera's image, rad; half of each is on either side of its axis."""

    horizontal: float
    vertical: float


_VIEW = FieldOfView(1.0, 0.75)  # about that of an ordinary colour camera


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RobotDescription:
    """A robot: its base and the parts mounted on it.

    >>> PANDA = RobotDescription(name="panda", drive=Drive.FIXED, arms={Arms.RIGHT: arm}, urdf=Path("panda.urdf"))
    >>> robot = Object("panda", ObjectType.ROBOT, robot=PANDA)

    `describe_robot` makes one from a URDF.
    """

    name: str
    """The model, the same for all robots of this kind."""
    serial: str | None = None
    """Distinguishes robots of one model; None if there is no need."""
    urdf: str | Path | None = None
    """The model that an `Object` of this robot loads; None for a built-in one. See `Object`."""
    base_link: str = ""
    """The link whose pose is the robot's pose, x ahead and z up; empty for the model's root link. It may be above the
    floor, and joints above it may move it."""
    drive: Drive = Drive.OMNIDIRECTIONAL
    arms: Mapping[Arms, ArmDescription] = field(default_factory=dict)
    torso_joint: str | None = None
    """A prismatic joint that lifts the arms; its limits are those of the model."""
    head_joints: tuple[str, ...] = ()
    """The joints that turn the camera, the first one nearest to the base."""
    camera_link: str | None = None
    camera_in_link: Pose | None = None
    """The camera's optical frame in `camera_link`: z points ahead, x to the right, y down. None: the link's own."""
    camera_view_rad: FieldOfView = _VIEW
    camera_height_m: Bounds | None = None
    """Camera height above the floor with the torso at its lowest and highest; None: the camera's current height."""
    postures: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Joint positions by the name of the posture, for `MoveJointsMotion`, such as "carry"."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PR2Description(RobotDescription):
    """A robot of the PR2's build, whose arms and head have closed forms: a lifting torso, and a head on its top.

    Plans may use the whole range of the torso, also outside its soft limits.
    """

    arms: Mapping[Arms, PR2Arm]
    torso_joint: str
    torso_origin: Vector
    """Origin of the torso link in the root link, at torso height 0."""
    torso_limits: Bounds
    head_pan_joint: str
    head_pan_link: str
    head_tilt_joint: str
    head_tilt_link: str
    camera_link: str
    camera_height_m: Bounds


FINGER_OPEN_RAD = 0.548
"""The position in rad of each finger joint of an open gripper of the PR2."""
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


def _pr2_arm(prefix: str, side: float, park: tuple[float, ...]) -> PR2Arm:
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
    return PR2Arm(
        base_link="torso_lift_link",
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
        payload_kg=1.8,  # Willow Garage, "Hardware Systems": willowgarage.com/pages/robots/hardware-systems
        park=MappingProxyType(dict(zip(joints, park, strict=True))),
    )


PR2 = PR2Description(
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
    head_joints=("head_pan_joint", "head_tilt_joint"),
    head_pan_joint="head_pan_joint",
    head_pan_link="head_pan_link",
    head_tilt_joint="head_tilt_joint",
    head_tilt_link="head_tilt_link",
    camera_link="wide_stereo_optical_frame",
    camera_view_rad=FieldOfView(0.99483, 0.75049),  # values of the reference systems for this camera
    camera_height_m=Bounds(1.27, 1.60),
)


_COURIER_JOINTS = tuple(
    f"arm_{name}_joint" for name in ("yaw", "shoulder", "elbow", "forearm_roll", "wrist", "wrist_roll")
)
_COURIER_FINGERS = ("left_finger_joint", "right_finger_joint")

COURIER = RobotDescription(
    name="courier",
    drive=Drive.DIFFERENTIAL,
    arms=MappingProxyType(
        {
            Arms.RIGHT: ArmDescription(
                joints=_COURIER_JOINTS,
                base_link="column_link",
                tool_frame="tool_frame",
                gripper_joints=MappingProxyType(
                    {
                        GripperState.OPEN: MappingProxyType(dict.fromkeys(_COURIER_FINGERS, 0.045)),
                        GripperState.CLOSE: MappingProxyType(dict.fromkeys(_COURIER_FINGERS, 0.0)),
                    }
                ),
                opening_m=0.09,
                payload_kg=3.0,  # assumed, as no such robot was built; arms of its size are rated for as much
                park=MappingProxyType(dict(zip(_COURIER_JOINTS, (0.0, -1.9, 2.5, 0.0, 0.9, 0.0), strict=True))),
            )
        }
    ),
    head_joints=("camera_pan_joint", "camera_tilt_joint"),
    camera_link="camera_optical_frame",
    camera_view_rad=FieldOfView(1.05, 0.80),
    camera_height_m=Bounds(1.3, 1.3),
)
"""A robot of another build than the PR2: one arm of six joints, no torso, a differential base."""


_registered: dict[str, RobotDescription] = {each.name: each for each in (PR2, COURIER)}
"""Descriptions by model, for the process: module state, because a plan's file registers its robots when it is loaded,
before any world is entered, and also in each process that loads it for rollouts."""


def register_robot(
    description: RobotDescription, *, payload_kg: float | Mapping[Arms, float] | None = None
) -> RobotDescription:
    """Make this the description of every later `Object` of type ROBOT with its name; return it.

    A description of the same name is replaced, so that a notebook's cell can run again. `payload_kg`, of all arms or by
    arm, replaces that of the description. Raises `CallerError` for an arm that the robot lacks.
    """
    if payload_kg is not None:
        description = replace(description, arms=with_payload(description.arms, payload_kg))
    _registered[description.name] = description
    return description


def with_payload(
    arms: Mapping[Arms, ArmDescription], payload_kg: float | Mapping[Arms, float]
) -> dict[Arms, ArmDescription]:
    """Return the arms with this payload, of all or by arm. Raises `CallerError` for an arm that is not among them."""
    payloads = payload_kg if isinstance(payload_kg, Mapping) else dict.fromkeys(arms, payload_kg)
    if (unknown := next((arm for arm in payloads if arm not in arms), None)) is not None:
        names = ", ".join(each.name for each in arms) or "none"
        raise CallerError(f"payload_kg is for the {unknown.name} arm, but the robot's arms are: {names}")
    return {arm: replace(each, payload_kg=payloads.get(arm, each.payload_kg)) for arm, each in arms.items()}


def robot_description(name: str) -> RobotDescription | None:
    """Return the built-in or registered description of that name; None if there is none."""
    return _registered.get(name)
