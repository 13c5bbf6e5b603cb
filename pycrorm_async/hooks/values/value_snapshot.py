"""The border: live values become frozen ones, copied at the moment they are seen.

A parameter that cannot be written down without changing its meaning raises `Unwritable` with the reason. Results,
arguments of failures and texts of the world never raise: what cannot be recorded becomes a `MissingValue`. The code of
a value's class runs here (`__float__`, `__repr__`, properties) and may raise anything, so every exception but Ctrl-C is
the reason why that value is missing. Reading a value is bounded in depth and in items, so a structure that holds itself
ends as well.
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
from pycrorm_async.events.types import (
    FailureValue,
    FieldDeclared,
    MissingValue,
    ObjectReference,
    ObjectValue,
    PoseValue,
)
from pycrorm_async.hooks.values.texts import clean, clean_repr, cut, message_of, reading_fault
from pycrorm_async.plan.language.outcome import Outcome
from pycrorm_async.plan.object_designators import BelieveObject, LocatedObject, ObjectDesignator, ObjectPart
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose

__all__ = [
    "OBJECT_TYPES",
    "Unwritable",
    "References",
    "pose_value",
    "written",
    "written_or_missing",
    "failure_value",
    "missing_in",
    "missing_value",
]

OBJECT_TYPES: tuple[type, ...] = (ObjectDesignator, Object)
"""Field types that mean an object; parts and believed objects are object designators too."""

ObjectDtype: TypeAlias = Literal["Object", "ObjectPart", "BelieveObject", "LocatedObject"]

_TEXT_MAX = 2_000
_REASON_MAX = 500
_NAME_MAX = 500
_DEPTH_MAX = 8
_GROUP_MAX = 100
ITEMS_MAX = 2**19
"""Items of one value. Each takes two bytes at least, so that many are above the usual `record_bytes_max`."""


class Unwritable(ValueError):
    """A value that JSON or its column cannot hold as it is."""


class References(Protocol):
    """What the episode knows of the objects in its world."""

    def reference(self, world_object: Object) -> ObjectReference | None:
        """The row in force of this object; None if the episode never saw it."""
        ...


def pose_value(pose: Pose) -> PoseValue:
    """The pose as it is now."""
    return PoseValue(pose.position, pose.orientation, pose.frame, pose.time_ns)


def written(field: FieldDeclared, enum: type[Enum] | None, value: Any, references: References) -> Any:
    """A parameter as JSON, by the type its field was declared with. Raises `Unwritable`."""
    if field.type == "list":
        if isinstance(value, str | bytes) or not isinstance(value, Sequence | np.ndarray):
            raise Unwritable(f"{_a(value)} stands where a list was declared")
        scalar = _WRITERS[field.item or "text"]
        return [scalar(each, enum, references) if each is not None else None for each in _bounded(value, value)]
    if field.type == "dict":
        if not isinstance(value, Mapping):
            raise Unwritable(f"{_a(value)} stands where a dict was declared")
        scalar = _WRITERS[field.item or "text"]
        entries = {
            _key(key): scalar(each, enum, references) if each is not None else None
            for key, each in _bounded(value, value.items())
        }
        if len(entries) < len(value):
            raise Unwritable("two keys of the dict have the same text")
        return entries
    return _WRITERS[field.type](value, enum, references)


def written_or_missing(value: Any, references: References) -> Any:
    """Any value as JSON, as far as it can be; a `MissingValue` where it cannot. Never raises."""
    try:
        return _Freely(references).read(value, 0)
    except Unwritable as reason:
        return missing_value(str(reason), value)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001  a user's __iter__ or property may raise anything
        return missing_value(reading_fault(error), value)


def missing_value(reason: str, value: Any) -> MissingValue:
    """What stands for a value that cannot be recorded."""
    return MissingValue(cut(clean(reason), _REASON_MAX), clean_repr(value))


def missing_in(value: Any) -> Iterator[MissingValue]:
    """Each `MissingValue` in what was written."""
    if isinstance(value, MissingValue):
        yield value
    elif isinstance(value, list | dict):
        for each in value.values() if isinstance(value, dict) else value:
            yield from missing_in(each)


def failure_value(failure: BaseException, references: References) -> FailureValue:
    """Class, message and arguments of an exception. Never raises."""
    return FailureValue(
        type=cut(_path_of(type(failure)), _NAME_MAX),
        message=cut(clean(message_of(failure)), _TEXT_MAX),
        arguments=_arguments_or_missing(failure, references),
    )


def _path_of(kind: type) -> str:
    try:
        return clean(f"{kind.__module__}.{kind.__qualname__}")
    except Exception as error:  # noqa: BLE001  a metaclass may raise anything
        return f"<an exception whose class has no name: {type(error).__name__}>"


def _arguments_or_missing(failure: BaseException, references: References) -> list[Any]:
    try:
        return _arguments(failure, references, 0)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001  `args` may be a property that raises anything
        return [MissingValue(reading_fault(error))]


def _arguments(failure: BaseException, references: References, depth: int) -> list[Any]:
    """What it was raised with; of a group its message, and class, message and arguments of each that is in it."""
    if not isinstance(failure, BaseExceptionGroup):
        return [written_or_missing(each, references) for each in failure.args]
    if depth > _DEPTH_MAX:
        return [missing_value(f"it is nested more than {_DEPTH_MAX} deep", failure)]
    inside = [
        {
            "type": cut(_path_of(type(each)).rpartition(".")[2], _NAME_MAX),
            "message": cut(clean(message_of(each)), _REASON_MAX),
            "arguments": _arguments(each, references, depth + 1),
        }
        for each in failure.exceptions[:_GROUP_MAX]
    ]
    return [cut(clean(str(failure.message)), _TEXT_MAX), inside]


# --- one writer per declared type ---------------------------------------------------------------------------------


def _integer(value: Any, _enum: type[Enum] | None, _references: References) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        raise Unwritable(f"{_a(value)} stands where an int was declared") from None
    if not -(2**63) <= number < 2**63:
        raise Unwritable("the integer does not fit into 64 bits")
    return int(number)


def _real(value: Any, _enum: type[Enum] | None, _references: References) -> float:
    if type(value) is not float:
        if isinstance(value, str | bytes) or not hasattr(value, "__float__"):
            raise Unwritable(f"{_a(value)} stands where a float was declared")
        try:
            value = float.__float__(value) if isinstance(value, float) else float(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise Unwritable(f"{_a(value)} stands where a float was declared: {error}") from None
    if not math.isfinite(value):
        raise Unwritable(f"{value} is not a finite number")
    return float.__float__(value)


def _text(value: Any, _enum: type[Enum] | None, _references: References) -> str:
    if not isinstance(value, str):
        raise Unwritable(f"{_a(value)} stands where a str was declared")
    return str.__str__(_checked(str.__str__(value)))


def _boolean(value: Any, _enum: type[Enum] | None, _references: References) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise Unwritable(f"{_a(value)} stands where a bool was declared")
    return bool(value)


def _datetime(value: Any, _enum: type[Enum] | None, _references: References) -> str:
    if not isinstance(value, datetime):
        raise Unwritable(f"{_a(value)} stands where a datetime was declared")
    if value.tzinfo is None:
        raise Unwritable("the datetime has no time zone")
    return value.astimezone(UTC).isoformat(timespec="microseconds")


def _member(value: Any, enum: type[Enum] | None, _references: References) -> str:
    if enum is not None and not isinstance(value, enum):
        raise Unwritable(f"{clean_repr(value)} is no member of {enum.__name__}")
    name = value.name
    if not isinstance(name, str):
        raise Unwritable(f"{clean_repr(value)} has no name in {type(value).__name__}")
    return str(_checked(name))


def _pose(value: Any, _enum: type[Enum] | None, _references: References) -> PoseValue:
    if not isinstance(value, Pose):
        raise Unwritable(f"{_a(value)} stands where a Pose was declared")
    if not math.isfinite(sum(value.position) + sum(value.orientation)):
        raise Unwritable(f"the pose holds a number that is not finite: {value}")
    if unwritable(value.frame):
        raise Unwritable(f"the pose's frame: {unwritable(value.frame)}")
    return pose_value(value)


def _object(value: Any, _enum: type[Enum] | None, references: References) -> ObjectReference | ObjectValue:
    if isinstance(value, Object):
        return references.reference(value) or _outside(value)
    if isinstance(value, ObjectPart):
        return _told("ObjectPart", value, _in_force(value.part_of, references))
    if isinstance(value, LocatedObject):
        return _told("LocatedObject", value, _in_force(value.reference, references))
    if isinstance(value, BelieveObject):
        return _told("BelieveObject", value)
    if isinstance(value, ObjectDesignator):
        known = references.reference(value.world_object) if value.world_object is not None else None
        return known or _outside(value)
    raise Unwritable(f"{_a(value)} stands where an object designator was declared")


def _outside(value: Any) -> ObjectValue:
    return _told("Object", value)


def _told(dtype: ObjectDtype, value: Any, part_of: ObjectReference | None = None) -> ObjectValue:
    return ObjectValue(dtype, clean(value.name), _type_name(value), _maybe_pose(value), part_of)


def _in_force(meant: ObjectDesignator, references: References) -> ObjectReference | None:
    """The row in force of the object of the world that is meant, or that the part belongs to."""
    while isinstance(meant, ObjectPart):
        meant = meant.part_of
    return references.reference(meant.world_object) if meant.world_object is not None else None


def _maybe_pose(value: Any) -> PoseValue | None:
    try:
        pose = value.pose
    except Exception:  # noqa: BLE001  a part of what was removed, a link that is not there: `perform` says so itself
        return None
    return _pose(pose, None, _NOBODY) if pose is not None else None


def _type_name(value: Any) -> str | None:
    kind = value.object_type
    return kind.name if isinstance(kind, Enum) else clean(str(kind)) if kind is not None else None


_WRITERS: dict[str, Callable[[Any, type[Enum] | None, References], Any]] = {
    "integer": _integer,
    "real": _real,
    "text": _text,
    "boolean": _boolean,
    "datetime": _datetime,
    "enum": _member,
    "pose": _pose,
    "object": _object,
}


class _Nobody:
    def reference(self, world_object: Object) -> ObjectReference | None:  # noqa: ARG002  the port's signature
        return None


_NOBODY = _Nobody()


def _key(key: Any) -> str:
    if isinstance(key, Enum):
        return str(key.name)
    if not isinstance(key, str):
        raise Unwritable(f"{_a(key)} stands where a dict's key must be a str")
    return str(_checked(key))


def _checked(value: Any) -> Any:
    reason = unwritable(value)
    if reason is not None:
        raise Unwritable(reason)
    return value


def _bounded(holder: Any, items: Iterable[Any]) -> Iterable[Any]:
    """The items, if there are not too many. Raises `Unwritable`."""
    if len(holder) > ITEMS_MAX:
        raise Unwritable(f"it holds {len(holder):,} items, {ITEMS_MAX:,} are the most")
    return items if type(holder) in _HONEST else _counted(items)


_HONEST = (list, tuple, dict, np.ndarray)
"""Their length is what iterating them gives; a class of the user's own may go on for ever."""


def _counted(items: Iterable[Any]) -> Iterator[Any]:
    for number, each in enumerate(items):
        if number == ITEMS_MAX:
            raise Unwritable(f"it holds more than {ITEMS_MAX:,} items")
        yield each


class _Freely:
    """Reads a value of no declared type, as far as JSON can hold it. Raises `Unwritable`."""

    def __init__(self, references: References) -> None:
        self._references = references
        self._left = ITEMS_MAX
        self._around: set[int] = set()

    def read(self, value: Any, depth: int) -> Any:
        self._left -= 1
        if self._left < 0:
            raise Unwritable(f"it holds more than {ITEMS_MAX:,} items")
        if depth > _DEPTH_MAX:
            raise Unwritable(f"it is nested more than {_DEPTH_MAX} deep")
        if isinstance(value, Enum):
            return _checked(value.name)
        if value is None or isinstance(value, bool | np.bool_):
            return None if value is None else bool(value)
        if isinstance(value, str | int | float):
            return _checked(_plainly(value))
        if isinstance(value, np.generic):
            return self.read(value.item(), depth + 1)
        for kind, writer in ((Pose, _pose), (datetime, _datetime), (OBJECT_TYPES, _object)):
            if isinstance(value, kind):
                return writer(value, None, self._references)
        if isinstance(value, Outcome):
            value = value.in_brief()
        if isinstance(value, Mapping | list | tuple | np.ndarray):
            return self._container(value, depth)
        raise Unwritable(f"{_a(value)} has no form in JSON")

    def _container(self, value: Any, depth: int) -> Any:
        if id(value) in self._around:
            raise Unwritable("it holds itself")
        self._around.add(id(value))
        written: Any
        if isinstance(value, Mapping):
            written = {_key(key): self.read(each, depth + 1) for key, each in value.items()}
        else:
            written = [self.read(each, depth + 1) for each in value]
        self._around.discard(id(value))
        return written


def _plainly(value: str | float) -> str | int | float:
    """The value as one of the built-in types, whose form in JSON no subclass can change."""
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, float):
        return float.__float__(value)
    return _integer(value, None, _NOBODY)


def _a(value: Any) -> str:
    return f"a {type(value).__name__}"
