"""The metadata for Datasette: hidden tables, described views, and queries that SQLite answers."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.export.export import datasette_metadata
from pycrorm_async.orm import RootFailure
from pycrorm_async.query.questions import QUESTIONS
from tests.commands import pycrorm
from tests.databases import Server

WITH_BYTES = {"recall_column"}
"""The views with a column of bytes, whose pages Datasette answers with an error."""


@pytest.fixture
async def described(reading: Reading) -> dict[str, Any]:
    """Return the description of the one database."""
    metadata = await datasette_metadata(reading)
    assert [*metadata["databases"]] == ["pycrorm"]
    database: dict[str, Any] = metadata["databases"]["pycrorm"]
    return database


async def test_internal_tables_are_hidden_and_views_are_described_sorted_and_faceted(
    described: dict[str, Any], kitchen: Path
) -> None:
    tables = described["tables"]
    with contextlib.closing(sqlite3.connect(kitchen / "pycrorm.db")) as plain:
        names = dict(plain.execute("SELECT name, type FROM sqlite_master WHERE type IN ('table', 'view')").fetchall())
    assert tables.keys() == names.keys()
    shown = {name for name, each in tables.items() if not each.get("hidden")}
    assert {name for name in shown if names[name] == "table"} == {"event", "episode"}
    assert {name for name in names if names[name] == "view"} - shown == WITH_BYTES
    columns = tables["root_failure"].pop("columns")
    assert columns["message"] == "its message"
    assert columns["start_time"] == "µs since 1970-01-01 00:00 UTC"
    assert tables["root_failure"] == {
        "description": " ".join((RootFailure.__doc__ or "").partition("\n\n")[0].split()),
        "sort_desc": "id",
        "facets": ["dtype", "status", "reason", "arm"],
    }


async def test_every_question_is_a_query_with_parameters_for_what_it_needs(
    described: dict[str, Any], kitchen: Path
) -> None:
    queries = described["queries"]
    assert queries.keys() == {*QUESTIONS}
    given = {"name": "Milk", "x": "0.7", "y": "0.55"}
    with contextlib.closing(sqlite3.connect(f"file:{kitchen}/pycrorm.db?mode=ro", uri=True)) as plain:
        rows = {name: plain.execute(each["sql"], given).fetchall() for name, each in queries.items()}
    assert len(rows["episodes"]) == 4
    assert len(rows["root_failures"]) == 2
    for name, words in (("object_history", ":name"), ("moves_of", ":name"), ("experience_at", ":x")):
        assert words in queries[name]["sql"]
        assert rows[name]


async def test_a_server_is_refused(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    async with Memory.open(url, spool=tmp_path), Reading.open(url) as reading:
        with pytest.raises(CallerError, match="Datasette opens SQLite files: copy"):
            await datasette_metadata(reading)


@pytest.mark.slow
def test_the_command_prints_the_metadata(kitchen: Path) -> None:
    done = pycrorm("datasette-metadata", cwd=kitchen)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["databases"].keys() == {"pycrorm"}
