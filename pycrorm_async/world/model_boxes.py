"""Compute the boxes around the links of a model, and put them in the place of meshes."""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import NamedTuple, TypeAlias
from xml.etree.ElementTree import Element, ParseError, SubElement, tostring

from pycrorm_async.world.bounding_boxes import BoundingBox, box_of
from pycrorm_async.world.models import numbers
from pycrorm_async.world.pose import JointType, Pose, rotated
from pycrorm_async.world.urdf_model import UrdfFault, along, parsed_urdf, read_model

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
    return tuple(dict.fromkeys(mesh.get("filename", "") for mesh in parsed_urdf(urdf).iter("mesh")))


def meshed_links(urdf: str) -> tuple[str, ...]:
    """Return the names of the links that have a mesh."""
    return tuple(link.get("name", "") for link in parsed_urdf(urdf).iter("link") if link.find(".//mesh") is not None)


def without_textures(urdf: str) -> tuple[str, tuple[str, ...]]:
    """Return the URDF without the texture files of its materials, and their names, each once."""
    if "<texture" not in urdf:
        return urdf, ()
    robot = parsed_urdf(urdf)
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
    robot = parsed_urdf(urdf)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", names[mesh.get("filename", "")])
    return tostring(robot, encoding="unicode")


def with_boxes(urdf: str, boxes: Mapping[str, BoundingBox], *, kept: frozenset[str] = frozenset()) -> str:
    """Replace the meshes of each link by the box of that link; remove them if the link has no box.

    Meshes with a file name in `kept` stay.
    """
    robot = parsed_urdf(urdf)
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


# === shape boxes ==============================================================================================
#
# Compute the box around the shapes of each link in its own frame, and the mass, of an object that no world has.


def shape_boxes(urdf: str, *, visual: bool, links: Collection[str] | None = None) -> dict[str, BoundingBox]:
    """Return the box around the collision or the visual shapes of each link, or of each of `links`, by its name.

    Links without a shape that can be read are left out, and so are all links of a text that is no URDF.
    """
    try:
        model = read_model(urdf)
    except (UrdfFault, ParseError):
        return {}
    shapes = {
        name: link._replace(collisions=link.visuals if visual else link.collisions)
        for name, link in model.links.items()
        if links is None or name in links
    }
    boxes = {name: box_of(link, visual=False) for name, link in shapes.items()}
    return {name: box for name, box in boxes.items() if box is not None}


def described_mass_kg(urdf: str) -> float | None:
    """Return the sum of the masses of all links, kg; None if it is not above zero, and for a text that is no URDF."""
    try:
        return read_model(urdf).mass_kg
    except (UrdfFault, ParseError):
        return None


# === link boxes ===============================================================================================
#
# Compute the box around the collision shapes of each link of a URDF, without Bullet.
#
# The result is aligned with the axes of the root link's frame, with every joint at position 0. The result for a link
# that a prismatic joint slides names that joint and its direction; of several joints in a row it names the last alone.
# Links without a shape are left out, and so are links that turn, with all links below them.

_Vector: TypeAlias = tuple[float, float, float]
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


def link_boxes(urdf: str, boxes: Mapping[str, BoundingBox] | None = None) -> Iterator[LinkBox]:
    """Yield the box of each link that is fixed or slides, the root's first.

    With `boxes`, those around the shapes of the links in their own frames, the shapes of the URDF are not read.
    """
    model = read_model(urdf)
    for name, path in model.paths.items():
        if any(each.kind in (JointType.REVOLUTE, JointType.CONTINUOUS) for each in path):
            continue
        box = box_of(model.links[name], visual=False) if boxes is None else boxes.get(name)
        path = tuple(each._replace(mimic=None) for each in path)  # a recorded position is that of the joint itself
        frame = along(path, {})
        if box is not None:
            corners = [(frame @ Pose(each)).position for each in itertools.product(*zip(box.min, box.max, strict=True))]
            ranges = [(min(each), max(each)) for each in zip(*corners, strict=True)]
            center = _rounded([(low + high) / 2 for low, high in ranges])
            half = _rounded([(high - low) / 2 for low, high in ranges])
            slide = next((at for at in reversed(range(len(path))) if path[at].kind is JointType.PRISMATIC), None)
            if slide is None:
                yield LinkBox(name, center, half)
            else:
                axis = rotated(along(path[: slide + 1], {}).orientation, path[slide].axis)
                yield LinkBox(name, center, half, path[slide].name, _rounded(axis))


def _rounded(values: Sequence[float]) -> _Vector:
    x, y, z = (round(each, 6) + 0.0 for each in values)  # + 0.0 makes 0.0 of -0.0
    return x, y, z
