"""Read the meshes of a model; compute the boxes around its meshes and links, and their inertia."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any, Literal, NamedTuple, TypeAlias
from xml.etree.ElementTree import Element, ParseError, SubElement, fromstring, tostring

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.bounding_boxes import BoundingBox, Solid, box_around
from pycrorm_async.world.models import numbers
from pycrorm_async.world.pose import Quaternion, Vector
from pycrorm_async.world.urdf import joined_link

#
# Replace the mesh files of a URDF: by other names, or by the boxes around the collision shapes of their links.
#
# A URDF with boxes needs no mesh file, and the object keeps its links, joints and poses.

_EDGE_MIN = 1e-6
"""The shortest edge of a box, m: Bullet needs one above zero."""


def mesh_files(urdf: str) -> tuple[str, ...]:
    """Return the file names of the meshes, each once."""
    if "<mesh" not in urdf:  # spares the parsing of most descriptions
        return ()
    return tuple(dict.fromkeys(mesh.get("filename", "") for mesh in _parsed(urdf).iter("mesh")))


def meshed_links(urdf: str) -> tuple[str, ...]:
    """Return the names of the links that have a mesh."""
    return tuple(link.get("name", "") for link in _parsed(urdf).iter("link") if link.find(".//mesh") is not None)


def without_textures(urdf: str) -> tuple[str, tuple[str, ...]]:
    """Return the URDF without the texture files of its materials, and their names, each once."""
    if "<texture" not in urdf:
        return urdf, ()
    robot = _parsed(urdf)
    textures = [(each, texture) for each in robot.iter("material") for texture in each.findall("texture")]
    for material, texture in textures:
        material.remove(texture)
    return tostring(robot, encoding="unicode"), tuple(
        dict.fromkeys(PurePath(texture.get("filename", "")).name for _, texture in textures)
    )


def with_mesh_files(urdf: str, names: Mapping[str, str]) -> str:
    """Return the URDF with these file names instead of the present ones, which are the keys."""
    if not names:
        return urdf
    robot = _parsed(urdf)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", names[mesh.get("filename", "")])
    return tostring(robot, encoding="unicode")


def with_boxes(urdf: str, boxes: Mapping[str, BoundingBox], *, kept: frozenset[str] = frozenset()) -> str:
    """Replace the meshes of each link by the box of that link; remove them if the link has no box.

    Meshes with a file name in `kept` stay.
    """
    robot = _parsed(urdf)
    for link in robot.iter("link"):
        box = boxes.get(link.get("name", ""))
        for kind in ("visual", "collision"):
            replaced = [
                each
                for each in link.findall(kind)
                if (mesh := each.find("geometry/mesh")) is not None and mesh.get("filename") not in kept
            ]
            for each in replaced:
                link.remove(each)
            if replaced and box is not None:
                _add_box(SubElement(link, kind), box, replaced[0].find("material"))
    return tostring(robot, encoding="unicode")


def _add_box(shape: Element, box: BoundingBox, material: Element | None) -> None:
    SubElement(shape, "origin", xyz=numbers(box.centre))
    size = [max(edge, _EDGE_MIN) for edge in box.size]
    SubElement(SubElement(shape, "geometry"), "box", size=numbers(size))
    if material is not None:
        shape.append(material)


def _parsed(urdf: str) -> Element:
    return fromstring(urdf)  # noqa: S314  `urdf_text` has checked it, now or before a memory recorded it


# === mesh triangles ===========================================================================================
#
# Read the triangles of mesh files: STL, OBJ and Collada (DAE), each as far as robots' descriptions use it.
#
# Materials and normals are left out: a drawing has the colour of the description and flat faces. A file that cannot be
# read raises `ValueError`; a drawing then has the box around its link instead.

TRIANGLES_MAX = 50_000
"""Bounds the triangles of a file: a drawing of a few hundred pixels shows no more."""
_FILE_BYTES_MAX = 2**26
"""Bounds the bytes of a file that is read for the box around it, ten times a detailed part of a robot."""
_STL_HEADER, _STL_TRIANGLE = 84, 50
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")
_DECIMALS = 5
"""Rounds vertices to 0.01 mm, so that those of neighbouring triangles are one."""

Points = NDArray[np.float64]


class Triangles(NamedTuple):
    """The vertices of a mesh, m, and for each triangle the indices of its three vertices."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]


def triangles_of(name: str, content: bytes) -> Triangles:
    """Return the triangles of a mesh file; the suffix of its name decides its format. Raises `ValueError`."""
    corners = _corners_of(name, content)
    if len(corners) > 3 * TRIANGLES_MAX:
        raise ValueError(f"it has {len(corners) // 3:,} triangles, more than {TRIANGLES_MAX:,}")
    vertices, faces = np.unique(corners.round(_DECIMALS), axis=0, return_inverse=True)
    return Triangles(vertices.astype(np.float32), faces.reshape(-1, 3).astype(np.uint32))


def mesh_points(file: Path) -> Points:
    """Return the corners of the triangles of a mesh file, m. Raises `ValueError` and `OSError`."""
    if (size := file.stat().st_size) > _FILE_BYTES_MAX:
        raise ValueError(f"it takes {size:,} bytes, {_FILE_BYTES_MAX:,} are read")
    return _corners_of(file.name, file.read_bytes())


def _corners_of(name: str, content: bytes) -> Points:
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
    if not np.isfinite(corners).all():
        raise ValueError("it has a number that is not finite")
    return corners


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
    for second, third in itertools.pairwise(polygon[1:]):
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


# === shape boxes ==============================================================================================
#
# Compute the box around the shapes of each link in its own frame without Bullet, for an object that no world has.


def shape_boxes(
    urdf: str, kind: Literal["collision", "visual"], links: Collection[str] | None = None
) -> dict[str, BoundingBox]:
    """Return the box around the shapes of each link, or of each of `links`, by its name, without links that have none.

    A mesh has the box around its triangles. A link with a shape that cannot be read is left out.
    """
    boxes: dict[str, BoundingBox] = {}
    for link in _parsed(urdf).iter("link") if links is None or links else ():
        if links is not None and link.get("name", "") not in links:
            continue
        with suppress(ValueError, OSError):
            solids = [_solid(each) for each in link.findall(kind)]
            box = box_around([((Vector(0, 0, 0), Quaternion(0, 0, 0, 1)), solids)])
            if box is not None and np.isfinite(box).all():
                boxes[link.get("name", "")] = box
    return boxes


def _solid(element: Element) -> Solid:
    """Return a shape in its link's frame. Raises `ValueError` and `OSError` if it cannot be read."""
    frame = _origin(element)
    rotation, position = np.array(frame.rotation), np.array(frame.position)
    shape = next(element.iterfind("geometry/*"), Element("nothing"))
    if shape.tag == "box":
        return Solid(np.array(_CORNERS) * _numbers(shape.get("size")) @ rotation.T + position)
    if shape.tag == "sphere":
        return Solid(position[None, :], float(shape.get("radius", "")))
    if shape.tag in ("cylinder", "capsule"):
        axis = rotation[:, 2]
        along = axis * float(shape.get("length", "")) / 2
        ends = np.stack([position - along, position + along])
        return Solid(ends, float(shape.get("radius", "")), axis if shape.tag == "cylinder" else None)
    if shape.tag == "mesh":
        points = mesh_points(Path(shape.get("filename", "").removeprefix("file://")))
        return Solid(points * _numbers(shape.get("scale", "1 1 1")) @ rotation.T + position)
    raise ValueError(f"the shape <{shape.tag}> is unknown")


# === inertia ==================================================================================================
#
# Read the mass of an object from its description (URDF).


@lru_cache(maxsize=256)
def described_mass_kg(urdf: str) -> float | None:
    """Return the sum of the masses of all links, kg; None if no link has one, or if one is not a number.

    Returns None also for a sum of 0, which means that the model leaves the masses out, and for a text that is no XML.
    """
    try:
        mass = sum(float(each.get("value", "")) for each in _parsed(urdf).iterfind("link/inertial/mass"))
    except (ValueError, ParseError):
        return None
    return mass if 0 < mass < math.inf else None


# === link boxes ===============================================================================================
#
# Compute the box around the collision shapes of each link of a URDF, without Bullet.
#
# The result is aligned with the axes of the root link's frame, with every joint at position 0. That of a link that a
# prismatic joint slides names the joint and its direction; of several joints in a row it names the last alone. Links
# without a shape are left out, and so are links that turn, with all links below them.

_Vector: TypeAlias = tuple[float, float, float]
_Matrix: TypeAlias = tuple[_Vector, _Vector, _Vector]

_CORNERS = list(itertools.product((-0.5, 0.5), repeat=3))
_ZERO: _Vector = (0.0, 0.0, 0.0)


class LinkBox(NamedTuple):
    """The box around a link: its center and half of its edges in the root link's frame, m.

    `joint` slides the link along `axis`, a unit vector in the same frame; None for a link that is fixed.
    """

    link: str
    center: _Vector
    half: _Vector
    joint: str | None = None
    axis: _Vector = _ZERO


class _Frame(NamedTuple):
    """The pose of a link or a shape in another's frame, and the joint that slides it."""

    rotation: _Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    position: _Vector = _ZERO
    joint: str | None = None
    axis: _Vector = _ZERO

    def turned(self, vector: _Vector) -> _Vector:
        """Return a vector of this frame along the axes of the other."""
        x, y, z = (sum(a * b for a, b in zip(row, vector, strict=True)) for row in self.rotation)
        return x, y, z

    def placed(self, point: _Vector) -> _Vector:
        """Return a point of this frame in the other."""
        x, y, z = (a + b for a, b in zip(self.position, self.turned(point), strict=True))
        return x, y, z


def link_boxes(urdf: str, boxes: Mapping[str, BoundingBox] | None = None) -> Iterator[LinkBox]:
    """Yield the box of each link that is fixed or slides, the root's first.

    With `boxes`, those around the shapes of the links in their own frames, the shapes of the URDF are not read.
    """
    boxes = shape_boxes(urdf, "collision") if boxes is None else boxes
    robot = fromstring(urdf)  # noqa: S314  a built-in description, or one that was loaded into a world
    links = {link.get("name", ""): link for link in robot.findall("link")}
    joints: dict[str, list[Element]] = {}
    for joint in robot.findall("joint"):
        joints.setdefault(joined_link(joint, "parent"), []).append(joint)
    children = {joined_link(joint, "child") for each in joints.values() for joint in each}
    pending = [(name, _Frame()) for name in links if name not in children]
    for name, frame in pending:
        if corners := [frame.placed(corner) for corner in _box_corners(boxes.get(name))]:
            ranges = [(min(each), max(each)) for each in zip(*corners, strict=True)]
            center = _rounded([(low + high) / 2 for low, high in ranges])
            half = _rounded([(high - low) / 2 for low, high in ranges])
            yield LinkBox(name, center, half, frame.joint, _rounded(frame.axis))
        without_rotation = (joint for joint in joints.get(name, ()) if joint.get("type") in ("fixed", "prismatic"))
        pending += [(joined_link(joint, "child"), _child(frame, joint)) for joint in without_rotation]


def _child(frame: _Frame, joint: Element) -> _Frame:
    """Return the frame of the link below this joint; `frame` is that of the link above it."""
    own = _origin(joint)
    columns = [frame.turned((own.rotation[0][at], own.rotation[1][at], own.rotation[2][at])) for at in range(3)]
    first, second, third = zip(*columns, strict=True)
    child = _Frame((first, second, third), frame.placed(own.position), frame.joint, frame.axis)
    if joint.get("type") == "fixed":
        return child
    axis = joint.find("axis")
    direction = (1.0, 0.0, 0.0) if axis is None else _numbers(axis.get("xyz"))
    length = math.hypot(*direction) or 1.0
    unit = direction[0] / length, direction[1] / length, direction[2] / length
    return child._replace(joint=joint.get("name"), axis=child.turned(unit))


def _box_corners(box: BoundingBox | None) -> Iterator[_Vector]:
    if box is not None:
        yield from itertools.product(*zip(box.min, box.max, strict=True))


def _origin(element: Element) -> _Frame:
    """Return the frame of a joint or a shape in that of its link."""
    origin = element.find("origin")
    if origin is None:
        return _Frame()
    angles = _numbers(origin.get("rpy"))
    (cr, cp, cy), (sr, sp, sy) = (tuple(map(each, angles)) for each in (math.cos, math.sin))
    rotation = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return _Frame(rotation, _numbers(origin.get("xyz")))


def _numbers(text: str | None) -> _Vector:
    x, y, z = (float(each) for each in (text or "0 0 0").split())
    return x, y, z


def _rounded(values: Sequence[float]) -> _Vector:
    x, y, z = (round(each, 6) + 0.0 for each in values)  # + 0.0 makes 0.0 of -0.0
    return x, y, z
