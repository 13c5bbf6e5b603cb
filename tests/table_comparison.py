"""Read the content of a memory with plain SQL, in a form that can be compared across databases.

Each database assigns its own episode numbers, and row ids contain them. Here an episode is a UUID and a row is
(UUID, sequence, slot), in every id column. NULL is left out, so that a table with an additional column, which
another episode's declaration added, compares as equal.

>>> differences(tables_of("sqlite:///merged.db"), united(tables_of("sqlite:///a.db"), tables_of("sqlite:///b.db")))
[]
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

from tests.databases import ask, ask_each

__all__ = ["Tables", "Logs", "tables_of", "logs_of", "declarations_of", "united", "differences"]

Key: TypeAlias = tuple[Any, ...]
Tables: TypeAlias = dict[str, dict[Key, dict[str, Any]]]
"""Values of the columns by table and by key. The key of most is one (UUID, sequence, slot)."""
Logs: TypeAlias = dict[str, list[tuple[Any, ...]]]
"""Lists of (sequence, type, version, wall ns, monotonic ns, payload) of every event, by the UUID of the episode."""

_KEYS = {
    "parameter_item": ("node_id", "field", "position"),
    "joint_change": ("id", "joint"),
    "location_candidate": ("resolution_id", "position"),
    "location_refusal": ("resolution_id", "position"),
    "detection": ("id", "position"),
    "observation_value": ("id", "position"),
    "episode_tagging": ("id", "position"),
    "state_sample": ("id", "channel"),
}
_OF_EPISODES = ("process_metadata", "simulated_episode")
_IDS = ("key", "row", "pose", "object")
"""The name of an id column in the layout of the tables of designator types."""

_SHOWN = "SELECT generation, layout FROM {}pycrorm_generation WHERE projection = 'tables'"
_COLUMNS_SQLITE = """
SELECT each.name, part.name FROM sqlite_master AS each JOIN pragma_table_info(each.name) AS part
WHERE each.type = 'table' ORDER BY each.name, part.cid"""
_COLUMNS_POSTGRESQL = """
SELECT table_name::text, column_name::text FROM information_schema.columns JOIN information_schema.tables
USING (table_schema, table_name) WHERE table_schema = 'memory_tables' AND table_type = 'BASE TABLE'
ORDER BY table_name, ordinal_position"""


def tables_of(place: str | Path) -> Tables:
    """Return the rows of the visible tables that have any. `place` is a URL, or a SQLite file's path."""
    episodes = dict(ask(place, "SELECT number, id FROM episode"))
    on_server = str(place).startswith("postgresql:")
    schema = "memory_tables." if on_server else ""
    [(generation, layout)] = ask(place, _SHOWN.format(schema))
    leaves = json.loads(layout)["leaves"]
    columns: dict[str, list[str]] = {}
    for physical, column in ask(place, _COLUMNS_POSTGRESQL if on_server else _COLUMNS_SQLITE):
        name, mark, number = physical.rpartition("__")
        if mark and number == str(generation) and "pycrorm_" not in name:
            columns.setdefault(physical, []).append(column)
    queries = []
    for physical, each in columns.items():
        listed = ", ".join(f'"{column}"' for column in each)
        queries.append(f'SELECT {listed} FROM {schema}"{physical}"')
    result: Tables = {}
    for (physical, each), rows in zip(columns.items(), ask_each(place, queries), strict=True):
        name = physical.removesuffix(f"__{generation}").removeprefix("zz_")
        result[name] = _rows(name, rows, each, leaves.get(name), episodes)
    return {name: rows for name, rows in result.items() if rows}


def _rows(
    name: str,
    values_of_rows: list[Any],
    columns: list[str],
    leaf: Mapping[str, str] | None,
    episodes: Mapping[int, str],
) -> dict[Key, dict[str, Any]]:
    keys = _KEYS.get(name, ("id",))
    rows: dict[Key, dict[str, Any]] = {}
    for values in values_of_rows:
        row = {
            column: _portable(name, column, leaf, value, episodes)
            for column, value in zip(columns, values, strict=True)
            if value is not None
        }
        key = tuple(row.pop(column) for column in keys)
        assert key not in rows, f"{name} has two rows {key}"
        rows[key] = row
    return rows


def _portable(name: str, column: str, leaf: Mapping[str, str] | None, value: Any, episodes: Mapping[int, str]) -> Any:
    if column == "process_metadata_id" or (name in _OF_EPISODES and column == "id"):
        return episodes[value]
    is_id = column == "id" or leaf[column] in _IDS if leaf is not None else column == "id" or column.endswith("_id")
    if not is_id:
        return value
    number, rest = divmod(value, 2**31)
    return (episodes[number], *divmod(rest, 2**5))


def logs_of(place: str | Path) -> Logs:
    """Return every event of every episode, in the order of its episode."""
    result: Logs = {}
    for identity, *event in ask(
        place,
        "SELECT id, sequence, type, version, wall_ns, monotonic_ns, payload FROM episode JOIN event ON episode = number"
        " ORDER BY number, sequence",
    ):
        result.setdefault(identity, []).append(tuple(event))
    return result


def declarations_of(place: str | Path) -> set[tuple[str, str]]:
    """Return fingerprint and payload of every designator type in the log."""
    return {(name, payload) for name, payload in ask(place, "SELECT fingerprint, payload FROM pycrorm_declaration")}


def united(*memories: Tables) -> Tables:
    """Return the content of a memory that holds all of these. Values that two of them have under one key must be the
    same.
    """
    whole: Tables = {}
    for tables in memories:
        for name, rows in tables.items():
            there = whole.setdefault(name, {})
            for key, row in rows.items():
                assert there.setdefault(key, row) == row, f"{name} {key}: {there[key]} and {row}"
    return whole


def differences(one: Tables, other: Tables) -> list[str]:
    """Return a line for each row that only one of them has, or that differs; none if they hold the same."""
    return [
        f"{name} {key}: {one.get(name, {}).get(key)} and {other.get(name, {}).get(key)}"
        for name in sorted(one.keys() | other.keys())
        for key in sorted(one.get(name, {}).keys() | other.get(name, {}).keys(), key=repr)
        if one.get(name, {}).get(key) != other.get(name, {}).get(key)
    ]
