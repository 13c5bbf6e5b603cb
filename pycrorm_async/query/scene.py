"""Read the recorded geometry of a moment without Bullet: shapes of objects, poses of links, outlines from above."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeAlias
from xml.etree.ElementTree import Element, ParseError, fromstring

import numpy as np
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
