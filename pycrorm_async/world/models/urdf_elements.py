"""Add links and joints to the URDF of a built-in robot.

The centre of mass of every link is its origin, so that Bullet, which places links by their centres of mass, uses the
frames of the model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement, fromstring

from pycrorm_async.world.models.primitives import INERTIA, numbers
from pycrorm_async.world.robots.robot_description import Bounds

WHITE, GREY, DARK = "0.93 0.93 0.95 1", "0.6 0.6 0.65 1", "0.2 0.2 0.22 1"
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
