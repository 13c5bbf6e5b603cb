"""Map the names of designator types to tables and their fields to columns, and reject names that cannot be mapped.

| field | column |
|---|---|
| scalar, enum (its name), datetime | `<field>` |
| pose, object | `<field>_id`, the row's id in `pose` or `object` |
| field of a nested dataclass | `<outer>_<inner>` |
| list, dict | none: rows in `parameter_item` |
| `true`, `false`, in any case | `_true`, `_false`, because SQLite cannot name a view's column `true` or `false` |
| a name of more than 60 bytes | its beginning, `_` and 12 hexadecimal digits of the whole name's BLAKE2b |
| a reserved name, such as `kind` | `kind_`: the recorder declares the field itself under that name |

A column's name depends on the field's name and type alone, so it is the same in every process and on both databases.
Field names never begin with an underscore, so `_true` cannot collide with another field's column. A mapped class
exposes each field under the field's own name, even if the column has another.

A mapped class also exposes the first pose field as `pose` and the first object field as `object`, so these names are
reserved for them.
"""

import hashlib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Final

import msgspec

from pycrorm_async.errors import CallerError
from pycrorm_async.events.codec import clean
from pycrorm_async.events.ids import SLOT_FIRST_FIELD, SLOT_MAX
from pycrorm_async.events.types import DesignatorTypeDeclared, FieldDeclared, FieldType

RESERVED_COLUMNS = frozenset(
    "id dtype kind process_metadata process_metadata_id robot_state robot_state_id parameters items node node_id"
    " metadata registry awaitable_attrs".split()
)
"""Column and attribute names that every designator's table or mapped class already has."""

_RESERVED_TABLES = frozenset(
    "event episode process_metadata task_tree_node designator action motion language robot_state pose position"
    " quaternion object object_removal object_part believe_object parameter_item attachment joint_change"
    " location_resolution location_candidate location_refusal detection state_sample simulated_episode designator_type"
    " observation observation_value episode_tag episode_tagging episode_robot"
    " pick_up_with_context_view pickupwithcontextview root_failure recall_block recall_column"
    " object_description concept concept_ancestor object_concept spatial_relation".split()
)
"""The memory's own tables and views, including planned ones."""
_RESERVED_BEGINNINGS = ("pycrorm_", "sqlite_", "pg_")
_OF_A_GENERATION = re.compile(r"__[0-9]+$")

_NAME_LENGTH_MAX = 60
"""Bounds the bytes of a table's or column's public name, because PostgreSQL truncates names to 63 bytes."""
_SHORTENED_TABLE_LENGTH_MAX = 48
"""Bounds the bytes of a shortened table name, so that a generation's prefix and number fit with it into PostgreSQL's
63 bytes (`projections.columns`)."""
_DTYPE_LENGTH_MAX = 255
"""Bounds the bytes of a dtype: longer than real class names, and short enough to quote in a message."""
_BASES_MAX = 32
"""Bounds the recorded ancestors of a type: a mapped class joins all their views, and SQLite joins at most 64."""
_FIELDS_MAX = SLOT_MAX - SLOT_FIRST_FIELD + 1
"""Bounds the fields of a type, because each has a slot of its own."""
_KINDS = ("action", "motion", "language")
_SPECIAL_KINDS = ("pose", "object")
"""Types of fields of which the first is also an attribute with the type's name."""
_SQL_TRUTH_VALUES = ("true", "false")
"""SQLite reads a column of such a name as the truth value, and names it `column1` in a view."""
_WORD_START = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


def table_name(dtype: str) -> str:
    """Return the name of a type's leaf table, which contains the rows of this type but not those of derived types.

    >>> table_name("SayingAction"), table_name("MoveTCPMotion")
    ('saying_action', 'move_tcp_motion')
    """
    return bounded(_WORD_START.sub("_", dtype).lower(), _NAME_LENGTH_MAX, _SHORTENED_TABLE_LENGTH_MAX)


def column_name(field: str, kind: FieldType) -> str:
    """Return the column name of a field of the given type.

    >>> column_name("target", "pose"), column_name("xmin", "real"), column_name("true", "boolean")
    ('target_id', 'xmin', '_true')
    """
    return _mapped_column(f"{field}_id" if kind in ("pose", "object") else field)


def _mapped_column(name: str) -> str:
    if name.lower() in _SQL_TRUTH_VALUES:
        return f"_{name}"
    return bounded(name, _NAME_LENGTH_MAX)


def bounded(name: str, bytes_max: int, shortened_bytes_max: int | None = None) -> str:
    """Return the name, or its beginning and a hash of the whole name if it takes more than `bytes_max` bytes.

    >>> bounded("pose__7_by_time", 63), bounded("a" * 80, 20)
    ('pose__7_by_time', 'aaaaaaa_01285d4c77f1')
    """
    whole = name.encode(errors="backslashreplace")  # half of a surrogate pair is refused where names are checked
    if len(whole) <= bytes_max:
        return name
    digest = hashlib.blake2b(whole, digest_size=6).hexdigest()
    beginning = whole[: (shortened_bytes_max or bytes_max) - len(digest) - 1].decode(errors="ignore")
    return f"{beginning}_{digest}"


def mapped_declaration(declared: DesignatorTypeDeclared) -> DesignatorTypeDeclared:
    """Rename the declaration's columns to names every database accepts; earlier versions declared others."""
    if all(each.column == _mapped_column(each.column) for each in declared.fields):
        return declared
    fields = tuple(msgspec.structs.replace(each, column=_mapped_column(each.column)) for each in declared.fields)
    return msgspec.structs.replace(declared, fields=fields)


def is_reserved(name: str) -> bool:
    """Return whether the memory or the database itself uses this name for a table or view.

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
    """Return the reason why this type cannot have a table, a view and a mapped class; None if it can.

    The hooks check each class before recording it for the first time; readers check each declaration in a log.
    """
    if declared.kind not in _KINDS:
        return f"its kind {declared.kind!r} is not a kind of designator ({', '.join(_KINDS)})"
    if len(declared.bases) > _BASES_MAX:
        return f"it descends from {len(declared.bases)} recorded types, at most {_BASES_MAX} are allowed"
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
            return f"field {field.name!r} is not a valid field name"
        if field.column.lower() != (column := column_name(field.name, field.type)).lower():
            return f"field {field.name!r} has the column {field.column!r}, must be {column!r}"
        if not SLOT_FIRST_FIELD <= field.slot <= SLOT_MAX or slots.setdefault(field.slot, field.name) != field.name:
            return (
                f"field {field.name!r} has the slot {field.slot}, must have one from {SLOT_FIRST_FIELD} to {SLOT_MAX}"
                " that no other field has"
            )
    return None


def fault_in_dtype(dtype: str) -> str | None:
    """Return the reason why a dtype cannot name a class and a table; None if it can.

    Two underscores are reserved: they separate the generation number in the names of generation tables.
    """
    if not dtype.isidentifier() or "__" in dtype:
        return f"its dtype {dtype!r} is not a name (letters, digits and single underscores)"
    if len(dtype.encode()) > _DTYPE_LENGTH_MAX:
        return f"its dtype {dtype[:40]!r}… is longer than {_DTYPE_LENGTH_MAX} bytes"
    return None


def fault_in_table(table: str) -> str | None:
    """Return the reason why a designator's table cannot have this name; None if it can."""
    if is_reserved(table):
        return f"its table would be {table!r}, which the memory itself uses (set another dtype)"
    if not table.isprintable() or not table.strip() or '"' in table:
        return f"its table would be {table!r}, which is not a name (printable characters without quotation marks)"
    if len(table.encode()) > _NAME_LENGTH_MAX:
        return f"its table's name {table!r} is longer than {_NAME_LENGTH_MAX} bytes (set a shorter dtype)"
    return None


def fault_in_fields(fields: Sequence[FieldDeclared]) -> str | None:
    """Return the reason, naming the field, why these fields cannot be columns of one table; None if they can."""
    if len(fields) > _FIELDS_MAX:
        return _too_many(len(fields))
    accepted = AcceptedFields()
    for field in fields:
        if (fault := accepted.fault_in(field)) is not None:
            return fault
        accepted.accept(field)
    return None


def without_reserved_names(fields: Iterable[FieldDeclared]) -> list[FieldDeclared]:
    """Return these fields, with as many `_` behind a reserved name as make it one that no other field has.

    >>> [each.name for each in without_reserved_names([FieldDeclared("kind", "kind", "text", 2)])]
    ['kind_']
    """
    renamed = list(fields)
    taken = set().union(*map(_names, renamed))
    kinds: set[str] = set()
    for index, own in enumerate(renamed):
        field = own
        while (
            _names(field) & RESERVED_COLUMNS
            or any(_is_named(field, kind) and not _is_first(field, kind, kinds) for kind in _SPECIAL_KINDS)
            or (field is not own and _names(field) & taken)
        ):
            name = f"{field.name}_"
            field = msgspec.structs.replace(field, name=name, column=column_name(name, field.type))
        renamed[index] = field
        taken |= _names(field)
        kinds.add(field.type)
    return renamed


class AcceptedFields:
    """The fields that one table has so far; checks each further one alone, so its cost does not grow with their number.

    Attributes:
        count: the number of fields.
    """

    def __init__(self) -> None:
        self.count = 0
        self._owners: dict[str, str] = {}
        self._kinds: set[str] = set()

    def fault_in(self, field: FieldDeclared) -> str | None:
        """Return what `fault_in_fields` returns for the accepted fields followed by this one."""
        if self.count >= _FIELDS_MAX:
            return _too_many(self.count + 1)
        fault = _fault_in_names(field, self._owners)
        if fault is not None:
            return fault
        for kind in _SPECIAL_KINDS:
            if _is_named(field, kind) and not _is_first(field, kind, self._kinds):
                return _misnamed(field.name, kind)
        return None

    def accept(self, field: FieldDeclared) -> None:
        """Add a field in which `fault_in` found no fault."""
        self.count += 1
        self._owners[field.name.lower()] = self._owners[field.column.lower()] = field.name
        self._kinds.add(field.type)


def _too_many(count: int) -> str:
    return f"it has {count} fields, at most {_FIELDS_MAX} are allowed"


def _misnamed(name: str, kind: str) -> str:
    return f"field {name!r}: the name {kind!r} is reserved for the first {kind} field"


def _fault_in_names(field: FieldDeclared, owners: Mapping[str, str]) -> str | None:
    """Return the reason why a field cannot have its name and column beside the names in `owners`, in lower case."""
    names = _names(field)
    reserved = names & RESERVED_COLUMNS
    if reserved:
        return f"field {field.name!r} has a reserved name ({', '.join(sorted(reserved))})"
    if len(field.column.encode()) > _NAME_LENGTH_MAX:
        return f"field {field.name!r} has a name longer than {_NAME_LENGTH_MAX} bytes"
    for name in names:
        if name in owners:
            return f"fields {owners[name]!r} and {field.name!r} would share the name {name!r}"
    return None


def _is_named(field: FieldDeclared, kind: str) -> bool:
    return bool(_names(field) & {kind, f"{kind}_id"})


def _is_first(field: FieldDeclared, kind: str, kinds: Collection[str]) -> bool:
    return field.type == kind and kind not in kinds


def _names(field: FieldDeclared) -> set[str]:
    return {field.name.lower(), field.column.lower()}


# === tags =====================================================================================================
#
# Check the tags of an episode, and apply a change to them. A change is an `EpisodeTagged`.

_CHARACTERS_MAX: Final = 100
"""Bounds a tag, so that a list of tags fits into a line."""
_TAGS_MAX: Final = 100
"""Bounds the tags of one event."""


def checked_tags(tags: object) -> tuple[str, ...]:
    """Return these tags, each once, cleaned as all recorded texts are.

    Raises `CallerError` for one that is not a text of 1 to 100 characters.

    >>> checked_tags(["kitchen", "good", "kitchen"])
    ('kitchen', 'good')
    """
    if isinstance(tags, str) or not isinstance(tags, Iterable):
        raise CallerError(f"tags must be a list of texts, not {tags!r:.100}")
    checked: dict[str, None] = {}
    for tag in tags:
        if not isinstance(tag, str) or not 0 < len(tag.strip()) <= len(tag) <= _CHARACTERS_MAX:
            raise CallerError(f"a tag must be a text of 1 to {_CHARACTERS_MAX} characters, not {tag!r:.110}")
        checked[clean(tag)] = None
    if len(checked) > _TAGS_MAX:
        raise CallerError(f"at most {_TAGS_MAX} tags may be given at once, not {len(checked)}")
    return tuple(checked)


def changed_tags(tags: Iterable[str], added: Iterable[str], removed: Iterable[str]) -> tuple[str, ...]:
    """Return the tags after a change. Raises `CallerError` for a removed tag that the episode does not have.

    >>> changed_tags(("kitchen", "good"), ("night",), ("good",))
    ('kitchen', 'night')
    """
    now, removed = tuple(tags), tuple(removed)
    for tag in removed:
        if tag not in now:
            raise CallerError(f"the episode has no tag {tag!r}; its tags: {', '.join(now) or 'none'}")
    return retagged(now, added, removed)


def retagged(tags: Iterable[str], added: Iterable[str], removed: Collection[str]) -> tuple[str, ...]:
    """Return the tags after a recorded change. A removed tag that the episode does not have is ignored.

    >>> retagged(("kitchen", "good"), ("night",), ("good", "late"))
    ('kitchen', 'night')
    """
    return tuple(dict.fromkeys([*(tag for tag in tags if tag not in removed), *added]))
