"""Copy the arguments of an executive: descriptions of objects, and values through its own conversion."""

import math
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, TypeAlias, TypeVar, cast

import msgspec
from msgspec.structs import replace

from pycrorm_async.errors import CallerError
from pycrorm_async.events import types as event_types
from pycrorm_async.events.reasons import UNNAMED
from pycrorm_async.record import values
from pycrorm_async.record.declarations import DeclaredType
from pycrorm_async.record.episode_writer import Emitter
from pycrorm_async.record.objects import RecordedObject, RecordedObjects

Convert: TypeAlias = Callable[[Any], Any]

# === checked arguments ========================================================================================
#
# Copy and check the arguments of an executive, because a value of a wrong type in the log would park its episode.
#
# A wrong pose or struct raises `CallerError`; another wrong value (a colour, one joint) is counted as missing.

_INTEGERS = range(-(2**63), 2**63)
_UNIT_TOLERANCE = 1e-6
"""A quaternion whose length differs from 1 by less stays unchanged, because single precision rounds by that much."""

S = TypeVar("S", bound=msgspec.Struct)


def struct_of(value: object, kind: type[S]) -> S:
    """Copy a struct of this class and check its parts; numbers of numpy become Python's. Raises `CallerError`."""
    if not isinstance(value, kind):
        raise CallerError(f"expected a {kind.__name__}, got {values.clean_repr(value)}")
    try:
        parts = msgspec.to_builtins(value, enc_hook=lambda number: number.tolist())
        return _with_unit_turn(msgspec.convert(parts, kind))
    except Exception as error:
        raise CallerError(f"not a whole {kind.__name__}: {values.message_of(error)}") from error


def _with_unit_turn(value: S) -> S:
    """Return a pose, or a value with one, whose quaternion is scaled to length 1; one of length 0, inf or nan stays."""
    if isinstance(value, event_types.PoseValue):
        length = math.hypot(*value.orientation)
        if 0 < length < math.inf and abs(length - 1) > _UNIT_TOLERANCE:
            return replace(value, orientation=tuple(each / length for each in value.orientation))
    elif isinstance(pose := getattr(value, "pose", None), event_types.PoseValue):
        return replace(value, pose=_with_unit_turn(pose))
    return value


def pose_of(pose: values.PoseLike | event_types.PoseValue) -> event_types.PoseValue:
    """Copy a pose. Raises `CallerError` for a wrong part, a number that is not finite, or a time beyond 64 bits."""
    value = (
        struct_of(pose, event_types.PoseValue)
        if values.recorded_as(type(pose)) is None
        else values.pose_value(cast("values.PoseLike", pose))
    )
    if not math.isfinite(sum(value.position) + sum(value.orientation)):
        raise CallerError(f"the pose holds a number that is not finite: {values.clean_repr(pose)}")
    if value.time_ns not in _INTEGERS:
        raise CallerError(f"the time of the pose does not fit into 64 bits: {values.clean_repr(pose)}")
    return value


def _are_plain(joints: dict[Any, Any]) -> bool:
    """Return whether all names are ASCII texts and all positions finite floats, which can be recorded as they are."""
    if set(map(type, joints)) != {str} or set(map(type, joints.values())) != {float}:
        return False
    names = "".join(joints)
    return names.isascii() and "\0" not in names and all(map(math.isfinite, joints.values()))


class ArgumentReader:
    """Copies the arguments that describe an object; counts wrong ones in the emitter's `missing`."""

    def __init__(self, emitter: Emitter) -> None:
        self._emitter = emitter
        self._missing = emitter.missing

    def object_of(
        self,
        name: str,
        object_type: str | Enum,
        pose: values.PoseLike | event_types.PoseValue,
        joints: Mapping[str, float],
        **others: Any,
    ) -> RecordedObject:
        """Copy the description of an object; `others` are all other attributes of `RecordedObject`."""
        kind, urdf = self.text_of("object_type", object_type) or "UNKNOWN", None
        mass_kg = self._number_of("mass_kg", others["mass_kg"])
        if others["urdf"] is not None:
            urdf = self._emitter.descriptions.urdf_of(name, others["urdf"])
        if mass_kg is None and urdf is not None:
            mass_kg = self._emitter.descriptions.mass_of(urdf, kind)
        texts = {each: self.text_of(each, others[each]) for each in ("model", "serial", "base_link", "torso_joint")}
        return RecordedObject(
            self.text_of("name", name) or "an object",
            kind,
            pose_of(pose),
            self.joints_of(joints, "ObjectAdded"),
            urdf=urdf,
            color=self._color_of(others["color"]),
            mass_kg=mass_kg,
            **texts,
        )

    def text_of(self, argument: str, text: object) -> str | None:
        """Copy a text. Return an enum member's name; count another value as missing, and return its shortened repr."""
        if text is None:
            return None
        if isinstance(text, Enum):
            return values.clean(str(text.name))
        if isinstance(text, str):
            return values.clean(str.__str__(text))
        self._missing.note("ObjectAdded", argument, f"it must be a text, not {values.clean_repr(text)}")
        return values.clean_repr(text)

    def joints_of(self, joints: Mapping[str, float], event: str) -> dict[str, float]:
        """Copy the joint positions of an event of this type.

        Leave out those that are not finite numbers, and count them as missing, except None.
        """
        if not isinstance(joints, Mapping):
            self._missing.note(event, "joints", f"they must be positions by name, not {values.clean_repr(joints)}")
            return {}
        copied = dict(joints)
        if _are_plain(copied):  # as nearly all are; the checks below take twenty times as long
            return copied
        positions: dict[str, float] = {}
        for name, position in copied.items():
            text = self.text_of("joint", name)
            number = self._number_of("joints", position, event)
            if text is not None and number is not None:
                positions[text] = number
        return positions

    def _number_of(self, argument: str, number: Any, event: str = "ObjectAdded") -> float | None:
        if number is None:
            return None
        try:
            if isinstance(number, str | bytes | bool) or not math.isfinite(number):
                raise ValueError("it must be a finite number")  # noqa: TRY301  counted below
            return float(number)
        except Exception as error:  # noqa: BLE001  a __float__ of the user's may raise anything
            self._missing.note(event, argument, f"{values.clean_repr(number)}: {values.message_of(error)}")
            return None

    def _color_of(self, color: Any) -> tuple[float, float, float, float] | None:
        if color is None:
            return None
        parts = [self._number_of("color", each) for each in color] if isinstance(color, list | tuple) else []
        red, green, blue, opacity, *_ = (*parts, None, None, None, None)
        if len(parts) != 4 or red is None or green is None or blue is None or opacity is None:
            self._missing.note(
                "ObjectAdded", "color", f"it must be red, green, blue and opacity: {values.clean_repr(color)}"
            )
            return None
        return red, green, blue, opacity


# === recorded values ==========================================================================================
#
# Copy the values of an executive, through its own conversion, into values of events.


class RecordedValues:
    """Converts values for one episode. `convert` is the executive's; it is called with each value and each item."""

    def __init__(self, convert: Convert | None, objects: RecordedObjects) -> None:
        self._convert = convert
        self._objects = objects
        self._failures = values.FailureCopies()

    def parameters(
        self, declared: DeclaredType, given: Mapping[Any, Any], references: values.References, missing: dict[str, str]
    ) -> dict[str, Any]:
        """Return the parameters by field name; add to `missing` the reason for each that becomes a `MissingValue`."""
        source: dict[Any, Any] = {}
        left = dict(given)
        for field in declared.fields:
            key = field.path[0]
            value = left.pop(key, None)
            if value is not None:
                source[key] = self.converted(value, as_object=field.is_object)
        parameters = values.read_parameters(source, declared.fields, references, missing)
        for name, value in left.items():
            if value is not None:
                text = values.clean(name) if isinstance(name, str) else values.clean_repr(name)
                missing[text] = reason = f"{declared.dtype} was declared without this field"
                parameters[text] = values.missing_value(reason, value)
        return parameters

    def converted(self, value: Any, *, as_object: bool = False) -> Any:
        """Return the value as the executive converts it; a `RefusedValue` with the reason if it cannot convert it.

        With `as_object` the key of an object becomes a reference to its row.
        """
        value = self._item(value, as_object)
        kind = type(value)
        if kind is list or kind is tuple:
            return [self._item(each, as_object) for each in value]
        if kind is dict:
            return {key: self._item(each, as_object) for key, each in value.items()}
        return value

    def _item(self, value: Any, as_object: bool) -> Any:  # noqa: FBT001  a keyword would cost each item of a list
        """Convert a value, but not the items inside it."""
        if as_object and (reference := self._known_object(value)) is not None:
            return reference
        if self._convert is not None:
            try:
                value = self._convert(value)
            except Exception as error:  # noqa: BLE001  an executive's conversion may raise anything
                reason = values.message_of(error) if isinstance(error, ValueError) else values.reading_fault(error)
                return values.RefusedValue(reason, value)
            if as_object and (reference := self._known_object(value)) is not None:
                return reference
        return self._checked(value) if isinstance(value, msgspec.Struct) else value

    def failure(self, failure: object, references: values.References) -> event_types.FailureValue:
        """Copy a `FailureCause`; `end_node` replaces the type `UNNAMED` of a text. Raises `CallerError` for others."""
        match failure:
            case BaseException():
                return self._failures.copy(failure, references, self.converted)
            case (str(), str()) | str():
                reason, message = (UNNAMED, failure) if isinstance(failure, str) else failure
                return event_types.FailureValue(values.clean(reason), values.clean(message))
        return struct_of(failure, event_types.FailureValue)

    def _checked(self, value: msgspec.Struct) -> Any:
        """Return a checked copy; a `RefusedValue` if a part is wrong, or it refers to a row that the episode lacks."""
        try:
            if isinstance(value, event_types.PoseValue):
                return pose_of(value)
            whole = struct_of(value, type(value))
        except CallerError as error:
            return values.RefusedValue(values.message_of(error), value)
        reference = whole.part_of if isinstance(whole, event_types.ObjectValue) else whole
        if isinstance(reference, event_types.ObjectReference) and not self._objects.holds(reference):
            return values.RefusedValue("it refers to a row that this episode does not have", value)
        if isinstance(whole, event_types.ObjectValue) and whole.pose is not None:
            return self._checked(whole.pose) if isinstance(self._checked(whole.pose), values.RefusedValue) else whole
        return whole

    def _known_object(self, value: Any) -> event_types.ObjectReference | None:
        try:
            return self._objects.reference(value)
        except Exception:  # noqa: BLE001  a value that cannot be hashed is no key
            return None
