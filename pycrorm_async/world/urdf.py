"""Check and read URDF files, and describe robots.

**Robot description.** Describe robots for plans: arms, grippers, torso, head, camera, limits and named postures.

A `RobotDescription` is a constant; the robot's current pose and joint positions are in the world. Lengths are in
metres, angles in rad, poses of links those of the loaded model (URDF). A part that a robot lacks is None or empty in
its description, and an action that needs it fails with `CapabilityAbsenceFailure`.

>>> PR2.arms[Arms.LEFT].tool_frame
'l_gripper_tool_frame'

**Joint chain.** Read the joints of a robot's model (URDF), and compute the frame to which they lead.

>>> above, arm = divided(urdf, "torso_lift_link", "l_gripper_tool_frame")
>>> along((*above, *arm), {"torso_lift_joint": 0.1})  # the tool in the root link

**Urdf description.** Describe a robot from its model (URDF) and, if there is one, its semantic description (SRDF).

>>> TIAGO = describe_robot("tiago", path, arms={Arms.RIGHT: describe_arm(path, "torso_lift_link", "arm_tool_link")},
...                        drive=Drive.DIFFERENTIAL, torso_joint="torso_lift_joint")
>>> PANDA = describe_robot("panda", path, srdf=srdf_path, park="default", drive=Drive.FIXED)
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

from pycrorm_async.errors import CallerError
from pycrorm_async.world.pose import (
    COORDINATE_MAX,
    Arms,
    DescriptionNotLoadable,
    Grasp,
    GripperState,
    JointType,
    Pose,
    Quaternion,
    Vector,
    product,
    rotated,
)

#
# Check a URDF before Bullet loads it, because some faults crash Bullet instead of raising an error.
#
# Two roots or two joints of one name end the process inside Bullet. Bullet reports a missing mesh only on stdout. An
# origin that is not finite gives links poses that are not finite. This module checks the tree of links, the names, the
# mesh files and the origins; Bullet checks the rest.


def urdf_text(name: str, description: str | Path) -> str:
    """Read and check a URDF and return its text with the absolute path of every mesh.

    Args:
        name: the object's name, used in the error message only.
        description: URDF text (it begins with "<"), or the path of a .urdf file. `package://x/y` is searched as `x/y`
            in the file's folder and those above it; other relative names start at the file's folder. For URDF text,
            which has no file, the current folder takes that place.

    Raises:
        DescriptionNotLoadable: the URDF has a fault, which the message names.
    """
    if isinstance(description, str) and description.lstrip().startswith("<"):
        text, folder = description, Path.cwd()
    else:
        path = Path(description)
        try:
            text, folder = path.read_text(encoding="utf-8"), path.resolve().parent
        except (OSError, UnicodeDecodeError, ValueError) as reason:
            raise DescriptionNotLoadable(name, f"{path} cannot be read: {reason}") from reason
    try:
        robot = fromstring(text)  # noqa: S314 the caller's own file, read in the caller's process
        _check(robot)
        meshes = list(robot.iter("mesh"))
        for mesh in meshes:
            mesh.set("filename", str(_find_mesh(mesh.get("filename", ""), folder)))
    except (ParseError, _Fault) as fault:
        raise DescriptionNotLoadable(name, str(fault)) from fault
    return tostring(robot, encoding="unicode") if meshes else text


class _Fault(Exception):
    """A fault of a URDF; `urdf_text` converts it to a `DescriptionNotLoadable`."""


def _find_mesh(reference: str, folder: Path) -> Path:
    """Return the path of a mesh file. Raises `_Fault` if it does not exist."""
    if reference.startswith("package://"):
        relative = reference.removeprefix("package://").lstrip("/")
        candidates = [above / relative for above in (folder, *folder.parents)]
    else:
        candidates = [folder / reference.removeprefix("file://")]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise _Fault(f"mesh {reference} is not at {' nor at '.join(map(str, candidates[:3]))}")


def _check(robot: Element) -> None:
    """Raise `_Fault` unless <robot> holds one tree of links, unique names and finite origins."""
    if robot.tag != "robot":
        raise _Fault(f"its root element is <{robot.tag}>, not <robot>")
    links = [link.get("name", "") for link in robot.findall("link")]
    joints = robot.findall("joint")
    if not links:
        raise _Fault("it has no link")
    _unique("link", links)
    _unique("joint", [joint.get("name", "") for joint in joints])
    above: dict[str, str] = {}
    for joint in joints:
        parent, child = joined_link(joint, "parent"), joined_link(joint, "child")
        for end in (parent, child):
            if end not in links:
                raise _Fault(f"joint {joint.get('name')!r} names a link {end!r} that does not exist")
        if child in above:
            raise _Fault(f"link {child!r} has two parents")
        above[child] = parent
    roots = [link for link in links if link not in above]
    if len(roots) != 1:
        raise _Fault(f"it must have one root link, and has {len(roots)}: {', '.join(roots) or 'a cycle'}")
    for link in links:
        _climb(link, above)
    for element in robot.iter():
        for value in _numbers(element):
            if not abs(value) <= COORDINATE_MAX:
                raise _Fault(
                    f"<{element.tag}> holds {value:g}; numbers must be finite, and none above {COORDINATE_MAX:g}"
                )


def _numbers(element: Element) -> Iterator[float]:
    """Yield the numbers of the element's origin; Bullet checks words that are not numbers."""
    for word in f"{element.get('xyz', '')} {element.get('rpy', '')}".split():
        try:
            yield float(word)
        except ValueError:
            continue


def _climb(link: str, above: dict[str, str]) -> None:
    """Raise `_Fault` if the links above this one form a cycle."""
    passed = {link}
    while link in above:
        link = above[link]
        if link in passed:
            raise _Fault(f"links are joined in a cycle at {link!r}")
        passed.add(link)


def _unique(kind: str, names: Iterable[str]) -> None:
    for each, count in Counter(names).items():
        if not each:
            raise _Fault(f"a {kind} has no name")
        if count > 1:
            raise _Fault(f"{count} {kind}s are named {each!r}")


def joined_link(joint: Element, end: str) -> str:
    """Return the name of the link at an end of a joint, `parent` or `child`; empty if the joint names none."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


# === robot description ========================================================================================


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


# === joint chain ==============================================================================================

_ENDLESS = Bounds(-math.inf, math.inf)
_MOVABLE = {"revolute": JointType.REVOLUTE, "continuous": JointType.CONTINUOUS, "prismatic": JointType.PRISMATIC}


class Joint(NamedTuple):
    """One joint of a chain; `kind` is FIXED if it cannot move."""

    name: str
    kind: JointType
    child: str
    origin: Pose
    rpy: tuple[float, float, float]
    """The rotation of `origin` as the model has it, which no conversion rounds."""
    axis: Vector
    bounds: Bounds


def joints_between(urdf: str, base_link: str, tool_link: str) -> tuple[str, ...]:
    """Return the movable joints between two links, from the base to the tool. Raises as `divided`."""
    return tuple(each.name for each in divided(urdf, base_link, tool_link)[1] if each.kind is not JointType.FIXED)


def divided(urdf: str, base_link: str, tool_link: str) -> tuple[tuple[Joint, ...], tuple[Joint, ...]]:
    """Return the joints from the root to the base link (empty: the root), and those from there to the tool.

    Raises `CallerError` if the model has no such links, or the tool link is not below the base link.
    """
    robot = fromstring(urdf)  # noqa: S314  loaded by the caller's own process, and checked before
    links = {each.get("name", "") for each in robot.findall("link")}
    for link in (base_link, tool_link):
        if link and link not in links:
            raise CallerError(f"the model {robot.get('name')!r} has no link {link!r}: correct the robot's description")
    above = {joined_link(each, "child"): each for each in robot.findall("joint")}
    path: list[Joint] = []
    link = tool_link
    while link in above:
        path.insert(0, _joint(above[link]))
        link = joined_link(above[link], "parent")
    passed = [link, *(each.child for each in path)]  # from the root to the tool
    if base_link and base_link not in passed:
        raise CallerError(f"{tool_link!r} is not below {base_link!r}: correct the robot's description")
    begin = passed.index(base_link) if base_link else 0
    return tuple(path[:begin]), tuple(path[begin:])


def chains(urdf: str) -> dict[str, tuple[Joint, ...]]:
    """Return for each link the joints from the root to it."""
    robot = fromstring(urdf)  # noqa: S314  loaded by the caller's own process, and checked before
    below: dict[str, list[Element]] = {}
    for each in robot.findall("joint"):
        below.setdefault(joined_link(each, "parent"), []).append(each)
    children = {joined_link(each, "child") for joints in below.values() for each in joints}
    names = (link.get("name", "") for link in robot.findall("link"))
    paths: dict[str, tuple[Joint, ...]] = {name: () for name in names if name not in children}
    pending = [*paths]
    for link in pending:
        for each in below.get(link, ()):
            joint = _joint(each)
            paths[joint.child] = (*paths[link], joint)
            pending.append(joint.child)
    return paths


def _joint(element: Element) -> Joint:
    kind = _MOVABLE.get(element.get("type", ""), JointType.FIXED)
    axis, limit = element.find("axis"), element.find("limit")
    x, y, z = _three_numbers(None if axis is None else axis.get("xyz"), (1.0, 0.0, 0.0))
    length = math.hypot(x, y, z) or 1.0
    bounds = _ENDLESS
    if kind is not JointType.CONTINUOUS and limit is not None:
        bounds = Bounds(float(limit.get("lower", 0.0)), float(limit.get("upper", 0.0)))
    origin = element.find("origin")
    at, rpy = (None, None) if origin is None else (origin.get("xyz"), origin.get("rpy"))
    roll, pitch, yaw = _three_numbers(rpy, (0.0, 0.0, 0.0))
    turn = product(product(_about((0, 0, 1), yaw), _about((0, 1, 0), pitch)), _about((1, 0, 0), roll))
    return Joint(
        element.get("name", ""),
        kind,
        joined_link(element, "child"),
        Pose(_three_numbers(at, (0.0, 0.0, 0.0)), turn),
        (roll, pitch, yaw),
        Vector(x / length, y / length, z / length),
        bounds,
    )


def _three_numbers(text: str | None, default: tuple[float, float, float]) -> tuple[float, float, float]:
    if text is None:
        return default
    x, y, z = map(float, text.split())
    return x, y, z


def along(joints: Sequence[Joint], positions: Mapping[str, float]) -> Pose:
    """Return the frame of the last joint's child link in the first joint's parent link, at these positions."""
    x = y = z = 0.0
    turn = Quaternion(0.0, 0.0, 0.0, 1.0)
    for each in joints:
        step = rotated(turn, each.origin.position)
        x, y, z, turn = x + step.x, y + step.y, z + step.z, product(turn, each.origin.orientation)
        position = 0.0 if each.kind is JointType.FIXED else positions.get(each.name, 0.0)
        if each.kind is JointType.PRISMATIC:
            step = rotated(turn, [position * along for along in each.axis])
            x, y, z = x + step.x, y + step.y, z + step.z
        elif position:
            turn = product(turn, _about(each.axis, position))
    return Pose((x, y, z), turn)


def _about(axis: Sequence[float], angle: float) -> Quaternion:
    x, y, z = axis
    sine = math.sin(angle / 2)
    return Quaternion(x * sine, y * sine, z * sine, math.cos(angle / 2))


# === urdf description =========================================================================================


def describe_robot(
    name: str,
    urdf: str | Path,
    *,
    srdf: str | Path | None = None,
    arms: Mapping[Arms, ArmDescription] | None = None,
    park: str = "park",
    payload_kg: float | Mapping[Arms, float] | None = None,
    base_link: str = "",
    **facts: Any,
) -> RobotDescription:
    """Return the description of a robot whose model is this URDF (text, or the path of a file).

    Without `arms` they come from the SRDF: an arm for each end effector. An arm whose group has "left" or "right" in
    its name is that one; the only arm of a robot is RIGHT; each further one has the name of its group in capitals
    (`Arms.named`). The named states become `postures`, and the state `park` the arms' park posture.

    Args:
        payload_kg: the greatest mass that each arm lifts, or by arm; a URDF does not have it.
        base_link: see `RobotDescription`.
        facts: further attributes of `RobotDescription`, such as `drive`, `torso_joint`, `camera_link`.

    Raises:
        CallerError: the SRDF cannot be parsed or does not fit the URDF, `payload_kg` names an arm that the robot lacks,
            or the model has no such base link.
        DescriptionNotLoadable: the URDF has a fault.
    """
    if base_link:
        joints_between(urdf_text(name, urdf), "", base_link)
    postures: dict[str, dict[str, float]] = {}
    if srdf is not None:
        semantics = _parsed(name, srdf)
        for state in semantics.findall("group_state"):
            joints = postures.setdefault(state.get("name", ""), {})
            joints |= {each.get("name", ""): float(each.get("value", "0")) for each in state.findall("joint")}
        if arms is None:
            arms = _arms(name, urdf_text(name, urdf), semantics, postures.get(park, {}))
    facts.setdefault("postures", postures)
    arms = dict(arms or {}) if payload_kg is None else with_payload(arms or {}, payload_kg)
    return RobotDescription(name=name, urdf=urdf, base_link=base_link, arms=arms, **facts)


def describe_arm(
    urdf: str | Path,
    base_link: str,
    tool_frame: str,
    *,
    park: Mapping[str, float] | None = None,
    tool_in_link: Pose | None = None,
    payload_kg: float | None = None,
) -> ArmDescription:
    """Return the arm between two links of the model, with its gripper, if that has fingers that slide.

    The gripper's joints are those that the arm carries and that are none of its own: open at their upper limits, closed
    at the lower ones. For a hand of another kind set `gripper_joints` and `opening_m` with `dataclasses.replace`.

    Raises:
        CallerError: the model has no such links, or no movable joint between them.
        DescriptionNotLoadable: the URDF has a fault.
    """
    text = urdf_text(tool_frame, urdf)
    joints = joints_between(text, base_link, tool_frame)
    if not joints:
        raise CallerError(f"no joint moves {tool_frame!r} against {base_link!r}: name the ends of an arm")
    fingers = dict(_sliding(fromstring(text), joints[-1]))  # noqa: S314  the caller's own file
    grip = {
        GripperState.OPEN: {joint: upper for joint, (_, upper) in fingers.items()},
        GripperState.CLOSE: {joint: lower for joint, (lower, _) in fingers.items()},
    }
    return ArmDescription(
        joints=joints,
        base_link=base_link,
        tool_frame=tool_frame,
        tool_in_link=tool_in_link,
        payload_kg=payload_kg,
        gripper_joints=grip if fingers else {},
        opening_m=sum(upper - lower for lower, upper in fingers.values()) if fingers else None,
        park={joint: position for joint, position in (park or {}).items() if joint in joints},
    )


def _parsed(name: str, srdf: str | Path) -> Element:
    text = srdf if isinstance(srdf, str) and srdf.lstrip().startswith("<") else Path(srdf).read_text(encoding="utf-8")
    try:
        return fromstring(text)  # noqa: S314  the caller's own file
    except SyntaxError as fault:
        raise CallerError(f"the SRDF of {name!r} cannot be read: {fault}") from fault


def _arms(name: str, urdf: str, semantics: Element, park: Mapping[str, float]) -> dict[Arms, ArmDescription]:
    """Return the arms that end in the SRDF's end effectors."""
    groups = {each.get("name", ""): each for each in semantics.findall("group")}
    ends = [(each.get("parent_group", each.get("group", "")), each) for each in semantics.findall("end_effector")]
    arms: dict[Arms, ArmDescription] = {}
    for group, end in ends:
        chain = groups[group].find("chain") if group in groups else None
        tool = end.get("parent_link", "")
        base = chain.get("base_link", "") if chain is not None else _first_link(name, urdf, groups.get(group))
        arms[_arm(group, only=len(ends) == 1)] = describe_arm(urdf, base, tool, park=park)
    return arms


def _arm(group: str, *, only: bool) -> Arms:
    for side, arm in (("left", Arms.LEFT), ("right", Arms.RIGHT)):
        if side in group.lower():
            return arm
    return Arms.RIGHT if only else Arms.named(group.upper())


def _first_link(name: str, urdf: str, group: Element | None) -> str:
    """Return the link that carries the first joint of a group of joints."""
    joint = None if group is None else group.find("joint")
    for each in fromstring(urdf).findall("joint"):  # noqa: S314  the caller's own file
        if joint is not None and each.get("name") == joint.get("name"):
            return joined_link(each, "parent")
    raise CallerError(f"the SRDF of {name!r} names an end effector of a group without a chain or a joint of the URDF")


def _sliding(robot: Element, last: str) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yield the joints that the joint `last` carries, with their limits; none at all if one of them turns."""
    carried = {joined_link(each, "child") for each in robot.findall("joint") if each.get("name") == last}
    joints: list[tuple[str, tuple[float, float]]] = []
    added = True
    while added:
        below = [
            each
            for each in robot.findall("joint")
            if joined_link(each, "parent") in carried and joined_link(each, "child") not in carried
        ]
        added = bool(below)
        for each in below:
            carried.add(joined_link(each, "child"))
            limit = each.find("limit")
            if each.get("type") == "prismatic" and limit is not None:
                joints.append((each.get("name", ""), (float(limit.get("lower", "0")), float(limit.get("upper", "0")))))
            elif each.get("type") != "fixed":
                return
    yield from joints
