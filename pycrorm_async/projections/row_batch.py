"""Collect the rows of one batch of events: those to insert, and changes to rows that the tables contain already.

A node that starts and ends in one batch is one row to insert. Rows are tuples in the order of `columns`. Until
the batch is complete later events change the rows of nodes and episodes, which are lists and dicts.
"""

from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from operator import itemgetter
from types import MappingProxyType
from typing import Any, Final, NamedTuple, Self, TypeAlias

import msgspec

from pycrorm_async.bulk_records import make
from pycrorm_async.events.codec import short_name
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX, row_id, row_key
from pycrorm_async.events.types import (
    BLOB_KEY,
    LOSES_OPEN_NODES,
    DesignatorTypeDeclared,
    FieldDeclared,
    NodeStarted,
    ObjectReference,
    ObjectValue,
    Observed,
    PoseReference,
    PoseValue,
    is_missing,
)
from pycrorm_async.projections.columns import COLUMNS, EPISODE, Union
from pycrorm_async.store.stored import StoredEvent

Row: TypeAlias = tuple[Any, ...]

_EPISODE_COLUMNS = itemgetter(*COLUMNS["process_metadata"])
_NODE_COLUMNS: Final = COLUMNS["task_tree_node"]
STATUS: Final = _NODE_COLUMNS.index("status")
"""The place of the status in a node's row."""
_NODE_EPISODE: Final = _NODE_COLUMNS.index(EPISODE)
_END_NS: Final = _NODE_COLUMNS.index("end_ns")
_END_SEQUENCE: Final = _NODE_COLUMNS.index("end_sequence")
_OUTCOME: Final = slice(_NODE_COLUMNS.index("reason"), _NODE_COLUMNS.index("result") + 1)
NO_OUTCOME: Final[Row] = (None, None, None, None, None)
"""The columns reason to result of a node that has not failed and has no result."""


class NodeEnd(NamedTuple):
    """The columns that the end of a node sets in its row."""

    id: int
    status: str
    end_ns: int | None
    end_sequence: int | None
    reason: str | None
    failure_message: str | None
    failure_arguments: str | None
    failure_node_id: int | None
    result: str | None


class EpisodeEnd(NamedTuple):
    """The columns that the end of an episode sets in its row."""

    id: int
    status: str
    end_ns: int
    end_sequence: int
    failure_type: str | None
    failure_message: str | None
    continued_in: str | None
    entered_world: str | None


assert NodeEnd._fields == ("id", "status", "end_ns", "end_sequence", *_NODE_COLUMNS[_OUTCOME])


class Rows:
    """The rows of one batch.

    Attributes:
        nodes, episodes: rows to insert, by id.
        inserts: rows to insert into the other core tables, by table.
        leaves: rows to insert into leaf tables, by (table, columns).
        descriptions: fingerprints of the descriptions of added objects.
        node_ends, episode_ends: updates of rows that an earlier batch inserted.
        lost: numbers of the episodes whose nodes that are RUNNING in the tables become LOST.
    """

    def __init__(self) -> None:
        self.nodes: dict[int, list[Any]] = {}
        self.episodes: dict[int, dict[str, Any]] = {}
        self.inserts: dict[str, list[Row]] = {table: [] for table in COLUMNS}
        self.leaves: dict[tuple[str, tuple[str, ...]], list[Row]] = {}
        self.descriptions: set[str] = set()
        self.node_ends: list[NodeEnd] = []
        self.episode_ends: list[EpisodeEnd] = []
        self.lost: list[int] = []

    def end_node(
        self,
        node: int,
        status: str,
        end_ns: int | None,
        end_sequence: int | None,
        outcome: Row,
    ) -> None:
        """Set the end of a node's row, in this batch or in the tables. `outcome`: the columns reason to result."""
        row = self.nodes.get(node)
        if row is None:
            self.node_ends.append(make(NodeEnd, (node, status, end_ns, end_sequence, *outcome)))
            return
        row[STATUS] = status
        row[_END_NS] = end_ns
        row[_END_SEQUENCE] = end_sequence
        row[_OUTCOME] = outcome

    def end_episode(self, end: EpisodeEnd) -> None:
        """Set the end of an episode's row, in this batch or in the tables."""
        row = self.episodes.get(end.id)
        if row is None:
            self.episode_ends.append(end)
        else:
            row.update(end._asdict())
        if end.status in LOSES_OPEN_NODES:
            self.lost.append(end.id)
            for node in self.nodes.values():
                if node[_NODE_EPISODE] == end.id and node[STATUS] == "RUNNING":
                    node[STATUS] = "LOST"

    def to_insert(self) -> dict[tuple[str, tuple[str, ...]], list[Row]]:
        """Return all rows to insert, by (table, columns)."""
        self.inserts["task_tree_node"] = list(map(tuple, self.nodes.values()))
        self.inserts["process_metadata"] = list(map(_EPISODE_COLUMNS, self.episodes.values()))
        core = {(table, COLUMNS[table]): rows for table, rows in self.inserts.items()}
        to_insert = {key: rows for key, rows in (core | self.leaves).items() if rows}
        for (table, columns), rows in to_insert.items():
            assert len(rows[0]) == len(columns), f"a row of {table} has {len(rows[0])} values, not {len(columns)}"
        return to_insert


# === column values ============================================================================================
#
# Convert recorded values into column values, by the declared type of their field.
#
# A value of another type, or one that refers to an impossible row, raises `CannotFold`.

_ROWS_OF_EPISODE, _ROWS_OF_EVENT = row_id(1, 0, 0), row_id(0, 1, 0)
POSE_COLUMNS = "x y z qx qy qz qw frame"
"""The columns of a pose, in the order of `pose_columns`."""
assert " ".join(COLUMNS["pose"]) == f"id process_metadata_id {POSE_COLUMNS} time", "`pose_row` has another order"
OBJECT_COLUMNS = "id process_metadata_id dtype name obj_type pose_id part_of_id identity_id time node_id"
"""The columns that every row of an object's state has; those behind them only the first row of an object has."""
NOT_FIRST: Row = (None,) * (len(COLUMNS["object"]) - len(OBJECT_COLUMNS.split()))
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)
_SCALARS: dict[str, tuple[type, ...]] = {
    "integer": (int,),
    "real": (float, int),
    "text": (str,),
    "enum": (str,),
    "boolean": (bool,),
}

AS_IT_IS: Mapping[str, type] = {kind: types[0] for kind, types in _SCALARS.items()}
"""The Python type whose values are stored unchanged, by field type."""


class CannotFold(ValueError):
    """The fold cannot make rows of an event; the message gives the reason."""


def row_of(number: int, sequence: int) -> int:
    """Return the id of the row of an event. Raises `CannotFold` for a sequence out of range."""
    if 0 < sequence <= SEQUENCE_MAX:
        return number * _ROWS_OF_EPISODE + sequence * _ROWS_OF_EVENT  # `row_id` without its repeated checks
    raise CannotFold(f"no row can have the sequence {sequence} and the slot 0")


def in_slot(own: int, slot: int) -> int:
    """Return the id of another row of the event that made row `own`. Raises `CannotFold` for a slot out of range."""
    if 0 <= slot <= SLOT_MAX:
        return own + slot
    raise CannotFold(f"no row can have the sequence {row_key(own).sequence} and the slot {slot}")


def microseconds(nanoseconds: int) -> int:
    """Convert a time to the unit of the columns."""
    return nanoseconds // 1000


def pose_columns(pose: PoseValue) -> tuple[float, float, float, float, float, float, float, str]:
    """Return the columns x to qw and frame."""
    return (*pose.position, *pose.orientation, pose.frame)


def pose_row(own: int, number: int, pose: PoseValue) -> Row:
    """Return the row of `pose` with the id `own`, in the episode `number`."""
    x, y, z = pose.position
    qx, qy, qz, qw = pose.orientation
    return own, number, x, y, z, qx, qy, qz, qw, pose.frame, pose.time_ns // 1000


def scalar(field: FieldDeclared, kind: str, value: Any) -> Any:
    """Convert a value for a column of type `kind`. Raises `CannotFold` for a value of another type."""
    if kind == "datetime":
        try:
            return (datetime.fromisoformat(value) - _EPOCH) // _MICROSECOND
        except (TypeError, ValueError):
            raise CannotFold(f"{field.name}: {_shortened(value)} is not of the declared type datetime") from None
    if not isinstance(value, _SCALARS[kind]) or (isinstance(value, bool) and kind != "boolean"):
        raise CannotFold(f"{field.name}: {_shortened(value)} is not of the declared type {kind}")
    return float(value) if isinstance(value, int) and kind == "real" else value


def pose_of(field: FieldDeclared, value: Any) -> PoseValue:
    try:
        return msgspec.convert(value, PoseValue)
    except msgspec.ValidationError as error:
        raise CannotFold(f"{field.name}: not a pose: {error}") from None


def object_of(field: FieldDeclared, value: Any) -> ObjectReference | ObjectValue:
    try:
        if isinstance(value, dict) and "row" in value:
            return msgspec.convert(value, ObjectReference)
        return msgspec.convert(value, ObjectValue)
    except msgspec.ValidationError as error:
        raise CannotFold(f"{field.name}: not an object: {error}") from None


def json_text(value: Any) -> str:
    """Encode a value as the JSON text of a column."""
    return msgspec.json.encode(value).decode()


def _shortened(value: Any) -> str:
    return repr(value)[:80]


# === observed values ==========================================================================================
#
# Flatten the values of an observation into rows: one for each scalar and each blob, with its path as key.

WHOLE: Final = "value"
"""Key of an observation that is a scalar or a blob itself, and so has no path."""


def value_rows(observed: Observed) -> Iterator[Row]:
    """Yield the columns key to missing of each value, in order.

    >>> [row[:3] for row in value_rows(Observed("force", {"x": 1.5, "of": ["arm"]}))]
    [('x', 1.5, None), ('of.0', None, 'arm')]
    """
    return _rows("", observed.values, observed.missing)


def _rows(path: str, value: Any, missing: dict[str, str]) -> Iterator[Row]:
    if isinstance(value, dict) and BLOB_KEY not in value:
        for key, each in value.items():
            yield from _rows(f"{path}.{key}" if path else key, each, missing)
    elif isinstance(value, list):
        for index, each in enumerate(value):
            yield from _rows(f"{path}.{index}" if path else str(index), each, missing)
    else:
        yield (path or WHOLE, *_columns(value), missing.get(path))


def _columns(value: Any) -> Row:
    """Return number, text, truth, blob, media_type and size."""
    if isinstance(value, bool):
        return None, None, value, None, None, None
    if isinstance(value, str):
        return None, value, None, None, None, None
    if isinstance(value, dict):
        return None, None, None, value[BLOB_KEY], value.get("media_type"), value.get("size")
    return float(value) if value is not None else None, None, None, None, None, None


# === parameters ===============================================================================================
#
# Fold a node's parameters: one row in its leaf table, and rows for poses, objects and list entries.

_NO_POSE = (None,) * 8
_ITEM_SCALARS = {"integer": 0, "real": 1, "text": 2, "enum": 2, "boolean": 3, "datetime": 4}

ParameterRows: TypeAlias = list[tuple[str, Row]]
"""Rows of tables other than the leaf table, each with its table."""


class DesignatorFold:
    """Folds the parameters of the nodes of one declaration.

    `own_names` are the names under which events have the values of renamed fields, by the fields' names.

    Attributes:
        kind: the kind of its nodes; earlier versions recorded the value of a field `kind` as the kind of a node.
        leaf: the leaf table and its columns.
    """

    def __init__(self, declared: DesignatorTypeDeclared, own_names: Mapping[str, str] = MappingProxyType({})) -> None:
        columned = [each for each in declared.fields if each.type not in ("list", "dict")]
        self.dtype, self.kind = declared.dtype, declared.kind
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
    """The folds of all declared designator types, by their short names.

    `declarations` and `refused`, the reasons why nodes cannot be folded, are by fingerprint.
    """

    def __init__(
        self,
        declarations: Mapping[str, DesignatorTypeDeclared] | None = None,
        refused: Mapping[str, str] | None = None,
        own_names: Mapping[str, Mapping[str, str]] = MappingProxyType({}),
    ) -> None:
        self._refused = {short_name(name): reason for name, reason in (refused or {}).items()}
        named = {short_name(name): (each, own_names.get(name, {})) for name, each in (declarations or {}).items()}
        self._folds = {name: DesignatorFold(*each) for name, each in named.items() if name not in self._refused}

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
    if (reference := PoseReference.of(value)) is not None:
        return in_slot(row_of(event.number, reference.pose_of), reference.slot)
    pose = pose_of(field, value)
    own = in_slot(node, field.slot)
    others.append(("pose", pose_row(own, event.number, pose)))
    return own


def _object(event: StoredEvent, node: int, field: FieldDeclared, recorded: Any, others: ParameterRows) -> int:
    """Return the current row of a world object; add a row in the field's slot for an object outside the world."""
    value = object_of(field, recorded)
    if isinstance(value, ObjectReference):
        return row_of(event.number, value.row)
    own = in_slot(node, field.slot)
    if value.pose is not None:
        others.append(("pose", pose_row(own, event.number, value.pose)))
    pose_id = own if value.pose is not None else None
    part_of = row_of(event.number, value.part_of.row) if value.part_of is not None else None
    number, time = event.number, microseconds(event.wall_ns)
    columns = (own, number, value.dtype, value.name, value.object_type, pose_id, part_of, None, time, node)
    others.append(("object", (*columns, *NOT_FIRST)))
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
        entry = object_of(field, value)
        if isinstance(entry, ObjectReference):
            return (*scalars, *_NO_POSE, row_of(event.number, entry.row), None, None)
        pose = pose_columns(entry.pose) if entry.pose is not None else _NO_POSE
        return (*scalars, *pose, None, entry.name, entry.object_type)
    scalars[_ITEM_SCALARS[item]] = scalar(field, item, value)
    return (*scalars, *_NO_POSE, None, None, None)
