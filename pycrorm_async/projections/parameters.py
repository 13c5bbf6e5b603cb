"""A node's parameters as rows: one in the leaf table of its designator, and those of the poses, objects and entries of
lists and dicts that it names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pycrorm_async.events.happenings import (
    DesignatorTypeDeclared,
    FieldDeclared,
    NodeStarted,
    ObjectReference,
    ObjectValue,
    PoseValue,
)
from pycrorm_async.projections.rows import Row
from pycrorm_async.projections.values import (
    CannotFold,
    is_missing,
    microseconds,
    object_of,
    pose_columns,
    pose_of,
    row,
    scalar,
)
from pycrorm_async.store.rows import StoredEvent

__all__ = ["Designators", "DesignatorFold", "Parameters"]

_NO_POSE = (None,) * 8
_ITEM_SCALARS = {"integer": 0, "real": 1, "text": 2, "enum": 2, "boolean": 3, "datetime": 4}


class Parameters:
    """What one node's parameters make: the values of its leaf columns, and rows of other tables."""

    def __init__(self) -> None:
        self.columns: list[Any] = []
        self.rows: dict[str, list[Row]] = {}

    def add(self, table: str, made: Row) -> None:
        self.rows.setdefault(table, []).append(made)


class DesignatorFold:
    """How the parameters of one declaration become rows."""

    def __init__(self, declared: DesignatorTypeDeclared) -> None:
        self.dtype = declared.dtype
        self.table = declared.table
        self._columned = tuple(each for each in declared.fields if each.type not in ("list", "dict"))
        self._listed = tuple(each for each in declared.fields if each.type in ("list", "dict"))
        self.columns = ("id", *(each.column for each in self._columned))

    def parameters(self, event: StoredEvent, given: Mapping[str, Any]) -> Parameters:
        """The rows of these parameters. Raises `CannotFold` naming the field."""
        made = Parameters()
        for field in self._columned:
            value = given.get(field.name)
            if value is None or is_missing(value):
                made.columns.append(None)
            elif field.type == "pose":
                made.columns.append(_pose(event, field, pose_of(field, value), made))
            elif field.type == "object":
                made.columns.append(_object(event, field, object_of(field, value), made))
            else:
                made.columns.append(scalar(field, field.type, value))
        for field in self._listed:
            value = given.get(field.name)
            if value is not None and not is_missing(value):
                for entry in _entries(event, field, value):
                    made.add("parameter_item", entry)
        return made


class Designators:
    """How to fold the nodes of every declared type, by the fingerprint of its declaration.

    `refused` says why declarations cannot share the tables: their nodes cannot be folded.
    """

    def __init__(
        self,
        declarations: Mapping[str, DesignatorTypeDeclared] | None = None,
        refused: Mapping[str, str] | None = None,
    ) -> None:
        self._folds = {name: DesignatorFold(each) for name, each in (declarations or {}).items()}
        self._refused = dict(refused or {})

    def of(self, started: NodeStarted) -> DesignatorFold | None:
        """That of this node; None for a root. Raises `CannotFold`."""
        name = started.designator
        if name is None:
            return None
        if name in self._refused:
            raise CannotFold(self._refused[name])
        if name not in self._folds:
            raise CannotFold(f"the designator type {name} was never declared")
        return self._folds[name]


def _pose(event: StoredEvent, field: FieldDeclared, pose: PoseValue, made: Parameters) -> int:
    own = row(event.number, event.sequence, field.slot)
    made.add("pose", (own, event.number, *pose_columns(pose), microseconds(pose.time_ns)))
    return own


def _object(event: StoredEvent, field: FieldDeclared, value: ObjectReference | ObjectValue, made: Parameters) -> int:
    """The row in force of an object of the world; for another a row of its own, in the field's slot."""
    if isinstance(value, ObjectReference):
        return row(event.number, value.row)
    own = row(event.number, event.sequence, field.slot)
    pose_id = _pose(event, field, value.pose, made) if value.pose is not None else None
    part_of = row(event.number, value.part_of.row) if value.part_of is not None else None
    time, node = microseconds(event.wall_ns), row(event.number, event.sequence)
    made.add(
        "object",
        (own, event.number, value.dtype, value.name, value.object_type, pose_id, part_of, None, time, node, None),
    )
    return own


def _entries(event: StoredEvent, field: FieldDeclared, value: Any) -> Iterator[Row]:
    """The rows of a list's or dict's entries."""
    if field.type == "dict" and isinstance(value, dict):
        pairs: list[tuple[str | None, Any]] = list(value.items())
    elif field.type == "list" and isinstance(value, list):
        pairs = [(None, each) for each in value]
    else:
        raise CannotFold(f"{field.name}: {repr(value)[:80]} stands where {field.type} is declared")
    node = row(event.number, event.sequence)
    for position, (key, entry) in enumerate(pairs):
        yield (node, field.name, position, event.number, key, *_entry(event, field, entry))


def _entry(event: StoredEvent, field: FieldDeclared, value: Any) -> Row:
    """The columns integer to obj_type of `parameter_item`."""
    item = field.item or "text"
    scalars: list[Any] = [None] * 5
    if value is None or is_missing(value):
        return (*scalars, *_NO_POSE, None, None, None)
    if item == "pose":
        return (*scalars, *pose_columns(pose_of(field, value)), None, None, None)
    if item == "object":
        return (*scalars, *_object_entry(event, object_of(field, value)))
    scalars[_ITEM_SCALARS[item]] = scalar(field, item, value)
    return (*scalars, *_NO_POSE, None, None, None)


def _object_entry(event: StoredEvent, value: ObjectReference | ObjectValue) -> Row:
    if isinstance(value, ObjectReference):
        return (*_NO_POSE, row(event.number, value.row), None, None)
    pose = pose_columns(value.pose) if value.pose is not None else _NO_POSE
    return (*pose, None, value.name, value.object_type)
