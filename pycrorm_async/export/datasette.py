"""Describe a memory for Datasette: hidden tables, meanings and sort orders of views, and the named questions.

    pycrorm datasette-metadata > metadata.json
    datasette -i pycrorm.db --metadata metadata.json

The names of hidden tables carry the number of a generation, so the description is made again after a rebuild.
"""

from __future__ import annotations

import inspect
import re
from typing import Any

from sqlalchemy import LargeBinary
from sqlalchemy import inspect as inspect_database

from pycrorm_async.errors import CallerError
from pycrorm_async.orm.documentation.descriptions import ViewDescription, described
from pycrorm_async.query.asking.ask import QUESTIONS, Ask
from pycrorm_async.query.reading import Reading

_INTERNAL = re.compile(r"zz_.*|.*__\d+|pycrorm_.*|sqlite_stat\d")
"""The tables of a generation, the bookkeeping of the log, and the statistics of SQLite's planner."""
_LOG = {
    "event": "The log: every event with its payload as JSON. All views can be made from it again.",
    "episode": "How far each episode is stored (head) and visible in the views (folded).",
}
"""The tables that no class maps."""
_FACETS = ("dtype", "kind", "status", "reason", "arm", "grasp", "obj_type", "robot", "relation", "source", "recovered")
_FACETS_MAX = 4
"""Datasette counts the values of each facet at every visit."""
_NEWEST = ("id", "node_id", "process_metadata_id", "global_position", "number")
"""Columns by which the newest rows come first, the first that a table has."""
_TIMES = " Times are integers, in µs since 1970-01-01 00:00 UTC, and durations are in s."
_TEXT, _NUMBER = "pycrorm-value-", 200_000_000
"""Placeholders (a text, numbers in m) in a question's SQL that become Datasette parameters."""


async def datasette_metadata(reading: Reading) -> dict[str, Any]:
    """Return the metadata of a SQLite memory, for Datasette 0.65.

    Raises `CallerError` for another database, which Datasette cannot open.
    """
    log = await reading.log()
    if not log.address.is_sqlite:
        raise CallerError(
            f"Datasette opens SQLite files: copy {log.address} with `pycrorm copy --to sqlite:///copy.db`"
        )
    async with log.reading() as connection:
        tables = await connection.run_sync(_columns_by_table)
    views = described()
    return {
        "title": "Episodic memory of robots",
        "description": "The views of a memory of pycrorm-async, and the questions of `pycrorm ask`." + _TIMES,
        "databases": {
            log.address.path.stem: {
                "tables": {
                    name: {"hidden": True} if columns is None else _table(name, columns, views.get(name))
                    for name, columns in tables.items()
                },
                "queries": {name: _query(reading, name) for name in QUESTIONS},
            }
        },
    }


def _columns_by_table(connection: Any) -> dict[str, list[str] | None]:
    """Return the columns of each table and view; None for one to hide.

    Views with bytes are hidden too: Datasette 0.65 answers their pages with an error, because it links a value of bytes
    by its row's key, which no view has.
    """
    inspector = inspect_database(connection)
    tables, views = inspector.get_table_names(sqlite_include_internal=True), inspector.get_view_names()
    columns: dict[str, list[str] | None] = {}
    for name in sorted([*tables, *views]):
        described = inspector.get_columns(name)
        has_bytes = name in views and any(isinstance(each["type"], LargeBinary) for each in described)
        is_hidden = has_bytes or _INTERNAL.fullmatch(name) is not None
        columns[name] = None if is_hidden else [each["name"] for each in described]
    return columns


def _table(name: str, columns: list[str], view: ViewDescription | None) -> dict[str, Any]:
    table: dict[str, Any] = {"description": _LOG[name]} if name in _LOG else {}
    if view is not None:
        table["description"] = view.text
        table["columns"] = {name: text for name, text in view.columns.items() if name in columns}
    newest = next((each for each in _NEWEST if each in columns), None)
    if newest is not None:
        table["sort_desc"] = newest
    facets = [each for each in _FACETS if each in columns][:_FACETS_MAX]
    if facets:
        table["facets"] = facets
    return table


def _query(reading: Reading, name: str) -> dict[str, str]:
    """Return a question as a canned query of Datasette; its required arguments are parameters of the query."""
    parameters = [*inspect.signature(getattr(Ask, name)).parameters.values()][1:]
    needed = {each.name: str(each.annotation) for each in parameters if each.default is each.empty}
    numbers = {each: _NUMBER * (index + 1) for index, each in enumerate(needed) if needed[each] == "float"}
    texts = {each: f"{_TEXT}{each}" for each in needed if each not in numbers}
    sql = getattr(reading.ask, name)(**numbers, **texts).sql
    for each, text in texts.items():
        sql = sql.replace(f"'{text}'", f":{each}")

    def with_parameter(number: re.Match[str]) -> str:
        for each, place in numbers.items():
            if abs(float(number[0]) - place) < _NUMBER / 2:
                return f"(:{each} + {float(number[0]) - place:g})"  # Datasette passes texts: the sum is a number
        return number[0]

    sql = re.sub(r"\b\d{9,}(?:\.\d+)?\b", with_parameter, sql)
    return {"sql": sql, "title": name.replace("_", " "), "description": _first_sentence(getattr(Ask, name))}


def _first_sentence(documented: Any) -> str:
    return " ".join((inspect.getdoc(documented) or "").partition("\n\n")[0].split())
