"""Replace the mesh files of a URDF: by other names, or by the boxes around the collision shapes of their links.

A URDF with boxes needs no mesh file, and the object keeps its links, joints and poses.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import PurePath
from xml.etree.ElementTree import Element, SubElement, fromstring, tostring

from pycrorm_async.world.models.primitives import numbers
from pycrorm_async.world.queries.bounding_boxes import BoundingBox

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
