"""Describe the situation in which an action starts, as symbols and numbers by feature.

| feature | |
|---|---|
| `robot` | name of the robot that acts |
| `object_type`, `object_name` | of the object of its first parameter that is an object; of others `<field>_type` |
| `near` | types of the objects within 0.5 m of this object |
| `held` | types of the objects attached to the robot |
| texts, enum members, booleans | by field; `True` and `False` for a boolean |
| `stand_x`, `stand_y`, `stand_yaw` | pose of the robot in the frame of an upright object |
| `torso`, `object_z`, `height` | position of the torso, height of the object, and over the torso |
| integers, reals | by field |
| `<field>_x`, `_y`, `_z`, `_yaw` | a pose in the robot's frame |

A parameter with a reserved name, such as `status`, becomes the feature `status_parameter`. Times, lists and dicts are
not features. `near` never contains the robot or the environment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import atan2
from typing import Any, Final, NamedTuple, TypeAlias

import msgspec

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.events.values import PoseValue, RobotValue
from pycrorm_async.projections.fold.world_fold import WorldFold, WorldObject
from pycrorm_async.recall.case import RESERVED

Symbols: TypeAlias = dict[str, str | tuple[str, ...]]
Numbers: TypeAlias = dict[str, float]

_NEAR_M = 0.5
"""The distance within which another object counts as near."""
_UPRIGHT_MIN: Final = 0.99
"""The cosine of 8 degrees: the x-y plane of an object that leans more does not lie on the floor."""
_OBJECTS_MAX: Final = 1_000
"""Bounds the objects that are compared for each action. In a world with more objects `near` is empty."""
_NUMBER_MAX: Final = 1e300
"""Bounds the magnitude of a number. An integer may have any number of digits, and then has no float."""
_NEVER_NEAR = frozenset({"ROBOT", "ENVIRONMENT"})
_COMPUTED = RESERVED | frozenset(
    "inside after after_status robot object_type object_name near held stand_x stand_y stand_yaw torso object_z"
    " height".split()
)


class FeatureFields(NamedTuple):
    """The fields of a designator type that are features, each with its feature, and the type itself."""

    dtype: str
    texts: tuple[tuple[str, str], ...]
    numbers: tuple[tuple[str, str], ...]
    poses: tuple[tuple[str, tuple[str, str, str, str]], ...]
    objects: tuple[str, ...]

    @classmethod
    def of(cls, declaration: DesignatorTypeDeclared) -> FeatureFields:
        named: dict[str, list[str]] = {}
        for each in declaration.fields:
            named.setdefault(each.type, []).append(each.name)

        def features(*types: str) -> tuple[tuple[str, str], ...]:
            names = [name for type_ in types for name in named.get(type_, ())]
            return tuple((name, f"{name}_parameter" if name in _COMPUTED else name) for name in names)

        objects = tuple(named.get("object", ()))
        poses = tuple((name, (f"{each}_x", f"{each}_y", f"{each}_z", f"{each}_yaw")) for name, each in features("pose"))
        return cls(declaration.dtype, features("text", "enum", "boolean"), features("integer", "real"), poses, objects)


def situation(
    fields: FeatureFields, parameters: Mapping[str, Any], robot: RobotValue | None, world: WorldFold
) -> tuple[Symbols, Numbers]:
    """Return the features of an action that starts with these parameters, for this robot and in this world."""
    symbols: Symbols = {}
    numbers: Numbers = {}
    _add_parameters(symbols, numbers, fields, parameters)
    if robot is not None:
        _add_robot(symbols, numbers, fields, parameters, robot)
    identity = None
    if fields.objects and (value := parameters.get(fields.objects[0])) is not None:
        identity = value.get("object")
        _add_object(symbols, numbers, _seen(value, world), robot)
    for name in fields.objects[1:]:
        if (value := parameters.get(name)) is not None and (type_ := _seen(value, world).type) is not None:
            symbols[f"{name}_type"] = type_
    if len(world.objects) <= _OBJECTS_MAX:
        _add_surroundings(symbols, identity, robot, world.objects)
    return symbols, numbers


def _add_parameters(symbols: Symbols, numbers: Numbers, fields: FeatureFields, parameters: Mapping[str, Any]) -> None:
    for name, feature in fields.texts:
        if (value := parameters.get(name)) is not None:
            symbols[feature] = value if isinstance(value, str) else str(value)
    for name, feature in fields.numbers:
        if (value := parameters.get(name)) is not None and abs(value) < _NUMBER_MAX:
            numbers[feature] = float(value)


def _add_robot(
    symbols: Symbols, numbers: Numbers, fields: FeatureFields, parameters: Mapping[str, Any], robot: RobotValue
) -> None:
    if robot.name is not None:
        symbols["robot"] = robot.name
    if robot.torso_height is not None:
        numbers["torso"] = robot.torso_height
    for name, features in fields.poses:
        if (value := parameters.get(name)) is not None and value["frame"] == robot.pose.frame:
            x, y, z, yaw = features
            numbers[x], numbers[y], numbers[z], numbers[yaw] = _pose_in(
                value["position"], value["orientation"], robot.pose
            )


class _Seen(NamedTuple):
    """Name, type and pose of a parameter's object, as far as they are known."""

    name: str | None
    type: str | None
    pose: PoseValue | None


def _seen(value: Mapping[str, Any], world: WorldFold) -> _Seen:
    """Return the state of a parameter's object, which may have been removed, or be outside of the recorded world."""
    identity = value.get("object")
    if identity is None:
        pose = value.get("pose")
        return _Seen(value.get("name"), value.get("object_type"), pose and msgspec.convert(pose, PoseValue))
    present = world.objects.get(identity)
    if present is None:
        return _Seen(world.names.get(identity), None, None)
    return _Seen(present.name, present.object_type, present.pose)


def _add_object(symbols: Symbols, numbers: Numbers, seen: _Seen, robot: RobotValue | None) -> None:
    if seen.type is not None:
        symbols["object_type"] = seen.type
    if seen.name is not None:
        symbols["object_name"] = seen.name
    if seen.pose is None:
        return
    height = seen.pose.position[2]
    numbers["object_z"] = height
    if robot is None or robot.pose.frame != seen.pose.frame:
        return
    if robot.torso_height is not None:
        numbers["height"] = height - robot.pose.position[2] - robot.torso_height
    x, y, _, _ = seen.pose.orientation
    if 1 - 2 * (x * x + y * y) >= _UPRIGHT_MIN:
        numbers["stand_x"], numbers["stand_y"], _, numbers["stand_yaw"] = _pose_in(
            robot.pose.position, robot.pose.orientation, seen.pose
        )


def _add_surroundings(
    symbols: Symbols, identity: int | None, robot: RobotValue | None, objects: Mapping[int, WorldObject]
) -> None:
    target = objects.get(identity) if identity is not None else None
    holder = robot.object.object if robot is not None and robot.object is not None else None
    if target is None and holder is None:
        return
    near, held = set(), set()
    for each in objects.values():
        if each.attached_to is not None and each.attached_to[0] == holder:
            held.add(each.object_type)
        if target is not None and each is not target and _is_near(each, target):
            near.add(each.object_type)
    if near:
        symbols["near"] = tuple(sorted(near))
    if held:
        symbols["held"] = tuple(sorted(held))


def _is_near(each: WorldObject, target: WorldObject) -> bool:
    if each.object_type in _NEVER_NEAR:
        return False
    x, y, z = each.pose.position
    to_x, to_y, to_z = target.pose.position
    return (x - to_x) ** 2 + (y - to_y) ** 2 + (z - to_z) ** 2 <= _NEAR_M**2


def _pose_in(
    position: Sequence[float], orientation: Sequence[float], frame: PoseValue
) -> tuple[float, float, float, float]:
    """Return x, y, z and yaw of a pose in the frame of another; orientations are quaternions xyzw."""
    (fx, fy, fz, fw), (at_x, at_y, at_z) = frame.orientation, frame.position
    dx, dy, dz = position[0] - at_x, position[1] - at_y, position[2] - at_z
    turned_x, turned_y, turned_z = fy * dz - fz * dy - fw * dx, fz * dx - fx * dz - fw * dy, fx * dy - fy * dx - fw * dz
    x, y, z, w = orientation
    qx = fw * x - fx * w - fy * z + fz * y
    qy = fw * y + fx * z - fy * w - fz * x
    qz = fw * z - fx * y + fy * x - fz * w
    qw = fw * w + fx * x + fy * y + fz * z
    return (
        dx + 2 * (fy * turned_z - fz * turned_y),
        dy + 2 * (fz * turned_x - fx * turned_z),
        dz + 2 * (fx * turned_y - fy * turned_x),
        atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)),
    )
