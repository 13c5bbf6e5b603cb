"""Rebuild tables from the log: the same rows for concurrent readers, and what a rebuild must not touch."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import DatabaseError, DatabaseForeign, DatabaseUnavailable, LogDamaged
from pycrorm_async.operations import rebuild as rebuilding
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.operations.workers import Assignment
from pycrorm_async.orm import PickUpAction, TaskTreeNode
from pycrorm_async.projections import rebuild
from pycrorm_async.projections import rebuild as steps
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.pipeline import FoldRunner, LiveTarget
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.rebuild import Rebuild
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent
from tests.databases import Server, ask, ask_to_change, change_each
from tests.projections.event_script import append_and_fold
from tests.projections.rebuild_cases import TYPES, folded_elsewhere, lost, parking, picking, str_of, traces, whispering
from tests.promises.test_random_plans import play
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


# === rebuild ==================================================================================================
#
# Rebuild tables from the log: the same rows, and nothing missing for concurrent readers and recorders.

PATIENT = Settings(connect_timeout_s=120, flush_timeout_s=300)
STOPPED = "SELECT number, folded, parked FROM episode ORDER BY number"
OUR_VIEW = UserView("Failed", select(TaskTreeNode.id, TaskTreeNode.reason).where(TaskTreeNode.reason.is_not(None)))


async def every_kind_of_episode(url: str, spool: Path) -> None:
    """Return random plans with types of their own and failures, a simulation, a lost episode, and a parked one."""
    async with Memory.open(url, spool=spool, views=[OUR_VIEW], settings=PATIENT) as memory:
        await play(0, memory)
        await memory.flush()
    scripts = [*map(picking, range(1, 4)), picking(8, simulated=True), lost(9), parking(10)]
    # Live, a node ends and is lost in another batch than that of its start; a rebuild folds both in one.
    await append_and_fold(url, [*TYPES, *(each for script in scripts for each in script.records[:4])])
    await append_and_fold(url, [each for script in scripts for each in script.records[4:]])
    await append_and_fold(url, whispering(11))


@pytest.mark.usefixtures("forked_workers")
async def test_rebuilt_tables_equal_row_for_row_those_folded_live(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    await every_kind_of_episode(database_url, tmp_path / "spool")
    before, stopped, failed = tables_of(database_url), ask(database_url, STOPPED), ask(database_url, FAILED)
    assert len([why for _, _, why in stopped if why]) == 1
    assert failed
    # A rebuild uses only the log, whatever was changed in the tables.
    at = "memory_tables." if database_url.startswith("postgresql:") else ""
    for change in ("DELETE FROM {}zz_pose__1001", "UPDATE {}zz_task_tree_node__1001 SET status = 'RUNNING'"):
        ask_to_change(database_url, change.format(at))
    assert differences(before, tables_of(database_url)) != []
    done = await rebuild_memory(database_url)
    assert differences(before, tables_of(database_url)) == []
    assert differences(before, await folded_elsewhere(database_url, tmp_path)) == []
    assert ask(database_url, STOPPED) == stopped
    assert ask(database_url, FAILED) == failed
    assert (done.generation, done.left, list(done.parked)) == (1002, [], [str_of(10)])
    assert traces(database_url) == []
    monkeypatch.setattr(rebuilding, "_SHARE_EVENTS_MIN", 1)
    again = await rebuild_memory(database_url, workers=2, views=[UserView("All", select(TaskTreeNode.id))])
    assert differences(before, tables_of(database_url)) == []
    assert (again.generation, again.left) == (1003, [])
    assert ask(database_url, 'SELECT count(*) FROM "All"') == ask(database_url, "SELECT count(*) FROM task_tree_node")
    assert ask(database_url, FAILED) == failed
    assert traces(database_url) == []


@pytest.mark.soak_on("postgresql")
async def test_a_view_of_the_package_that_was_noted_as_a_users_one_is_rebuilt_too(database_url: str) -> None:
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    query = 'SELECT id, arm, status FROM "PickUpWithContextView" ORDER BY id'
    before = ask(database_url, query)
    assert before
    notes = "memory_tables.pycrorm_generation" if database_url.startswith("postgresql:") else "pycrorm_generation"
    [(noted,)] = ask(database_url, f"SELECT layout FROM {notes} WHERE projection = 'tables'")
    layout = msgspec.json.decode(noted)
    layout["user_views"] = {"PickUpWithContextView": "SELECT 1 AS id", **layout.get("user_views", {})}
    changed = msgspec.json.encode(layout).decode()
    ask_to_change(database_url, f"UPDATE {notes} SET layout = '{changed}' WHERE projection = 'tables'")
    await rebuild_memory(database_url)
    assert ask(database_url, query) == before


FAILED = 'SELECT * FROM "Failed" ORDER BY id'


@pytest.mark.parametrize(
    ("events", "share", "cores", "load", "begun"),
    [
        (500_000, 45, {0, 1}, 0.0, []),
        (100, 45, {0, 1}, 0.4, [2]),
        (100, 46, {0, 1}, 0.4, []),  # of 105 events the smaller share has 45
        (100, 45, {0, 1}, 1.0, []),
        (100, 45, {0}, 0.0, []),
    ],
)
@pytest.mark.usefixtures("forked_workers")
async def test_large_logs_are_rebuilt_by_two_processes_where_two_cores_are_idle(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    events: int,
    share: int,
    cores: set[int],
    load: float,
    begun: list[int],
) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    await append_and_fold(url, [*TYPES, *(record for number in range(1, 8) for record in picking(number).records)])
    before, real, shared_out = tables_of(url), rebuilding._run_workers, list[int]()
    ((all_events,),) = ask(url, "SELECT sum(head) FROM episode")

    async def share_out(assignment: Assignment, workers: int, report: Callable[[int], None]) -> None:
        shared_out.append(workers)
        counts: list[int] = []
        await real(assignment, workers, counts.append)
        assert sum(counts) == all_events
        report(all_events)

    monkeypatch.setattr(rebuilding, "_run_workers", share_out)
    monkeypatch.setattr(rebuilding, "_ALONE_EVENTS_MAX", events)
    monkeypatch.setattr(rebuilding, "_SHARE_EVENTS_MIN", share)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: cores)
    monkeypatch.setattr(os, "getloadavg", lambda: (load, 9.0, 9.0))
    assert (await rebuild_memory(url, workers=None)).events == all_events > 100
    assert shared_out == begun
    assert differences(before, tables_of(url)) == []


@pytest.mark.usefixtures("forked_workers")
async def test_workers_that_are_killed_are_restarted_and_the_tables_are_the_same(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rebuilding, "_SHARE_EVENTS_MIN", 1)
    url = f"sqlite:///{tmp_path}/memory.db"
    episodes = [picking(number, nodes=124).records for number in range(1, 71)]  # two batches for each of two workers
    await append_and_fold(url, [*TYPES, *(record for records in episodes for record in records)])
    before, killed = tables_of(url), set[int | None]()

    def kill_once(_done: int, _total: int, _what: str | None = None) -> None:
        if not killed:
            workers = [each for each in multiprocessing.active_children() if each.name.startswith("fold worker")]
            killed.update(each.pid for each in workers)
            for each in workers:
                each.kill()

    await rebuild_memory(url, workers=2, report_progress=kill_once)
    assert killed
    lines = [each for each in caplog.messages if "exited with signal 9; restarting it in 1 s" in each]
    assert {int(each.partition("(pid ")[2].partition(")")[0]) for each in lines} == killed
    assert differences(before, tables_of(url)) == []


@pytest.mark.empty_database
async def test_missing_tables_are_made(database_url: str) -> None:
    await append_and_fold(database_url, [*TYPES, *picking(1).records, *parking(2).records], folded=False)
    done = await rebuild_memory(database_url)
    assert (done.generation, done.events, done.episodes) == (1001, 19, 2)
    assert [(number, folded) for number, folded, _ in ask(database_url, STOPPED)] == [(1, 15), (2, 2)]
    assert ask(database_url, "SELECT count(*) FROM pick_up_action") == [(5,)]
    assert traces(database_url) == []


@pytest.mark.soak_on("sqlite")
async def test_events_folded_while_the_new_tables_are_published_are_in_them(
    database_url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    projector = Projector(log)
    await projector.open()
    # A few more episodes of one event each than one lookup takes.
    monkeypatch.setattr(steps, "_LATE_EVENTS_MAX", 10)
    original, done = Rebuild._show_if_complete, 0

    async def fold_late(self: Rebuild) -> bool:
        nonlocal done
        if done < 3:  # after the last lookup, before the other processes are stopped
            first = 100 * done
            done += 1
            count = (13, 11, 3)[done - 1]
            records = [each for number in range(first + 2, first + 2 + count) for each in picking(number).records[:1]]
            assert await log.append(records) == {}
            await projector.catch_up()
        return await original(self)

    monkeypatch.setattr(Rebuild, "_show_if_complete", fold_late)
    await rebuild_memory(database_url)
    assert done == 3
    assert ask(database_url, "SELECT count(*) FROM episode WHERE folded < head") == [(0,)]
    assert ask(database_url, "SELECT count(*) FROM process_metadata") == [(1 + 13 + 11 + 3,)]
    assert differences(tables_of(database_url), await folded_elsewhere(database_url, tmp_path)) == []
    # A process that folded before continues in the new tables.
    assert await log.append(picking(999).records) == {}
    await projector.catch_up()
    assert ask(database_url, "SELECT count(*) FROM process_metadata") == [(29,)]
    await log.close()


async def test_a_batch_yields_to_the_loop_even_when_all_its_episodes_are_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = b'{"node":1,"status":"SUCCEEDED"}'
    events = [
        StoredEvent(number, turn, "NodeEnded", 1, 1, 1, ended) for number in range(1, 101) for turn in range(1, 21)
    ]
    turns = 0

    async def read(_: EventLog, _spans: Sequence[Span]) -> list[StoredEvent]:
        return events

    monkeypatch.setattr(EventLog, "spans", read)
    log = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{tmp_path}/memory.db"), create=True)
    await Projector(log).open()
    runner = FoldRunner(LiveTarget(log))

    async def other() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    task = asyncio.create_task(other())
    preview = await runner.prepare([Span(number, 0, 20) for number in range(1, 101)])
    task.cancel()
    assert preview.reached == dict.fromkeys(range(1, 101), 20)
    assert turns >= 10
    await log.close()


# === rebuild limits ===========================================================================================
#
# A rebuild refuses a log that it must not touch, and keeps the tables that readers or other programs use.

# --- bad input ------------------------------------------------------------------------------------------------------


async def test_tables_of_a_newer_version_are_refused_unchanged(database_url: str) -> None:
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    at = "memory_tables." if database_url.startswith("postgresql:") else ""
    ask_to_change(database_url, f"UPDATE {at}pycrorm_generation SET version = 999, layout = '[]'")
    with pytest.raises(DatabaseForeign, match=r"made by version 999 of the fold, this is version \d+: use a newer"):
        await rebuild_memory(database_url)
    assert ask(database_url, "SELECT count(*) FROM pick_up_action") == [(5,)]


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
