"""Read the joints of a robot's model (URDF), and compute the frame to which they lead.

>>> above, arm = divided(urdf, "torso_lift_link", "l_gripper_tool_frame")
>>> along((*above, *arm), {"torso_lift_joint": 0.1})  # the tool in the root link
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element, fromstring

from pycrorm_async.errors import CallerError
from pycrorm_async.world.enums import JointType
from pycrorm_async.world.pose import Pose, Quaternion, Vector, product, rotated
from pycrorm_async.world.robots.robot_description import Bounds
from pycrorm_async.world.urdf_checks import joined_link

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
    x, y, z = _numbers(None if axis is None else axis.get("xyz"), (1.0, 0.0, 0.0))
    length = math.hypot(x, y, z) or 1.0
    bounds = _ENDLESS
    if kind is not JointType.CONTINUOUS and limit is not None:
        bounds = Bounds(float(limit.get("lower", 0.0)), float(limit.get("upper", 0.0)))
    origin = element.find("origin")
    at, rpy = (None, None) if origin is None else (origin.get("xyz"), origin.get("rpy"))
    roll, pitch, yaw = _numbers(rpy, (0.0, 0.0, 0.0))
    turn = product(product(_about((0, 0, 1), yaw), _about((0, 1, 0), pitch)), _about((1, 0, 0), roll))
    return Joint(
        element.get("name", ""),
        kind,
        joined_link(element, "child"),
        Pose(_numbers(at, (0.0, 0.0, 0.0)), turn),
        (roll, pitch, yaw),
        Vector(x / length, y / length, z / length),
        bounds,
    )


def _numbers(text: str | None, default: tuple[float, float, float]) -> tuple[float, float, float]:
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
