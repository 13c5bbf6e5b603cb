"""Declare a designator type from the names and types of its fields, for an executive that has no class for it.

A field that cannot have its name is kept under `<field>_<type>`: one whose type contradicts a built-in type or an
earlier declaration of the same dtype, because one column cannot hold both, and one with a reserved name. A type that
cannot have its name gets the most similar one that it can have.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

from pycrorm_async.events.codec import encode, fingerprint
from pycrorm_async.events.fields import (
    AcceptedFields,
    column_name,
    fault_in_declaration,
    fault_in_dtype,
    fault_in_table,
    table_name,
)
from pycrorm_async.events.ids import SLOT_FIRST_FIELD
from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.events.values import FieldDeclared, FieldType, ItemType, ObjectReference, PoseValue
from pycrorm_async.recording.declarations.declared_type import DeclaredType, Field, Undeclared
from pycrorm_async.recording.declarations.known_types import KnownTypes
from pycrorm_async.recording.values.parameter_types import Shape, shape_of
from pycrorm_async.recording.values.texts import clean, clean_repr, cut

RecordedKind: TypeAlias = Literal["action", "motion", "language"]
FieldSpec: TypeAlias = FieldType | tuple[FieldType, ItemType] | type[Any]
"""`real`; `("list", "real")`; or a Python type: `float`, an `Enum` class, `list[float]`, `Pose`."""

_REASON_MAX = 500
"""Bounds the characters of the reason why a field or type cannot be declared; reasons may quote a user's names."""
_TYPES: frozenset[str] = frozenset(get_args(FieldType))
_WITHOUT_ITEMS = _TYPES - {"list", "dict"}
_ITEMS: frozenset[str] = frozenset(get_args(ItemType))


class Renamed(NamedTuple):
    """The name under which a field or type is recorded, and the reason why it is not its own."""

    name: str
    reason: str


class Declared(NamedTuple):
    """A declared type, the renamed fields by their own names, and the name of the type if it was renamed."""

    type: DeclaredType
    fields: dict[str, Renamed]
    dtype: Renamed | None


class PreparedType(NamedTuple):
    """A type that was derived ahead, and what was known of its table then (`KnownTypes.state_of`)."""

    declared: Declared
    state: tuple[str | None, int]


class _Named(NamedTuple):
    """A field under a name that it may have, and the reason why it is not its own; None if it is."""

    field: Field
    reason: str | None


def declare_type(
    kind: str,
    dtype: str,
    fields: Mapping[str, FieldSpec],
    known_types: KnownTypes,
    *,
    bases: Sequence[str] = (),
    concept: str | None = None,
    aliases: Sequence[str] = (),
) -> Declared:
    """Declare a type.

    A type that cannot be declared at all has no payload, and its `fault` states why. Of a built-in dtype, table, bases
    and concept are those of the built-in type.
    """
    own = cut(clean(str(dtype)), _REASON_MAX)
    dtype, table, fault = _dtype(own, kind, known_types)
    renamed = Renamed(dtype, fault) if fault is not None and dtype != own else None
    built_in = known_types.built_in(dtype)
    if built_in is not None:
        known_types.note_stored(built_in)
    accepted: list[Field] = []
    columns = AcceptedFields()
    undeclared: list[Undeclared] = []
    renamed_fields: dict[str, Renamed] = {}
    for name, spec in fields.items():
        named = _named(str(name), spec, known_types, table, columns)
        if isinstance(named, str):
            undeclared.append(Undeclared(clean(str(name)), (name,), cut(clean(named), _REASON_MAX)))
            continue
        accepted.append(named.field)
        columns.accept(named.field.declared)
        if named.reason is not None:
            renamed_fields[clean(str(name))] = Renamed(named.field.declared.name, clean(named.reason))
    declaration = DesignatorTypeDeclared(
        kind=kind,  # type: ignore[arg-type]  # checked below
        dtype=dtype,
        table=table,
        concept=concept or (built_in.concept if built_in is not None else None),
        bases=tuple(bases) or (built_in.bases if built_in is not None else ()),
        fields=tuple(each.declared for each in accepted),
        aliases=tuple(aliases),
    )
    fault = (
        fault_in_declaration(declaration)
        or _fault_in_kind(declaration, built_in)
        or _fault_in_aliases(declaration, known_types)
    )
    if fault is not None:
        placeholder = DesignatorTypeDeclared(kind="action", dtype=own, table="")
        reason = cut(clean(fault), _REASON_MAX)
        undeclared_type = DeclaredType(own, b"", "", tuple(accepted), placeholder, tuple(undeclared), reason)
        return Declared(undeclared_type, renamed_fields, None)
    payload = encode(declaration)
    known_types.note(declaration)
    declared = DeclaredType(dtype, payload, fingerprint(payload), tuple(accepted), declaration, tuple(undeclared))
    return Declared(declared, renamed_fields, renamed)


def prepare_type(
    kind: str, dtype: str, fields: Mapping[str, FieldSpec], known_types: KnownTypes, *, bases: Sequence[str] = ()
) -> PreparedType | None:
    """Derive a type ahead, without noting it; None for one whose names depend on other tables than its own."""
    built_in = known_types.built_in(dtype)
    table = built_in.table if built_in is not None else table_name(dtype)
    declared = declare_type(kind, dtype, fields, known_types.copy_of(table), bases=bases)
    if declared.dtype is not None or not declared.type.payload:
        return None
    return PreparedType(declared, known_types.state_of(table))


def declare_prepared(prepared: PreparedType, known_types: KnownTypes) -> Declared | None:
    """Declare a prepared type; None if its table has got an owner or columns since it was prepared."""
    declaration = prepared.declared.type.declaration
    if known_types.state_of(declaration.table) != prepared.state:
        return None
    built_in = known_types.built_in(declaration.dtype)
    if built_in is not None:
        known_types.note_stored(built_in)
    known_types.note(declaration)
    return prepared.declared


def _dtype(own: str, kind: str, known_types: KnownTypes) -> tuple[str, str, str | None]:
    """Return the first name that the type may have, its table, and the reason why the name is not its own.

    If it may have none of them, the name is its own.
    """
    tables: list[str] = []
    first_fault: str | None = None
    for candidate in _dtype_candidates(own, kind):
        built_in = known_types.built_in(candidate)
        table = built_in.table if built_in is not None else table_name(candidate)
        tables.append(table)
        fault = fault_in_dtype(candidate) or fault_in_table(table) or known_types.fault_in_table(table, candidate)
        if fault is None:
            return candidate, table, first_fault
        first_fault = first_fault or cut(clean(fault), _REASON_MAX)
    return own, tables[0], first_fault


def _dtype_candidates(own: str, kind: str) -> Iterator[str]:
    yield own
    plain = re.sub(r"[\W_]+", "_", own).strip("_") or "Unnamed"
    if not plain.isidentifier():
        plain = f"{kind}_{plain}"
    yield plain
    yield f"{plain}{kind.title()}"


def _fault_in_kind(declaration: DesignatorTypeDeclared, built_in: DesignatorTypeDeclared | None) -> str | None:
    if built_in is None or built_in.kind == declaration.kind:
        return None
    return f"the built-in type {built_in.dtype} is a {built_in.kind}, not a {declaration.kind}"


def _fault_in_aliases(declaration: DesignatorTypeDeclared, known_types: KnownTypes) -> str | None:
    """Return the reason why the table of a former dtype cannot be this one's; None if it can."""
    for alias in declaration.aliases:
        for field in declaration.fields:
            reason = known_types.fault_in_field(field, table_name(alias))
            if reason is not None:
                return f"its alias {alias!r} does not fit: field {field.name!r}: {reason}"
    return None


def _named(name: str, spec: FieldSpec, known_types: KnownTypes, table: str, accepted: AcceptedFields) -> _Named | str:
    """Return the field under the first name that it may have; the reason if it may have none."""
    shape = _shape(spec)
    if shape is None:
        return f"{clean_repr(spec)} is not a type of a field ({', '.join(sorted(_TYPES))}) and not a Python type of one"
    first_reason: str | None = None
    for candidate in _candidates(name, shape):
        declared = FieldDeclared(
            name=candidate,
            column=column_name(candidate, shape.kind),
            type=shape.kind,
            slot=SLOT_FIRST_FIELD + accepted.count,
            optional=True,
            enum=f"{shape.enum.__module__}.{shape.enum.__qualname__}" if shape.enum is not None else None,
            item=shape.item,
        )
        reason = _fault_in_field(declared, accepted) or known_types.fault_in_field(declared, table)
        if reason is None:
            return _Named(Field(declared, (name,), shape.enum), first_reason)
        first_reason = first_reason or reason
    return first_reason or "it has no name"


def _candidates(name: str, shape: Shape) -> Iterator[str]:
    yield name
    plain = re.sub(r"\W+", "_", name).strip("_") or "field"
    if not plain.isidentifier():
        plain = f"field_{plain}"
    if plain != name:
        yield plain
    yield f"{plain}_{shape.kind}"


def _fault_in_field(field: FieldDeclared, accepted: AcceptedFields) -> str | None:
    if not field.name.isidentifier() or field.name.startswith("_"):
        return f"{cut(field.name, 100)!r} is not a valid field name"
    return accepted.fault_in(field)


def _shape(spec: object) -> Shape | None:
    """Return the field type of a spec; None if there is none."""
    if isinstance(spec, str):
        return Shape(spec) if spec in _WITHOUT_ITEMS else None  # type: ignore[arg-type]  # just checked
    if isinstance(spec, tuple) and len(spec) == 2 and spec[0] in ("list", "dict") and spec[1] in _ITEMS:
        return Shape(spec[0], item=spec[1])
    if isinstance(spec, type) and not isinstance(spec, Enum) and issubclass(spec, PoseValue | ObjectReference):
        return Shape("pose" if issubclass(spec, PoseValue) else "object")
    shape = shape_of(spec)
    return shape if shape is not None and shape.nested is None else None
