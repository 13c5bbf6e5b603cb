"""Compute the boxes around the meshes and links of a model, and their inertia."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Literal, NamedTuple, TypeAlias
from xml.etree.ElementTree import Element, SubElement, fromstring, tostring

import numpy as np

from pycrorm_async.world.bounding_boxes import BoundingBox, Solid, box_around
from pycrorm_async.world.meshes import mesh_points
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


def visuals_as_collisions(urdf: str, links: Collection[str]) -> dict[str, str]:
    """Return for each of these links a URDF of this link alone, in which the visual shapes are collision shapes."""
    alone: dict[str, str] = {}
    for link in _parsed(urdf).iter("link"):
        name = link.get("name", "")
        if name in links:
            robot = Element("robot", name=name)
            shape = SubElement(robot, "link", name=name)
            for visual in link.findall("visual"):
                copied = SubElement(shape, "collision")
                copied.extend(each for each in visual if each.tag in ("origin", "geometry"))
            alone[name] = tostring(robot, encoding="unicode")
    return alone


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


# === shape boxes ==============================================================================================
#
# Compute the box around the shapes of each link in its own frame without Bullet, for an object that no world has.


def shape_boxes(urdf: str, kind: Literal["collision", "visual"]) -> dict[str, BoundingBox]:
    """Return the box around the shapes of each link, by its name, without links that have none.

    A mesh has the box around its triangles. A link with a shape that cannot be read is left out.
    """
    boxes: dict[str, BoundingBox] = {}
    for link in _parsed(urdf).iter("link"):
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
    shape = next(element.iterfind("geometry/*"), None)
    if shape is None:
        raise ValueError("a shape has no geometry")
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

    Returns None also for a sum of 0, which means that the model leaves the masses out.
    """
    robot = fromstring(urdf)  # noqa: S314  loaded by the caller's own process, and checked before
    try:
        mass = sum(float(each.get("value", "")) for each in robot.iterfind("link/inertial/mass"))
    except ValueError:
        return None
    return mass if 0 < mass < math.inf else None


# === link boxes ===============================================================================================
#
# Compute the box around the collision shapes of each link of a URDF, without Bullet.
#
# The result is aligned with the axes of the root link's frame, with every joint at position 0. The shapes must be boxes
# and cylinders, unless the caller passes the boxes around the links; then the shapes are not read. The result for a
# link that a prismatic joint slides names that joint and its direction; of several joints in a row it names the last
# alone. Links without a shape are left out, and so are links that turn, with all links below them.

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

    With `boxes`, those around the shapes of the links in their own frames, the shapes of the URDF are not read;
    otherwise they must be boxes and cylinders that are not rotated in their links.
    """
    robot = fromstring(urdf)  # noqa: S314  a built-in description, or one that was loaded into a world
    links = {link.get("name", ""): link for link in robot.findall("link")}
    joints: dict[str, list[Element]] = {}
    for joint in robot.findall("joint"):
        joints.setdefault(joined_link(joint, "parent"), []).append(joint)
    children = {joined_link(joint, "child") for each in joints.values() for joint in each}
    pending = [(name, _Frame()) for name in links if name not in children]
    for name, frame in pending:
        inside = _shape_corners(links[name]) if boxes is None else _box_corners(boxes.get(name))
        if corners := [frame.placed(corner) for corner in inside]:
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


def _shape_corners(link: Element) -> Iterator[_Vector]:
    """Yield the corners of the boxes around a link's shapes in its frame."""
    for collision in link.findall("collision"):
        frame = _origin(collision)
        assert frame.rotation == _Frame().rotation, "a shape of a built-in model is not rotated in its link"
        (shape,) = collision.iterfind("geometry/*")
        if shape.tag == "box":
            size = _numbers(shape.get("size"))
        else:
            assert shape.tag == "cylinder", shape.tag
            diameter = 2 * float(shape.get("radius", 0))
            size = diameter, diameter, float(shape.get("length", 0))
        for x, y, z in _CORNERS:
            yield frame.placed((x * size[0], y * size[1], z * size[2]))


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
