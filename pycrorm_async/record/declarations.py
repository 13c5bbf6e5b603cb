"""Declare a designator type from the names and types of its fields.

A field with a reserved name is kept under `<field>_`. One whose type contradicts a built-in type or an earlier
declaration of the same dtype is kept under `<field>_<type>`, because one column cannot hold both; one whose name cannot
be a column, under a similar name. A type that cannot have its name gets the most similar one that it can have.
"""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from datetime import datetime
from enum import Enum
from functools import cache, partial
from operator import itemgetter
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

from pycrorm_async.events import fields as event_fields
from pycrorm_async.events import types as event_types
from pycrorm_async.events.codec import encode, fingerprint
from pycrorm_async.events.ids import SLOT_FIRST_FIELD
from pycrorm_async.record.values import Field, clean, clean_repr, cut, encoder_of, recorded_as, refuse
from pycrorm_async.recorded_names import recorded_name

RecordedKind: TypeAlias = Literal["action", "motion", "language"]
FieldSpec: TypeAlias = event_types.FieldType | tuple[event_types.FieldType, event_types.ItemType] | type[Any]
"""`real`; `("list", "real")`; or a Python type: `float`, an `Enum` class, `list[float]`, `Pose`."""

_REASON_MAX = 500
"""Bounds the characters of the reason why a field or type cannot be declared; reasons may quote a user's names."""
_TYPES: frozenset[str] = frozenset(get_args(event_types.FieldType))
_WITHOUT_ITEMS = _TYPES - {"list", "dict"}
_ITEMS: frozenset[str] = frozenset(get_args(event_types.ItemType))


class DeclaredType(NamedTuple):
    """The declaration of a designator type, encoded, and the fields that are read from each node.

    Attributes:
        payload: the encoded declaration; empty if the type cannot be declared.
        fingerprint: fingerprint of the payload; empty if the type cannot be declared.
        fields: those that are read from each node, also ones without a column, whose values are recorded as missing.
        undeclared: the reasons of fields without a column, by their names.
        fault: reason why the type, or one of its aliases, cannot be declared.
    """

    dtype: str
    payload: bytes
    fingerprint: str
    fields: tuple[Field, ...]
    declaration: event_types.DesignatorTypeDeclared
    undeclared: Mapping[str, str] = types.MappingProxyType({})
    fault: str | None = None


class Renamed(NamedTuple):
    """The name under which a field or type is recorded, and the reason why it is not its own."""

    name: str
    reason: str


class Declared(NamedTuple):
    """A declared type, the renamed fields by their own names, and the name of the type if it was renamed."""

    type: DeclaredType
    fields: dict[str, Renamed]
    dtype: Renamed | None = None


class OwnField(NamedTuple):
    """A field as an executive names it, see `Field`. Without a shape no column can hold it, for this reason."""

    name: str
    read: Callable[[Any], Any]
    shape: FieldShape | None
    reason: str = ""
    path: tuple[str, ...] = ()


def reason_text(text: str) -> str:
    """Clean and shorten the reason why a field or type cannot be declared."""
    return cut(clean(text), _REASON_MAX)


def declare(
    kind: event_types.NodeKind,
    dtype: str,
    own: Sequence[OwnField],
    *,
    contradiction: Callable[[event_types.FieldDeclared], str | None],
    columns: Collection[str] = (),
    fault: Callable[[event_types.DesignatorTypeDeclared], str | None] = event_fields.fault_in_declaration,
    **further: Any,
) -> Declared:
    """Declare a type with these fields.

    Args:
        contradiction: returns the reason why a field of this name and type cannot be a column; None if it can.
        columns: names of the table's fields and columns so far, in lower case.
        fault: returns the reason why the type cannot be declared, in which case it has no payload.
        further: further fields of `DesignatorTypeDeclared`.
    """
    accepted: list[event_types.FieldDeclared] = []
    fields: list[Field] = []
    undeclared: dict[str, str] = {}
    renamed: dict[str, Renamed] = {}
    unreserved, taken = _unreserved(own), event_fields.AcceptedFields()
    for each in own:
        field, reason = None, each.reason
        if each.shape is not None:
            field, reason = _named(each.name, unreserved[each.name], each.shape, contradiction, columns, taken)
        if field is None or each.shape is None:
            name, undeclared[name] = clean(each.name), reason_text(reason)
            fields.append(Field(name, each.read, partial(refuse, undeclared[name]), path=each.path))
            continue
        taken.accept(field)
        accepted.append(field)
        is_object = "object" in (field.type, field.item)
        fields.append(Field(field.name, each.read, encoder_of(field), each.shape.enum, each.path, is_object))
        if reason:
            renamed[clean(each.name)] = Renamed(field.name, reason_text(reason))
    declaration = event_types.DesignatorTypeDeclared(kind=kind, dtype=dtype, fields=tuple(accepted), **further)
    if (because := fault(declaration)) is not None:
        return Declared(without_type(kind, dtype, because, fields), renamed)
    payload = encode(declaration)
    declared = DeclaredType(dtype, payload, fingerprint(payload), tuple(fields), declaration, undeclared)
    return Declared(declared, renamed)


def without_type(kind: event_types.NodeKind, dtype: str, fault: str, fields: Sequence[Field] = ()) -> DeclaredType:
    """Build the record of a type that cannot be declared: its nodes keep their parameters, but have no type."""
    dtype = reason_text(dtype)
    placeholder = event_types.DesignatorTypeDeclared(kind=kind, dtype=dtype, table="")
    return DeclaredType(dtype, b"", "", tuple(fields), placeholder, fault=reason_text(fault))


def declare_named(
    kind: str,
    dtype: str,
    fields: Mapping[str, FieldSpec],
    known_types: KnownTypes,
    *,
    bases: Sequence[str] = (),
    concept: str | None = None,
    aliases: Sequence[str] = (),
) -> Declared:
    """Declare a type for an executive that has no class for it, and note it in `known_types`.

    Of a built-in dtype, table, bases and concept are those of the built-in type.
    """
    own = reason_text(str(dtype))
    dtype, table, reason = _dtype(own, kind, known_types)
    built_in = known_types.built_in(dtype)
    if built_in is not None:
        known_types.note_stored(built_in)
        bases, concept = tuple(bases) or built_in.bases, concept or built_in.concept

    def fault(declaration: event_types.DesignatorTypeDeclared) -> str | None:
        if (reason := event_fields.fault_in_declaration(declaration)) is not None:
            return reason
        if built_in is not None and built_in.kind != kind:
            return f"the built-in type {dtype} is a {built_in.kind}, not a {kind}"
        for alias in declaration.aliases:
            for field in declaration.fields:
                reason = known_types.fault_in_field(field, event_fields.table_name(alias))
                if reason is not None:
                    return f"its alias {alias!r} does not fit: field {field.name!r}: {reason}"
        return None

    own_fields = [
        OwnField(str(name), itemgetter(name), shape := _shape(spec), "" if shape else _no_type(spec), (name,))
        for name, spec in fields.items()
    ]
    declared = declare(
        kind,  # type: ignore[arg-type]  # checked by `fault`
        dtype,
        own_fields,
        contradiction=lambda field: known_types.fault_in_field(field, table),
        columns=known_types.columns_of(table),
        fault=fault,
        table=table,
        concept=reason_text(concept) if concept else None,
        bases=tuple(bases),
        aliases=tuple(aliases),
    )
    if not declared.type.payload:
        kept, because = declared.type.fields, declared.type.fault or ""
        return declared._replace(type=without_type("action", own, because, kept))
    known_types.note(declared.type.declaration)
    return declared._replace(dtype=Renamed(dtype, reason)) if reason is not None and dtype != own else declared


def _no_type(spec: object) -> str:
    return f"{clean_repr(spec)} is not a type of a field ({', '.join(sorted(_TYPES))}) and not a Python type of one"


def _dtype(own: str, kind: str, known_types: KnownTypes) -> tuple[str, str, str | None]:
    """Return the first name that the type may have, its table, and the reason why the name is not its own.

    If it may have none of them, the name is its own.
    """
    tables: list[str] = []
    first_fault: str | None = None
    for candidate in _dtype_candidates(own, kind):
        table = known_types.table_of(candidate)
        tables.append(table)
        fault = (
            event_fields.fault_in_dtype(candidate)
            or event_fields.fault_in_table(table)
            or known_types.fault_in_table(table, candidate)
        )
        if fault is None:
            return candidate, table, first_fault
        first_fault = first_fault or reason_text(fault)
    return own, tables[0], first_fault


def _dtype_candidates(own: str, kind: str) -> Iterator[str]:
    yield own
    plain = re.sub(r"[\W_]+", "_", own).strip("_") or "Unnamed"
    if not plain.isidentifier():
        plain = f"{kind}_{plain}"
    yield plain
    yield f"{plain}{kind.title()}"


def _unreserved(own: Sequence[OwnField]) -> dict[str, str]:
    """Return the names of fields with as many underscores as make them ones that no other field has."""
    kinds = {each.name: each.shape.kind for each in own if each.shape is not None}
    fields = [
        event_types.FieldDeclared(name, event_fields.column_name(name, kind), kind, SLOT_FIRST_FIELD)
        for name, kind in kinds.items()
    ]
    return {name: each.name for name, each in zip(kinds, event_fields.without_reserved_names(fields), strict=True)}


def _named(
    name: str,
    unreserved: str,
    shape: FieldShape,
    contradiction: Callable[[event_types.FieldDeclared], str | None],
    columns: Collection[str],
    taken: event_fields.AcceptedFields,
) -> tuple[event_types.FieldDeclared | None, str]:
    """Return the field under the first name that it may have, with the reason why it is not its own; or no field."""
    first_reason = ""
    for candidate in _candidates(name, unreserved, shape, columns):
        field = event_types.FieldDeclared(
            name=candidate,
            column=event_fields.column_name(candidate, shape.kind),
            type=shape.kind,
            slot=SLOT_FIRST_FIELD + taken.count,
            optional=shape.optional,
            enum=recorded_name(shape.enum) if shape.enum is not None else None,
            item=shape.item,
        )
        if candidate.isidentifier() and not candidate.startswith("_"):
            reason = taken.fault_in(field) or contradiction(field)
        else:
            reason = f"{cut(candidate, 100)!r} is not a valid field name"
        if reason is None:
            return field, first_reason if candidate != unreserved else ""
        first_reason = first_reason or reason
    return None, first_reason


def _candidates(name: str, unreserved: str, shape: FieldShape, columns: Collection[str]) -> Iterator[str]:
    yield name
    if f"{name}_{shape.kind}".lower() not in columns:  # earlier versions kept a reserved name so
        yield unreserved
    plain = re.sub(r"\W+", "_", name).strip("_") or "field"
    if not plain.isidentifier():
        plain = f"field_{plain}"
    if plain != name:
        yield plain
    yield f"{plain}_{shape.kind}"


# === types of fields ==========================================================================================
#
# Map field types as an executive names them, and Python types, to types of fields.


def _shape(spec: object) -> FieldShape | None:
    """Return the field type of a spec, which may be left out; None if there is none."""
    if isinstance(spec, str):
        return FieldShape(spec, optional=True) if spec in _WITHOUT_ITEMS else None  # type: ignore[arg-type]  # checked
    if isinstance(spec, tuple) and len(spec) == 2 and spec[0] in ("list", "dict") and spec[1] in _ITEMS:
        return FieldShape(spec[0], optional=True, item=spec[1])
    if (
        isinstance(spec, type)
        and not isinstance(spec, Enum)
        and issubclass(spec, event_types.PoseValue | event_types.ObjectReference)
    ):
        return FieldShape("pose" if issubclass(spec, event_types.PoseValue) else "object", optional=True)
    shape = shape_of(spec)
    return shape._replace(optional=True) if shape is not None and shape.nested is None else None


class FieldShape(NamedTuple):
    """The field type of a parameter; `nested` is a dataclass, whose fields replace the parameter."""

    kind: event_types.FieldType
    optional: bool = False
    item: event_types.ItemType | None = None
    enum: type[Enum] | None = None
    nested: type | None = None


def shape_of(hint: Any) -> FieldShape | None:
    """Map a type hint to a field type; None if no column can hold it."""
    origin = typing.get_origin(hint)
    if isinstance(hint, typing.NewType):
        return shape_of(hint.__supertype__)
    if origin in (typing.Union, types.UnionType):
        return _union_shape(hint)
    if origin is typing.Literal:
        return FieldShape("text") if all(isinstance(each, str) for each in typing.get_args(hint)) else None
    if origin is not None and isinstance(origin, type):
        return _container_shape(origin, typing.get_args(hint))
    if isinstance(hint, type):
        return _class_shape(hint)
    return None


def _class_shape(kind: type) -> FieldShape | None:
    if issubclass(kind, Enum):
        return FieldShape("enum", enum=kind)
    for python, name in _SCALARS:
        if issubclass(kind, python):
            return FieldShape(name)
    if (recorded := recorded_as(kind)) is not None:
        return FieldShape("pose" if recorded == "pose" else "object")
    if dataclasses.is_dataclass(kind):
        return FieldShape("text", nested=kind)
    return None


_SCALARS: tuple[tuple[type, event_types.FieldType], ...] = (
    (bool, "boolean"),
    (int, "integer"),
    (float, "real"),
    (str, "text"),
    (datetime, "datetime"),
)


def _union_shape(hint: Any) -> FieldShape | None:
    members = typing.get_args(hint)
    shapes = [shape_of(each) for each in members if each is not type(None)]
    optional = len(shapes) < len(members) or any(each is not None and each.optional for each in shapes)
    different = {each._replace(optional=optional) if each is not None else None for each in shapes}
    if different == {FieldShape("integer", optional), FieldShape("real", optional)}:
        return FieldShape("real", optional)
    return different.pop() if len(different) == 1 else None


def _container_shape(origin: type, arguments: tuple[Any, ...]) -> FieldShape | None:
    kind: event_types.FieldType
    if issubclass(origin, Mapping) and len(arguments) == 2:
        key = shape_of(arguments[0])
        if key is None or key.kind not in ("text", "enum") or key.optional:
            return None
        kind, value = "dict", arguments[1]
    elif issubclass(origin, Sequence) and len({each for each in arguments if each is not Ellipsis}) == 1:
        kind, value = "list", arguments[0]
    else:
        return None
    item = shape_of(value)
    if item is None or item.nested is not None or item.kind in ("list", "dict"):
        return None
    return FieldShape(kind, item=typing.cast("event_types.ItemType", item.kind), enum=item.enum)


# === known types ==============================================================================================
#
# `KnownTypes` holds the field types of all designator types that one memory has declared.

_COLUMNS_MAX = 500
"""Bounds the names of one table, below the columns that the databases allow."""


class KnownTypes:
    """The declared types of one memory. A field of one dtype has one type in all its declarations.

    Attributes:
        built_in: returns the declaration of the plan layer's own type with this dtype; None if it has none. Each answer
            is kept for the life of the memory, because finding that there is none searches all classes.
    """

    def __init__(self, built_in: Callable[[str], event_types.DesignatorTypeDeclared | None]) -> None:
        self.built_in = cache(built_in)
        self._fields_by_dtype: dict[str, dict[str, str]] = {}
        self._tables: dict[str, str] = {}
        self._columns: dict[str, dict[str, event_types.FieldDeclared]] = {}

    def fields_of(self, dtype: str) -> Mapping[str, str]:
        """Return the types of the fields of a dtype as this memory declared them, as `type_text` describes them."""
        return self._fields_by_dtype.get(dtype, {})

    def fault_in_table(self, table: str, dtype: str) -> str | None:
        """Return the reason why another type has this table; None if none has."""
        owner = self._tables.get(table.lower(), dtype)
        return f"the dtype {owner!r} already has the table {table!r}" if owner != dtype else None

    def fault_in_field(self, field: event_types.FieldDeclared, table: str) -> str | None:
        """Return the reason why this field cannot be a column of the table beside all declared ones; None if it can."""
        columns = self._columns.get(table.lower(), {})
        for name in (field.name.lower(), field.column.lower()):
            declared = columns.get(name, field)
            if (declared.name, type_text(declared)) != (field.name, type_text(field)):
                return f"its type is {type_text(field)}, but the table has {declared.name!r} as {type_text(declared)}"
        if len(columns) > _COLUMNS_MAX and field.name.lower() not in columns:
            return f"the table has {_COLUMNS_MAX} columns already"
        return None

    def columns_of(self, table: str) -> Collection[str]:
        """Return the names of the table's fields and columns, in lower case."""
        return self._columns.get(table.lower(), {})

    def table_of(self, dtype: str) -> str:
        """Return the table that the nodes of a dtype are in."""
        built_in = self.built_in(dtype)
        return built_in.table if built_in is not None else event_fields.table_name(dtype)

    def note(self, declaration: event_types.DesignatorTypeDeclared) -> None:
        """Note a declaration of this memory."""
        fields = ((each.name, type_text(each)) for each in declaration.fields)
        self._fields_by_dtype.setdefault(declaration.dtype, {}).update(fields)
        self.note_stored(declaration)

    def note_stored(self, declaration: event_types.DesignatorTypeDeclared) -> None:
        """Note a declaration, also of another process, whose table and columns the database has."""
        self._tables.setdefault(declaration.table.lower(), declaration.dtype)
        columns = self._columns.setdefault(declaration.table.lower(), {})
        for field in declaration.fields:
            columns.setdefault(field.name.lower(), field)
            columns.setdefault(field.column.lower(), field)


def type_text(field: event_types.FieldDeclared) -> str:
    """Describe a field's type; an enum counts as text, because its members are stored as text."""
    return f"{'text' if field.type == 'enum' else field.type}{f' of {field.item}' if field.item else ''}"
