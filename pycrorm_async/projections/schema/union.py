"""Unite the declarations of all processes in one layout, in the order in which they were stored.

A process does not know what others declare, so declarations may contradict each other. The first one keeps its names. A
later one is fitted beside it: a field of another type is kept under `<field>_<type>`, a type of another kind, or whose
table another type has, under `<dtype><Kind>`, and an alias that would join contradicting types is left out. Events keep
their own names.

The other names follow from the declaration and the layout alone, and a layout never loses a column. So a declaration
gets the same names whenever it is united again, and a rebuild, which unites all at once, makes the tables that live
folding made as the declarations arrived.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import msgspec

from pycrorm_async.events.codec import UnknownShape, declaration_of, fingerprint
from pycrorm_async.events.fields import column_name, fault_in_fields, mapped_declaration, table_name
from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.events.values import FieldDeclared
from pycrorm_async.projections.schema.core_columns import Storage
from pycrorm_async.projections.schema.layout import STORED_AS, Contradiction, Layout, LayoutConflict


class Adjustment(NamedTuple):
    """The names of its own under which a declaration that contradicts others is in the tables.

    Attributes:
        own_names: the names under which events have the values of renamed fields, by the fields' names in the tables.
        lines: a line for each contradiction, which names the other name.
    """

    own_names: dict[str, str]
    lines: list[str]


class Union(NamedTuple):
    """The layout with the accepted declarations.

    Attributes:
        accepted: those declarations by fingerprint, with the names that types and fields have in the tables.
        refused: the reasons of refusals, by fingerprint.
        adjustments: by fingerprint, the names of the accepted declarations that contradict others.
    """

    layout: Layout
    accepted: dict[str, DesignatorTypeDeclared]
    refused: dict[str, str]
    adjustments: dict[str, Adjustment]


def unite(layout: Layout, payloads: Sequence[bytes]) -> Union:
    """Add to the layout those of these declarations that can have tables."""
    accepted: dict[str, DesignatorTypeDeclared] = {}
    refused: dict[str, str] = {}
    adjustments: dict[str, Adjustment] = {}
    for payload in payloads:
        name = fingerprint(payload)
        if name in layout.unmade:
            refused[name] = layout.unmade[name]
            continue
        try:
            declared = mapped_declaration(declaration_of(payload))
            try:
                layout = layout.with_declaration(declared)
            except Contradiction as reason:
                layout, declared, adjustments[name] = _fit(layout, declared, reason)
            accepted[name] = declared
        except LayoutConflict as reason:
            refused[name] = str(reason)
        except (UnknownShape, msgspec.DecodeError) as error:  # from a newer version, or damaged
            refused[name] = f"this version cannot read the declaration of its type: {error}"
    unreadable = [fingerprint(each) for each in payloads if not _is_readable(each)]
    return Union(layout.with_unreadable(unreadable) if unreadable else layout, accepted, refused, adjustments)


def _fit(
    layout: Layout, declared: DesignatorTypeDeclared, reason: Contradiction
) -> tuple[Layout, DesignatorTypeDeclared, Adjustment]:
    """Return the layout with a contradicting declaration under other names; raise the reason if none fit."""
    dtype = f"{declared.dtype}{declared.kind.title()}"
    candidates: tuple[tuple[dict[str, Any], list[str]], ...] = (
        ({}, []),
        ({"aliases": ()}, [f"{reason}; the alias is left out, so they stay two types"]),
        (
            {"aliases": (), "dtype": dtype, "table": table_name(dtype)},
            [f"{reason}; the {declared.kind} is kept as {dtype}"],
        ),
    )
    for changes, lines in candidates:
        candidate, adjustment = _with_other_fields(layout, msgspec.structs.replace(declared, **changes))
        with suppress(LayoutConflict):
            all_lines = lines + adjustment.lines
            return layout.with_declaration(candidate), candidate, Adjustment(adjustment.own_names, all_lines)
    raise reason


def _with_other_fields(layout: Layout, declared: DesignatorTypeDeclared) -> tuple[DesignatorTypeDeclared, Adjustment]:
    """Rename the fields whose columns contradict those of the type.

    A field that fits under neither name is left out; `parameters` of the nodes has its values.
    """
    columns = layout.columns_beside(declared)
    fields = {each.slot: each for each in declared.fields if _fits(columns, each)}
    adjustment = Adjustment({}, [])
    for field in declared.fields:
        if field.slot in fields:
            continue
        name = f"{field.name}_{field.type}"
        renamed = msgspec.structs.replace(field, name=name, column=column_name(name, field.type))
        column, storage = columns[field.column.lower()]
        if column == field.column:
            line = f"{declared.dtype}.{column} is declared as {storage} and as {STORED_AS[field.type]}"
        else:
            line = f"{declared.dtype} is declared with the column {column} and with {field.column}"
        if _fits(columns, renamed) and fault_in_fields([*fields.values(), renamed]) is None:
            fields[field.slot] = renamed
            adjustment.own_names[name] = field.name
            adjustment.lines.append(f"{line}; the {field.type} is kept as {name}")
        else:
            adjustment.lines.append(f"{line}; the {field.type} has no column, because {name} is taken too")
    ordered = tuple(fields[each.slot] for each in declared.fields if each.slot in fields)
    return msgspec.structs.replace(declared, fields=ordered), adjustment


def _fits(columns: Mapping[str, tuple[str, Storage]], field: FieldDeclared) -> bool:
    """Return whether a field needs no column, a new column, or a column that has its storage."""
    storage = STORED_AS.get(field.type)
    return storage is None or columns.get(field.column.lower(), (field.column, storage)) == (field.column, storage)


def _is_readable(payload: bytes) -> bool:
    """Return whether both databases can extract a member: PostgreSQL refuses JSON that contains U+0000."""
    if b"\\u0000" in payload:
        return False
    try:
        msgspec.json.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    return True
