"""The owner of a memory on PostgreSQL makes its roles by one command, and goes on recording, folding and querying."""

from __future__ import annotations

import asyncio
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pycrorm_async.memory import Memory
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.query.reading import Reading
from tests.commands import answer, pycrorm
from tests.databases import Server, change_each
from tests.query.read_only_queries import login

pytestmark = pytest.mark.slow


async def test_the_owner_makes_the_roles_by_one_command_and_goes_on_working(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    database = urlsplit(url).path.removeprefix("/")
    change_each(
        url, [f"CREATE ROLE lab_{database} LOGIN CREATEROLE", f"ALTER DATABASE {database} OWNER TO lab_{database}"]
    )
    owner = server.url(database, user=f"lab_{database}")
    for number, each in enumerate((url, owner)):
        is_superuser = number == 0
        if not is_superuser:
            change_each(url, [f"DROP SCHEMA {name} CASCADE" for name in ("memory", "memory_tables", "pycrorm")])
        await _record(each, tmp_path / f"spool{number}")
        refused = await asyncio.to_thread(pycrorm, "query", "SELECT 1", "--url", each, cwd=tmp_path)
        assert (refused.returncode, "run `pycrorm roles --create` once" in refused.stderr) == (2, True)
        if not is_superuser:  # another database's owner made the roles of this server
            change_each(
                url, [f"GRANT pycrorm_{name} TO lab_{database} WITH ADMIN OPTION" for name in ("reader", "recorder")]
            )
        for _ in range(2):
            made = await asyncio.to_thread(answer, "roles", "--create", "--url", each, cwd=tmp_path)
            assert {(role["tables_owner"], role["login"]) for role in made} == {(urlsplit(each).username,) * 2}
            assert {"pycrorm_recorder", "pycrorm_reader"} <= {role["name"] for role in made if role["exists"]}
        await _record(each, tmp_path / f"spool{number}")  # the owner folds into new tables and views
        await rebuild_memory(each, workers=1)
        count = "SELECT count(*) AS n, (SELECT count(*) FROM step_action) AS steps FROM process_metadata"
        for user in (each, login(url, "IN ROLE pycrorm_reader")):
            assert (await asyncio.to_thread(answer, "query", count, "--url", user, cwd=tmp_path))["rows"] == [
                {"n": 2, "steps": 2}
            ]
            async with Reading.open(user) as reading:
                assert len(await reading.episodes()) == 2
        assert "SQLite has no roles" in pycrorm("roles", "--url", "sqlite:///m.db", cwd=tmp_path).stderr


async def _record(url: str, spool: Path) -> None:
    async with Memory.open(url, spool=spool) as memory:
        step = memory.recording.type("action", "StepAction", {"step": int})
        with memory.recording.episode(description="step") as episode:
            episode.start("one", step, {"step": 1})
            episode.end("one", "SUCCEEDED")
        await memory.flush()
