"""Describe robots.

**Robot description.** Describe robots for plans: arms, grippers, torso, head, camera, limits and named postures.

A `RobotDescription` is a constant; the robot's current pose and joint positions are in the world. Lengths are in
metres, angles in rad, poses of links those of the loaded model (URDF). A part that a robot lacks is None or empty in
its description, and an action that needs it fails with `CapabilityAbsenceFailure`.

>>> PR2.arms[Arms.LEFT].tool_frame
'l_gripper_tool_frame'

**Urdf description.** Describe a robot from its model (URDF) and, if there is one, its semantic description (SRDF).

>>> TIAGO = describe_robot("tiago", path, arms={Arms.RIGHT: describe_arm(path, "torso_lift_link", "arm_tool_link")},
...                        drive=Drive.DIFFERENTIAL, torso_joint="torso_lift_joint")
>>> PANDA = describe_robot("panda", path, srdf=srdf_path, park="default", drive=Drive.FIXED)
"""

import itertools
import logging
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.world.models import tiago_pro_urdf_path
from pycrorm_async.world.pose import Arms, Grasp, GripperState, JointType, Pose, Quaternion, Vector
from pycrorm_async.world.urdf_model import ENDLESS, Joint, Model, along, number_of, parsed_srdf, read_model, urdf_text
from pycrorm_async.world.urdf_model import Bounds as Bounds  # one of the names of this module

# === robot description ========================================================================================


class Limits(Enum):
    """One of the two ranges of an arm's joints."""

    SOFT = "SOFT"
    """The range that the robot's own controllers and arm services use, inside the mechanical stops."""
    HARD = "HARD"
    """The range up to the mechanical stops, as declared in the model (URDF)."""


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
    inverse kinematics has a closed form (`world.arms`).
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
    packages: Mapping[str, str | Path] = field(default_factory=dict)
    """Folders of ROS packages by their names, for `package://` in the URDF."""
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
    approaches_along_fingers: bool = True
    """Whether a hand approaches an object along the fingers as they are in the grasp, whatever the arm's posture was.
    Otherwise it comes from behind along the fingers as they are before: of an arm parked with the hand up, from below,
    through the table."""

    def __post_init__(self) -> None:
        for what, text in (("name", self.name), ("serial", self.serial or "")):
            if not isinstance(text, str):
                raise CallerError(f"the {what} of a robot must be a str, got {text!r}")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PR2Description(RobotDescription):
    """A robot of the PR2's build, whose arms and head have closed forms: a lifting torso, and a head on its top.

    Plans may use the whole range of the torso, also outside its soft limits. Its hands approach as in the thesis.
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
    approaches_along_fingers: bool = False


FINGER_OPEN_RAD = 0.548
"""The position in rad of each finger joint of an open gripper of the PR2."""


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
        ENDLESS,
        Bounds(-1.994, -0.1),
        ENDLESS,
    )
    hard = (
        mirrored(-0.7146, 2.2854),
        Bounds(-0.5236, 1.3963),
        mirrored(-0.8, 3.9),
        Bounds(-2.3213, 0.0),
        ENDLESS,
        Bounds(-2.18, 0.0),
        ENDLESS,
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
        soft_limits=dict(zip(joints, soft, strict=True)),
        hard_limits=dict(zip(joints, hard, strict=True)),
        gripper_joints={
            GripperState.OPEN: dict.fromkeys(fingers, FINGER_OPEN_RAD),
            GripperState.CLOSE: dict.fromkeys(fingers, 0.0),
        },
        opening_m=0.086,
        payload_kg=1.8,  # Willow Garage, "Hardware Systems": willowgarage.com/pages/robots/hardware-systems
        park=dict(zip(joints, park, strict=True)),
    )


PR2 = PR2Description(
    name="pr2",
    torso_joint="torso_lift_joint",
    torso_origin=Vector(-0.05, 0.0, 0.051 + 0.739675),
    torso_limits=Bounds(0.0, 0.33),
    arms={
        Arms.LEFT: _pr2_arm("l", 1.0, (1.712, -0.264, 1.38, -2.12, 16.996, -0.073, 0.0)),
        Arms.RIGHT: _pr2_arm("r", -1.0, (-1.712, -0.256, -1.463, -2.12, 1.766, -0.07, 0.051)),
    },
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
    arms={
        Arms.RIGHT: ArmDescription(
            joints=_COURIER_JOINTS,
            base_link="column_link",
            tool_frame="tool_frame",
            gripper_joints={
                GripperState.OPEN: dict.fromkeys(_COURIER_FINGERS, 0.045),
                GripperState.CLOSE: dict.fromkeys(_COURIER_FINGERS, 0.0),
            },
            opening_m=0.09,
            payload_kg=3.0,  # assumed, as no such robot was built; arms of its size are rated for as much
            park=dict(zip(_COURIER_JOINTS, (0.0, -1.9, 2.5, 0.0, 0.9, 0.0), strict=True)),
        )
    },
    head_joints=("camera_pan_joint", "camera_tilt_joint"),
    camera_link="camera_optical_frame",
    camera_view_rad=FieldOfView(1.05, 0.80),
    camera_height_m=Bounds(1.3, 1.3),
)
"""A robot of another build than the PR2: one arm of six joints, no torso, a differential base."""


TIAGO_PRO = "tiago_pro"
"""The name of a TIAGo Pro of PAL Robotics, whose model and description need the package example-robot-data."""


def _tiago_pro() -> RobotDescription:
    """Describe the TIAGo Pro: an omnidirectional base, a torso that lifts, and two arms of seven joints.

    Limits are those of the model; what the model lacks was measured in it. Raises `MissingExtra` without the package.
    """
    urdf = tiago_pro_urdf_path()
    parked = (0.35, -1.85, 0.5, -2.35, 0.0, -1.2, 0.0)  # folded beside the torso, with the fingers up
    arms = {}
    for arm, side, sign in ((Arms.LEFT, "left", 1.0), (Arms.RIGHT, "right", -1.0)):
        joints = (f"arm_{side}_{number}_joint" for number in range(1, 8))
        mirrored = (position * sign if number % 2 == 0 else position for number, position in enumerate(parked))
        described = describe_arm(
            urdf,
            "torso_lift_link",
            f"arm_{side}_tool_link",
            park=dict(zip(joints, mirrored, strict=True)),
            tool_in_link=Pose((0.0, 0.0, 0.14), _unit(0, -1, 0, 1)),  # the fingers point along z
        )
        arms[arm] = replace(described, opening_m=0.079)
    return describe_robot(
        TIAGO_PRO,
        urdf,
        arms=arms,
        torso_joint="torso_lift_joint",
        head_joints=("head_1_joint", "head_2_joint"),
        camera_link="head_front_camera_link",
        camera_in_link=Pose(orientation=_unit(-1, 1, -1, 1)),  # x of the link points ahead, z up
        camera_height_m=Bounds(1.16, 1.51),
    )


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
    """Return the built-in or registered description of that name; None if there is none.

    That of the TIAGo Pro is None where its model is not installed.
    """
    if name == TIAGO_PRO and name not in _registered:
        with suppress(MissingExtra):
            register_robot(_tiago_pro())
    return _registered.get(name)


# === urdf description =========================================================================================

_log = logging.getLogger("pycrorm_async")


def describe_robot(
    name: str,
    urdf: str | Path,
    *,
    srdf: str | Path | None = None,
    arms: Mapping[Arms, ArmDescription] | None = None,
    park: str = "park",
    payload_kg: float | Mapping[Arms, float] | None = None,
    base_link: str = "",
    packages: Mapping[str, str | Path] = MappingProxyType({}),
    **facts: Any,
) -> RobotDescription:
    """Return the description of a robot whose model is this URDF (text, or the path of a file).

    Without `arms` they come from the SRDF: an arm for each end effector that is no leg. An arm whose group has "left"
    or "right" (or the word "l" or "r") in its name is that one; the only arm of a robot is RIGHT; each further one has
    the name of its group in capitals (`Arms.named`). The named states become `postures`, without the joints that the
    URDF lacks, such as that of a floating base, and the state `park` the arms' park posture.

    Args:
        payload_kg: the greatest mass that each arm lifts, or by arm; a URDF does not have it.
        base_link: see `RobotDescription`.
        packages: folders of ROS packages by their names, for `package://` in the URDF.
        facts: further attributes of `RobotDescription`, such as `drive`, `torso_joint`, `camera_link`.

    Raises:
        CallerError: the SRDF cannot be read or does not fit the URDF, `payload_kg` names an arm that the robot lacks,
            `drive` is no `Drive`, or the model lacks a link, a joint or the state `park` that is named.
        DescriptionNotLoadable: the URDF has a fault.
    """
    model = read_model(urdf_text(name, urdf, packages))
    model.path(base_link)
    postures: dict[str, dict[str, float]] = {}
    if srdf is not None:
        semantics = parsed_srdf(name, srdf)
        for state in semantics.findall("group_state"):
            if positions := _positions(name, state, model):
                postures.setdefault(state.get("name", ""), {}).update(positions)
        _log_faults(name, semantics, model, postures)
        if park not in {"park", *postures}:
            raise CallerError(
                f"the SRDF of {name!r} has no state {park!r}; its states are: {', '.join(postures) or 'none'}"
            )
        if arms is None:
            arms = _arms(name, model, semantics, postures.get(park, {}))
    facts.setdefault("postures", postures)
    arms = dict(arms or {}) if payload_kg is None else with_payload(arms or {}, payload_kg)
    robot = RobotDescription(name=name, urdf=urdf, base_link=base_link, arms=arms, packages=dict(packages), **facts)
    _check_parts(robot, model)
    return robot


def _check_parts(robot: RobotDescription, model: Model) -> None:
    """Raise `CallerError` if the description names a link or a joint that its model lacks, or has no drive."""
    if not isinstance(robot.drive, Drive):
        raise CallerError(f"the drive of {robot.name!r} must be a Drive, got {robot.drive!r}")
    arms = robot.arms.values()
    links = [robot.camera_link or "", *(each for arm in arms for each in (arm.base_link, arm.tool_frame))]
    joints = [robot.torso_joint or "", *robot.head_joints, *(each for arm in arms for each in arm.joints)]
    for positions in (*robot.postures.values(), *(arm.park for arm in arms)):
        joints += positions
    for arm in arms:
        joints += itertools.chain.from_iterable(arm.gripper_joints.values())
    for kind, names, known in (("link", links, model.links), ("joint", joints, model.joints)):
        for name in filter(None, names):
            if name not in known:
                raise CallerError(f"the description of {robot.name!r} names a {kind} {name!r} that its URDF lacks")


def describe_arm(
    urdf: str | Path,
    base_link: str,
    tool_frame: str,
    *,
    park: Mapping[str, float] | None = None,
    tool_in_link: Pose | None = None,
    payload_kg: float | None = None,
    packages: Mapping[str, str | Path] = MappingProxyType({}),
) -> ArmDescription:
    """Return the arm between two links of the model, with its soft limits and its gripper, if it has one.

    The gripper's joints are those that the arm carries and that are none of its own. Fingers that slide are open at
    their upper limits, closed at the lower ones. Fingers that turn are open where their tips are farthest from each
    other and from the tool frame, and `opening_m` is not known. For a hand of another kind set `gripper_joints`
    and `opening_m` with `dataclasses.replace`.

    Raises:
        CallerError: the model has no such links, or no movable joint between them.
        DescriptionNotLoadable: the URDF has a fault.
    """
    model = read_model(urdf_text(tool_frame, urdf, packages))
    return _arm_between(model, base_link, tool_frame, park or {}, tool_in_link, payload_kg)


def _arm_between(
    model: Model,
    base_link: str,
    tool_frame: str,
    park: Mapping[str, float],
    tool_in_link: Pose | None = None,
    payload_kg: float | None = None,
) -> ArmDescription:
    path = [each for each in model.divided(base_link, tool_frame)[1] if each.moves_freely]
    if not path:
        raise CallerError(f"no joint moves {tool_frame!r} against {base_link!r}: name the ends of an arm")
    joints = tuple(each.name for each in path)
    grip, opening_m = _gripper(model, path[-1].child, tool_frame)
    return ArmDescription(
        joints=joints,
        base_link=base_link,
        tool_frame=tool_frame,
        tool_in_link=tool_in_link,
        payload_kg=payload_kg,
        soft_limits={each.name: each.soft for each in path if each.soft is not None},
        gripper_joints=grip,
        opening_m=opening_m,
        park={joint: position for joint, position in park.items() if joint in joints},
    )


def _gripper(model: Model, palm: str, tool: str) -> tuple[Mapping[GripperState, Mapping[str, float]], float | None]:
    """Return the open and the closed positions of the fingers below a link, and the width of the open gripper."""
    arm = model.path(tool)
    fingers = [each for each in model.below(palm) if each.kind is not JointType.FIXED and each not in arm]
    free = {each.name: each.bounds for each in fingers if each.moves_freely}
    if leading := {each.mimic.joint for each in fingers if each.mimic is not None} & free.keys():
        free = {name: free[name] for name in free if name in leading}  # the others are no drives of the gripper
    lowest = {name: bounds.lower for name, bounds in free.items()}
    highest = {name: bounds.upper for name, bounds in free.items()}
    slide = all(each.kind is JointType.PRISMATIC for each in fingers if each.name in free or each.mimic is not None)
    closed, opened = dict(lowest), dict(highest)
    if not slide:
        spread = _spread(model, palm, tool, fingers)
        start = {name: min(max(0.0, bounds.lower), bounds.upper) for name, bounds in free.items()}
        for name in free:
            low, high = (spread({**start, name: ends[name]}) for ends in (lowest, highest))
            if not abs(high - low) > _SPREAD_MIN_M:  # also without limits, where it is not a number
                del closed[name], opened[name]
            elif high < low:
                closed[name], opened[name] = opened[name], closed[name]
    followed = [each for each in fingers if each.name in closed or (each.mimic and each.mimic.joint in closed)]
    if not followed or not all(map(math.isfinite, (*closed.values(), *opened.values()))):
        return {}, None
    positions = [{each.name: each.position(state) for each in followed} for state in (opened, closed)]
    opening_m = sum(abs(positions[0][each.name] - positions[1][each.name]) for each in followed) if slide else None
    return {GripperState.OPEN: positions[0], GripperState.CLOSE: positions[1]}, opening_m


_SPREAD_MIN_M = 1e-4
"""A joint that changes the distances of the finger tips by less does not open a hand."""


def _spread(model: Model, palm: str, tool: str, fingers: Sequence[Joint]) -> Callable[[Mapping[str, float]], float]:
    """Return the sum of the distances of the finger tips from each other and from the tool, by joint positions."""
    from pycrorm_async.world.bounding_boxes import box_of

    above = len(model.path(palm))
    middle = along(model.path(tool)[above:], {}).position
    tips: list[tuple[tuple[Joint, ...], Pose]] = []
    for each in fingers:
        if not any(joint in fingers for joint in model.below(each.child)):
            last = max((path for path in model.paths.values() if each in path), key=len)
            box = box_of(model.links[last[-1].child])
            tips.append((last[above:], Pose() if box is None else Pose(box.centre)))

    def spread(positions: Mapping[str, float]) -> float:
        if not all(map(math.isfinite, positions.values())):
            return math.nan
        points = [(along(path, positions) @ tip).position for path, tip in tips]
        pairs = sum(math.dist(one, other) for one, other in itertools.combinations(points, 2))
        return pairs + sum(math.dist(point, middle) for point in points)

    return spread


# --- SRDF ------------------------------------------------------------------------------------------------------

_ROUNDED = 1e-6
"""A position that is outside its limits by no more is a rounded one, rad or m, and can be set."""
_LEG = re.compile(r"(?<![a-z])(?:[lr]|[lr][fhr]|[fhr][lr])?(?:leg|foot|feet|sole|ankle|toe|wheel)s?(?![a-z])")
_SIDES = (
    (re.compile(r"left|(?<![a-z])l(?![a-z])"), Arms.LEFT),
    (re.compile(r"right|(?<![a-z])r(?![a-z])"), Arms.RIGHT),
)
_STATES = {GripperState.OPEN: ("open", "opened"), GripperState.CLOSE: ("close", "closed")}


def _positions(name: str, state: Element, model: Model) -> dict[str, float]:
    """Return the positions of a state for joints of the URDF that move freely. Raises `CallerError` for other words.

    A follower gives its leader's position where the state has none for that.
    """
    positions: dict[str, float] = {}
    of_leaders: dict[str, float] = {}
    for each in state.findall("joint"):
        joint = model.joints.get(each.get("name", ""))
        if joint is None or joint.kind is JointType.FIXED:
            continue
        try:
            position = number_of(each.get("value", ""))
            if not math.isfinite(position):
                raise ValueError(f"{each.get('value')!r} is not finite")  # noqa: TRY301  a fault like the others
        except ValueError as fault:
            raise CallerError(
                f"the SRDF of {name!r}: <group_state name={state.get('name', '')!r}>, joint {joint.name!r}: {fault}"
            ) from None
        if joint.mimic is None:
            positions[joint.name] = position
        elif joint.mimic.multiplier:
            of_leaders[joint.mimic.joint] = (position - joint.mimic.offset) / joint.mimic.multiplier
    return of_leaders | positions


def _log_faults(name: str, semantics: Element, model: Model, postures: Mapping[str, Mapping[str, float]]) -> None:
    """Log states that no robot can take, and joints that the URDF lacks.

    The joints of a floating base, which have several numbers, are not logged.
    """
    for state, positions in postures.items():
        for joint, position in positions.items():
            lower, upper = model.joints[joint].bounds
            if not lower - _ROUNDED <= position <= upper + _ROUNDED:
                at = f"{joint} at {position:g}, outside its limits {lower:g} to {upper:g}"
                _log.warning("the SRDF of %r: the state %r puts %s", name, state, at)
    states = semantics.iterfind("group_state/joint")
    named = dict.fromkeys(each.get("name", "") for each in states if len(each.get("value", "").split()) < 2)
    if unknown := [each for each in named if each not in model.joints]:
        _log.warning("the SRDF of %r has states of joints that the URDF lacks: %s", name, ", ".join(unknown))


def _arms(name: str, model: Model, semantics: Element, park: Mapping[str, float]) -> dict[Arms, ArmDescription]:
    """Return the arms that end in the SRDF's end effectors."""
    groups = {each.get("name", ""): each for each in semantics.findall("group")}
    ends: list[tuple[str, Element, str, str]] = []
    for end in semantics.findall("end_effector"):
        group = end.get("parent_group") or end.get("group") or ""
        tool = end.get("parent_link", "")
        if any(_LEG.search(word.lower()) for word in (group, tool, end.get("name", ""), end.get("group", ""))):
            continue
        tool = model.joints[tool].child if tool in model.joints and tool not in model.links else tool
        if tool not in model.paths:
            raise CallerError(f"the SRDF of {name!r} names an end effector at a link {tool!r} that the URDF lacks")
        base = _first_link(groups, group, model, tool)
        if base is None:  # the group is that of the hand
            others = (each for each in groups if _first_link(groups, each, model, tool, ends=True) is not None)
            group = next(others, group)
            base = _first_link(groups, group, model, tool)
        if base is None:
            raise CallerError(
                f"the SRDF of {name!r} names an end effector of a group without a chain or a joint of the URDF:"
                f" {group!r}"
            )
        ends.append((group, end, base, tool))
    arms: dict[Arms, ArmDescription] = {}
    for group, end, base, tool in ends:
        described = _arm_between(model, base, tool, park)
        states = {
            kind: _positions(name, state, model)
            for kind, words in _STATES.items()
            for state in semantics.findall("group_state")
            if state.get("group") == end.get("group") != group and state.get("name", "").lower() in words
        }
        arm = _arm(group, taken=arms, only=len(ends) == 1)
        arms[arm] = replace(described, gripper_joints=states) if len(states) == len(_STATES) else described
    return arms


def _arm(group: str, *, taken: Collection[Arms], only: bool) -> Arms:
    for side, arm in _SIDES:
        if side.search(group.lower()) and arm not in taken:
            return arm
    return Arms.RIGHT if only else Arms.named(re.sub(r"\W|^(?=\d)", "_", group.upper()) or "_")


def _first_link(
    groups: Mapping[str, Element], group: str, model: Model, tool: str, *, ends: bool = False
) -> str | None:
    """Return the link above the first joint of a group on the way to the tool, or that at which its chain begins.

    None if no joint of the group moves the tool; with `ends` also if a joint outside the group is the last that does.
    """
    joints = _joints_of(groups, group, model)
    path = [each for each in model.path(tool) if each.moves_freely]
    first = next((each for each in path if each.name in joints), None)
    if first is None or (ends and path[-1].name not in joints):
        return None
    for chain in groups[group].findall("chain"):
        base = chain.get("base_link", "")
        if base in model.paths and model.path(tool)[: len(model.path(base))] == model.path(base):
            return base
    return first.parent


def _joints_of(
    groups: Mapping[str, Element], group: str, model: Model, passed: frozenset[str] = frozenset()
) -> set[str]:
    """Return the joints of a group: those that it names, above its links, of its chains, and of its subgroups."""
    if group not in groups or group in passed:
        return set()
    element = groups[group]
    links = {each.get("name") for each in element.findall("link")}
    joints = {each.get("name", "") for each in element.findall("joint")}
    joints |= {each.name for each in model.joints.values() if each.child in links}
    for chain in element.findall("chain"):
        base, tip = (model.paths.get(chain.get(end, ""), ()) for end in ("base_link", "tip_link"))
        joints |= {each.name for each in tip if each not in base}
    for each in element.findall("group"):
        joints |= _joints_of(groups, each.get("name", ""), model, passed | {group})
    return joints
