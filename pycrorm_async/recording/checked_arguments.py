"""Check what an executive hands over, because a value of a wrong type in the log would stop the fold of its episode.

Each function raises `CallerError` with the reason; the recorded episode counts it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeVar, get_args

import msgspec

from pycrorm_async.errors import CallerError
from pycrorm_async.events.values import FailureValue, NodeStatus, PoseValue
from pycrorm_async.recording.recorded_objects import RecordedObject
from pycrorm_async.recording.values.texts import clean, clean_repr, message_of
from pycrorm_async.world.pose import Pose

__all__ = ["END_STATUSES", "failure_of", "joints_of", "link_of", "object_of", "pose_of", "struct_of"]

END_STATUSES = tuple(each for each in get_args(NodeStatus) if each != "RUNNING")

S = TypeVar("S", bound=msgspec.Struct)


def struct_of(value: object, kind: type[S]) -> S:
    """Return a value of this class whose parts have the declared types."""
    if not isinstance(value, kind):
        raise CallerError(f"expected a {kind.__name__}, got {clean_repr(value)}")
    try:
        return msgspec.convert(msgspec.to_builtins(value), kind)
    except (msgspec.ValidationError, TypeError) as error:
        raise CallerError(f"not a whole {kind.__name__}: {message_of(error)}") from error


def pose_of(pose: Pose | PoseValue) -> PoseValue:
    """Copy a pose."""
    if isinstance(pose, Pose):
        return PoseValue(pose.position, pose.orientation, pose.frame, pose.time_ns)
    return struct_of(pose, PoseValue)


def joints_of(joints: Mapping[str, float]) -> dict[str, float]:
    """Copy joint positions; those that are no finite number are left out, as an event cannot hold them."""
    try:
        positions = {clean(str(name)): float(position) for name, position in joints.items()}
    except (AttributeError, TypeError, ValueError) as error:
        raise CallerError(f"joint positions are numbers by name, not {clean_repr(joints)}") from error
    return {name: position for name, position in positions.items() if math.isfinite(position)}


def link_of(link: str | None) -> str | None:
    """Copy the name of a link."""
    return clean(str(link)) if link is not None else None


def object_of(
    name: str, object_type: str, pose: Pose | PoseValue, joints: Mapping[str, float], **others: Any
) -> RecordedObject:
    """Copy the description of an object; `others` are the further attributes of `RecordedObject`."""
    texts = {each: others[each] for each in ("urdf", "model", "serial", "base_link", "torso_joint")} | {"name": name}
    for what, text in texts.items():
        if text is not None and not isinstance(text, str):
            raise CallerError(f"the {what} of an object is a text, not {clean_repr(text)}")
    return RecordedObject(
        clean(name),
        clean(str(object_type)),
        pose_of(pose),
        joints_of(joints),
        urdf=others["urdf"],
        color=_color_of(others["color"]),
        model=link_of(others["model"]),
        serial=link_of(others["serial"]),
        mass_kg=_number_of("mass", others["mass_kg"]),
        base_link=link_of(others["base_link"]),
        torso_joint=others["torso_joint"],
    )


def failure_of(failure: object) -> FailureValue:
    """Return a failure that is no exception: a `FailureValue`, or a text."""
    return FailureValue("str", clean(failure)) if isinstance(failure, str) else struct_of(failure, FailureValue)


def _number_of(what: str, number: object) -> float | None:
    if number is None or (isinstance(number, int | float) and math.isfinite(number)):
        return float(number) if number is not None else None
    raise CallerError(f"the {what} of an object is a finite number, not {clean_repr(number)}")


def _color_of(color: Any) -> tuple[float, float, float, float] | None:
    if color is None:
        return None
    try:
        red, green, blue, opacity = (_number_of("color", float(each)) or 0.0 for each in color)
    except (TypeError, ValueError) as error:
        raise CallerError(f"a color is red, green, blue and opacity, not {clean_repr(color)}") from error
    return red, green, blue, opacity
