"""The tables behind the views come last in a list of names, and tables with former names are used until a rebuild."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Reading
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import PickUpAction, TaskTreeNode
from pycrorm_async.projections import projector
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import ask
from tests.projections.factories import append_and_fold
from tests.projections.rebuild_cases import TYPES, picking, traces
from tests.table_comparison import differences, tables_of


async def assert_verified(url: str) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    result = await verify(log)
    await log.close()
    assert (result.damage, result.differences) == (0, [])
    assert result.episodes > 0


@pytest.mark.slow
async def test_the_tables_of_a_generation_come_last_in_a_list_of_names(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    await append_and_fold(url, [*TYPES, *picking(1).records])
    for generation in (1001, 1002):
        listed = ask(url, "SELECT name, type FROM sqlite_master WHERE type IN ('table', 'view')")
        behind = {name for name, kind in listed if kind == "table" and name.endswith(f"__{generation}")}
        assert len(behind) > 40
        for names in (sorted(name for name, _ in listed), sorted((name for name, _ in listed), key=str.lower)):
            assert set(names[-len(behind) :]) == behind
        await rebuild_memory(url, views=[UserView("zoom_all", select(TaskTreeNode.id))])


@pytest.mark.soak_on("postgresql")
@pytest.mark.empty_database
@pytest.mark.slow
async def test_tables_with_former_names_are_used_until_a_rebuild_replaces_them(
    database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(projector, "next_number", lambda _numbers: 7)
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    await append_and_fold(database_url, picking(2).records)
    at = "memory_tables." if database_url.startswith("postgresql:") else ""
    assert ask(database_url, f"SELECT count(*) FROM {at}pose__7")[0][0] > 0
    async with Reading.open(database_url) as reading, reading.session() as session:
        assert len((await session.scalars(select(PickUpAction.id))).all()) == 10
    await assert_verified(database_url)
    before = tables_of(database_url)
    assert (await rebuild_memory(database_url)).generation == 1001
    assert differences(before, tables_of(database_url)) == []
    assert traces(database_url) == []
    assert ask(database_url, f"SELECT count(*) FROM {at}zz_pose__1001")[0][0] > 0
    await assert_verified(database_url)
