"""Copy live values of a plan into frozen event values at the moment a hook observes them.

A parameter that cannot be recorded without changing its meaning raises `UnrecordableValue` with the reason. Results,
arguments of failures and texts of the world never raise: a value that cannot be recorded becomes a `MissingValue`.
Reading a value runs the code of its class (`__float__`, `__repr__`, properties), which may raise anything, so every
`Exception` becomes the reason why that value is missing. Ctrl-C, and the SystemExit of a signal handler, which may come
in the middle of that code, reach the caller. Reading is bounded in depth and in items, so it also ends for a structure
that contains itself.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from enum import Enum
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from pycrorm_async.events.codec import unwritable
from pycrorm_async.events.values import (
    FieldDeclared,
    MissingValue,
    ObjectReference,
    ObjectValue,
    PoseValue,
)
from pycrorm_async.plan.language.outcome import Outcome
from pycrorm_async.plan.object_designators import BelieveObject, LocatedObject, ObjectDesignator, ObjectPart
from pycrorm_async.recording.values.texts import clean, clean_repr, cut, reading_fault
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose

OBJECT_TYPES: tuple[type, ...] = (ObjectDesignator, Object)
"""Field types whose values are recorded as objects; `ObjectPart` and `BelieveObject` are object designators too."""

ObjectDtype: TypeAlias = Literal["Object", "ObjectPart", "BelieveObject", "LocatedObject"]

REASON_MAX = 500
"""Bounds the characters of the reason why a value is missing, and of the messages inside an exception group."""
DEPTH_MAX = 8
"""Bounds the nesting of a result, of a failure's arguments and of exception groups."""
ITEMS_MAX = 2**19
"""Bounds the items of one value. An item takes at least two bytes, so more exceed the default `record_bytes_max`."""


class UnrecordableValue(ValueError):
    """JSON or the declared column cannot hold the value unchanged; the message states the reason."""


class RefusedValue:
    """Replaces a value that an executive's own conversion refused; it is recorded as missing for this reason."""

    def __init__(self, reason: str) -> None:
        self.reason = reason


class References(Protocol):
    """Looks up the rows of an episode's world objects."""

    def reference(self, world_object: Object) -> ObjectReference | None:
        """Return the object's current row; None if the episode has no row of it."""
        ...


def pose_value(pose: Pose) -> PoseValue:
    """Copy a pose."""
    return PoseValue(pose.position, pose.orientation, pose.frame, pose.time_ns)


def encode_parameter(field: FieldDeclared, enum: type[Enum] | None, value: Any, references: References) -> Any:
    """Convert a parameter to a JSON value of its field's declared type. Raises `UnrecordableValue`."""
    encode_scalar = _ENCODERS.get(field.type)
    if encode_scalar is not None:
        return encode_scalar(value, enum, references)
    if field.type == "list":
        if isinstance(value, str | bytes) or not isinstance(value, Sequence | np.ndarray):
            raise _mismatch("list", value)
        encode_item = _ENCODERS[field.item or "text"]
        return [
            encode_item(each, enum, references) if each is not None else None for each in _limit_items(value, value)
        ]
    assert field.type == "dict", field.type
    if not isinstance(value, Mapping):
        raise _mismatch("dict", value)
    encode_item = _ENCODERS[field.item or "text"]
    entries = {
        _encode_key(key): encode_item(each, enum, references) if each is not None else None
        for key, each in _limit_items(value, value.items())
    }
    if len(entries) < len(value):
        raise UnrecordableValue("two keys of the dict have the same text")
    return entries


def encode_or_missing(value: Any, references: References) -> Any:
    """Convert any value to a JSON value, or to a `MissingValue`. Raises no `Exception`."""
    try:
        return _ValueReader(references).read(value, 0)
    except UnrecordableValue as reason:
        return missing_value(str(reason), value)
    except Exception as error:  # noqa: BLE001  a user's __iter__ or property may raise anything
        return missing_value(reading_fault(error), value)


def missing_value(reason: str, value: Any) -> MissingValue:
    """Build the `MissingValue` that replaces a value, with a shortened reason and repr."""
    return MissingValue(cut(clean(reason), REASON_MAX), clean_repr(value))


def missing_in(value: Any) -> Iterator[MissingValue]:
    """Yield each `MissingValue` inside an encoded value."""
    if isinstance(value, MissingValue):
        yield value
    elif isinstance(value, list | dict):
        for each in value.values() if isinstance(value, dict) else value:
            yield from missing_in(each)


# --- one encoder per declared type --------------------------------------------------------------------------------


def _encode_integer(value: Any, _enum: type[Enum] | None, _references: References) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        raise _mismatch("int", value) from None
    if not -(2**63) <= number < 2**63:
        raise UnrecordableValue("the integer does not fit into 64 bits")
    return int(number)


def _encode_real(value: Any, _enum: type[Enum] | None, _references: References) -> float:
    if type(value) is not float:
        if isinstance(value, str | bytes) or not hasattr(value, "__float__"):
            raise _mismatch("float", value)
        try:
            value = float.__float__(value) if isinstance(value, float) else float(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise UnrecordableValue(f"declared as float, got a {type(value).__name__}: {error}") from None
    if not math.isfinite(value):
        raise UnrecordableValue(f"{value} is not a finite number")
    return float.__float__(value)


def _encode_text(value: Any, _enum: type[Enum] | None, _references: References) -> str:
    if not isinstance(value, str):
        raise _mismatch("str", value)
    return str.__str__(_require_writable(str.__str__(value)))


def _encode_boolean(value: Any, _enum: type[Enum] | None, _references: References) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise _mismatch("bool", value)
    return bool(value)


def _encode_datetime(value: Any, _enum: type[Enum] | None, _references: References) -> str:
    if not isinstance(value, datetime):
        raise _mismatch("datetime", value)
    if value.tzinfo is None:
        raise UnrecordableValue("the datetime has no time zone")
    return value.astimezone(UTC).isoformat(timespec="microseconds")


def _encode_member(value: Any, enum: type[Enum] | None, references: References) -> str:
    if enum is None and isinstance(value, str) and not isinstance(value, Enum):
        return _encode_text(value, None, references)  # the name of a member of another executive's enum
    if enum is not None and not isinstance(value, enum):
        raise UnrecordableValue(f"{clean_repr(value)} is not a member of {enum.__name__}")
    name = value._name_ if isinstance(value, Enum) else value.name  # `Enum.name` takes ten times as long
    if not isinstance(name, str):
        raise UnrecordableValue(f"{clean_repr(value)} is not a named member of {type(value).__name__}")
    writable: str = _require_writable(name)
    return writable if type(writable) is str else str(writable)


def _encode_pose(value: Any, _enum: type[Enum] | None, _references: References) -> PoseValue:
    if not isinstance(value, Pose) and not isinstance(value, PoseValue):  # a union takes 0.1 µs longer
        raise _mismatch("Pose", value)
    if not math.isfinite(sum(value.position) + sum(value.orientation)):
        raise UnrecordableValue(f"the pose holds a number that is not finite: {value}")
    try:
        _require_writable(value.frame)
    except UnrecordableValue as reason:
        raise UnrecordableValue(f"the pose's frame: {reason}") from None
    if isinstance(value, Pose):
        return pose_value(value)
    if (len(value.position), len(value.orientation)) != (3, 4):
        raise UnrecordableValue(f"a position has 3 numbers and an orientation 4: {value}")
    return value


def _encode_object(value: Any, _enum: type[Enum] | None, references: References) -> ObjectReference | ObjectValue:
    if isinstance(value, Object):
        return references.reference(value) or _unrecorded_object(value)
    if isinstance(value, ObjectPart):
        return _object_value("ObjectPart", value, _row_in_force(value.part_of, references))
    if isinstance(value, LocatedObject):
        return _object_value("LocatedObject", value, _row_in_force(value.reference, references))
    if isinstance(value, BelieveObject):
        return _object_value("BelieveObject", value)
    if isinstance(value, ObjectDesignator):
        row = references.reference(value.world_object) if value.world_object is not None else None
        return row or _unrecorded_object(value)
    if isinstance(value, ObjectReference | ObjectValue):
        return value
    raise _mismatch("object designator", value)


def _unrecorded_object(value: Any) -> ObjectValue:
    return _object_value("Object", value)


def _object_value(dtype: ObjectDtype, value: Any, part_of: ObjectReference | None = None) -> ObjectValue:
    return ObjectValue(dtype, clean(value.name), _type_name(value), _pose_or_none(value), part_of)


def _row_in_force(designator: ObjectDesignator, references: References) -> ObjectReference | None:
    """Return the current row of the designated world object; for a part, of the object it belongs to."""
    while isinstance(designator, ObjectPart):
        designator = designator.part_of
    return references.reference(designator.world_object) if designator.world_object is not None else None


def _pose_or_none(value: Any) -> PoseValue | None:
    try:
        pose = value.pose
    except Exception:  # noqa: BLE001  the object or link was removed; `perform` reports it
        return None
    return _encode_pose(pose, None, NO_REFERENCES) if pose is not None else None


def _type_name(value: Any) -> str | None:
    kind = value.object_type
    return kind.name if isinstance(kind, Enum) else clean(str(kind)) if kind is not None else None


_ENCODERS: dict[str, Callable[[Any, type[Enum] | None, References], Any]] = {
    "integer": _encode_integer,
    "real": _encode_real,
    "text": _encode_text,
    "boolean": _encode_boolean,
    "datetime": _encode_datetime,
    "enum": _encode_member,
    "pose": _encode_pose,
    "object": _encode_object,
}


class _NoReferences:
    def reference(self, world_object: Object) -> ObjectReference | None:  # noqa: ARG002  the port's signature
        return None


NO_REFERENCES = _NoReferences()


def _encode_key(key: Any) -> str:
    if isinstance(key, Enum):
        return str(key.name)
    if not isinstance(key, str):
        raise UnrecordableValue(f"a key of the dict is a {type(key).__name__}, not a str")
    return str(_require_writable(key))


def _require_writable(value: Any) -> Any:
    if type(value) is str and value.isascii() and "\x00" not in value:  # `unwritable` takes three times longer
        return value
    reason = unwritable(value)
    if reason is not None:
        raise UnrecordableValue(reason)
    return value


def _limit_items(holder: Any, items: Iterable[Any]) -> Iterable[Any]:
    """Return the items of a container. Raises `UnrecordableValue` if there are more than `ITEMS_MAX`."""
    if len(holder) > ITEMS_MAX:
        raise UnrecordableValue(f"it holds {len(holder):,} items, at most {ITEMS_MAX:,} are allowed")
    return items if type(holder) in _BUILT_IN_CONTAINERS else _stop_at_limit(items)


_BUILT_IN_CONTAINERS = (list, tuple, dict, np.ndarray)
"""Types whose `len` bounds their iteration; a user's own class may yield items without end."""


def _stop_at_limit(items: Iterable[Any]) -> Iterator[Any]:
    for number, each in enumerate(items):
        if number == ITEMS_MAX:
            raise UnrecordableValue(f"it holds more than {ITEMS_MAX:,} items")
        yield each


_ENCODERS_BY_CLASS: tuple[tuple[Any, Callable[[Any, type[Enum] | None, References], Any]], ...] = (
    ((Pose, PoseValue), _encode_pose),
    (datetime, _encode_datetime),
    ((*OBJECT_TYPES, ObjectReference, ObjectValue), _encode_object),
)
"""The encoders of values without a declared type."""


class _ValueReader:
    """Converts one value without a declared type to a JSON value. Raises `UnrecordableValue`."""

    def __init__(self, references: References) -> None:
        self._references = references
        self._left = ITEMS_MAX
        self._enclosing_ids: set[int] = set()

    def read(self, value: Any, depth: int) -> Any:
        self._left -= 1
        if self._left < 0:
            raise UnrecordableValue(f"it holds more than {ITEMS_MAX:,} items")
        if depth > DEPTH_MAX:
            raise UnrecordableValue(f"it is nested more than {DEPTH_MAX} deep")
        if isinstance(value, Enum):
            return _require_writable(value.name)
        if value is None or isinstance(value, bool | np.bool_):
            return None if value is None else bool(value)
        if isinstance(value, str | int | float):
            return _require_writable(_as_built_in(value))
        if isinstance(value, np.generic):
            return self.read(value.item(), depth + 1)
        for kind, encode in _ENCODERS_BY_CLASS:
            if isinstance(value, kind):
                return encode(value, None, self._references)
        if isinstance(value, Outcome):
            value = value.in_brief()
        if isinstance(value, Mapping | list | tuple | np.ndarray):
            return self._container(value, depth)
        raise _mismatch("JSON", value)

    def _container(self, value: Any, depth: int) -> Any:
        if id(value) in self._enclosing_ids:
            raise UnrecordableValue("it contains itself")
        self._enclosing_ids.add(id(value))
        items: Any
        if isinstance(value, Mapping):
            items = {_encode_key(key): self.read(each, depth + 1) for key, each in value.items()}
        else:
            items = [self.read(each, depth + 1) for each in value]
        self._enclosing_ids.discard(id(value))
        return items


def _as_built_in(value: str | float) -> str | int | float:
    """Convert a value of a subclass to the built-in type, so that the subclass cannot change its JSON."""
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, float):
        return float.__float__(value)
    return _encode_integer(value, None, NO_REFERENCES)


def _mismatch(declared: str, value: Any) -> UnrecordableValue:
    if isinstance(value, RefusedValue):
        return UnrecordableValue(value.reason)
    if declared == "JSON":
        return UnrecordableValue(f"JSON cannot hold a {type(value).__name__}")
    return UnrecordableValue(f"declared as {declared}, got a {type(value).__name__}")
