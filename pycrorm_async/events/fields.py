"""Names of tables and columns: how a designator's name becomes a table, a field a column, and which names are taken.

| field | column |
|---|---|
| scalar, enum (its name), datetime | `<field>` |
| pose, object | `<field>_id`, the row's id in `pose` or `object` |
| field of a nested dataclass | `<outer>_<inner>` |
| list, dict | none: rows in `parameter_item` |

The first pose field is also offered as `pose`, the first object field as `object`, so these names are kept for them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from pycrorm_async.events.happenings import FieldDeclared, FieldType
from pycrorm_async.events.ids import SLOT_FIRST_FIELD, SLOT_MAX

__all__ = [
    "RESERVED_COLUMNS",
    "table_name",
    "column_name",
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
    " location_resolution location_candidate detection state_sample designator_type pick_up_with_context_view"
    " pickupwithcontextview".split()
)
"""Tables and views of the memory itself, the planned ones too."""
_RESERVED_BEGINNINGS = ("pycrorm_", "sqlite_", "pg_")
_OF_A_GENERATION = re.compile(r"__[0-9]+$")

_NAME_LENGTH_MAX = 60
_WORD_START = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


def table_name(dtype: str) -> str:
    """The leaf table of a type.

    >>> table_name("SayingAction"), table_name("MoveTCPMotion")
    ('saying_action', 'move_tcp_motion')
    """
    return _WORD_START.sub("_", dtype).lower()


def column_name(field: str, kind: FieldType) -> str:
    """The column of a field."""
    return f"{field}_id" if kind in ("pose", "object") else field


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


def fault_in_table(table: str) -> str | None:
    """Why a designator's table cannot have this name; None if it can."""
    if is_reserved(table):
        return f"its table would be {table!r}, which the memory itself uses (set another dtype)"
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
