"""Compute the box around the collision shapes of each link of a built-in URDF, without Bullet.

Boxes are exact; cylinders have the box around them. The boxes are in the frame of the root link, with every joint at
position 0. A link that a prismatic joint slides also has that joint and its direction. Links without such a shape and
links that turn are left out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias
from xml.etree.ElementTree import Element, fromstring

__all__ = ["LinkBox", "link_boxes"]

_Vector: TypeAlias = tuple[float, float, float]

_CORNERS = list(itertools.product((-0.5, 0.5), repeat=3))


class LinkBox(NamedTuple):
    """The box around a link: its centre and half of its edges in the root link's frame, m.

    `joint` slides it along `axis`, a unit vector in the same frame; None for a link that is fixed.
    """

    link: str
    centre: _Vector
    half: _Vector
    joint: str | None = None
    axis: _Vector = (0.0, 0.0, 0.0)


class _Frame(NamedTuple):
    """The pose of a link in the root's frame, and the joint that slides it. Rotations are about z only."""

    turn: float
    position: _Vector
    joint: str | None
    axis: _Vector

    def placed(self, point: _Vector) -> _Vector:
        """Return a point of the link in the root's frame."""
        turned = _turned(point, self.turn)
        return (self.position[0] + turned[0], self.position[1] + turned[1], self.position[2] + turned[2])


def link_boxes(urdf: str) -> Iterator[LinkBox]:
    """Yield the box of each link that is fixed or slides, the root's first. Links may be rotated about z only."""
    robot = fromstring(urdf)  # noqa: S314  a built-in description
    links = {link.get("name", ""): link for link in robot.findall("link")}
    joints: dict[str, list[Element]] = {}
    for joint in robot.findall("joint"):
        joints.setdefault(_name(joint, "parent"), []).append(joint)
    children = {_name(joint, "child") for each in joints.values() for joint in each}
    pending = [(name, _Frame(0.0, (0.0, 0.0, 0.0), None, (0.0, 0.0, 0.0))) for name in links if name not in children]
    for name, frame in pending:
        corners = [frame.placed(corner) for each in links[name].findall("collision") for corner in _corners(each)]
        if corners:
            ranges = [(min(each), max(each)) for each in zip(*corners, strict=True)]
            centre = _rounded([(low + high) / 2 for low, high in ranges])
            half = _rounded([(high - low) / 2 for low, high in ranges])
            yield LinkBox(name, centre, half, frame.joint, _rounded(frame.axis))
        moving = (joint for joint in joints.get(name, ()) if joint.get("type") in ("fixed", "prismatic"))
        pending += [(_name(joint, "child"), _child(frame, joint)) for joint in moving]


def _child(frame: _Frame, joint: Element) -> _Frame:
    turn, offset = _origin(joint)
    turn, position = frame.turn + turn, frame.placed(offset)
    if joint.get("type") == "fixed":
        return _Frame(turn, position, frame.joint, frame.axis)
    axis = joint.find("axis")
    assert axis is not None, joint.get("name")
    return _Frame(turn, position, joint.get("name"), _turned(_numbers(axis.get("xyz")), turn))


def _corners(collision: Element) -> Iterator[_Vector]:
    """Yield the corners of the box around a shape in its link's frame."""
    turn, offset = _origin(collision)
    assert turn == 0, "a shape of a built-in model is not rotated in its link"
    (shape,) = collision.iterfind("geometry/*")
    if shape.tag == "box":
        size = _numbers(shape.get("size"))
    else:
        assert shape.tag == "cylinder", shape.tag
        diameter = 2 * float(shape.get("radius", 0))
        size = diameter, diameter, float(shape.get("length", 0))
    for corner in _CORNERS:
        x, y, z = (middle + part * edge for middle, part, edge in zip(offset, corner, size, strict=True))
        yield x, y, z


def _origin(element: Element) -> tuple[float, _Vector]:
    origin = element.find("origin")
    if origin is None:
        return 0.0, (0.0, 0.0, 0.0)
    roll, pitch, yaw = _numbers(origin.get("rpy"))
    assert roll == pitch == 0, "a link of a built-in model is rotated about z only"
    return yaw, _numbers(origin.get("xyz"))


def _turned(point: _Vector, angle: float) -> _Vector:
    x, y, z = point
    return math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y, z


def _numbers(text: str | None) -> _Vector:
    x, y, z = (float(each) for each in (text or "0 0 0").split())
    return x, y, z


def _rounded(values: Sequence[float]) -> _Vector:
    x, y, z = (round(each, 6) + 0.0 for each in values)
    return x, y, z


def _name(joint: Element, role: str) -> str:
    element = joint.find(role)
    return element.get("link", "") if element is not None else ""
