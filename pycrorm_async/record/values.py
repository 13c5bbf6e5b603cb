"""Copy live values of a plan into frozen event values at the moment a hook observes them.

A parameter that cannot be recorded without changing its meaning raises `UnrecordableValue` with the reason. Results,
arguments of failures and texts of the world never raise: a value that cannot be recorded becomes a `MissingValue`.
Reading a value runs the code of its class (`__float__`, `__repr__`, properties), which may raise anything, so every
`Exception` becomes the reason why that value is missing. Ctrl-C, and the SystemExit of a signal handler, which may come
in the middle of that code, reach the caller. Reading is bounded in depth and in items, so it also ends for a structure
that contains itself.
"""

from __future__ import annotations

import io
import json
import logging
import math
import operator
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from enum import Enum
from reprlib import Repr
from types import NoneType
from typing import Any, Final, Literal, NamedTuple, Protocol, TypeAlias, cast

import numpy as np

from pycrorm_async.events.codec import clean as clean
from pycrorm_async.events.codec import unwritable
from pycrorm_async.events.types import (
    Blob,
    BlobReference,
    FailureValue,
    FieldDeclared,
    MissingValue,
    ObjectReference,
    ObjectValue,
    PoseValue,
)
from pycrorm_async.plan.language import Outcome
from pycrorm_async.plan.objects import BelieveObject, LocatedObject, ObjectDesignator, ObjectPart
from pycrorm_async.recorded_names import recorded_name
from pycrorm_async.visible_text import visible
from pycrorm_async.world.bullet import Object
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


# === texts ====================================================================================================
#
# Describe exceptions and arbitrary values as texts, also if their `__str__` or `__repr__` raises.
#
# Methods of `str` are called as `str.method(text)`, so that those of a user's subclass do not run.

_REPR_MAX = 200
"""Bounds the characters of a repr that is recorded in place of a value; enough to recognise the value."""
_TEXT_MAX = 150
"""Bounds the characters of a text inside a repr; below `_REPR_MAX`, so that the mark with the text's length fits."""


def reading_fault(error: BaseException) -> str:
    """Return the reason why a value was not recorded, if reading the value raised `error`."""
    message = cut(clean(message_of(error)), _REPR_MAX)
    return f"reading it raised {type(error).__name__}{': ' if message else ''}{message}"


def message_of(failure: BaseException) -> str:
    """Return the message of an exception, also of one whose `__str__` raises an `Exception`."""
    try:
        return str(failure)
    except Exception as error:  # noqa: BLE001  a user's __str__ may raise anything
        return f"<its __str__ raised {type(error).__name__}>"


def cut(text: str, characters_max: int) -> str:
    """Truncate a text after `characters_max` characters and append a mark that gives its full length."""
    return text[:characters_max] + _cut_mark(len(text), "characters", characters_max)


def _cut_mark(length: int, unit: str, length_max: int = _TEXT_MAX) -> str:
    return f"… ({length:,} {unit})" if length > length_max else ""


def clean_repr(value: Any) -> str:
    """Return a shortened repr; a large list, tuple, set or dict is not represented as a whole first.

    Returns also for a value whose `__repr__` raises an `Exception`.
    """
    text = clean(_Brief().repr(value))
    return text if len(text) <= _REPR_MAX else f"{text[:_REPR_MAX]}…"


class _Brief(Repr):
    """The standard library's bounded repr, also of bytes and subclasses of str. Names a type whose repr raises."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdeque = self.maxdict = 20
        self.maxother = self.maxlong = self.maxstring = 2 * _REPR_MAX
        self._left = _REPR_MAX  # a part takes at least one character, so more parts would be cut off anyway

    def repr1(self, x: Any, level: int) -> str:
        self._left -= 1
        if self._left < 0:
            return "…"
        try:
            if isinstance(x, str) and type(x).__repr__ is str.__repr__:
                return repr(str.__getitem__(x, slice(_TEXT_MAX))) + _cut_mark(str.__len__(x), "characters")
            if isinstance(x, bytes | bytearray):
                kind = bytes if isinstance(x, bytes) else bytearray
                return repr(kind(x[:_TEXT_MAX])) + _cut_mark(len(x), "bytes")
            return super().repr1(x, level)
        except Exception as error:  # noqa: BLE001  a user's __repr__ may raise anything
            return f"<a {type(x).__name__} whose repr raised {type(error).__name__}>"

    def repr_instance(self, x: Any, level: int) -> str:  # noqa: ARG002  `Repr` gives the signature
        return str.__str__(repr(x))


# === failure values ===========================================================================================
#
# Copy exceptions into values of events.

_MESSAGE_MAX = 2_000
"""Bounds the characters of a failure's message."""
_FAILURE_NAME_MAX = 500
"""Bounds the characters of an exception's qualified class name."""
_GROUP_MAX = 100
"""Bounds the recorded exceptions of one exception group."""


def failure_value(
    failure: BaseException, references: References, convert: Callable[[Any], Any] = lambda each: each
) -> FailureValue:
    """Copy class, message and arguments, each as `convert` returns it, of an exception. Raises no `Exception`."""
    return FailureValue(
        type=cut(_path_of(type(failure)), _FAILURE_NAME_MAX),
        message=cut(clean(message_of(failure)), _MESSAGE_MAX),
        arguments=_arguments_or_missing(failure, references, convert),
    )


def _path_of(kind: type) -> str:
    try:
        return clean(recorded_name(kind))
    except Exception as error:  # noqa: BLE001  a metaclass may raise anything
        return f"<an exception whose class has no name: {type(error).__name__}>"


def _arguments_or_missing(failure: BaseException, references: References, convert: Callable[[Any], Any]) -> list[Any]:
    try:
        return _arguments(failure, references, convert, 0)
    except Exception as error:  # noqa: BLE001  `args` may be a property that raises anything
        return [MissingValue(reading_fault(error))]


def _arguments(failure: BaseException, references: References, convert: Callable[[Any], Any], depth: int) -> list[Any]:
    """Encode the arguments of an exception; for a group, its message and the encoded exceptions inside it."""
    if not isinstance(failure, BaseExceptionGroup):
        return [encode_or_missing(convert(each), references) for each in failure.args]
    if depth > DEPTH_MAX:
        return [missing_value(f"it is nested more than {DEPTH_MAX} deep", failure)]
    inside = [
        {
            "type": cut(_path_of(type(each)).rpartition(".")[2], _FAILURE_NAME_MAX),
            "message": cut(clean(message_of(each)), REASON_MAX),
            "arguments": _arguments(each, references, convert, depth + 1),
        }
        for each in failure.exceptions[:_GROUP_MAX]
    ]
    return [cut(clean(str(failure.message)), _MESSAGE_MAX), inside]


# === missing values ===========================================================================================
#
# Count the values that could not be recorded, and log one warning for each type and field.
#
# A plan may perform the same action a million times, so one warning per perform would bury the log. The warning states
# the reason, the counter the number of values.

WARNED_MAX = 1_000
"""Bounds the (type, field) pairs with a warning of their own, because classes created in a loop would never stop."""

_log = logging.getLogger("pycrorm_async")


class Missing(NamedTuple):
    """The number of values recorded as missing, and the last one with its reason; `status` shows both."""

    total: int
    last: str | None


class MissingValues:
    """Counts the missing values of one memory. Any thread may call `note`."""

    def __init__(self) -> None:
        self._total = 0
        self._last: str | None = None
        self._warned: set[tuple[str, str]] = set()

    @property
    def count(self) -> Missing:
        return Missing(self._total, self._last)

    def note(self, owner: str, field: str, reason: str) -> None:
        """Count one missing value, and warn if it is the first of its type and field."""
        self._note(owner, field, f"is recorded as missing: {reason}", reason)

    def note_renamed(self, owner: str, field: str, name: str, reason: str) -> None:
        """Count a field or type whose values are kept under another name, and warn if it is the first of its type."""
        self._note(owner, field, f"is recorded as {name!r}: {reason}", f"recorded as {name!r}: {reason}")

    def _note(self, owner: str, field: str, text: str, reason: str) -> None:
        self._total += 1
        self._last = f"{owner}.{field}: {reason}"
        if (owner, field) in self._warned or len(self._warned) > WARNED_MAX:
            return
        self._warned.add((owner, field))
        if len(self._warned) > WARNED_MAX:
            _log.warning("more than %d fields have missing values; further ones are only counted in status", WARNED_MAX)
        else:
            warning = f"{owner}.{field} {text} (further values of this field are only counted in status)"
            _log.warning("%s", visible(warning))


# === observed values ==========================================================================================
#
# Copy the values of an observation into JSON values; contents too large for an event become blobs.
#
# A part that cannot be recorded becomes null, with its path and the reason in `missing`; the other parts are recorded.
# The usual case, a dict of a few numbers, takes about a microsecond.

ARRAY_ITEMS_MAX: Final = 64
"""Bounds the elements of an array that is recorded as JSON, each with a row of its own, as a joint state needs."""
NPY: Final = "application/x-npy"
"""Media type of an array that is stored as a blob: `numpy.load(io.BytesIO(content))`."""
_DEPTH_MAX: Final = 8
"""Bounds the nesting of observed values."""
_INTEGERS: Final = range(-(2**63), 2**63)
_NUMBERS: Final = "biuf"
"""The dtype kinds of arrays whose elements JSON can hold."""
_MEDIA_TYPE_MAX: Final = 255
"""Bounds the characters of a blob's media type."""


class ObservedReader:
    """Reads the values of one observation. `put_blob` takes content and media type.

    Attributes:
        missing: by path, the reason why a value is missing.
        blobs: the references in the values, to be released when the event is put.
    """

    __slots__ = ("_left", "_put_blob", "_references", "blobs", "missing")

    def __init__(self, references: References, put_blob: Callable[[bytes, str], BlobReference]) -> None:
        self._references = references
        self._put_blob = put_blob
        self._left = ITEMS_MAX
        self.missing: dict[str, str] = {}
        self.blobs: list[BlobReference] = []

    def read(self, value: Any, path: str = "", depth: int = 0) -> Any:
        """Return the JSON value of `value`, at this path in the observation."""
        kind = type(value)
        if kind is float:
            return value if math.isfinite(value) else self._note(path, f"{value} is not a finite number")
        if kind is bool or value is None:
            return value
        if kind is int and value in _INTEGERS:
            return value
        if kind is str:
            reason = unwritable(value)
            return value if reason is None else self._note(path, reason)
        self._left -= 1
        if depth > _DEPTH_MAX:
            return self._note(path, f"it is nested more than {_DEPTH_MAX} deep")
        if kind is dict:
            return self._dict(value, path, depth)
        if kind is list or kind is tuple:
            return self._list(value, path, depth)
        if isinstance(value, np.ndarray):
            return self._array(value, path, depth)
        if isinstance(value, Blob):
            return self._blob(value, path)
        return self._other(value, path)

    def _dict(self, value: dict[Any, Any], path: str, depth: int) -> Any:
        if (reason := self._fault_in_keys(value)) is not None:
            return self._note(path, reason)
        prefix = f"{path}." if path else ""
        return {key: self.read(each, f"{prefix}{key}", depth + 1) for key, each in value.items()}

    def _fault_in_keys(self, keys: Collection[Any]) -> str | None:
        for key in keys:
            if type(key) is not str:
                return f"a key of the dict is a {type(key).__name__}, not a str"
            if key[:1] == "$":
                return "a key of the dict begins with $, which marks a blob"
            if (reason := unwritable(key)) is not None:
                return reason
        return self._over_limit(len(keys))

    def _list(self, value: list[Any] | tuple[Any, ...], path: str, depth: int) -> Any:
        if (reason := self._over_limit(len(value))) is not None:
            return self._note(path, reason)
        prefix = f"{path}." if path else ""
        return [self.read(each, f"{prefix}{index}", depth + 1) for index, each in enumerate(value)]

    def _over_limit(self, count: int) -> str | None:
        self._left -= count
        return f"it holds more than {ITEMS_MAX:,} items" if self._left < 0 else None

    def _array(self, value: np.ndarray[Any, Any], path: str, depth: int) -> Any:
        if value.dtype.kind in _NUMBERS and value.size <= ARRAY_ITEMS_MAX:
            return self.read(value.tolist(), path, depth)
        try:
            file = io.BytesIO()
            np.save(file, value, allow_pickle=False)
        except Exception as error:  # noqa: BLE001  an array of objects, or a user's own dtype
            return self._note(path, reading_fault(error))
        reference = self._put(file.getvalue(), NPY, path)
        if reference is None:
            return None
        return BlobReference(reference.hash, NPY, reference.size, str(value.dtype), value.shape)

    def _blob(self, value: Blob, path: str) -> Any:
        content, media_type = cast("tuple[object, object]", value)  # unchecked by the caller
        if not isinstance(content, bytes | bytearray | memoryview):
            return self._note(path, f"the content of a blob must be bytes, not {type(content).__name__}")
        if not isinstance(media_type, str) or len(media_type) > _MEDIA_TYPE_MAX or unwritable(media_type):
            return self._note(path, f"the media type of a blob must be a str of at most {_MEDIA_TYPE_MAX} characters")
        return self._put(bytes(content), media_type, path)

    def _put(self, content: bytes, media_type: str, path: str) -> BlobReference | None:
        try:
            reference = self._put_blob(content, media_type)
        except ValueError as refusal:
            self._note(path, str(refusal))
            return None
        self.blobs.append(reference)
        return reference

    def _other(self, value: Any, path: str) -> Any:
        encoded = encode_or_missing(value, self._references)
        if isinstance(encoded, MissingValue):
            return self._note(path, encoded.missing)
        for each in missing_in(encoded):
            return self._note(path, each.missing)
        return encoded

    def _note(self, path: str, reason: str) -> None:
        self.missing[path] = reason


# === plain values =============================================================================================
#
# Copy models of pydantic, dataclasses and containers of an executive as dicts and lists, or as a text of JSON.

_PLAIN = frozenset({str, int, float, bool, NoneType})
_RECORDED_AS_THEY_ARE = (Pose, Outcome, *OBJECT_TYPES)
"""Dataclasses, and others, of which events have values of their own."""


def plain_value(value: Any, simplified: Callable[[Any], Any] = lambda each: each) -> Any:
    """Return models and dataclasses as dicts, at any depth.

    `simplified` returns the scalar, dict or list that is recorded for a value that is none; the value itself if all of
    it is copied. A value that cannot be copied is returned as it is, and recorded as missing, with the reason.

    >>> plain_value([Reading(volts=24.0)])
    [{'volts': 24.0}]
    """
    try:
        return _copy(value, simplified)
    except Exception:  # noqa: BLE001  models of a user may raise anything
        return value


def json_text(value: Any, simplified: Callable[[Any], Any] = lambda each: each) -> Any:
    """Return the JSON of a value's copy; the value itself if there is none, which is recorded as missing."""
    try:
        return json.dumps(_copy(value, simplified), default=str)
    except Exception:  # noqa: BLE001  as above
        return value


def _copy(value: Any, simplified: Callable[[Any], Any]) -> Any:
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind is dict or kind is list or kind is tuple:  # as nearly all others are; the checks below take much longer
        return _copy_items(value, simplified)
    if (simple := simplified(value)) is not value:
        return simple
    if hasattr(kind, "model_dump"):  # a model of pydantic, which this package does not need
        return _copy(value.model_dump(), simplified)
    if is_dataclass(kind) and not isinstance(value, _RECORDED_AS_THEY_ARE):
        return {each.name: _copy(getattr(value, each.name), simplified) for each in fields(kind)}
    return _copy_items(value, simplified) if isinstance(value, Mapping | list | tuple) else value


def _copy_items(items: Any, simplified: Callable[[Any], Any]) -> Any:
    """Copy a container; most of its items are scalars, for which a call of `_copy` would take longer than the check."""
    if isinstance(items, (dict, Mapping)):
        return {str(key): each if type(each) in _PLAIN else _copy(each, simplified) for key, each in items.items()}
    return [each if type(each) in _PLAIN else _copy(each, simplified) for each in items]
