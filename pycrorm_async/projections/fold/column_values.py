"""Convert recorded values into column values, by the declared type of their field.

A value of another type, or one that refers to an impossible row, raises `CannotFold`.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

import msgspec

from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX, row_id, row_key
from pycrorm_async.events.values import FieldDeclared, ObjectReference, ObjectValue, PoseValue
from pycrorm_async.projections.fold.row_batch import Row
from pycrorm_async.projections.schema.core_columns import COLUMNS

_ROWS_OF_EPISODE, _ROWS_OF_EVENT = row_id(1, 0, 0), row_id(0, 1, 0)
POSE_COLUMNS = "x y z qx qy qz qw frame"
"""The columns of a pose, in the order of `pose_columns`."""
assert " ".join(COLUMNS["pose"]) == f"id process_metadata_id {POSE_COLUMNS} time", "`pose_row` has another order"
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
"""The Python type whose values are stored unchanged, by field type."""


class CannotFold(ValueError):
    """The fold cannot make rows of an event; the message gives the reason."""


def row(number: int, sequence: int) -> int:
    """Return the id of the row of an event. Raises `CannotFold` for a sequence out of range."""
    if 0 < sequence <= SEQUENCE_MAX:
        return number * _ROWS_OF_EPISODE + sequence * _ROWS_OF_EVENT  # `row_id` without its repeated checks
    raise CannotFold(f"no row can have the sequence {sequence} and the slot 0")


def in_slot(own: int, slot: int) -> int:
    """Return the id of another row of the event that made row `own`. Raises `CannotFold` for a slot out of range."""
    if 0 <= slot <= SLOT_MAX:
        return own + slot
    raise CannotFold(f"no row can have the sequence {row_key(own).sequence} and the slot {slot}")


def microseconds(nanoseconds: int) -> int:
    """Convert a time to the unit of the columns."""
    return nanoseconds // 1000


def pose_columns(pose: PoseValue) -> tuple[float, float, float, float, float, float, float, str]:
    """Return the columns x to qw and frame."""
    return (*pose.position, *pose.orientation, pose.frame)


def pose_row(own: int, number: int, pose: PoseValue) -> Row:
    """Return the row of `pose` with the id `own`, in the episode `number`."""
    x, y, z = pose.position
    qx, qy, qz, qw = pose.orientation
    return own, number, x, y, z, qx, qy, qz, qw, pose.frame, pose.time_ns // 1000


def is_missing(value: Any) -> bool:
    """Return whether this value is a recorded `MissingValue`."""
    if not isinstance(value, dict) or "missing" not in value:
        return False
    return isinstance(value["missing"], str) and value.keys() <= {"missing", "repr"}


def scalar(field: FieldDeclared, kind: str, value: Any) -> Any:
    """Convert a value for a column of type `kind`. Raises `CannotFold` for a value of another type."""
    if kind == "datetime":
        return _datetime_us(field, value)
    if not isinstance(value, _SCALARS[kind]) or (isinstance(value, bool) and kind != "boolean"):
        raise CannotFold(f"{field.name}: {_shortened(value)} is not of the declared type {kind}")
    return float(value) if isinstance(value, int) and kind == "real" else value


def pose_of(field: FieldDeclared, value: Any) -> PoseValue:
    try:
        return msgspec.convert(value, PoseValue)
    except msgspec.ValidationError as error:
        raise CannotFold(f"{field.name}: not a pose: {error}") from None


def object_of(field: FieldDeclared, value: Any) -> ObjectReference | ObjectValue:
    try:
        if isinstance(value, dict) and "row" in value:
            return msgspec.convert(value, ObjectReference)
        return msgspec.convert(value, ObjectValue)
    except msgspec.ValidationError as error:
        raise CannotFold(f"{field.name}: not an object: {error}") from None


def json_text(value: Any) -> str:
    """Encode a value as the JSON text of a column."""
    return msgspec.json.encode(value).decode()


def _datetime_us(field: FieldDeclared, value: Any) -> int:
    try:
        moment = datetime.fromisoformat(value)
        return (moment - _EPOCH) // _MICROSECOND
    except (TypeError, ValueError):
        raise CannotFold(f"{field.name}: {_shortened(value)} is not of the declared type datetime") from None


def _shortened(value: Any) -> str:
    return repr(value)[:80]
