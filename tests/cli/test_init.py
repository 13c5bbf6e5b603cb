"""`pycrorm init`: a memory with partitions keeps them, whatever is made later, and its log stays append-only."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import Iterable
from pathlib import Path

import asyncpg
import pytest
from sqlalchemy import select

from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import PickUpAction
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.commands import answer, one_line_of, pycrorm
from tests.databases import Server, ask, ask_to_change
from tests.projections.event_script import append_and_fold
from tests.projections.rebuild_cases import TYPES, picking, whispering
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow

PARTITIONS = 3
PLACED = {"partitions": PARTITIONS, "shards": []}
WHOLE = """SELECT relname FROM pg_class WHERE relkind = 'r' AND NOT relispartition
AND relnamespace IN ('pycrorm'::regnamespace, 'memory_tables'::regnamespace) ORDER BY relname"""
PARTS = """SELECT inhparent::regclass::text, count(*) FROM pg_inherits JOIN pg_class ON oid = inhrelid
WHERE relkind = 'r' GROUP BY 1"""
GUARDED = """SELECT relname FROM pg_class WHERE relnamespace = 'pycrorm'::regnamespace AND relkind IN ('r', 'p')
AND relname ~ '^(event|pycrorm_digest)'"""
KEPT = UserView("Arms", select(PickUpAction.id, PickUpAction.process_metadata_id, PickUpAction.arm), materialised=True)


def without_number(names: Iterable[str]) -> set[str]:
    """Return the names of tables without the number of their generation."""
    return {each.rpartition("__")[0] or each for each in names}


def assert_partitioned(url: str, *present: str) -> None:
    """Fail unless all tables with rows of episodes have their partitions, among them those that are `present`."""
    assert without_number(name for (name,) in ask(url, WHOLE)) == {
        "episode",
        "pycrorm_declaration",
        "pycrorm_generation",
        "pycrorm_log",
        "zz_process_metadata",
        "zz_pycrorm_link_box",
        "zz_pycrorm_progress_recall",
        "zz_simulated_episode",
    }
    parts = {name.rpartition(".")[2]: count for name, count in ask(url, PARTS)}
    assert set(parts.values()) == {PARTITIONS}
    assert {"event", "pycrorm_digest", "zz_pose", "zz_task_tree_node", *present} <= without_number(parts)


async def test_partitions_are_kept_by_new_types_views_rebuilds_copies_and_restores(
    server: Server, tmp_path: Path
) -> None:
    url, copied, restored = server.new_database(), server.new_database(), server.new_database()
    document = answer("init", "--partitions", str(PARTITIONS), "--url", url, cwd=tmp_path)
    assert document == {"url": DatabaseAddress.parse(url).to_type, "placement": PLACED}
    assert_partitioned(url)
    await append_and_fold(url, [*TYPES, *(each for number in range(1, 8) for each in picking(number).records)])
    await append_and_fold(url, whispering(8))
    assert_partitioned(url, "zz_whispering_action")
    rows = ask(url, "SELECT count(*) FROM pycrorm.event GROUP BY tableoid")
    assert len(rows) == PARTITIONS, "episodes are in all partitions"
    before = tables_of(url)
    await rebuild_memory(url)
    assert_partitioned(url, "zz_whispering_action")
    assert differences(before, tables_of(url)) == []
    await copy_episodes(url, copied)
    assert_partitioned(copied, "zz_whispering_action")
    assert differences(before, tables_of(copied)) == []
    for program, *arguments in (
        ("pg_dump", "--format=custom", f"--file={tmp_path}/dump", f"--dbname={url}"),
        ("pg_restore", f"--dbname={restored}", f"{tmp_path}/dump"),
    ):
        words = [str(server.programs / program), *arguments]
        await asyncio.to_thread(subprocess.check_call, words, timeout=120)
    assert_partitioned(restored, "zz_whispering_action")
    assert differences(before, tables_of(restored)) == []
    assert pycrorm("verify", "--url", restored, cwd=tmp_path).returncode == 0
    assert answer("status", "--url", restored, cwd=tmp_path)["placement"] == PLACED
    assert f"memory: {PARTITIONS} partitions by episode" in pycrorm("status", "--url", restored, cwd=tmp_path).stdout


async def test_the_rows_of_a_materialised_view_are_partitioned(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    pycrorm("init", "--partitions", str(PARTITIONS), "--url", url, cwd=tmp_path)
    await append_and_fold(url, [*TYPES, *picking(1).records])
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    projector = Projector(log, views=[KEPT])
    await projector.open()
    await projector.catch_up()
    await log.close()
    assert ask(url, 'SELECT count(*) FROM "Arms"') == [(5,)]
    assert len([name for name, _ in ask(url, PARTS) if "arms" in name.lower()]) == 1


async def test_no_partition_of_the_log_lets_its_rows_be_changed_or_deleted(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    pycrorm("init", "--partitions", str(PARTITIONS), "--url", url, cwd=tmp_path)
    await append_and_fold(url, [*TYPES, *(each for number in range(1, 8) for each in picking(number).records)])
    tables = [name for (name,) in ask(url, GUARDED)]
    assert len(tables) == 2 * (1 + PARTITIONS)
    for table in tables:
        for change in ("DELETE FROM {}", "UPDATE {} SET sequence = 1", "TRUNCATE {}"):
            with pytest.raises(asyncpg.IntegrityConstraintViolationError, match=f"{table} refuses"):
                ask_to_change(url, change.format(f"pycrorm.{table}"))


def test_the_largest_number_of_partitions_fits_a_default_server(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    assert pycrorm("init", "--partitions", "16", "--url", url, cwd=tmp_path).returncode == 0
    assert ask(url, "SELECT count(*) FROM pg_inherits WHERE inhparent = 'pycrorm.event'::regclass") == [(16,)]


def test_what_cannot_be_partitioned_is_refused_in_one_line(server: Server, tmp_path: Path) -> None:
    url = server.new_memory()
    for words, line in (
        (("--partitions", "4", "--url", "sqlite:///new.db"), "has no partitions: name a PostgreSQL database"),
        (("--partitions", "4", "--url", url), "is a memory already, with"),
        (("--partitions", "1", "--url", url), "from 2 to 16 partitions, or up to 16 shards, not 1"),
        (("--partitions", "17", "--url", url), "up to 16 shards, not 17"),
    ):
        done = pycrorm("init", *words, cwd=tmp_path)
        assert (done.returncode, line in one_line_of(done)) == (2, True), done.stderr
    assert not (tmp_path / "new.db").exists()
    for _ in range(2):
        assert "is a memory with plain tables" in pycrorm("init", "--url", "sqlite:///new.db", cwd=tmp_path).stdout
