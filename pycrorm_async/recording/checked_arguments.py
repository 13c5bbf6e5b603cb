"""Copy the arguments of an executive, because a value of a wrong type in the log would stop the fold of its episode.

A wrong value raises `CallerError` if it is required (a pose); an optional one (a colour, one joint) is counted as
missing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from typing import Any, TypeVar, get_args

import msgspec

from pycrorm_async.errors import CallerError
from pycrorm_async.events.values import NodeStatus, PoseValue
from pycrorm_async.recording.recorded_objects import RecordedObject
from pycrorm_async.recording.values.missing_values import MissingValues
from pycrorm_async.recording.values.texts import clean, clean_repr, message_of
from pycrorm_async.world.pose import Pose

END_STATUSES = tuple(each for each in get_args(NodeStatus) if each != "RUNNING")
_INTEGERS = range(-(2**63), 2**63)

S = TypeVar("S", bound=msgspec.Struct)


def struct_of(value: object, kind: type[S]) -> S:
    """Return a value of this class whose parts have the declared types. Raises `CallerError`."""
    if not isinstance(value, kind):
        raise CallerError(f"expected a {kind.__name__}, got {clean_repr(value)}")
    try:
        return msgspec.convert(msgspec.to_builtins(value), kind)
    except Exception as error:
        raise CallerError(f"not a whole {kind.__name__}: {message_of(error)}") from error


def pose_of(pose: Pose | PoseValue) -> PoseValue:
    """Copy a pose. Raises `CallerError`, also for a number that is not finite."""
    if isinstance(pose, Pose):
        value = PoseValue(pose.position, pose.orientation, pose.frame, pose.time_ns)
    else:
        value = struct_of(pose, PoseValue)
    if not math.isfinite(sum(value.position) + sum(value.orientation)):
        raise CallerError(f"the pose holds a number that is not finite: {clean_repr(pose)}")
    if value.time_ns not in _INTEGERS:
        raise CallerError(f"the time of the pose does not fit into 64 bits: {clean_repr(pose)}")
    return value


def _are_plain(joints: dict[Any, Any]) -> bool:
    """Return whether all names are ASCII texts and all positions finite floats, so that none of them must change."""
    if set(map(type, joints)) != {str} or set(map(type, joints.values())) != {float}:
        return False
    names = "".join(joints)
    return names.isascii() and "\0" not in names and all(map(math.isfinite, joints.values()))


class ArgumentReader:
    """Copies the arguments that describe an object; counts the ones that it has to leave out in `missing`."""

    def __init__(self, missing: MissingValues) -> None:
        self._missing = missing

    def object_of(
        self, name: str, object_type: str | Enum, pose: Pose | PoseValue, joints: Mapping[str, float], **others: Any
    ) -> RecordedObject:
        """Copy the description of an object; `others` are the further attributes of `RecordedObject`."""
        urdf = others["urdf"]
        if urdf is not None and not isinstance(urdf, str):
            self._missing.note("ObjectAdded", "urdf", f"it must be a text, not {clean_repr(urdf)}")
            urdf = None
        texts = {each: self.text_of(each, others[each]) for each in ("model", "serial", "base_link", "torso_joint")}
        return RecordedObject(
            self.text_of("name", name) or "an object",
            self.text_of("object_type", object_type) or "UNKNOWN",
            pose_of(pose),
            self.joints_of(joints),
            urdf=urdf,
            color=self._color_of(others["color"]),
            mass_kg=self._number_of("mass_kg", others["mass_kg"]),
            **texts,
        )

    def text_of(self, argument: str, text: object) -> str | None:
        """Copy a text; of an enum its member's name, of another value its shortened repr."""
        if text is None:
            return None
        if isinstance(text, Enum):
            return clean(str(text.name))
        if isinstance(text, str):
            return clean(str.__str__(text))
        self._missing.note("ObjectAdded", argument, f"it must be a text, not {clean_repr(text)}")
        return clean_repr(text)

    def joints_of(self, joints: Mapping[str, float]) -> dict[str, float]:
        """Copy joint positions; those that are not finite numbers are counted as missing."""
        if not isinstance(joints, Mapping):
            self._missing.note("JointsMoved", "joints", f"they must be positions by name, not {clean_repr(joints)}")
            return {}
        copied = dict(joints)
        if _are_plain(copied):  # as nearly all are; the checks below take twenty times as long
            return copied
        positions: dict[str, float] = {}
        for name, position in copied.items():
            text = self.text_of("joint", name)
            number = self._number_of("joints", position)
            if text is not None and number is not None:
                positions[text] = number
        return positions

    def _number_of(self, argument: str, number: Any) -> float | None:
        if number is None:
            return None
        try:
            if isinstance(number, str | bytes | bool) or not math.isfinite(number):
                raise ValueError("it must be a finite number")  # noqa: TRY301  counted below
            return float(number)
        except Exception as error:  # noqa: BLE001  a __float__ of the user's may raise anything
            self._missing.note("ObjectAdded", argument, f"{clean_repr(number)}: {message_of(error)}")
            return None

    def _color_of(self, color: Any) -> tuple[float, float, float, float] | None:
        if color is None:
            return None
        parts = [self._number_of("color", each) for each in color] if isinstance(color, list | tuple) else []
        red, green, blue, opacity, *_ = (*parts, None, None, None, None)
        if len(parts) != 4 or red is None or green is None or blue is None or opacity is None:
            self._missing.note("ObjectAdded", "color", f"it must be red, green, blue and opacity: {clean_repr(color)}")
            return None
        return red, green, blue, opacity
