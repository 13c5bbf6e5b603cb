"""List the columns of a select with their declared types.

A mapped class contributes its columns under its attributes' names; deferred ones only if `deferred` is True. Two
columns of one name become `x` and `x_1`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple, TypeAlias

from sqlalchemy import (
    BigInteger,
    Boolean,
    CompoundSelect,
    Date,
    DateTime,
    Double,
    Enum,
    Float,
    Integer,
    LargeBinary,
    Numeric,
    Select,
    String,
    Text,
    TextClause,
    TextualSelect,
    inspect,
    select,
    type_coerce,
)
from sqlalchemy.ext.hybrid import HybridExtensionType
from sqlalchemy.orm import Mapper
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeEngine

from pycrorm_async.errors import CallerError
from pycrorm_async.orm.designators import ClassOfRow
from pycrorm_async.orm.types import EnumName, JsonText, Moment

ColumnKind: TypeAlias = Literal[
    "integer", "number", "bool", "text", "enum", "time", "json", "bytes", "date", "local time", "untyped"
]
"""The type of a column as far as frames and files distinguish it. `local time` is one without a time zone."""

_KINDS: tuple[tuple[type[TypeEngine[Any]], ColumnKind, TypeEngine[Any] | None], ...] = (
    (Moment, "time", BigInteger()),
    (EnumName, "enum", String()),
    (ClassOfRow, "text", String()),
    (JsonText, "json", Text()),
    (Boolean, "bool", None),
    (Integer, "integer", None),
    (Float, "number", None),
    (Numeric, "number", Double()),
    (Enum, "enum", String()),
    (String, "text", None),
    (LargeBinary, "bytes", None),
    (DateTime, "local time", None),
    (Date, "date", None),
)
"""The kind of each SQLAlchemy type, and the type as which it is read in place of its own Python values."""


class FrameColumn(NamedTuple):
    """One column: its name, its SQL expression, and its kind."""

    name: str
    expression: Any
    kind: ColumnKind


def select_of(query: object) -> Select[*tuple[Any, ...]]:
    """Return the select of a `FrameQuery` except a question. Raises `CallerError` for anything else."""
    if isinstance(query, Select):
        return query
    if isinstance(query, CompoundSelect):
        return select(query.subquery())
    if isinstance(query, type) and getattr(inspect(query, raiseerr=False), "is_mapper", False):
        return select(query)
    if isinstance(query, str | TextClause | TextualSelect):
        raise CallerError(
            "a frame has the types that a select declares, and SQL as text declares none:"
            " `(await memory.query(sql)).frame()` has those of its values"
        )
    raise CallerError(f"a frame can be of a select, a mapped class or a question, not of {query!r:.100}")


def columns_of(statement: Select[*tuple[Any, ...]], *, deferred: bool = False) -> list[FrameColumn]:
    """Return the columns of a select over columns, mapped classes, views, or a mix; with `deferred`, those too."""
    return list(_distinct(_columns(statement, deferred=deferred)))


def _columns(statement: Select[*tuple[Any, ...]], *, deferred: bool) -> Iterator[FrameColumn]:
    for each in statement.column_descriptions:
        entity = inspect(each["expr"], raiseerr=False)
        if not (getattr(entity, "is_mapper", False) or getattr(entity, "is_aliased_class", False)):
            yield _column(each["name"], each["expr"], each["type"])
            continue
        for name, kind in _attributes(entity.mapper, deferred=deferred):
            yield _column(name, getattr(each["expr"], name), kind)


def _attributes(mapper: Mapper[Any], *, deferred: bool) -> Iterator[tuple[str, TypeEngine[Any]]]:
    """Yield name and type of the attributes that are columns: mapped ones, synonyms on request, then hybrids."""
    for attribute in mapper.column_attrs:
        name = attribute.key.removeprefix("_")
        if (deferred or not attribute.deferred) and (name == attribute.key or name in mapper.synonyms):
            yield name, attribute.columns[0].type
    for name, each in mapper.all_orm_descriptors.items():
        if each.extension_type is not HybridExtensionType.HYBRID_PROPERTY:
            continue
        shown = mapper.column_attrs.get(f"_{name}")
        if shown is not None and (deferred or not shown.deferred):
            yield name, shown.columns[0].type
        elif name == "sequence":  # computed from the id
            yield name, BigInteger()


def _column(name: str, expression: Any, type_: Any) -> FrameColumn:
    if _is_mean(expression):
        return FrameColumn(name, type_coerce(expression, Double()), "number")
    for types, kind, read_as in _KINDS:
        if isinstance(type_, types):
            return FrameColumn(name, expression if read_as is None else type_coerce(expression, read_as), kind)
    return FrameColumn(name, expression, "untyped")


def _is_mean(expression: Any) -> bool:
    """Return whether it is SQL's `avg`, to which SQLAlchemy gives no type, also with a label or over a window."""
    while (inner := getattr(expression, "element", None)) is not None:
        expression = inner
    return isinstance(expression, FunctionElement) and getattr(expression, "name", "") == "avg"


def _distinct(columns: Iterator[FrameColumn]) -> Iterator[FrameColumn]:
    seen: dict[str, int] = {}
    for each in columns:
        count = seen[each.name] = seen.get(each.name, -1) + 1
        yield each._replace(name=f"{each.name}_{count}") if count else each
