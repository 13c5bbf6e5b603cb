"""Names of tables and columns: how a designator's name becomes a table, a field a column, and which names are taken.

| field | column |
|---|---|
| scalar, enum (its name), datetime | `<field>` |
| pose, object | `<field>_id`, the row's id in `pose` or `object` |
| field of a nested dataclass | `<outer>_<inner>` |
| list, dict | none: rows in `parameter_item` |
| `true`, `false`, in any case | `_true`, `_false`: SQLite shows no column under these names |
| a name of more than 60 bytes | its beginning, `_` and 12 hexadecimal digits of the whole name's BLAKE2b |

A mapped name depends on the field's name alone, so it is the same in every process and on both databases. No field's
name begins with an underscore, so `_true` is no other field's column. Mapped classes offer each field under its own
name, whatever its column is called.

The first pose field is also offered as `pose`, the first object field as `object`, so these names are kept for them.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence

import msgspec

from pycrorm_async.events.ids import SLOT_FIRST_FIELD, SLOT_MAX
from pycrorm_async.events.types import DesignatorTypeDeclared, FieldDeclared, FieldType

__all__ = [
    "RESERVED_COLUMNS",
    "table_name",
    "column_name",
    "bounded",
    "mapped_declaration",
    "fault_in_declaration",
    "fault_in_dtype",
    "fault_in_fields",
    "fault_in_table",
    "is_reserved",
]

RESERVED_COLUMNS = frozenset(
    "id dtype kind process_metadata process_metadata_id robot_state robot_state_id parameters items node node_id"
    " metadata registry awaitable_attrs".split()
)
"""Every designator has these already."""

_RESERVED_TABLES = frozenset(
    "event episode process_metadata task_tree_node designator action motion language robot_state pose position"
    " quaternion object object_removal object_part believe_object parameter_item attachment joint_change"
    " location_resolution location_candidate detection state_sample simulated_episode designator_type"
    " pick_up_with_context_view pickupwithcontextview".split()
)
"""Tables and views of the memory itself, the planned ones too."""
_RESERVED_BEGINNINGS = ("pycrorm_", "sqlite_", "pg_")
_OF_A_GENERATION = re.compile(r"__[0-9]+$")

_NAME_LENGTH_MAX = 60
"""Bytes of a table's or column's name as people see it. PostgreSQL keeps 63 bytes of a name."""
_MAPPED_TABLE_LENGTH_MAX = 48
"""Bytes of a table's name that had to be shortened: there is room for the number of any generation behind it."""
_DTYPE_LENGTH_MAX = 255
"""Bytes of a dtype: longer than any class is called, and short enough for every message that names it."""
_BASES_MAX = 32
"""Recorded types that a type may descend from. A mapped class joins the views of all of them, and SQLite joins 64."""
_KINDS = ("action", "motion", "language")
_SHOWN_BY_NO_VIEW = ("true", "false")
"""SQLite takes a column of these names for the truth value, and calls it `column1` in a view."""
_WORD_START = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


def table_name(dtype: str) -> str:
    """The leaf table of a type.

    >>> table_name("SayingAction"), table_name("MoveTCPMotion")
    ('saying_action', 'move_tcp_motion')
    """
    return bounded(_WORD_START.sub("_", dtype).lower(), _NAME_LENGTH_MAX, _MAPPED_TABLE_LENGTH_MAX)


def column_name(field: str, kind: FieldType) -> str:
    """The column of a field.

    >>> column_name("target", "pose"), column_name("xmin", "real"), column_name("true", "boolean")
    ('target_id', 'xmin', '_true')
    """
    return _mapped_column(f"{field}_id" if kind in ("pose", "object") else field)


def _mapped_column(name: str) -> str:
    if name.lower() in _SHOWN_BY_NO_VIEW:
        return f"_{name}"
    return bounded(name, _NAME_LENGTH_MAX)


def bounded(name: str, bytes_max: int, shortened_bytes_max: int | None = None) -> str:
    """The name itself, or its beginning and a hash of all of it if it takes more than so many bytes.

    >>> bounded("pose__7_by_time", 63), bounded("a" * 80, 20)
    ('pose__7_by_time', 'aaaaaaa_01285d4c77f1')
    """
    whole = name.encode()
    if len(whole) <= bytes_max:
        return name
    digest = hashlib.blake2b(whole, digest_size=6).hexdigest()
    beginning = whole[: (shortened_bytes_max or bytes_max) - len(digest) - 1].decode(errors="ignore")
    return f"{beginning}_{digest}"


def mapped_declaration(declared: DesignatorTypeDeclared) -> DesignatorTypeDeclared:
    """The declaration with columns that every database takes, also if an earlier version named them otherwise."""
    if all(each.column == _mapped_column(each.column) for each in declared.fields):
        return declared
    fields = tuple(msgspec.structs.replace(each, column=_mapped_column(each.column)) for each in declared.fields)
    return msgspec.structs.replace(declared, fields=fields)


def is_reserved(name: str) -> bool:
    """Whether a table or view of this name is the memory's own, or the database's.

    >>> is_reserved("Pose"), is_reserved("pose__1"), is_reserved("saying_action")
    (True, True, False)
    """
    lowered = name.lower()
    return (
        lowered in _RESERVED_TABLES
        or lowered.startswith(_RESERVED_BEGINNINGS)
        or _OF_A_GENERATION.search(lowered) is not None
    )


def fault_in_declaration(declared: DesignatorTypeDeclared) -> str | None:
    """Why this type cannot have a table, a view and a mapped class; None if it can. Names the field.

    A class is checked with it before it is recorded for the first time, and every declaration that is read from a log.
    """
    if declared.kind not in _KINDS:
        return f"its kind {declared.kind!r} is none of a designator ({', '.join(_KINDS)})"
    if len(declared.bases) > _BASES_MAX:
        return f"it descends from {len(declared.bases)} recorded types, {_BASES_MAX} are the most"
    for name in (declared.dtype, *declared.bases, *declared.aliases):
        fault = fault_in_dtype(name)
        if fault is not None:
            return fault
    fault = fault_in_table(declared.table) or fault_in_fields(declared.fields)
    if fault is not None:
        return fault
    slots: dict[int, str] = {}
    for field in declared.fields:
        if not field.name.isidentifier() or field.name.startswith("_"):
            return f"field {field.name!r} is not a name that a field can have"
        if field.column.lower() != column_name(field.name, field.type).lower():
            return f"field {field.name!r} has the column {field.column!r}, and must have its own"
        if not SLOT_FIRST_FIELD <= field.slot <= SLOT_MAX or slots.setdefault(field.slot, field.name) != field.name:
            return f"field {field.name!r} has the slot {field.slot}, and must have one of its own"
    return None


def fault_in_dtype(dtype: str) -> str | None:
    """The name must work as one of a class and of a table; two underscores are kept for tables of a generation."""
    if not dtype.isidentifier() or "__" in dtype:
        return f"its dtype {dtype!r} is not a name (letters, digits and single underscores)"
    if len(dtype.encode()) > _DTYPE_LENGTH_MAX:
        return f"its dtype {dtype[:40]!r}… is longer than {_DTYPE_LENGTH_MAX} bytes"
    return None


def fault_in_table(table: str) -> str | None:
    """Why a designator's table cannot have this name; None if it can."""
    if is_reserved(table):
        return f"its table would be {table!r}, which the memory itself uses (set another dtype)"
    if not table.isprintable() or not table.strip() or '"' in table:
        return f"its table would be {table!r}, which is not a name (letters, digits and single underscores)"
    if len(table.encode()) > _NAME_LENGTH_MAX:
        return f"its table's name {table!r} is longer than {_NAME_LENGTH_MAX} bytes (set a shorter dtype)"
    return None


def fault_in_fields(fields: Sequence[FieldDeclared]) -> str | None:
    """Why these fields cannot be columns of one table; None if they can. Names the field."""
    if len(fields) > SLOT_MAX - SLOT_FIRST_FIELD + 1:
        return f"it has {len(fields)} fields, {SLOT_MAX - SLOT_FIRST_FIELD + 1} are the most"
    taken: dict[str, str] = {}
    for field in fields:
        names = {field.name.lower(), field.column.lower()}
        reserved = names & RESERVED_COLUMNS
        if reserved:
            return f"field {field.name!r} has a reserved name ({', '.join(sorted(reserved))})"
        if len(field.column.encode()) > _NAME_LENGTH_MAX:
            return f"field {field.name!r} has a name longer than {_NAME_LENGTH_MAX} bytes"
        for name in names:
            if name in taken:
                return f"fields {taken[name]!r} and {field.name!r} would share the name {name!r}"
        taken |= dict.fromkeys(names, field.name)
    for kind in ("pose", "object"):
        first = next((field.name for field in fields if field.type == kind), None)
        wrong = _keepers(fields, kind) - {first}
        if wrong:
            return f"field {wrong.pop()!r}: the name {kind!r} is kept for the first {kind} field"
    return None


def _keepers(fields: Iterable[FieldDeclared], kind: str) -> set[str]:
    return {field.name for field in fields if {field.name.lower(), field.column.lower()} & {kind, f"{kind}_id"}}
