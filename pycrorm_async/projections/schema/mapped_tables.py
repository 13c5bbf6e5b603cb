"""List the leaf tables of the mapped classes, so that a query of any class on a new memory returns no rows.

A built-in class has the dtype of its name. A class that a user declared (`class ORMSaying(Action)`) has only a table
until a designator is declared for it. Classes that exist in one memory only are derived from its declarations.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sqlalchemy import Boolean, Column, Double, Float, Integer, Table
from sqlalchemy.orm import Mapper
from sqlalchemy.types import TypeEngine

from pycrorm_async.orm import Action, Designator, Language, Motion
from pycrorm_async.orm.types import Moment
from pycrorm_async.projections.schema.core_columns import EPISODE, Storage
from pycrorm_async.projections.schema.layout import Leaf

__all__ = ["mapped_leaves", "storage_of"]

_KINDS = {Action: "action", Motion: "motion", Language: "language"}
_ROOTS = (Designator, *_KINDS)


def mapped_leaves() -> list[Leaf]:
    """Return the tables of all classes below `Designator` that every memory of this process shares."""
    return list(_leaves(Designator.__mapper__))


def _leaves(root: Mapper[Designator]) -> Iterator[Leaf]:
    for mapper in root.self_and_descendants:
        table = mapper.local_table
        if mapper.class_ in _ROOTS or mapper.class_.metadata is not Designator.metadata or not isinstance(table, Table):
            continue
        if table.metadata is not Designator.metadata:
            continue
        columns = {str(each.name): _storage(each) for each in table.columns if each.name not in ("id", EPISODE)}
        built_in = mapper.class_.__module__.startswith("pycrorm_async.orm.")
        kind = next((kind for root, kind in _KINDS.items() if issubclass(mapper.class_, root)), None)
        yield Leaf(str(table.name), columns, mapper.class_.__name__ if built_in else None, kind if built_in else None)


def _storage(column: Column[object]) -> Storage:
    for key in column.foreign_keys:
        target = key.target_fullname
        if target in ("pose.id", "object.id"):
            return "pose" if target == "pose.id" else "object"
    return storage_of(column.type)


def storage_of(type_: TypeEngine[Any]) -> Storage:
    """Return the storage of a SQLAlchemy type."""
    kinds: tuple[tuple[type, Storage], ...] = (
        (Moment, "time"),
        (Boolean, "boolean"),
        (Integer, "integer"),
        (Float, "real"),
        (Double, "real"),
    )
    return next((storage for kind, storage in kinds if isinstance(type_, kind)), "text")
