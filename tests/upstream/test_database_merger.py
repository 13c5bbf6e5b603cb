"""PyCRAM's tests of its merging of databases (July 2024), by name; the assertions are those that theirs were meant to
make.

There, three runs of a pick-and-place plan were stored in SQLite and moved to PostgreSQL: the primary keys of the
existing run were shifted until none collided, then every row was inserted. Here no existing row is changed, and copying
twice has the same result as once.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.operations.copy import copy_episodes
from tests.commands import pycrorm
from tests.databases import Server, ask
from tests.plan.conftest import kitchen
from tests.promises.lab import url_of
from tests.table_comparison import Tables, differences, logs_of, tables_of, united
from tests.upstream.conftest import common_plan

pytestmark = pytest.mark.slow

RUNS = 3


@pytest.fixture
async def source(tmp_path: Path) -> str:
    """Three runs of the common plan, each with its own metadata."""
    async with Memory.open(url_of(tmp_path)) as memory:
        for run in range(RUNS):
            with kitchen():
                async with memory.episode(description=f"run {run}"):
                    await common_plan()
    return url_of(tmp_path)


@pytest.fixture
async def destination(server: Server, tmp_path: Path) -> str:
    """A memory with a run of its own, whose rows have the ids of the first run in the source."""
    url = server.new_database()
    opened = Memory.open(url, spool=tmp_path / "spool")
    async with opened as memory, memory.episode(description="was here before"):
        with kitchen():
            await common_plan()
    return url


def assert_holds(destination: str, source: Tables, before: Tables) -> None:
    """Assert that every table has all rows of the source, and all that it had before."""
    tables_before = tables_of(destination)
    for table, rows in source.items():
        assert rows.items() <= tables_before[table].items(), table
    assert differences(tables_before, united(source, before)) == []


async def test_merge_databases(source: str, destination: str) -> None:
    same_ids = "SELECT id FROM pose WHERE process_metadata_id = 1 ORDER BY id"
    assert ask(source, same_ids) == ask(destination, same_ids)
    rows, before = tables_of(source), tables_of(destination)
    for _ in range(2):
        await copy_episodes(source, destination)
        assert_holds(destination, rows, before)
    described = ask(destination, "SELECT description FROM process_metadata ORDER BY description")
    assert described == [("run 0",), ("run 1",), ("run 2",), ("was here before",)]
    assert tables_of(source) == rows


async def test_migrate_neems(source: str, destination: str, tmp_path: Path) -> None:
    rows, before, log = tables_of(source), tables_of(destination), logs_of(destination)
    for _ in range(2):
        done = pycrorm("copy", "--from", source, "--to", destination, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        assert_holds(destination, rows, before)
    assert logs_of(destination) == log | logs_of(source)
