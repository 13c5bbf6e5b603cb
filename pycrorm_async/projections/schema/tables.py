"""Define the tables that every memory has, column by column; `layout` adds those of designator types.

Every row names its episode (`process_metadata_id`). Row ids are computed from (episode number, sequence, slot), see
`pycrorm_async.events.ids`: a node, its designator and its leaf row have one id, and so have an object's row and its
pose. Foreign keys are not enforced, because that would cost a third of the write rate; `verify` checks integrity.

The tables can be divided by episode. No row refers to a row of another episode, views and relationships join by id and
episode, and on PostgreSQL the episode is part of every primary key, as a table partitioned by it requires. The id comes
first in the key, so that a lookup by id alone, which is unique in the memory, finds its row as well.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal, TypeAlias

from sqlalchemy import BigInteger, Boolean, Column, Double, Index, Integer, MetaData, PrimaryKeyConstraint, Table, Text
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeEngine

from pycrorm_async.projections.table_names import index_name, physical_name

__all__ = [
    "Storage",
    "EPISODE",
    "OWN",
    "CORE",
    "LINK_BOX",
    "OF_NO_EPISODE",
    "COLUMNS",
    "leaf_columns",
    "make_table",
    "column_type",
    "indexed",
]

Storage: TypeAlias = Literal["key", "row", "pose", "object", "integer", "real", "text", "boolean", "time", "json"]
"""The storage of a column: part of the key, the id of a row (of `pose`, of `object`), a scalar, µs since 1970, JSON."""

OWN = "pycrorm_own_"
"""The prefix of the tables of custom projections, so that they never collide with the table of a designator."""
EPISODE = "process_metadata_id"
"""The column that names the episode of a row. In `process_metadata` and `simulated_episode` it is `id`."""

_POSE: dict[str, Storage] = {
    "x": "real",
    "y": "real",
    "z": "real",
    "qx": "real",
    "qy": "real",
    "qz": "real",
    "qw": "real",
    "frame": "text",
}

_ROW: dict[str, Storage] = {"id": "key", "process_metadata_id": "row"}
_ITEM: dict[str, Storage] = {"id": "key", "position": "key", "process_metadata_id": "row"}

CORE: dict[str, dict[str, Storage]] = {
    "process_metadata": {
        "id": "key",
        "created_at": "time",
        "created_by": "text",
        "description": "text",
        "version": "text",
        "host": "text",
        "python": "text",
        "plan": "text",
        "world": "text",
        "seed": "integer",
        "status": "text",
        "ended_at": "time",
        "end_sequence": "integer",
        "failure_type": "text",
        "failure_message": "text",
        "simulated": "boolean",
        "thought_by": "text",
        "thought_by_node": "integer",
        "continues": "text",
        "continued_in": "text",
        "plan_sha256": "text",
        "git_commit": "text",
        "git_dirty": "boolean",
        "libraries": "json",
        "settings": "json",
        "clock_synchronized": "boolean",
        "clock_error_us": "integer",
        "entered_world": "text",
        "metadata": "json",
    },
    "episode_tagging": {
        **_ITEM,
        "tag": "text",
        "added": "boolean",
        "time": "time",
    },
    "simulated_episode": {"id": "key"},
    "task_tree_node": {
        **_ROW,
        "parent_id": "row",
        "kind": "text",
        "dtype": "text",
        "status": "text",
        "start_time": "time",
        "end_time": "time",
        "start_ns": "integer",
        "end_ns": "integer",
        "end_sequence": "integer",
        "reason": "text",
        "failure_message": "text",
        "failure_arguments": "json",
        "result": "json",
        "robot_pose_id": "pose",
        "torso_height": "real",
        "robot_type": "text",
        "robot_object_id": "object",
        "robot": "text",
        "simulated": "boolean",
        "parameters": "json",
    },
    "pose": {"id": "key", "process_metadata_id": "row", **_POSE, "time": "time"},
    "object": {
        **_ROW,
        "dtype": "text",
        "name": "text",
        "obj_type": "text",
        "pose_id": "pose",
        "part_of_id": "object",
        "identity_id": "object",
        "time": "time",
        "node_id": "row",
        "joints": "json",
        "description_fingerprint": "text",
        "color": "json",
        "model": "text",
        "serial": "text",
        "mass_kg": "real",
        "base_link": "text",
    },
    "object_removal": {
        **_ROW,
        "object_id": "object",
        "identity_id": "object",
        "time": "time",
        "node_id": "row",
    },
    "parameter_item": {
        "node_id": "key",
        "field": "key",
        "position": "key",
        "process_metadata_id": "row",
        "key": "text",
        "integer": "integer",
        "real": "real",
        "text": "text",
        "boolean": "boolean",
        "time": "time",
        **_POSE,
        "object_id": "object",
        "object_name": "text",
        "obj_type": "text",
    },
    "attachment": {
        **_ROW,
        "kind": "text",
        "parent_id": "object",
        "child_id": "object",
        "link": "text",
        "time": "time",
        "node_id": "row",
    },
    "joint_change": {
        "id": "key",
        "joint": "key",
        "process_metadata_id": "row",
        "object_id": "object",
        "position": "real",
        "time": "time",
        "node_id": "row",
    },
    "location_resolution": {
        **_ROW,
        "node_id": "row",
        "location": "text",
        "considered": "integer",
        "offered": "integer",
        "taken": "integer",
        "pose_id": "pose",
        "time": "time",
    },
    "location_candidate": {
        "resolution_id": "key",
        "position": "key",
        "process_metadata_id": "row",
        **_POSE,
        "arms": "text",
        "taken": "boolean",
        "grasp": "text",
        "torso_height": "real",
    },
    "location_refusal": {
        "resolution_id": "key",
        "position": "key",
        "process_metadata_id": "row",
        **_POSE,
        "reason": "text",
    },
    "detection": {
        **_ITEM,
        "node_id": "row",
        "source": "text",
        "looked_for": "text",
        "object_id": "object",
        "name": "text",
        "obj_type": "text",
        **_POSE,
        "visible": "real",
        "confidence": "real",
        "time": "time",
    },
    "state_sample": {
        "id": "key",
        "channel": "key",
        "process_metadata_id": "row",
        "object_id": "object",
        "node_id": "row",
        "value": "real",
        "time": "time",
        "ns": "integer",
    },
    "observation": {
        **_ROW,
        "node_id": "row",
        "name": "text",
        "time": "time",
        "ns": "integer",
    },
    "observation_value": {
        **_ITEM,
        "key": "text",
        "number": "real",
        "text": "text",
        "truth": "boolean",
        "blob": "text",
        "media_type": "text",
        "size": "integer",
        "missing": "text",
    },
}
"""The columns of each table, in the order in which the fold writes their values.

`simulated_episode` has no view. It repeats the ids of simulations, so that every view can exclude their rows by a
lookup in a small table that consists of its key only.
"""

LINK_BOX = "pycrorm_link_box"
OF_NO_EPISODE: dict[str, dict[str, Storage]] = {
    LINK_BOX: {
        "model": "key",
        "position": "key",
        "link": "text",
        "joint": "text",
        **{f"{letter}{axis}": "real" for letter in "cha" for axis in "xyz"},
    },
}
"""Columns of the table of the boxes around the links of descriptions, which belong to no episode; it has no view.

A box has the fingerprint of its description as `model`, its centre, half of its edges, and the direction in which its
joint slides it; in m, in the frame of the root link.
"""

COLUMNS = {table: tuple(columns) for table, columns in CORE.items()}

_TEXT_KEYS = {
    ("parameter_item", "field"),
    ("joint_change", "joint"),
    ("state_sample", "channel"),
    (LINK_BOX, "model"),
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

_SECOND_COLUMNS = {("task_tree_node", "dtype"): ("status",)}
"""Further key columns of an index, after its first: learning queries filter the nodes of a type by status."""

_INCLUDES = {("task_tree_node", "dtype"): ("id", "robot_pose_id", "torso_height", "robot", "simulated")}
"""Columns stored in PostgreSQL's index without being part of its key. An index-only scan saves reading a page for each
node, so the learning query over 50,000 pick-ups takes some 70 ms instead of 100."""


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
            for column, storage in columns.items()
        ),
    )
    if keys := [table.c[column] for column, storage in columns.items() if storage == "key"]:
        table.append_constraint(_Key(*keys))
    for column in indexed(name, columns):
        Index(
            index_name(name, column, generation),
            *(
                [_EpisodeThenId(table.c[EPISODE], table.c.id)]
                if (name, column) == ("task_tree_node", EPISODE)
                else (table.c[each] for each in (column, *_SECOND_COLUMNS.get((name, column), ())))
            ),
            postgresql_include=_INCLUDES.get((name, column), ()),
        )
    return table


class _EpisodeThenId(FunctionElement[int]):
    """The key of the index of nodes by episode, on PostgreSQL with the id, because plans look nodes up by it."""

    inherit_cache = True


@compiles(_EpisodeThenId)
def _by_dialect(element: _EpisodeThenId, compiler: Any, **options: Any) -> str:
    columns = list(element.clauses)[: None if compiler.dialect.name == "postgresql" else 1]
    return ", ".join(compiler.process(each, **options) for each in columns)


class _Key(PrimaryKeyConstraint):
    """A primary key that on PostgreSQL also has the episode, behind the id. On SQLite a single key is the rowid."""


@compiles(_Key, "postgresql")
def _with_episode(key: _Key, compiler: Any, **_options: Any) -> str:
    first, *others = key.columns
    episode = [first.table.c[EPISODE]] if EPISODE in first.table.c else []
    return f"PRIMARY KEY ({', '.join(compiler.preparer.format_column(each) for each in (first, *episode, *others))})"


def leaf_columns(columns: dict[str, Storage]) -> dict[str, Storage]:
    """Return the columns of a leaf table: its key, its episode and those of the layout."""
    return {"id": "key", EPISODE: "row", **columns}


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
        case "real":
            return Double()
        case "boolean":
            return Boolean()
        case "text" | "json":
            return Text()
