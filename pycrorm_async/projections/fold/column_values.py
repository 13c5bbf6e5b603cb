"""From a recorded value to the columns that hold it, by the type its field was declared with.

What stands where another type was declared, or names what cannot be, raises `CannotFold`.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

import msgspec

from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX, row_id, row_key
from pycrorm_async.events.types import FieldDeclared, ObjectReference, ObjectValue, PoseValue
from pycrorm_async.projections.fold.row_batch import Row

__all__ = [
    "AS_IT_IS",
    "CannotFold",
    "row",
    "in_slot",
    "microseconds",
    "pose_columns",
    "pose_row",
    "is_missing",
    "scalar",
    "pose_of",
    "object_of",
    "json_text",
]

_ROWS_OF_EPISODE, _ROWS_OF_EVENT = row_id(1, 0, 0), row_id(0, 1, 0)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)
_SCALARS: dict[str, tuple[type, ...]] = {
    "integer": (int,),
    "real": (float, int),
    "text": (str,),
    "enum": (str,),
    "boolean": (bool,),
}

AS_IT_IS: Mapping[str, type] = {kind: types[0] for kind, types in _SCALARS.items()}
"""By a field's type, the Python type whose values its column holds just as they are."""


class CannotFold(ValueError):
    """An event that no row can be made of; the message says why."""


def row(number: int, sequence: int, slot: int = 0) -> int:
    """The row's id. Raises `CannotFold` for a sequence or slot that no row can have."""
    if 0 < sequence <= SEQUENCE_MAX and 0 <= slot <= SLOT_MAX:
        return number * _ROWS_OF_EPISODE + sequence * _ROWS_OF_EVENT + slot  # as `row_id`, whose checks were made
    raise CannotFold(f"no row can have the sequence {sequence} and the slot {slot}")


def in_slot(own: int, slot: int) -> int:
    """The id of another row of the event whose own row that is. Raises `CannotFold` for a slot that no row can have."""
    if 0 <= slot <= SLOT_MAX:
        return own + slot
    raise CannotFold(f"no row can have the sequence {row_key(own).sequence} and the slot {slot}")


def microseconds(nanoseconds: int) -> int:
    """Time in a column."""
    return nanoseconds // 1000


def pose_columns(pose: PoseValue) -> tuple[float, float, float, float, float, float, float, str]:
    """x to qw and the frame."""
    return (*pose.position, *pose.orientation, pose.frame)


def pose_row(own: int, number: int, pose: PoseValue) -> Row:
    """The row of `pose` with this id, in the episode of this number."""
    x, y, z = pose.position
    qx, qy, qz, qw = pose.orientation
    return own, number, x, y, z, qx, qy, qz, qw, pose.frame, pose.time_ns // 1000


def is_missing(value: Any) -> bool:
    """Whether a `MissingValue` stands here."""
    if not isinstance(value, dict) or "missing" not in value:
        return False
    return isinstance(value["missing"], str) and value.keys() <= {"missing", "repr"}


def scalar(field: FieldDeclared, kind: str, value: Any) -> Any:
    """What a column of this type holds."""
    if kind == "datetime":
        return _moment(field, value)
    if not isinstance(value, _SCALARS[kind]) or (isinstance(value, bool) and kind != "boolean"):
        raise CannotFold(f"{field.name}: {_shown(value)} stands where {kind} is declared")
    return float(value) if isinstance(value, int) and kind == "real" else value


def pose_of(field: FieldDeclared, value: Any) -> PoseValue:
    try:
        return msgspec.convert(value, PoseValue)
    except msgspec.ValidationError as error:
        raise CannotFold(f"{field.name}: no pose: {error}") from None


def object_of(field: FieldDeclared, value: Any) -> ObjectReference | ObjectValue:
    try:
        if isinstance(value, dict) and "row" in value:
            return msgspec.convert(value, ObjectReference)
        return msgspec.convert(value, ObjectValue)
    except msgspec.ValidationError as error:
        raise CannotFold(f"{field.name}: no object: {error}") from None


def json_text(value: Any) -> str:
    """JSON as it is kept in a column."""
    return msgspec.json.encode(value).decode()


def _moment(field: FieldDeclared, value: Any) -> int:
    try:
        moment = datetime.fromisoformat(value)
        return (moment - _EPOCH) // _MICROSECOND
    except (TypeError, ValueError):
        raise CannotFold(f"{field.name}: {_shown(value)} stands where datetime is declared") from None


def _shown(value: Any) -> str:
    return repr(value)[:80]
