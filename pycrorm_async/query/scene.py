"""Read the recorded geometry of a moment without Bullet: shapes of objects, poses of links, outlines from above."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias
from xml.etree.ElementTree import Element, ParseError, fromstring

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.world.bounding_boxes import BoundingBox, rotation_matrix
from pycrorm_async.world.model_boxes import with_boxes
from pycrorm_async.world.models import built_in_that_fits
from pycrorm_async.world.pose import ObjectType, Pose, Vector

# === link frames ==============================================================================================
#
# Compute the frame of every link of a model from an object's pose and joint positions: forward kinematics.

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


# === mesh triangles ===========================================================================================
#
# Read the triangles of mesh files: STL, OBJ and Collada (DAE), each as far as robots' descriptions use it.
#
# Materials and normals are left out: a drawing has the colour of the description and flat faces. A file that cannot be
# read raises `ValueError`, and a drawing then has the box around its link instead.

TRIANGLES_MAX = 50_000
"""Bounds the triangles of a file: a drawing of a few hundred pixels shows no more."""
_STL_HEADER, _STL_TRIANGLE = 84, 50
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")
_DECIMALS = 5
"""Rounds vertices to 0.01 mm, so that those of neighbouring triangles are one."""

Points = npt.NDArray[np.float64]


class Triangles(NamedTuple):
    """The vertices of a mesh, m, and for each triangle the indices of its three vertices."""

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.uint32]


def triangles_of(name: str, content: bytes) -> Triangles:
    """Return the triangles of a mesh file; the suffix of its name decides its format. Raises `ValueError`."""
    suffix = name.rpartition(".")[2].lower()
    read = _FORMATS.get(suffix)
    if read is None:
        raise ValueError(f"the format {suffix!r} is not read")
    try:
        corners = np.asarray(read(content), dtype=np.float64).reshape(-1, 3, 3).reshape(-1, 3)
    except (ValueError, IndexError, KeyError, ParseError, UnicodeDecodeError) as error:
        raise ValueError(f"it is not a readable {suffix} file: {error}") from error
    if len(corners) == 0:
        raise ValueError("it has no triangles")
    if len(corners) > 3 * TRIANGLES_MAX:
        raise ValueError(f"it has {len(corners) // 3:,} triangles, more than {TRIANGLES_MAX:,}")
    if not np.isfinite(corners).all():
        raise ValueError("it has a number that is not finite")
    vertices, faces = np.unique(corners.round(_DECIMALS), axis=0, return_inverse=True)
    return Triangles(vertices.astype(np.float32), faces.reshape(-1, 3).astype(np.uint32))


def _stl(content: bytes) -> Points:
    """Return three corners for each triangle of a binary or a text STL."""
    count = int.from_bytes(content[80:_STL_HEADER], "little")
    if len(content) >= _STL_HEADER and len(content) == _STL_HEADER + count * _STL_TRIANGLE:
        rows = np.frombuffer(content, np.uint8, offset=_STL_HEADER).reshape(count, _STL_TRIANGLE)
        return rows[:, 12:48].copy().view("<f4").astype(np.float64)
    if not content.lstrip().startswith(b"solid"):
        raise ValueError("its length does not fit its number of triangles")
    return np.array(_VERTEX.findall(content), dtype=np.float64)


def _obj(content: bytes) -> Points:
    vertices: list[list[float]] = []
    corners: list[int] = []
    for line in content.decode().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(each) for each in words[1:4]])
        elif words[:1] == ["f"]:
            indices = [int(each.partition("/")[0]) for each in words[1:]]
            corners += _fan([each - 1 if each > 0 else len(vertices) + each for each in indices])
    return np.array(vertices, dtype=np.float64).reshape(-1, 3)[corners]


def _fan(polygon: Sequence[int]) -> Iterator[int]:
    """Divide a polygon into triangles that share its first corner."""
    for second, third in pairwise(polygon[1:]):
        yield from (polygon[0], second, third)


# --- Collada ---------------------------------------------------------------------------------------------------


def _collada(content: bytes) -> Points:
    """Return the geometries of a Collada file where its scene places them, in m and with the z axis up."""
    root = fromstring(content)  # noqa: S314  a memory has recorded it
    for each in root.iter():
        each.tag = each.tag.rpartition("}")[2]
    geometries = {f"#{each.get('id')}": each for each in root.iter("geometry")}
    placed = [
        _placed(corners, matrix)
        for scene in root.iter("visual_scene")
        for node in scene.findall("node")
        for corners, matrix in _instances(node, np.eye(4), geometries)
    ]
    if not placed:
        return np.empty((0, 3))
    corners = np.concatenate(placed)
    unit = root.find("asset/unit")
    corners *= 1.0 if unit is None else float(unit.get("meter", "1"))
    if root.findtext("asset/up_axis", "Y_UP").strip() == "Y_UP":
        corners = np.stack([corners[:, 0], -corners[:, 2], corners[:, 1]], axis=1)
    return corners


def _placed(corners: Points, matrix: Points) -> Points:
    return corners @ matrix[:3, :3].T + matrix[:3, 3]


def _instances(node: Element, above: Points, geometries: Mapping[str, Element]) -> Iterator[tuple[Points, Points]]:
    matrix = above
    for each in node:
        if each.tag in _TRANSFORMS:
            matrix = matrix @ _TRANSFORMS[each.tag](_floats(each))
    for each in node.findall("instance_geometry"):
        mesh = geometries[each.get("url", "")].find("mesh")
        if mesh is not None:
            yield _corners(mesh), matrix
    for each in node.findall("node"):
        yield from _instances(each, matrix, geometries)


def _corners(mesh: Element) -> Points:
    arrays = {f"#{each.get('id')}": _positions(each) for each in mesh.findall("source")}
    vertices = {
        f"#{each.get('id')}": arrays[position.get("source", "")]
        for each in mesh.findall("vertices")
        for position in each.findall("input")
        if position.get("semantic") == "POSITION"
    }
    parts = [_primitive(each, vertices) for kind in ("triangles", "polylist") for each in mesh.findall(kind)]
    return np.concatenate(parts) if parts else np.empty((0, 3))


def _positions(source: Element) -> Points:
    accessor, array = source.find("technique_common/accessor"), source.find("float_array")
    stride = int(accessor.get("stride", "3")) if accessor is not None else 3
    return _floats(array).reshape(-1, stride)[:, :3] if array is not None else np.empty((0, 3))


def _primitive(primitive: Element, vertices: Mapping[str, Points]) -> Points:
    inputs = primitive.findall("input")
    stride = 1 + max(int(each.get("offset", "0")) for each in inputs)
    [vertex] = [each for each in inputs if each.get("semantic") == "VERTEX"]
    indices = np.array(primitive.findtext("p", "").split(), dtype=np.int64).reshape(-1, stride)
    corners = indices[:, int(vertex.get("offset", "0"))]
    if primitive.tag == "polylist":
        ends = np.cumsum(np.array(primitive.findtext("vcount", "").split(), dtype=np.int64))
        polygons = np.split(corners, ends[:-1])
        corners = np.array([index for each in polygons for index in _fan(each.tolist())], dtype=np.int64)
    return vertices[vertex.get("source", "")][corners]


def _floats(element: Element) -> Points:
    return np.array((element.text or "").split(), dtype=np.float64)


def _translation(values: Points) -> Points:
    matrix = np.eye(4)
    matrix[:3, 3] = values
    return matrix


def _rotation(values: Points) -> Points:
    """Return the matrix of an axis and an angle in degrees (Rodrigues' formula)."""
    x, y, z = values[:3] / np.linalg.norm(values[:3])
    angle = np.radians(values[3])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    return matrix


_TRANSFORMS: Mapping[str, Callable[[Points], Points]] = {
    "matrix": lambda values: values.reshape(4, 4),
    "translate": _translation,
    "rotate": _rotation,
    "scale": lambda values: np.diag([*values, 1.0]),
}
_FORMATS: Mapping[str, Callable[[bytes], Any]] = {"stl": _stl, "obj": _obj, "dae": _collada}


# === object model =============================================================================================
#
# Read the links, joints and shapes of a URDF as plain values, for forward kinematics where they are drawn.
#
# A mesh is drawn with its triangles where its file is recorded and they are asked for, otherwise as the box around its
# link's collision shapes. A link without a visual shape has its collision shapes.

_POINT: dict[str, Any] = {"root": "", "shapes": {"": [["sphere", [0.03], [0, 0, 0], [0, 0, 0], [1, 0, 1, 1]]]}}


def point_model(reason: str) -> dict[str, Any]:
    """Return the model of an object whose shape is unknown: a magenta point."""
    return {**_POINT, "joints": [], "assumed": f"a point, because {reason}"}


def object_model(description: DescriptionDeclared, *, drawn: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Return root link, shapes by link, and joints in the order of the tree.

    A shape is `[kind, sizes, xyz, rpy, rgba or None]`; a joint is `[name, type, parent, child, xyz, rpy, axis, mimic]`,
    with `mimic` as `[joint, multiplier, offset]` or None. `drawn` are the references of the meshes that keep their
    place (`MeshValue.reference`); their sizes are the reference and three factors. The others are boxes.
    """
    if description.missing is not None:
        return point_model(f"its description is missing: {description.missing}")
    try:
        return _model(fromstring(_without_meshes(description, drawn)))  # noqa: S314  a memory has recorded it
    except (ValueError, ParseError) as error:
        return point_model(f"its description cannot be read: {error}")


def assumed_model(name: str, object_type: str, joints: set[str]) -> dict[str, Any]:
    """Return the model of an object without a recorded description: the built-in shape if it fits, or a point."""
    reason = "its description was not recorded"
    if object_type in ObjectType.__members__:
        urdf = built_in_that_fits(name, ObjectType[object_type], joints=joints, links=set())
        if urdf is not None:
            return {**_model(fromstring(urdf)), "assumed": f"the built-in shape, because {reason}"}  # noqa: S314  our own
    return point_model(reason)


def _without_meshes(description: DescriptionDeclared, drawn: frozenset[str]) -> str:
    if "<mesh" not in description.text:
        return description.text
    boxes = {link: BoundingBox(Vector(*box.min), Vector(*box.max)) for link, box in description.boxes.items()}
    return with_boxes(description.text, boxes, kept=drawn)


def _model(robot: Element) -> dict[str, Any]:
    colors = {each.get("name"): color for each in robot.findall("material") if (color := _rgba(each)) is not None}
    shapes = {link.get("name", ""): list(_shapes(link, colors)) for link in robot.findall("link")}
    joints = [_joint(each) for each in robot.findall("joint")]
    children = {joint[3] for joint in joints}
    root = next((link for link in shapes if link not in children), None)
    if root is None:
        raise ValueError("it has no root link")
    ordered, reached = [], {root}
    while rest := [each for each in joints if each[2] in reached and each[3] not in reached]:
        ordered += rest
        reached |= {each[3] for each in rest}
    return {"root": root, "shapes": {name: each for name, each in shapes.items() if each}, "joints": ordered}


def _joint(joint: Element) -> list[Any]:
    xyz, rpy = _origin(joint)
    axis, mimic = joint.find("axis"), joint.find("mimic")
    copied = None
    if mimic is not None:
        copied = [mimic.get("joint", ""), _number(mimic.get("multiplier", "1")), _number(mimic.get("offset", "0"))]
    return [
        joint.get("name", ""),
        joint.get("type", "fixed"),
        _link(joint, "parent"),
        _link(joint, "child"),
        xyz,
        rpy,
        _numbers(axis.get("xyz", "1 0 0"), 3) if axis is not None else [1.0, 0.0, 0.0],
        copied,
    ]


def _link(joint: Element, end: str) -> str:
    element = joint.find(end)
    return element.get("link", "") if element is not None else ""


def _shapes(link: Element, colors: dict[str | None, list[float]]) -> Iterator[list[Any]]:
    visuals = link.findall("visual") or link.findall("collision")
    for visual in visuals:
        geometry = visual.find("geometry")
        if geometry is None:
            continue
        xyz, rpy = _origin(visual)
        material = visual.find("material")
        color = None if material is None else _rgba(material) or colors.get(material.get("name"))
        for shape in geometry:
            sizes = _sizes(shape)
            if sizes is not None:
                yield [shape.tag, sizes, xyz, rpy, color]


def _sizes(shape: Element) -> list[Any] | None:
    match shape.tag:
        case "mesh":
            return [shape.get("filename", ""), *_numbers(shape.get("scale", "1 1 1"), 3)]
        case "box":
            return _numbers(shape.get("size", ""), 3)
        case "cylinder" | "capsule":
            return [_number(shape.get("radius", "")), _number(shape.get("length", ""))]
        case "sphere":
            return [_number(shape.get("radius", ""))]
    return None


def _rgba(material: Element) -> list[float] | None:
    color = material.find("color")
    return None if color is None else _numbers(color.get("rgba", ""), 4)


def _origin(element: Element) -> tuple[list[float], list[float]]:
    origin = element.find("origin")
    if origin is None:
        return [0.0] * 3, [0.0] * 3
    return _numbers(origin.get("xyz", "0 0 0"), 3), _numbers(origin.get("rpy", "0 0 0"), 3)


def _numbers(text: str, count: int) -> list[float]:
    numbers = [_number(each) for each in text.split()]
    if len(numbers) != count:
        raise ValueError(f"{text!r} has {len(numbers)} numbers instead of {count}")
    return numbers


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text!r} is not a finite number")
    return round(number, 5)
