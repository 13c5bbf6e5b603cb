"""Fold a node's parameters: one row in its leaf table, and rows for poses, objects and list entries."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, Self, TypeAlias

from pycrorm_async.events.types import DesignatorTypeDeclared, NodeStarted
from pycrorm_async.events.values import FieldDeclared, ObjectReference, ObjectValue
from pycrorm_async.projections.fold.column_values import (
    AS_IT_IS,
    CannotFold,
    in_slot,
    is_missing,
    microseconds,
    object_of,
    pose_columns,
    pose_of,
    pose_row,
    row,
    scalar,
)
from pycrorm_async.projections.fold.object_row import object_row
from pycrorm_async.projections.fold.row_batch import Row
from pycrorm_async.projections.schema.core_columns import EPISODE
from pycrorm_async.projections.schema.union import Union
from pycrorm_async.store.stored import StoredEvent

_NO_POSE = (None,) * 8
_ITEM_SCALARS = {"integer": 0, "real": 1, "text": 2, "enum": 2, "boolean": 3, "datetime": 4}

ParameterRows: TypeAlias = list[tuple[str, Row]]
"""Rows of tables other than the leaf table, each with its table."""


class DesignatorFold:
    """Folds the parameters of the nodes of one declaration.

    `own_names` are the names under which events have the values of renamed fields, by the fields' names.

    Attributes:
        leaf: the leaf table and its columns.
    """

    def __init__(self, declared: DesignatorTypeDeclared, own_names: Mapping[str, str] = MappingProxyType({})) -> None:
        columned = [each for each in declared.fields if each.type not in ("list", "dict")]
        self.dtype = declared.dtype
        self.leaf = (declared.table, ("id", EPISODE, *(each.column for each in columned)))
        self._columned = [
            (own_names.get(f.name, f.name), AS_IT_IS.get(f.type), _CONVERTED.get(f.type, _scalar), f) for f in columned
        ]
        self._listed = [each for each in declared.fields if each.type in ("list", "dict")]

    def rows(self, event: StoredEvent, node: int, parameters: Mapping[str, Any], others: ParameterRows) -> Row:
        """Return the node's row in the leaf table and add rows of other tables to `others`. Raises `CannotFold`."""
        leaf: list[Any] = [node, event.number]
        for name, as_it_is, converted, field in self._columned:
            value = parameters.get(name)
            if value is None or type(value) is as_it_is:
                leaf.append(value)
            elif is_missing(value):
                leaf.append(None)
            else:
                leaf.append(converted(event, node, field, value, others))
        for field in self._listed:
            value = parameters.get(field.name)
            if value is not None and not is_missing(value):
                others.extend(("parameter_item", each) for each in _entries(event, node, field, value))
        return tuple(leaf)


class Designators:
    """The folds of all declared designator types, by the fingerprint of their declaration.

    `refused` maps the declarations whose nodes cannot be folded to the reason.
    """

    def __init__(
        self,
        declarations: Mapping[str, DesignatorTypeDeclared] | None = None,
        refused: Mapping[str, str] | None = None,
        own_names: Mapping[str, Mapping[str, str]] = MappingProxyType({}),
    ) -> None:
        self._refused = dict(refused or {})
        accepted = {name: each for name, each in (declarations or {}).items() if name not in self._refused}
        self._folds = {name: DesignatorFold(each, own_names.get(name, {})) for name, each in accepted.items()}

    @classmethod
    def of_union(cls, united: Union) -> Self:
        """Return the folds of these declarations."""
        own_names = {name: each.own_names for name, each in united.adjustments.items()}
        return cls(united.accepted, united.refused, own_names)

    def of(self, started: NodeStarted) -> DesignatorFold | None:
        """Return the fold of this node's type; None for a root. Raises `CannotFold`."""
        name = started.designator
        if name is None:
            return None
        fold = self._folds.get(name)
        if fold is None:
            raise CannotFold(self._refused.get(name, f"the designator type {name} was never declared"))
        return fold


def _scalar(_event: StoredEvent, _node: int, field: FieldDeclared, value: Any, _others: ParameterRows) -> Any:
    return scalar(field, field.type, value)


def _pose(event: StoredEvent, node: int, field: FieldDeclared, value: Any, others: ParameterRows) -> int:
    pose = pose_of(field, value)
    own = in_slot(node, field.slot)
    others.append(("pose", pose_row(own, event.number, pose)))
    return own


def _object(event: StoredEvent, node: int, field: FieldDeclared, recorded: Any, others: ParameterRows) -> int:
    """Return the current row of a world object; add a row in the field's slot for an object outside the world."""
    value = object_of(field, recorded)
    if isinstance(value, ObjectReference):
        return row(event.number, value.row)
    own = in_slot(node, field.slot)
    if value.pose is not None:
        others.append(("pose", pose_row(own, event.number, value.pose)))
    pose_id = own if value.pose is not None else None
    part_of = row(event.number, value.part_of.row) if value.part_of is not None else None
    number, time = event.number, microseconds(event.wall_ns)
    columns = object_row(own, number, value.dtype, value.name, value.object_type, pose_id, part_of, None, time, node)
    others.append(("object", columns))
    return own


_CONVERTED: Mapping[str, Callable[[StoredEvent, int, FieldDeclared, Any, ParameterRows], Any]] = {
    "pose": _pose,
    "object": _object,
}
"""The conversion of a field's value to that of its column; all other types use `_scalar`."""


def _entries(event: StoredEvent, node: int, field: FieldDeclared, value: Any) -> Iterator[Row]:
    """Yield one row for each entry of a list or dict."""
    if field.type == "dict" and isinstance(value, dict):
        pairs: list[tuple[str | None, Any]] = list(value.items())
    elif field.type == "list" and isinstance(value, list):
        pairs = [(None, each) for each in value]
    else:
        raise CannotFold(f"{field.name}: {repr(value)[:80]} is not of the declared type {field.type}")
    for position, (key, entry) in enumerate(pairs):
        yield (node, field.name, position, event.number, key, *_entry(event, field, entry))


def _entry(event: StoredEvent, field: FieldDeclared, value: Any) -> Row:
    """Return the columns integer to obj_type of `parameter_item`."""
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
