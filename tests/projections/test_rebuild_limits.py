"""A rebuild refuses a log that it must not touch, and keeps the tables that readers or other programs use."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Reading
from pycrorm_async.errors import CallerError, DatabaseError, DatabaseForeign, DatabaseUnavailable, LogDamaged
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import PickUpAction
from pycrorm_async.projections import rebuild
from pycrorm_async.projections.rebuild import claimed
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import Server, ask, ask_to_change, change_each
from tests.projections.factories import append_and_fold
from tests.projections.rebuild_cases import TYPES, picking, str_of, traces
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


# --- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.soak_on("sqlite")
async def test_only_one_process_rebuilds_at_a_time(database_url: str) -> None:
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    async with claimed(log):
        with pytest.raises(CallerError, match="another `pycrorm rebuild` is running: wait for it to end"):
            await rebuild_memory(database_url)
    await log.close()
    assert (await rebuild_memory(database_url)).generation == 1002


async def test_tables_of_a_newer_version_are_refused_unchanged(database_url: str) -> None:
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    at = "memory_tables." if database_url.startswith("postgresql:") else ""
    ask_to_change(database_url, f"UPDATE {at}pycrorm_generation SET version = 999, layout = '[]'")
    with pytest.raises(DatabaseForeign, match=r"made by version 999 of the fold, this is version \d: use a newer"):
        await rebuild_memory(database_url)
    assert ask(database_url, "SELECT count(*) FROM pick_up_action") == [(5,)]


@pytest.mark.soak_on("sqlite")
async def test_tables_of_an_older_version_are_replaced(database_url: str) -> None:
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    before = tables_of(database_url)
    at = "memory_tables." if database_url.startswith("postgresql:") else ""
    ask_to_change(database_url, f"UPDATE {at}pycrorm_generation SET version = 1")
    with pytest.raises(DatabaseForeign, match="run `pycrorm rebuild`"):
        await append_and_fold(database_url, [])
    assert (await rebuild_memory(database_url)).generation == 1002
    assert differences(before, tables_of(database_url)) == []
    assert traces(database_url) == []


async def test_a_database_without_a_memory_is_left_unchanged(tmp_path: Path, server: Server) -> None:
    with pytest.raises(DatabaseUnavailable, match=r"none\.db does not exist"):
        await rebuild_memory(f"sqlite:///{tmp_path}/none.db")
    assert list(tmp_path.iterdir()) == []
    other = f"sqlite:///{tmp_path}/other.db"
    ask_to_change(other, "CREATE TABLE theirs (a)")
    with pytest.raises(DatabaseForeign, match="of another program"):
        await rebuild_memory(other)
    assert ask(other, "SELECT name FROM sqlite_master") == [("theirs",)]
    with pytest.raises(DatabaseUnavailable, match="holds no memory yet"):
        await rebuild_memory(server.new_database())


async def test_an_event_missing_from_the_log_is_damage_and_ends_the_rebuild(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    await append_and_fold(url, [*TYPES, *picking(1).records, *picking(2).records])
    before = tables_of(url)
    ask_to_change(url, "DROP TRIGGER event_is_not_deleted")
    ask_to_change(url, "DELETE FROM event WHERE episode = 2 AND sequence IN (1, 7)")
    with pytest.raises(LogDamaged, match=f"episode {str_of(2)}, event 1: is missing in"):
        await rebuild_memory(url)
    assert differences(before, tables_of(url)) == []


# --- PostgreSQL alone -------------------------------------------------------------------------------------------------


@pytest.fixture
def few_attempts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a rebuild leave tables in use after two attempts to drop them, instead of seven in 6 s."""
    monkeypatch.setattr(rebuild, "_DROP_PAUSES_S", (0.0, 0.1))


@pytest.mark.usefixtures("few_attempts")
async def test_a_reader_in_a_transaction_continues_and_the_next_rebuild_drops_its_tables(server: Server) -> None:
    url = server.new_database()
    await append_and_fold(url, [*TYPES, *picking(1).records])
    before = tables_of(url)
    async with Reading.open(url) as reading:
        async with reading.session() as session:
            assert len((await session.scalars(select(PickUpAction.id))).all()) == 5
            done = await rebuild_memory(url)
            assert "zz_pick_up_action__1001" in done.left
            assert "tables/gone/1001" in traces(url)
            assert len((await session.scalars(select(PickUpAction.id))).all()) == 5
        assert differences(before, tables_of(url)) == []
        assert (await rebuild_memory(url)).left == []
    assert traces(url) == []


@pytest.mark.soak
@pytest.mark.usefixtures("few_attempts")
async def test_a_foreign_view_on_the_tables_keeps_them_and_is_reported(server: Server) -> None:
    url = server.new_database()
    await append_and_fold(url, [*TYPES, *picking(1).records])
    ask_to_change(url, "CREATE VIEW public.mine AS SELECT id FROM memory.pick_up_action")
    done = await rebuild_memory(url)
    assert "zz_pick_up_action__1001" in done.left
    assert ask(url, "SELECT count(*) FROM public.mine") == [(5,)]
    ask_to_change(url, "DROP VIEW public.mine")
    assert (await rebuild_memory(url)).left == []
    assert traces(url) == []


async def test_a_foreign_view_keeps_a_replaced_view_and_its_table(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rebuild, "_DROP_PAUSES_S", (0.0,))
    url = server.new_memory()
    views = ("CREATE VIEW public.mine AS SELECT id FROM memory.pose", "ALTER SCHEMA memory RENAME TO memory_gone_1_1")
    change_each(url, views)
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    assert await rebuild._drop_all(log, ["zz_pose__1001"]) == ["zz_pose__1001"]
    await log.close()
    assert ask(url, "SELECT count(*) FROM public.mine") == [(0,)]


async def test_a_foreign_table_in_the_schema_of_the_views_is_reported_in_one_line_and_stays(server: Server) -> None:
    url = server.new_database()
    await append_and_fold(url, [*TYPES, *picking(1).records])
    ask_to_change(url, "CREATE TABLE memory.mine (a int)")
    with pytest.raises(DatabaseError, match=r"memory\.mine does not belong to the memory.*: move it to"):
        await rebuild_memory(url, report_progress=lambda done, *_: pytest.fail(f"reported after {done} events"))
    assert ask(url, "SELECT count(*) FROM memory.mine") == [(0,)]
    assert traces(url) == []
    ask_to_change(url, "DROP TABLE memory.mine")
    assert (await rebuild_memory(url)).left == []
    assert traces(url) == []
