"""Built-in models as URDF text: primitive shapes, a kitchen, a PR2.

**Kitchen.** Generate the built-in kitchen: a counter with a sink area, an island, sliding drawers and a fridge with a
door.

Layout as seen from the origin, where the robot starts (x ahead, y to the left, metres):

    ahead, front at x 1.05, 0.6 deep    fridge y -1.25..-0.60 | counter -0.55..0.85, top 0.848 | sink area 0.85..1.75,
                                        top 0.812; a wall behind all three
    behind, front at x -1.10, 0.7 deep  island y 0.20..1.80, top 0.900

The thesis' cereal (1.3, 0.7, 0.95) and milk (1.3, 1, 0.9) are on the counter and in the sink area. A surface's frame is
in the middle of its top face; a handle's frame is in its middle with x pointing into the furniture, so that a gripper
approaching from the front has the handle's orientation. A drawer or door at joint position 0 is closed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring
from xml.sax.saxutils import quoteattr

from pycrorm_async.errors import MissingExtra
from pycrorm_async.world.pose import Arms, DescriptionNotLoadable, JointType, ObjectType
from pycrorm_async.world.urdf import COURIER, FINGER_OPEN_RAD, PR2, Bounds, PR2Arm
from pycrorm_async.world.urdf_model import read_model

# === primitives ===============================================================================================
#
# Generate boxes, cylinders and points as URDF text (metres, around the object's origin).

_INERTIAL = '<inertial><mass value="{:g}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
INERTIA = _INERTIAL.format(1.0)
"""The inertia of a link of a robot or an environment: Bullet warns about links without one. Its values do not matter
because the simulation is never stepped, and because no gripper lifts such an object."""

Range = tuple[float, float]
WHITE = (1.0, 1.0, 1.0, 1.0)


def box_urdf(
    name: str, *, x: Range, y: Range, z: Range, color: Sequence[float] = WHITE, mass_kg: float | None = None
) -> str:
    """Return an object of one link: the box between these bounds, m. A mass of None is left out of the URDF."""
    size, middle = zip(*((high - low, (low + high) / 2) for low, high in (x, y, z)), strict=True)
    return _one_link(name, f'<box size="{numbers(size)}"/>', middle, color, mass_kg)


def cylinder_urdf(
    name: str, *, radius: float, z: Range, color: Sequence[float] = WHITE, mass_kg: float | None = None
) -> str:
    """Return an object of one link: the upright cylinder around its z axis between these heights, m.

    A mass of None is left out of the URDF.
    """
    geometry = f'<cylinder radius="{radius:g}" length="{numbers([z[1] - z[0]])}"/>'
    return _one_link(name, geometry, (0.0, 0.0, (z[0] + z[1]) / 2), color, mass_kg)


def point_urdf(name: str, *, joints: Iterable[str], links: Iterable[str]) -> str:
    """Return a substitute for an object whose shape is unknown: a magenta point of 2 cm that touches nothing.

    Its joints are continuous, so that they take every position, and move links without a shape. `links` are fixed.
    """
    visual = '<visual><geometry><sphere radius="0.01"/></geometry><material name="1 0 1"><color rgba="1 0 1 1"/>'
    parts = [f"<link name={quoteattr(name)}>{visual}</material></visual></link>"]
    for kind, joint, link in (
        *(("continuous", each, f"{each} of {name}") for each in joints),
        *(("fixed", f"{each} fixed in {name}", each) for each in links if each != name),
    ):
        parts.append(
            f"<link name={quoteattr(link)}/><joint name={quoteattr(joint)} type={quoteattr(kind)}>"
            f'<parent link={quoteattr(name)}/><child link={quoteattr(link)}/><axis xyz="0 0 1"/></joint>'
        )
    lines = "\n".join(parts)  # Bullet cannot read a long file that has a single line
    return f"<robot name={quoteattr(name)}>\n{lines}\n</robot>\n"


def shape(geometry: str, middle: Sequence[float], color: Sequence[float]) -> str:
    """Return the <visual> and <collision> elements of a link: the same geometry around `middle`."""
    origin = f'<origin xyz="{numbers(middle)}"/>'
    return (
        f"<visual>{origin}<geometry>{geometry}</geometry>"
        f'<material name="{numbers(color)}"><color rgba="{numbers(color)}"/></material></visual>'
        f"<collision>{origin}<geometry>{geometry}</geometry></collision>"
    )


def numbers(values: Sequence[float]) -> str:
    """Format numbers for URDF, rounded to 1e-6, without negative zero."""
    return " ".join(f"{round(value, 6) + 0.0:g}" for value in values)


def _one_link(name: str, geometry: str, middle: Sequence[float], color: Sequence[float], mass_kg: float | None) -> str:
    link, inertial = quoteattr(name), "" if mass_kg is None else _INERTIAL.format(mass_kg)
    return f"<robot name={link}><link name={link}>{inertial}{shape(geometry, middle, color)}</link></robot>\n"


# === catalog ==================================================================================================
#
# Return built-in descriptions as URDF text, so that no file has to be read, downloaded or licensed.
#
# A small object is one link, a box or an upright cylinder, with the extent of the objects in the thesis' plans (metres,
# around the object's origin). The masses are assumptions that were not checked against a source: they are meant to
# match similar objects of the YCB set (chips can, cracker box, bowl, mug, spoon), and a litre of milk in its carton;
# `Object(..., mass_kg=)` replaces one. The robots and the environment are built in by name.


class _Box(NamedTuple):
    x: Range
    y: Range
    z: Range
    color: tuple[float, float, float, float]
    mass_kg: float | None = None


class _Cylinder(NamedTuple):
    radius: float
    z: Range
    color: tuple[float, float, float, float]
    mass_kg: float | None = None


_SHAPES: dict[ObjectType, _Box | _Cylinder] = {
    ObjectType.MILK: _Box((-0.033, 0.033), (-0.033, 0.033), (-0.088, 0.106), (0.3, 0.5, 0.9, 1.0), 1.06),
    ObjectType.BREAKFAST_CEREAL: _Box((-0.075, 0.073), (-0.03, 0.028), (-0.102, 0.122), (0.2, 0.7, 0.3, 1.0), 0.411),
    ObjectType.SPOON: _Box((-0.108, 0.108), (-0.023, 0.023), (-0.0095, 0.0095), (0.7, 0.7, 0.75, 1.0), 0.03),
    ObjectType.BOWL: _Cylinder(0.07, (-0.032, 0.035), (0.9, 0.8, 0.2, 1.0), 0.147),
    ObjectType.JEROEN_CUP: _Cylinder(0.04, (-0.05, 0.05), (0.9, 0.9, 0.9, 1.0), 0.118),
    ObjectType.METALMUG: _Cylinder(0.04, (-0.05, 0.05), (0.6, 0.6, 0.65, 1.0), 0.118),
    ObjectType.PRINGLES: _Cylinder(0.0375, (-0.12, 0.12), (0.8, 0.2, 0.2, 1.0), 0.205),
    ObjectType.GENERIC_OBJECT: _Box((-0.05, 0.05), (-0.05, 0.05), (-0.05, 0.05), (0.6, 0.6, 0.6, 1.0)),
    ObjectType.HUMAN: _Cylinder(0.25, (0.0, 1.75), (0.8, 0.6, 0.5, 1.0)),
}


_NOT_IN_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Finds characters that XML cannot hold, not even as references: a recorded name may have any."""


def built_in_urdf(name: str, object_type: ObjectType) -> str:
    """Return the built-in description of an object: by type, for robots and environments by name.

    Raises:
        DescriptionNotLoadable: no built-in robot or environment has that name.
    """
    if object_type is ObjectType.ROBOT or object_type is ObjectType.ENVIRONMENT:
        return _by_name(name, object_type)
    shape, name = _SHAPES[object_type], _NOT_IN_XML.sub("_", name)
    if isinstance(shape, _Box):
        return box_urdf(name, x=shape.x, y=shape.y, z=shape.z, color=shape.color, mass_kg=shape.mass_kg)
    return cylinder_urdf(name, radius=shape.radius, z=shape.z, color=shape.color, mass_kg=shape.mass_kg)


def built_in_that_fits(name: str, object_type: ObjectType, *, joints: set[str], links: set[str]) -> str | None:
    """Return the built-in URDF for a name and a type if it has these joints and links, otherwise None."""
    try:
        urdf = built_in_urdf(name, object_type)
    except DescriptionNotLoadable:  # no robot or environment of that name is built in
        return None
    model = read_model(urdf)
    movable = {name for name, each in model.joints.items() if each.kind is not JointType.FIXED}
    return urdf if joints <= movable and links <= model.links.keys() else None


def _by_name(name: str, object_type: ObjectType) -> str:
    if (name, object_type) == ("pr2", ObjectType.ROBOT):
        return pr2_urdf()
    if (name, object_type) == ("courier", ObjectType.ROBOT):
        return courier_urdf()
    if (name, object_type) == ("kitchen", ObjectType.ENVIRONMENT):
        return kitchen_urdf()
    raise DescriptionNotLoadable(
        name,
        f"no {object_type.name} of that name is built in ('pr2', 'courier' are robots, 'kitchen' the environment); "
        "pass a description: URDF text or the path of a .urdf file",
    )


# === courier ==================================================================================================
#
# Provide the courier as a model for Bullet, generated from boxes: a small robot of our own design.
#
# A differential base carries a column; the arm of six joints is mounted at its front, the camera on its top. With all
# joints 0 the arm points ahead, along x.

_X, _Y, _Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_AT_PARENT = (0.0, 0.0, 0.0)
_UPPER_ARM_M, _FOREARM_M, _TOOL_M = 0.42, 0.36, 0.17
_SHOULDER_HEIGHT_M, _CAMERA_HEIGHT_M = 0.85, 1.3


def courier_urdf() -> str:
    """Return the courier as URDF text; it refers to no other file."""
    robot = Element("robot", name=COURIER.name)
    link(robot, "base_footprint")
    fixed(robot, "base_footprint_joint", "base_footprint", "base_link", (0, 0, 0.03))
    link(robot, "base_link", (0.5, 0.44, 0.26), (0, 0, 0.13), WHITE_RGBA)
    fixed(robot, "column_joint", "base_link", "column_link", (-0.05, 0, 0.26))
    link(robot, "column_link", (0.14, 0.14, 0.9), (0, 0, 0.45), GREY)
    _courier_arm(robot)
    _camera(robot)
    indent(robot)  # Bullet cannot read a long file that has a single line
    return tostring(robot, encoding="unicode")


def _courier_arm(robot: Element) -> None:
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
    link(robot, "upper_arm_link", (0.36, 0.1, 0.1), (_UPPER_ARM_M / 2, 0, 0), WHITE_RGBA)
    link(robot, "elbow_link", (0.11, 0.11, 0.11), _AT_PARENT, GREY)
    link(robot, "forearm_link", (0.28, 0.08, 0.08), (_FOREARM_M / 2, 0, 0), WHITE_RGBA)
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
    link(robot, "camera_link", (0.04, 0.14, 0.05), _AT_PARENT, WHITE_RGBA)
    fixed(robot, "camera_optical_joint", "camera_link", COURIER.camera_link or "", (0.02, 0, 0), rotation=OPTICAL)
    link(robot, COURIER.camera_link or "")


# === kitchen ==================================================================================================

_FRONT, _ISLAND_FRONT = 1.05, -1.10
_WOOD, _STEEL, _PALE = (0.62, 0.45, 0.28, 1.0), (0.7, 0.72, 0.75, 1.0), (0.93, 0.92, 0.88, 1.0)
_DRAWER_TRAVEL_M, _DOOR_SWING_RAD = 0.35, 1.9
_PANEL_M = 0.02


class _Block(NamedTuple):
    """An axis-aligned box in its link's frame: (low, high) along x, y and z."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]
    color: tuple[float, ...] = _WOOD


def kitchen_urdf() -> str:
    """Return the kitchen as URDF text; deterministic."""
    parts = [
        f'<link name="kitchen">{INERTIA}</link>',
        *_part("kitchen_wall", "kitchen", (1.65, 0.0, 0.0), [_Block((0.0, 0.1), (-1.25, 1.75), (0.0, 2.2), _PALE)]),
        *_cupboard("kitchen_counter", x=(_FRONT, 1.65), y=(-0.55, 0.85), top=0.848),
        *_cupboard("sink_area", x=(_FRONT, 1.65), y=(0.85, 1.75), top=0.812),
        *_tap(),
        *_cupboard("kitchen_island", x=(-1.80, _ISLAND_FRONT), y=(0.20, 1.80), top=0.900),
        *_drawer("kitchen_counter_upper_drawer", front=(_FRONT, 0.35), turn=0.0, z=(0.60, 0.79)),
        *_drawer("kitchen_counter_lower_drawer", front=(_FRONT, 0.35), turn=0.0, z=(0.30, 0.58)),
        *_drawer("sink_area_drawer", front=(_FRONT, 1.30), turn=0.0, z=(0.57, 0.76)),
        *_drawer("kitchen_island_upper_drawer", front=(_ISLAND_FRONT, 1.0), turn=math.pi, z=(0.64, 0.84)),
        *_drawer("kitchen_island_lower_drawer", front=(_ISLAND_FRONT, 1.0), turn=math.pi, z=(0.34, 0.62)),
        *_fridge(),
    ]
    return '<robot name="kitchen">\n' + "\n".join(parts) + "\n</robot>\n"


def _cupboard(name: str, *, x: tuple[float, float], y: tuple[float, float], top: float) -> Iterable[str]:
    """Yield a closed body up to the worktop, and the worktop as `<name>_surface`."""
    half = ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2)
    middle = ((x[0] + x[1]) / 2, (y[0] + y[1]) / 2)
    sides = (-half[0], half[0]), (-half[1], half[1])
    yield from _part(name, "kitchen", (*middle, 0.0), [_Block(*sides, (0.0, top - 0.04))])
    yield from _part(f"{name}_surface", name, (0.0, 0.0, top), [_Block(*sides, (-0.04, 0.0), _PALE)])


def _tap() -> Iterable[str]:
    spout = _Block((-0.18, 0.0), (-0.012, 0.012), (0.22, 0.245), _STEEL)
    pipe = _Block((-0.0125, 0.0125), (-0.0125, 0.0125), (0.0, 0.25), _STEEL)
    yield from _part("sink_area_tap", "sink_area_surface", (0.22, 0.15, 0.0), [pipe, spout])


def _drawer(name: str, *, front: tuple[float, float], turn: float, z: tuple[float, float]) -> Iterable[str]:
    """Yield an open box 0.6 m wide and 0.45 m deep that `<name>_joint` slides out of the front, and `<name>_handle`."""
    height, side = z[1] - z[0], 0.30
    inner = (_PANEL_M, 0.45)
    blocks = [
        _Block((-_PANEL_M, _PANEL_M), (-side, side), (0.0, height), _PALE),
        _Block(inner, (-side + _PANEL_M, side - _PANEL_M), (0.0, _PANEL_M)),
        _Block(inner, (-side + _PANEL_M, -side + 2 * _PANEL_M), (_PANEL_M, height - 0.03)),
        _Block(inner, (side - 2 * _PANEL_M, side - _PANEL_M), (_PANEL_M, height - 0.03)),
        _Block((0.43, 0.45), (-side + 2 * _PANEL_M, side - 2 * _PANEL_M), (_PANEL_M, height - 0.03)),
    ]
    yield _link(name, blocks)
    yield _part_joint(name, "kitchen", "prismatic", (*front, z[0]), turn, axis=(-1, 0, 0), travel=_DRAWER_TRAVEL_M)
    handle = _Block((-0.008, 0.008), (-0.07, 0.07), (-0.008, 0.008), _STEEL)
    yield from _part(f"{name}_handle", name, (-0.05, 0.0, height / 2), [handle])


def _fridge() -> Iterable[str]:
    """Yield a hollow body open to the front, a shelf, and a door hinged on the right."""
    wall, width, depth, height = 0.03, 0.65, 0.60, 1.60
    across, deep = (0.0, width), (0.0, depth)
    blocks = [
        _Block(deep, (0.0, wall), (0.0, height), _PALE),
        _Block(deep, (width - wall, width), (0.0, height), _PALE),
        _Block((depth - wall, depth), across, (0.0, height), _PALE),
        _Block(deep, across, (0.0, 0.1), _PALE),
        _Block(deep, across, (height - wall, height), _PALE),
    ]
    yield from _part("fridge", "kitchen", (_FRONT, -1.25, 0.0), blocks)
    board = _Block((-0.27, 0.27), (-width / 2 + wall, width / 2 - wall), (-0.015, 0.0), _STEEL)
    yield from _part("fridge_shelf_surface", "fridge", (0.30, width / 2, 0.80), [board])
    yield _link("fridge_door", [_Block((-0.05, 0.0), across, (0.1, height), _PALE)])
    yield _part_joint("fridge_door", "fridge", "revolute", (0.0, 0.0, 0.0), 0.0, axis=(0, 0, 1), travel=_DOOR_SWING_RAD)
    handle = _Block((-0.01, 0.01), (-0.01, 0.01), (-0.2, 0.2), _STEEL)
    yield from _part("fridge_door_handle", "fridge_door", (-0.10, width - 0.06, 0.95), [handle])


def _part(name: str, parent: str, at: tuple[float, float, float], blocks: Iterable[_Block]) -> Iterable[str]:
    """Yield a link and the joint that fixes it to its parent."""
    yield _link(name, blocks)
    yield _part_joint(name, parent, "fixed", at, 0.0)


def _link(name: str, blocks: Iterable[_Block]) -> str:
    shapes = []
    for block in blocks:
        bounds = block[:3]
        size = numbers([high - low for low, high in bounds])
        shapes.append(shape(f'<box size="{size}"/>', [(low + high) / 2 for low, high in bounds], block.color))
    return f'<link name="{name}">{INERTIA}{"".join(shapes)}</link>'


def _part_joint(
    link: str,
    parent: str,
    kind: str,
    at: tuple[float, float, float],
    turn: float,
    *,
    axis: tuple[int, int, int] | None = None,
    travel: float = 0.0,
) -> str:
    """Return `<link>_joint` at that position of the parent, rotated about z; it moves from 0 to `travel` if it can."""
    motion = ""
    if axis is not None:
        motion = f'<axis xyz="{numbers(axis)}"/><limit lower="0" upper="{travel}" effort="100" velocity="1"/>'
    return (
        f'<joint name="{link}_joint" type="{kind}"><parent link="{parent}"/><child link="{link}"/>'
        f'<origin xyz="{numbers(at)}" rpy="0 0 {turn}"/>{motion}</joint>'
    )


# === pr2 ======================================================================================================
#
# Provide the PR2 as a model for Bullet: generated from boxes (`pr2_urdf`), or from meshes (`pr2_mesh_urdf_path`).
#
# Both have the same root, links, joints and dimensions as far as plans use them. The generated one needs no file and
# loads in milliseconds; the mesh model is in the optional package example-robot-data and has narrower limits of two
# joints (wrist flex -2.094 rad, torso 0.31 m).
#
# The root link `base_footprint` is on the floor. The centre of mass of every link is its origin, so that Bullet, which
# places links by their centres of mass, uses the frames of the model. The shapes are about as large as the robot's:
# precise enough for bounding boxes, rays and pictures.

_MESH_MODEL = "cmeel.prefix/share/example-robot-data/robots/pr2_description/urdf/pr2.urdf"


@cache
def pr2_urdf() -> str:
    """Return a PR2 of boxes as URDF text, with the names and dimensions of the real one; it refers to no other file.

    It declares the hard limits; the rolls of forearm and wrist are continuous.
    """
    robot = Element("robot", name=PR2.name)
    link(robot, "base_footprint")
    fixed(robot, "base_footprint_joint", "base_footprint", "base_link", (0, 0, 0.051))
    link(robot, "base_link", (0.65, 0.65, 0.28), (0, 0, 0.14), WHITE_RGBA)
    torso = PR2.torso_origin
    moving(
        robot,
        PR2.torso_joint,
        "base_link",
        "torso_lift_link",
        (torso.x, torso.y, torso.z - 0.051),
        _Z,
        PR2.torso_limits,
        prismatic=True,
    )
    link(robot, "torso_lift_link", (0.24, 0.44, 0.95), (-0.1, 0, -0.235), WHITE_RGBA)
    _head(robot)
    for arm in PR2.arms.values():
        _pr2_arm(robot, arm)
    indent(robot)  # Bullet cannot read a long file that has a single line
    return tostring(robot, encoding="unicode")


def pr2_mesh_urdf_path() -> Path:
    """Return the path of the PR2's mesh model in the optional package example-robot-data.

    Its meshes are located relative to that path. Bullet warns about frames without a mass when it loads the model.

    Raises:
        MissingExtra: the package, or the model in it, is not installed.
    """
    try:
        path = Path(str(distribution("example-robot-data").locate_file(_MESH_MODEL)))
    except PackageNotFoundError:
        raise MissingExtra(
            "the PR2's mesh model is not installed: pip install 'pycrorm-async[pr2]', or use the built-in model"
        ) from None
    if not path.is_file():
        raise MissingExtra(f"example-robot-data contains no PR2 at {path}: pip install 'pycrorm-async[pr2]'")
    return path


def _head(robot: Element) -> None:
    """Add pan, tilt and the stereo camera on top, which is 1.27 m above the floor at torso height 0."""
    moving(
        robot,
        PR2.head_pan_joint,
        "torso_lift_link",
        PR2.head_pan_link,
        (-0.01707, 0, 0.38145),
        _Z,
        Bounds(-3.007, 3.007),
    )
    link(robot, PR2.head_pan_link, (0.16, 0.2, 0.2), (0.02, 0, -0.06), DARK)
    moving(
        robot,
        PR2.head_tilt_joint,
        PR2.head_pan_link,
        PR2.head_tilt_link,
        (0.068, 0, 0),
        _Y,
        Bounds(-0.471238, 1.39626),
    )
    link(robot, PR2.head_tilt_link, (0.22, 0.3, 0.11), (-0.05, 0, 0.1), WHITE_RGBA)
    for joint, parent, child, origin in (
        ("head_plate_frame_joint", PR2.head_tilt_link, "head_plate_frame", (0.0232, 0, 0.0645)),
        ("sensor_mount_frame_joint", "head_plate_frame", "sensor_mount_link", (0, 0, 0)),
        ("double_stereo_frame_joint", "sensor_mount_link", "double_stereo_link", (0, 0, 0.003)),
        ("wide_stereo_frame_joint", "double_stereo_link", "wide_stereo_link", (0, 0.03, 0.0305)),
    ):
        fixed(robot, joint, parent, child, origin)
        link(robot, child)
    fixed(
        robot,
        "wide_stereo_optical_frame_joint",
        "wide_stereo_link",
        PR2.camera_link,
        (0, 0, 0),
        rotation=OPTICAL,
    )
    link(robot, PR2.camera_link)


def _pr2_arm(robot: Element, arm: PR2Arm) -> None:
    """Add the seven joints from the torso to the wrist, and the gripper."""
    prefix = arm.tool_frame[0]
    pan, lift, roll, elbow, forearm_roll, wrist, wrist_roll = (
        joint.removesuffix("_joint") + "_link" for joint in arm.joints
    )
    upper_arm, forearm = f"{prefix}_upper_arm_link", f"{prefix}_forearm_link"
    to_lift, to_elbow, to_wrist = (
        (length, 0.0, 0.0) for length in (arm.shoulder_offset_m, arm.upper_arm_m, arm.forearm_m)
    )
    origin_of_parent = (0.0, 0.0, 0.0)
    chain = (  # parent, child, origin of the joint in the parent, axis
        ("torso_lift_link", pan, arm.shoulder, _Z),
        (pan, lift, to_lift, _Y),
        (lift, roll, origin_of_parent, _X),
        (upper_arm, elbow, to_elbow, _Y),
        (elbow, forearm_roll, origin_of_parent, _X),
        (forearm, wrist, to_wrist, _Y),
        (wrist, wrist_roll, origin_of_parent, _X),
    )
    for joint, (parent, child, origin, axis) in zip(arm.joints, chain, strict=True):
        moving(robot, joint, parent, child, origin, axis, arm.hard_limits[joint])
    fixed(robot, f"{prefix}_upper_arm_joint", roll, upper_arm, origin_of_parent)
    fixed(robot, f"{prefix}_forearm_joint", forearm_roll, forearm, origin_of_parent)

    link(robot, pan, (0.2, 0.2, 0.5), (0.02, 0, -0.2), WHITE_RGBA)
    link(robot, lift, (0.22, 0.16, 0.22), origin_of_parent, GREY)
    link(robot, roll)
    link(robot, upper_arm, (0.3, 0.14, 0.14), (0.22, 0, 0), WHITE_RGBA)
    link(robot, elbow, (0.14, 0.1, 0.14), origin_of_parent, GREY)
    link(robot, forearm_roll)
    link(robot, forearm, (0.22, 0.11, 0.11), (0.18, 0, 0), WHITE_RGBA)
    link(robot, wrist, (0.07, 0.05, 0.08), origin_of_parent, GREY)
    link(robot, wrist_roll)
    _gripper(robot, arm, prefix, wrist_roll)


def _gripper(robot: Element, arm: PR2Arm, prefix: str, wrist_roll: str) -> None:
    """Add the palm, two fingers that swing outwards, and the tool frame between their tips."""
    palm = f"{prefix}_gripper_palm_link"
    fixed(robot, f"{prefix}_gripper_palm_joint", wrist_roll, palm, (0, 0, 0))
    link(robot, palm, (0.1, 0.1, 0.05), (0.07, 0, 0), DARK)
    fixed(robot, f"{prefix}_gripper_tool_joint", palm, arm.tool_frame, (arm.tool_m, 0, 0))
    link(robot, arm.tool_frame)
    for finger, side in (("l", 1), ("r", -1)):
        finger_link = f"{prefix}_gripper_{finger}_finger_link"
        origin, axis = (0.07691, side * 0.01, 0), (0, 0, side)
        moving(
            robot,
            f"{prefix}_gripper_{finger}_finger_joint",
            palm,
            finger_link,
            origin,
            axis,
            Bounds(0.0, FINGER_OPEN_RAD),
        )
        link(robot, finger_link, (0.12, 0.02, 0.03), (0.06, side * 0.005, 0), GREY)


# === urdf elements ============================================================================================
#
# Add links and joints to the URDF of a built-in robot.
#
# The centre of mass of every link is its origin, so that Bullet, which places links by their centres of mass, uses the
# frames of the model.

WHITE_RGBA, GREY, DARK = "0.93 0.93 0.95 1", "0.6 0.6 0.65 1", "0.2 0.2 0.22 1"
OPTICAL = (-math.pi / 2, 0.0, -math.pi / 2)
"""Rotation from a camera's body (x ahead) to its optical frame (z ahead)."""


def link(
    robot: Element,
    name: str,
    size: Sequence[float] | None = None,
    centre: Sequence[float] = (0, 0, 0),
    rgba: str = GREY,
) -> None:
    """Add a link: a box around `centre`, or, without a size, a frame only."""
    link = SubElement(robot, "link", name=name)
    link.append(fromstring(INERTIA))  # noqa: S314  our own text
    if size is None:
        return
    for purpose in ("visual", "collision"):
        shape = SubElement(link, purpose)
        SubElement(shape, "origin", xyz=numbers(centre))
        SubElement(SubElement(shape, "geometry"), "box", size=numbers(size))
        if purpose == "visual":
            SubElement(SubElement(shape, "material", name=rgba), "color", rgba=rgba)


def fixed(
    robot: Element,
    name: str,
    parent: str,
    child: str,
    origin: Sequence[float],
    *,
    rotation: Sequence[float] = (0, 0, 0),
) -> None:
    _joint(robot, "fixed", name, parent, child, origin, rotation)


def moving(
    robot: Element,
    name: str,
    parent: str,
    child: str,
    origin: Sequence[float],
    axis: Sequence[float],
    bounds: Bounds,
    *,
    prismatic: bool = False,
) -> None:
    """Add a movable joint: continuous if the bounds are infinite, prismatic on request, revolute otherwise."""
    endless = math.isinf(bounds.upper)
    kind = "continuous" if endless else "prismatic" if prismatic else "revolute"
    joint = _joint(robot, kind, name, parent, child, origin, (0, 0, 0))
    SubElement(joint, "axis", xyz=numbers(axis))
    limit = SubElement(joint, "limit", effort="100", velocity="3")
    if not endless:
        limit.set("lower", repr(bounds.lower))
        limit.set("upper", repr(bounds.upper))


def _joint(
    robot: Element,
    kind: str,
    name: str,
    parent: str,
    child: str,
    origin: Sequence[float],
    rotation: Sequence[float],
) -> Element:
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    # `numbers` rounds to 1e-6, which would turn right angles into other angles: write the rotation in full.
    SubElement(joint, "origin", xyz=numbers(origin), rpy=" ".join(map(repr, rotation)))
    return joint
