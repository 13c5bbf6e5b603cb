"""Copy an executive's live values into frozen values of events at the moment when they are reported.

A parameter that cannot be recorded without changing its meaning raises `UnrecordableValue` with the reason. Results,
arguments of failures and observations never raise: a value that cannot be recorded becomes a `MissingValue`, or null
with its reason. Reading a value runs the code of its class (`__float__`, `__repr__`, properties), which may raise
anything, so every `Exception` becomes the reason why that value is missing. Ctrl-C, and the SystemExit of a signal
handler, which may come in the middle of that code, reach the caller. Reading is bounded in depth and in items, so it
also ends for a structure that contains itself.

Classes for poses and objects say so themselves, by `__recorded_as__` (`PoseLike`, `ObjectLike`); so this module knows
neither a plan layer nor a world.
"""

from __future__ import annotations

import io
import json
import logging
import math
import operator
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from enum import Enum
from functools import partial
from reprlib import Repr
from types import NoneType
from typing import Any, ClassVar, Final, NamedTuple, Protocol, TypeAlias, cast
from weakref import ReferenceType, ref

from pycrorm_async.events import types as event_types
from pycrorm_async.events.codec import clean as clean
from pycrorm_async.events.codec import unwritable
from pycrorm_async.recorded_names import class_name, recorded_name
from pycrorm_async.visible_text import visible

REASON_MAX = 500
"""Bounds the characters of the reason why a value is missing, and of the messages inside an exception group."""
DEPTH_MAX = 8
"""Bounds the nesting of a value, of a failure's arguments and of exception groups."""
ITEMS_MAX = 2**19
"""Bounds the items of one value. An item takes at least two bytes, so more exceed the default `record_bytes_max`."""


_FROZEN_MAX = 32
"""Bounds the poses whose copies an episode keeps: those of an action and of the nodes inside it."""


class UnrecordableValue(ValueError):
    """JSON or the declared column cannot hold the value unchanged; the message states the reason."""


class RefusedValue:
    """Replaces a value that an executive's own conversion refused; it is recorded as missing for this reason."""

    def __init__(self, reason: str, value: object = None) -> None:
        self.reason = reason
        self.value = value


class PoseLike(Protocol):
    """A pose of an executive: metres, unit quaternion xyzw, frame name, UTC in ns. `__recorded_as__` is "pose"."""

    __recorded_as__: ClassVar[str]

    @property
    def position(self) -> tuple[float, float, float]: ...
    @property
    def orientation(self) -> tuple[float, float, float, float]: ...
    @property
    def frame(self) -> str: ...
    @property
    def time_ns(self) -> int: ...


class ObjectLike(Protocol):
    """An object of an executive, or a designator of one. `__recorded_as__` is the `dtype` of its `ObjectValue`.

    Attributes:
        row_of: what `References` looks up: the object itself, the whole of a part, the reference of a located object.
    """

    __recorded_as__: ClassVar[str]

    @property
    def name(self) -> str: ...
    @property
    def object_type(self) -> Any: ...
    @property
    def row_of(self) -> Any: ...


class References(Protocol):
    """Looks up the rows of an episode's objects."""

    def reference(self, key: Any, /) -> event_types.ObjectReference | None:
        """Return the object's current row; None if the episode has no row of it."""
        ...


Encoder: TypeAlias = Callable[[Any, type[Enum] | None, References], Any]
"""Converts a value to a JSON value of its declared type. Raises `UnrecordableValue`."""


def recorded_as(kind: type) -> str | None:
    """Return "pose", or the dtype of an object, for a class that is a `PoseLike` or an `ObjectLike`."""
    return getattr(kind, "__recorded_as__", None)


def pose_value(pose: PoseLike) -> event_types.PoseValue:
    """Copy a pose."""
    return event_types.PoseValue(pose.position, pose.orientation, pose.frame, pose.time_ns)


def brief_pose(pose: PoseLike) -> event_types.BriefPose:
    """Copy a pose for a field of an event whose type is a pose."""
    return event_types.BriefPose.of(pose_value(pose))


class FrozenPoses:
    """The copies of the poses that an episode recorded last, for a class of poses whose objects never change."""

    def __init__(self, kind: type) -> None:
        self._kind = kind
        self._copies: dict[int, tuple[Any, event_types.PoseValue]] = {}

    def get(self, pose: object) -> event_types.PoseValue | None:
        """Return the copy of this very object; None if it has none, or may change."""
        copy = self._copies.get(id(pose))
        return copy[1] if copy is not None and copy[0] is pose else None

    def keep(self, pose: PoseLike) -> event_types.PoseValue:
        """Copy a pose."""
        value = pose_value(pose)
        if type(pose) is self._kind:
            if len(self._copies) >= _FROZEN_MAX:
                self._copies.clear()
            self._copies[id(pose)] = pose, value
        return value


KnownPoses: TypeAlias = tuple[tuple[event_types.PoseValue, event_types.PoseReference], ...]
"""The poses in parameters of a node and of those around it, each with a reference to it."""
_KNOWN_MAX: Final = 8
"""Bounds the poses that a parameter is compared with: those of four levels of nodes, of two poses each."""


def pose_fields(fields: Iterable[event_types.FieldDeclared]) -> tuple[tuple[str, int], ...]:
    """Return name and slot of the fields that are poses."""
    return tuple((each.name, each.slot) for each in fields if each.type == "pose")


def name_known(parameters: dict[str, Any], fields: tuple[tuple[str, int], ...], poses: KnownPoses) -> None:
    """Replace the known poses among the parameters with references to them."""
    for name, _ in fields:
        pose = parameters.get(name)
        for known, reference in poses:
            if known is pose:
                parameters[name] = reference
                break


def with_own(
    poses: KnownPoses, parameters: Mapping[str, Any], fields: tuple[tuple[str, int], ...], node: int
) -> KnownPoses:
    """Return the known poses with those that this node was written with."""
    for name, slot in fields:
        if type(pose := parameters.get(name)) is event_types.PoseValue:
            poses = (*poses[1 - _KNOWN_MAX :], (pose, event_types.PoseReference(node, name, slot)))
    return poses


def encoder_of(field: event_types.FieldDeclared) -> Encoder:
    """Return the encoder of a field's declared type."""
    if field.type == "list":
        return partial(_encode_list, _ENCODERS[field.item or "text"])
    if field.type == "dict":
        return partial(_encode_dict, _ENCODERS[field.item or "text"])
    return _ENCODERS[field.type]


def encode_or_missing(value: Any, references: References) -> Any:
    """Convert any value to a JSON value, or to a `MissingValue`. Raises no `Exception`."""
    try:
        return ValueReader(references).read(value)
    except UnrecordableValue as reason:
        return missing_value(str(reason), value)


def missing_value(reason: str, value: Any) -> event_types.MissingValue:
    """Build the `MissingValue` that replaces a value, with a shortened reason and repr."""
    return event_types.MissingValue(
        cut(clean(reason), REASON_MAX), clean_repr(value.value if type(value) is RefusedValue else value)
    )


def missing_in(value: Any) -> Iterator[event_types.MissingValue]:
    """Yield each `MissingValue` inside an encoded value."""
    if isinstance(value, event_types.MissingValue):
        yield value
    elif isinstance(value, list | dict):
        for each in value.values() if isinstance(value, dict) else value:
            yield from missing_in(each)


def read_parameters(
    source: Any, fields: Iterable[Field], references: References, missing: dict[str, str]
) -> dict[str, Any]:
    """Read the parameters of a node as JSON values by field name, each on its own.

    For each parameter that becomes a `MissingValue`, the function adds the reason to `missing`.
    """
    parameters: dict[str, Any] = {}
    for name, read, encode, enum, _, _ in fields:
        value: Any = None
        try:
            value = read(source)
            if value is not None:
                parameters[name] = encode(value, enum, references)
        except Exception as error:  # noqa: BLE001  a property or a __float__ of the user's may raise anything
            if value is None and isinstance(error, AttributeError | KeyError):
                continue
            reason = str(error) if isinstance(error, UnrecordableValue) else reading_fault(error)
            missing[name], parameters[name] = reason, missing_value(reason, value)
    return parameters


class Field(NamedTuple):
    """A field of a designator type, and how its value is read and encoded.

    Attributes:
        read: raises `AttributeError` or `KeyError` where a node has no such parameter.
        path: leads to the value from a designator, or is the executive's own name.
        is_object: whether the value, or each of its items, is an object.
    """

    name: str
    read: Callable[[Any], Any]
    encode: Encoder
    enum: type[Enum] | None = None
    path: tuple[str, ...] = ()
    is_object: bool = False


def refuse(reason: str, _value: Any, _enum: type[Enum] | None, _references: References) -> Any:
    """Encode no value, for this reason: that of a field without a column."""
    raise UnrecordableValue(reason)


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
            raise UnrecordableValue(f"declared as float, got a {class_name(type(value))}: {error}") from None
    if not math.isfinite(value):
        raise UnrecordableValue(f"{value} is not a finite number")
    return float.__float__(value)


def _encode_text(value: Any, _enum: type[Enum] | None, _references: References) -> str:
    if not isinstance(value, str):
        raise _mismatch("str", value)
    return str.__str__(_require_writable(str.__str__(value)))


def _is_numpy(value: object, kind: str) -> bool:
    """Return whether a value is of this class of numpy. Numpy is not imported for it: who has such a value did so."""
    numpy = sys.modules.get("numpy")
    return numpy is not None and isinstance(value, getattr(numpy, kind, ()))


def _encode_boolean(value: Any, _enum: type[Enum] | None, _references: References) -> bool:
    if not (isinstance(value, bool) or _is_numpy(value, "bool_")):
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
    is_member = type(value) is enum  # the usual case; `isinstance` asks the class of the enum
    if not is_member and enum is not None and not isinstance(value, enum):
        raise UnrecordableValue(f"{clean_repr(value)} is not a member of {enum.__name__}")
    # `Enum.name` takes ten times as long.
    name = value._name_ if is_member or isinstance(value, Enum) else value.name
    if not isinstance(name, str):
        raise UnrecordableValue(f"{clean_repr(value)} is not a named member of {class_name(type(value))}")
    writable: str = _require_writable(name)
    return writable


def _encode_pose(value: Any, _enum: type[Enum] | None, references: References) -> event_types.PoseValue:
    frozen: FrozenPoses | None = getattr(references, "frozen_poses", None)
    if frozen is not None and (known := frozen.get(value)) is not None:
        return known
    is_copied = isinstance(value, event_types.PoseValue)
    if not is_copied and recorded_as(type(value)) != "pose":
        raise _mismatch("Pose", value)
    if not math.isfinite(sum(value.position) + sum(value.orientation)):
        raise UnrecordableValue(f"the pose holds a number that is not finite: {value}")
    try:
        _require_writable(value.frame)
    except UnrecordableValue as reason:
        raise UnrecordableValue(f"the pose's frame: {reason}") from None
    if not is_copied:
        return pose_value(value) if frozen is None else frozen.keep(value)
    if (len(value.position), len(value.orientation)) != (3, 4):
        raise UnrecordableValue(f"a position has 3 numbers and an orientation 4: {value}")
    copied: event_types.PoseValue = value
    return copied


def _encode_object(
    value: Any, _enum: type[Enum] | None, references: References
) -> event_types.ObjectReference | event_types.ObjectValue:
    dtype: Any = recorded_as(type(value))
    if dtype is None and isinstance(value, event_types.ObjectReference | event_types.ObjectValue):
        return value
    if dtype is None or dtype == "pose":
        raise _mismatch("object designator", value)
    row = references.reference(value.row_of) if value.row_of is not None else None
    if dtype == "Object":
        return row or event_types.ObjectValue(dtype, clean(value.name), _type_name(value), _pose_or_none(value))
    return event_types.ObjectValue(dtype, clean(value.name), _type_name(value), _pose_or_none(value), row)


def _pose_or_none(value: Any) -> event_types.PoseValue | None:
    try:
        pose = value.pose
    except Exception:  # noqa: BLE001  the object or link was removed; `perform` reports it
        return None
    return _encode_pose(pose, None, NO_REFERENCES) if pose is not None else None


def _type_name(value: Any) -> str | None:
    kind = value.object_type
    return kind.name if isinstance(kind, Enum) else clean(str(kind)) if kind is not None else None


def _encode_list(encode: Encoder, value: Any, enum: type[Enum] | None, references: References) -> list[Any]:
    if isinstance(value, str | bytes) or not (isinstance(value, Sequence) or _is_numpy(value, "ndarray")):
        raise _mismatch("list", value)
    return [encode(each, enum, references) if each is not None else None for each in _limit_items(value, value)]


def _encode_dict(encode: Encoder, value: Any, enum: type[Enum] | None, references: References) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise _mismatch("dict", value)
    entries = {
        _encode_key(key): encode(each, enum, references) if each is not None else None
        for key, each in _limit_items(value, value.items())
    }
    if len(entries) < len(value):
        raise UnrecordableValue("two keys of the dict have the same text")
    if event_types.is_missing(entries):
        raise UnrecordableValue("a dict of the text `missing`, alone or with `repr`, marks a missing value")
    return entries


_ENCODERS: dict[str, Encoder] = {
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
    def reference(self, _key: Any, /) -> event_types.ObjectReference | None:
        return None


NO_REFERENCES = _NoReferences()


def _encode_key(key: Any) -> str:
    if isinstance(key, Enum):
        return str(key.name)
    if not isinstance(key, str):
        raise UnrecordableValue(f"a key of the dict is a {class_name(type(key))}, not a str")
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
    return items


# === values without a declared type ===========================================================================
#
# Read results, arguments of failures and observations. The usual case, a dict of a few numbers, takes about a
# microsecond.

ARRAY_ITEMS_MAX: Final = 64
"""Bounds the elements of an observed array that is recorded as JSON, each with a row of its own, as a joint state."""
NPY: Final = "application/x-npy"
"""Media type of an array that is stored as a blob: `numpy.load(io.BytesIO(content))`."""
SAMPLES: Final = "application/x-npy; samples"
"""Media type of a block of samples (`record.samples`)."""
_INTEGERS: Final = range(-(2**63), 2**63)
_NUMBERS: Final = "biuf"
"""The dtype kinds of arrays whose elements JSON can hold."""
_MEDIA_TYPE_MAX: Final = 255
"""Bounds the characters of a blob's media type."""


class ValueReader:
    """Reads one value. Raises `UnrecordableValue` for one that cannot be recorded, unless it is an observation.

    Args:
        put_blob: of an observation, stores content with its media type; large contents become blobs. A part of an
            observation that cannot be recorded is null.

    Attributes:
        missing: by path, the reason why a part is missing.
        blobs: the references in the value, to be released when the event is put.
    """

    __slots__ = ("_enclosing_ids", "_left", "_put_blob", "_references", "blobs", "missing")

    def __init__(
        self, references: References, put_blob: Callable[[bytes, str], event_types.BlobReference] | None = None
    ) -> None:
        self._references = references
        self._put_blob = put_blob
        self._left = ITEMS_MAX
        self._enclosing_ids: set[int] = set()
        self.missing: dict[str, str] = {}
        self.blobs: list[event_types.BlobReference] = []

    def read(self, value: Any, path: str = "", depth: int = 0) -> Any:
        """Return the JSON value of `value`, at this path."""
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
        if depth > DEPTH_MAX:
            return self._note(path, f"it is nested more than {DEPTH_MAX} deep")
        try:
            if kind is dict or kind is list or kind is tuple:
                return self._items(value, path, depth)
            return self._other(value, path, depth)
        except UnrecordableValue as reason_:
            return self._note(path, str(reason_))
        except Exception as error:  # noqa: BLE001  a user's __iter__ or property may raise anything
            return self._note(path, reading_fault(error))

    def _note(self, path: str, reason: str) -> None:
        if self._put_blob is None:
            raise UnrecordableValue(reason)
        self.missing[path] = reason

    def _items(self, value: Any, path: str, depth: int) -> Any:
        self._left -= len(value)
        if self._left < 0:
            raise UnrecordableValue(f"it holds more than {ITEMS_MAX:,} items")
        if id(value) in self._enclosing_ids:
            raise UnrecordableValue("it contains itself")
        self._enclosing_ids.add(id(value))
        prefix, items = f"{path}." if path else "", value
        if isinstance(value, Mapping):
            keyed = {self._key(key): each for key, each in _limit_items(value, value.items())}
            items = {key: self.read(each, f"{prefix}{key}", depth + 1) for key, each in keyed.items()}
        else:
            read = enumerate(_limit_items(value, value))
            items = [self.read(each, f"{prefix}{index}", depth + 1) for index, each in read]
        self._enclosing_ids.discard(id(value))
        return items

    def _key(self, key: Any) -> str:
        text = _encode_key(key)
        if self._put_blob is not None and text[:1] == "$":
            raise UnrecordableValue("a key of the dict begins with $, which marks a blob")
        return text

    def _other(self, value: Any, path: str, depth: int) -> Any:
        kind = type(value)
        if isinstance(value, Enum):
            return _require_writable(value.name)
        if isinstance(value, str | int | float):
            return _require_writable(_as_built_in(value))
        if _is_numpy(value, "generic"):
            plain = value.item()
            is_wide = type(plain) is kind and value.dtype.kind == "f"  # a `longdouble`, which is not a Python float
            return self.read(float(plain) if is_wide else plain, path, depth + 1)
        if isinstance(value, event_types.Blob):
            return self._blob(value)
        if _is_numpy(value, "ndarray"):
            return self._array(value, path, depth)
        if recorded_as(kind) == "pose" or isinstance(value, event_types.PoseValue):
            return _encode_pose(value, None, self._references)
        if recorded_as(kind) is not None or isinstance(value, event_types.ObjectReference | event_types.ObjectValue):
            return _encode_object(value, None, self._references)
        if isinstance(value, datetime):
            return _encode_datetime(value, None, self._references)
        if hasattr(kind, "in_brief"):  # an outcome of a plan
            value = value.in_brief()
        if isinstance(value, Mapping | list | tuple):
            return self._items(value, path, depth)
        raise _mismatch("JSON", value)

    def _array(self, value: Any, path: str, depth: int) -> Any:
        if self._put_blob is None or (value.dtype.kind in _NUMBERS and value.size <= ARRAY_ITEMS_MAX):
            return self.read(value.tolist(), path, depth)
        file = io.BytesIO()
        save = sys.modules["numpy"].save
        save(file, value, allow_pickle=False)  # raises for an array of objects, or a user's own dtype
        reference = self._put(file.getvalue(), NPY)
        return event_types.BlobReference(reference.hash, NPY, reference.size, str(value.dtype), value.shape)

    def _blob(self, value: event_types.Blob) -> event_types.BlobReference:
        content, media_type = cast("tuple[object, object]", value)  # unchecked by the caller
        if not isinstance(content, bytes | bytearray | memoryview):
            raise UnrecordableValue(f"the content of a blob must be bytes, not {class_name(type(content))}")
        if not isinstance(media_type, str) or len(media_type) > _MEDIA_TYPE_MAX or unwritable(media_type):
            raise UnrecordableValue(f"the media type of a blob must be a str of at most {_MEDIA_TYPE_MAX} characters")
        return self._put(bytes(content), media_type)

    def _put(self, content: bytes, media_type: str) -> event_types.BlobReference:
        if self._put_blob is None:
            raise UnrecordableValue("JSON cannot hold a Blob")
        try:
            reference = self._put_blob(content, media_type)
        except ValueError as refusal:
            raise UnrecordableValue(str(refusal)) from None
        self.blobs.append(reference)
        return reference


def _as_built_in(value: str | float) -> str | int | float:
    """Convert a value of a subclass to the built-in type, so that the subclass cannot change its JSON."""
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, float):
        return float.__float__(value)
    return _encode_integer(value, None, NO_REFERENCES)


def _mismatch(declared: str, value: Any) -> UnrecordableValue:
    if type(value) is RefusedValue:  # `isinstance` reads an attribute, which may raise
        return UnrecordableValue(value.reason)
    if declared == "JSON":
        return UnrecordableValue(f"JSON cannot hold a {class_name(type(value))}")
    return UnrecordableValue(f"declared as {declared}, got a {class_name(type(value))}")


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
    return f"reading it raised {class_name(type(error))}{': ' if message else ''}{message}"


def message_of(failure: BaseException) -> str:
    """Return the message of an exception, also of one whose `__str__` raises an `Exception`."""
    try:
        return str(failure)
    except Exception as error:  # noqa: BLE001  a user's __str__ may raise anything
        return f"<its __str__ raised {class_name(type(error))}>"


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
        self.maxlevel = 3
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdeque = self.maxdict = 20
        self.maxother = self.maxlong = self.maxstring = 2 * _REPR_MAX

    def repr1(self, x: Any, level: int) -> str:
        try:
            if isinstance(x, str) and type(x).__repr__ is str.__repr__:
                return repr(str.__getitem__(x, slice(_TEXT_MAX))) + _cut_mark(str.__len__(x), "characters")
            if isinstance(x, bytes | bytearray):
                kind = bytes if isinstance(x, bytes) else bytearray
                return repr(kind(x[:_TEXT_MAX])) + _cut_mark(len(x), "bytes")
            return super().repr1(x, level)
        except Exception as error:  # noqa: BLE001  a user's __repr__ may raise anything
            return f"<a {class_name(type(x))} whose repr raised {class_name(type(error))}>"

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
_ARGS: Final = BaseException.__dict__["args"].__get__
"""Reads the arguments that an exception was made with, also of a class that has an attribute `args` of its own."""


class FailureCopies:
    """Copies exceptions for one episode. An exception that several nodes raise on its way up is copied once.

    It is copied again when its arguments or its message are others, or an argument may have changed in place. The copy
    does not keep the exception, and with it the frames of its traceback, alive.
    """

    def __init__(self) -> None:
        self._last: tuple[ReferenceType[BaseException], object, str, event_types.FailureValue] | None = None

    def copy(
        self, failure: BaseException, references: References, convert: Callable[[Any], Any] = lambda each: each
    ) -> event_types.FailureValue:
        """Copy class, message and arguments of an exception. Raises no `Exception`."""
        if not issubclass(type(failure), BaseException):  # whatever an executive gave, which may deny its class
            return failure_value(failure, references, convert)
        arguments, message = _ARGS(failure), message_of(failure)
        if self._last is not None:
            copied, former_arguments, former_message, value = self._last
            if copied() is failure and former_arguments is arguments and former_message == message:
                return value
        value = failure_value(failure, references, convert)
        poses: FrozenPoses | None = getattr(references, "frozen_poses", None)
        if all(_is_fixed(each, poses) for each in arguments):
            with suppress(TypeError):  # of a built-in class, to which there are no weak references
                self._last = ref(failure), arguments, message, value
        return value


def _is_fixed(argument: object, poses: FrozenPoses | None) -> bool:
    kind = type(argument)
    return kind in _PLAIN or issubclass(kind, Enum) or (poses is not None and poses.get(argument) is not None)


def failure_value(
    failure: BaseException, references: References, convert: Callable[[Any], Any] = lambda each: each
) -> event_types.FailureValue:
    """Copy class, message and converted arguments of an exception. Raises no `Exception`."""
    return event_types.FailureValue(
        type=_name_of(failure),
        message=cut(clean(message_of(failure)), _MESSAGE_MAX),
        arguments=_arguments(failure, references, convert, 0),
    )


def _name_of(failure: BaseException) -> str:
    return cut(clean(recorded_name(type(failure))), _FAILURE_NAME_MAX)


def _arguments(failure: BaseException, references: References, convert: Callable[[Any], Any], depth: int) -> list[Any]:
    """Encode the arguments of an exception; for a group, its message and the encoded exceptions inside it."""
    if not isinstance(failure, BaseExceptionGroup):
        values = _ARGS(failure) if issubclass(type(failure), BaseException) else ()
        return [encode_or_missing(convert(each), references) for each in values]
    if depth > DEPTH_MAX:
        return [missing_value(f"it is nested more than {DEPTH_MAX} deep", failure)]
    inside = [
        {
            "type": _name_of(each).rpartition(".")[2],
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


# === plain values =============================================================================================
#
# Copy models of pydantic, dataclasses and containers of an executive as dicts and lists, or as a text of JSON.

_PLAIN = frozenset({str, int, float, bool, NoneType})


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
    if is_dataclass(kind) and recorded_as(kind) is None and not hasattr(kind, "in_brief"):
        return {each.name: _copy(getattr(value, each.name), simplified) for each in fields(kind)}
    return _copy_items(value, simplified) if isinstance(value, Mapping | list | tuple) else value


def _copy_items(items: Any, simplified: Callable[[Any], Any]) -> Any:
    """Copy a container; most of its items are scalars, for which a call of `_copy` would take longer than the check."""
    if isinstance(items, (dict, Mapping)):
        return {str(key): each if type(each) in _PLAIN else _copy(each, simplified) for key, each in items.items()}
    return [each if type(each) in _PLAIN else _copy(each, simplified) for each in items]
