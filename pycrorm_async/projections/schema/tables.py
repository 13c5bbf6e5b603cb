"""Make the tables of a generation, those that every memory has (`core_columns`) and those of types (`layout`).

Every row names its episode (`process_metadata_id`). Row ids are computed from (episode number, sequence, slot), see
`pycrorm_async.events.ids`: a node, its designator and its leaf row have one id, and so have an object's row and its
pose. Foreign keys are not enforced, because that would cost a third of the write rate; `verify` checks integrity.

The tables can be divided by episode. No row refers to a row of another episode, views and relationships join by id and
episode, and on PostgreSQL the episode is part of every primary key, as a table partitioned by it requires. The id comes
first in the key, so that a lookup by id alone, which is unique in the memory, finds its row as well.

Three kinds of tables are not divided. `pycrorm_link_box` has the boxes of descriptions, each once by its content,
however many episodes use it: a catalogue of which each part needs a copy, as of the declarations. A row of
`recall_block` and `recall_column`, the index of the recall of all episodes, has cases of many of them, and 0 as its
episode. The checkpoints of a projection (`pycrorm_progress`) are keyed by the number of an episode, as `episode` is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Double,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    PrimaryKeyConstraint,
    Table,
    Text,
)
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeEngine

from pycrorm_async.projections.schema.core_columns import CORE, EPISODE, LINK_BOX, OWN, Storage
from pycrorm_async.projections.table_names import index_name, physical_name

_TEXT_KEYS = {
    ("parameter_item", "field"),
    ("joint_change", "joint"),
    ("state_sample", "channel"),
    (LINK_BOX, "model"),
    (f"{OWN}recall_column", "feature"),
    (f"{OWN}recall_column", "kind"),
}

_INDEXED = {
    "episode_tagging": ("process_metadata_id", "tag"),
    "task_tree_node": ("process_metadata_id", "parent_id", "status", "dtype"),
    "pose": ("process_metadata_id",),
    "object": ("process_metadata_id", "identity_id", "obj_type"),
    "object_removal": ("process_metadata_id", "identity_id"),
    "parameter_item": ("process_metadata_id",),
    "attachment": ("process_metadata_id", "child_id"),
    "joint_change": ("process_metadata_id", "object_id"),
    "location_resolution": ("process_metadata_id", "node_id"),
    "location_candidate": ("process_metadata_id",),
    "location_refusal": ("process_metadata_id",),
    "detection": ("process_metadata_id", "node_id"),
    "state_sample": ("process_metadata_id", "node_id"),
    "observation": ("process_metadata_id", "node_id", "name"),
    "observation_value": ("process_metadata_id",),
}

_FURTHER = {("task_tree_node", "dtype"): ("status",)}
"""Further key columns of an index, after its first: learning queries filter the nodes of a type by status."""

_FURTHER_ON_POSTGRESQL = {("task_tree_node", EPISODE): ("id",), ("task_tree_node", "dtype"): ("simulated",)}
"""Key columns that follow on PostgreSQL: plans look nodes up by episode and id, and all views read `simulated`."""

_PICK_UPS = "PickUpAction", ("status", "id"), (EPISODE, "robot_pose_id", "torso_height", "robot", "simulated")
"""An index on PostgreSQL for the nodes of this type alone: its key columns, and columns without being part of the key.
An index-only scan saves `PickUpWithContextView` reading a page for each node, half of the learning query's time."""

_WIDTHS: dict[Storage, int] = {"number": 4, "boolean": 1, "text": 0, "json": 0, "bytes": 0}
"""The bytes to which PostgreSQL aligns a column, 8 for the others. Columns in this order need no bytes in between."""

_ORDER = "order"


def make_table(name: str, columns: dict[str, Storage], generation: int, stored: Callable[[str], str]) -> Table:
    """Return the table with its key and its indexes, in one generation.

    `stored` maps a column of the layout to its name in this database; the table's column keys are those of the layout.
    The latest tables are kept, because the views of all tables are made again whenever one is added.
    """
    return _make_table(name, tuple(columns.items()), generation, stored)


@lru_cache(maxsize=512)
def _make_table(
    name: str, items: tuple[tuple[str, Storage], ...], generation: int, stored: Callable[[str], str]
) -> Table:
    columns = dict(items)
    table = Table(
        physical_name(name, generation),
        MetaData(),
        *(
            Column(
                stored(column),
                Text() if (name, column) in _TEXT_KEYS else column_type(storage),
                nullable=storage != "key",
                autoincrement=False,
                key=column,
            )
            for column, storage in sorted(columns.items(), key=lambda item: -_WIDTHS.get(item[1], 8))
        ),
        info={_ORDER: tuple(columns)},
    )
    if keys := [table.c[column] for column, storage in columns.items() if storage == "key"]:
        table.append_constraint(_Key(*keys))
    for column in indexed(name, columns):
        Index(
            index_name(name, column, generation),
            _IndexKeys(
                *(table.c[each] for each in (column, *_FURTHER.get((name, column), ()))),
                on_postgresql=[table.c[each] for each in _FURTHER_ON_POSTGRESQL.get((name, column), ())],
            ),
        )
    if name == "task_tree_node":
        dtype, key_columns, included = _PICK_UPS
        Index(
            index_name(name, "pick_up", generation),
            *(table.c[each] for each in key_columns),
            postgresql_include=included,
            postgresql_where=table.c.dtype == dtype,
            info={"dialect": "postgresql"},
        )
    return table


def columns_in_order(table: Table) -> list[Column[Any]]:
    """Return the columns in the order of the layout, which is that of the views; the table has the widest first."""
    return [table.c[each] for each in table.info[_ORDER]]


class _IndexKeys(FunctionElement[int]):
    """The key columns of an index."""

    inherit_cache = False

    def __init__(self, *columns: Column[Any], on_postgresql: Sequence[Column[Any]]) -> None:
        super().__init__(*columns, *on_postgresql)
        self.count = len(columns)


@compiles(_IndexKeys)
def _by_dialect(element: _IndexKeys, compiler: Any, **options: Any) -> str:
    columns = list(element.clauses)[: None if compiler.dialect.name == "postgresql" else element.count]
    return ", ".join(compiler.process(each, **options) for each in columns)


class _Key(PrimaryKeyConstraint):
    """A primary key that on PostgreSQL also has the episode, behind the id. On SQLite a single key is the rowid."""


@compiles(_Key, "postgresql")
def _with_episode(key: _Key, compiler: Any, **_options: Any) -> str:
    first, *others = key.columns
    episode = [first.table.c[EPISODE]] if EPISODE in first.table.c else []
    columns = ", ".join(compiler.preparer.format_column(each) for each in (first, *episode, *others))
    # Rows are appended with ascending ids, so a page of the index needs no room, except for nodes that end later.
    filling = "" if "status" in first.table.c else " WITH (fillfactor = 100)"
    return f"PRIMARY KEY ({columns}){filling}"


def leaf_columns(columns: dict[str, Storage]) -> dict[str, Storage]:
    """Return the columns of a leaf table: its key, its episode and those of the layout."""
    return {"id": "key", EPISODE: "number", **columns}


def indexed(name: str, columns: dict[str, Storage]) -> tuple[str, ...]:
    """Return the indexed columns: of a core table those that queries filter and join by, of a leaf its objects."""
    if name in CORE:
        return _INDEXED.get(name, ())
    return tuple(column for column, storage in columns.items() if storage == "object")


def column_type(storage: Storage) -> TypeEngine[Any]:
    """Return the column type. On SQLite only a key declared INTEGER becomes the rowid."""
    match storage:
        case "key":
            return BigInteger().with_variant(Integer(), "sqlite")
        case "row" | "pose" | "object" | "integer" | "time":
            return BigInteger()
        case "number":
            return Integer()
        case "real":
            return Double()
        case "boolean":
            return Boolean()
        case "text" | "json":
            return Text()
        case "bytes":
            return LargeBinary()
