"""`pycrorm verify` as an operator runs it: its output, its exit codes, and the rights it needs."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from sqlalchemy import BigInteger, column, select, table

from pycrorm_async.events.codec import Record
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import GRANTS
from tests.commands import answer, one_line_of, pycrorm
from tests.databases import Server, ask, ask_to_change, change_each
from tests.projections.event_script import declarations, declared
from tests.projections.verify_cases import fold_in_batches, full, opened, visible_tables
from tests.store.factories import declaration

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""These tests take long on a server, where they run in turns; other modules show that the server behaves alike."""

ID = "00000000-0000-7000-8000-00000000000{}"


async def memory(url: str) -> None:
    log = await opened(url)
    await fold_in_batches(log, [full(1), full(2), full(3, simulated=True)], 10_000)
    await log.close()


@pytest.fixture
async def folder(tmp_path: Path) -> Path:
    """A folder with a memory of three episodes of twenty events, the last one a simulation."""
    await memory(f"sqlite:///{tmp_path}/pycrorm.db")
    return tmp_path


def number_of_rows(url: str) -> int:
    counts: list[int] = [ask(url, f"SELECT count(*) FROM {each.physical}")[0][0] for each in visible_tables(url)]
    return sum(counts)


def test_an_intact_memory_is_reported_as_such(folder: Path) -> None:
    rows = number_of_rows(f"sqlite:///{folder}/pycrorm.db")
    done = pycrorm("verify", cwd=folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"60 events of 3 episodes and {rows} rows: no problem\n"
    assert answer("verify", cwd=folder) == {
        "episodes": 3, "events": 60, "rows": rows, "behind": 0, "damage": 0, "drift": 0, "remarks": 0,
        "damages": [], "differences": [], "not_compared": {}, "stopped": [], "unmade": {}, "outdated": None,
        "failed_views": {}, "blobs": 0, "without_digest": 0, "deleted": [], "rows_without_event": 0,
    }  # fmt: skip


def test_differences_are_printed_with_both_values_and_exit_with_1_and_damage_with_4(folder: Path) -> None:
    file = folder / "pycrorm.db"
    ask_to_change(file, "UPDATE zz_detection__1001 SET name = '[b]mïlk' WHERE id >> 31 = 2 AND position = 0")
    ask_to_change(file, "DELETE FROM zz_object_removal__1001 WHERE id >> 31 = 3")
    ask_to_change(file, "UPDATE zz_pose__1001 SET frame = x'fe00' WHERE id = (SELECT min(id) FROM zz_pose__1001)")
    done = pycrorm("verify", cwd=folder)
    assert (done.returncode, done.stderr) == (1, "")
    lines = done.stdout.splitlines()
    assert lines[0] == "drift: episode 1, event 3: pose.frame is b'\\xfe\\x00', and should be 'map'"
    assert lines[1] == "drift: episode 2, event 9: detection.name is '[b]mïlk', and should be 'milk'"
    assert lines[2].startswith("drift: episode 3, event 18: object_removal lacks a row: (6442451520, ")
    assert lines[3].endswith("the log is intact, but the tables differ from it; run `pycrorm rebuild`")
    assert len(lines) == 4
    assert pycrorm("verify", "--episode", ID.format(2), cwd=folder).stdout.splitlines()[0] == lines[1]
    # `last` is the last real episode.
    document = answer("verify", "--episode", "last", cwd=folder, code=1)
    assert (document["episodes"], document["drift"]) == (1, 1)
    [difference] = document["differences"]
    assert difference == {
        "episode": ID.format(2), "number": 2, "sequence": 9, "table": "detection", "column": "name",
        "stored": "[b]mïlk", "expected": "milk",
    }  # fmt: skip
    triggers = ask(file, "SELECT name FROM sqlite_master WHERE type = 'trigger'")
    change_each(file, [f"DROP TRIGGER {name}" for (name,) in triggers])
    ask_to_change(file, "DELETE FROM event WHERE episode = 1 AND sequence = 9")
    done = pycrorm("verify", cwd=folder)
    assert (done.returncode, done.stderr) == (4, "")
    assert done.stdout.splitlines()[0] == "damage: episode 1, event 9: is missing"
    document = answer("verify", cwd=folder, code=4)
    assert document["damages"] == [{"episode": ID.format(1), "number": 1, "sequence": 9, "reason": "is missing"}]
    assert (document["damage"], document["drift"]) == (1, 3)


def test_of_many_findings_the_first_are_shown_and_all_are_counted(folder: Path) -> None:
    ask_to_change(folder / "pycrorm.db", "UPDATE zz_task_tree_node__1001 SET simulated = 1 - simulated, start_ns = 0")
    ask_to_change(folder / "pycrorm.db", "UPDATE zz_pose__1001 SET x = -x - 1, time = 0, frame = NULL")
    done = pycrorm("verify", cwd=folder)
    assert done.returncode == 1
    count = 12 * 2 + 3 * ask(folder / "pycrorm.db", "SELECT count(*) FROM zz_pose__1001")[0][0]
    lines = done.stdout.splitlines()
    assert len(lines) == 22
    assert lines[20] == f"and {count - 20} more"
    document = answer("verify", cwd=folder, code=1)
    assert (document["drift"], len(document["differences"])) == (count, min(count, 100))


async def test_a_type_without_tables_exits_with_1(folder: Path) -> None:
    url = f"sqlite:///{folder}/pycrorm.db"
    ask_to_change(url, "CREATE TABLE walk_action (mine TEXT)")
    log = await opened(url)
    await fold_records(log, [*declarations(declared("WalkAction", "walk_action")), *full(4).records])
    await log.close()
    done = pycrorm("verify", cwd=folder)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("no tables: 'WalkAction': ")
    assert done.stdout.endswith("0 episodes are stopped, 1 types have no tables, no other problem\n")


async def test_a_view_that_is_left_out_exits_with_1(folder: Path) -> None:
    url = f"sqlite:///{folder}/pycrorm.db"
    log = await opened(url)
    ask_to_change(url, "CREATE TABLE plans (process_metadata_id BIGINT)")
    plans = table("plans", column("process_metadata_id", BigInteger()))
    view = UserView("planned", select(plans.c.process_metadata_id), materialised=True)
    await Projector(log, views=[view]).open()
    ask_to_change(url, "DROP TABLE plans")
    await fold_records(log, full(4).records)
    await log.close()
    done = pycrorm("verify", cwd=folder)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("no view: planned: ")
    assert " 1 views are left out, no other problem\n" in done.stdout


async def fold_records(log: EventLog, records: Sequence[Record]) -> None:
    projector = Projector(log)
    await projector.open()
    await log.append(records)
    await projector.catch_up()


def test_an_impossible_verification_is_one_line(folder: Path) -> None:
    done = pycrorm("verify", "--episode", "7", cwd=folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert "there is no episode '7'" in one_line_of(done)
    ask_to_change(folder / "pycrorm.db", "DROP TABLE zz_state_sample__1001")
    done = pycrorm("verify", cwd=folder)
    assert (done.returncode, done.stdout) == (3, "")
    assert "a table is missing: run `pycrorm rebuild`" in one_line_of(done)


def test_a_log_without_tables_and_a_database_without_a_memory_are_one_line_each(tmp_path: Path) -> None:
    async def record_plan() -> None:
        log = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{tmp_path}/bare.db"), create=True)
        await log.append(full(1).records)
        await log.close()

    asyncio.run(record_plan())
    other = sqlite3.connect(tmp_path / "other.db")
    other.execute("CREATE TABLE cake (a)")
    other.commit()
    other.close()
    for name, reason in (
        ("bare", "bare.db has a log but no tables yet: run `pycrorm writer --once --url sqlite:///bare.db`"),
        ("other", "is a database of another program"),
        ("none", "does not exist"),
    ):
        done = pycrorm("verify", "--url", f"sqlite:///{name}.db", cwd=tmp_path)
        assert (done.returncode, done.stdout) == (3, "")
        assert reason in one_line_of(done)


async def test_rows_missing_from_the_tables_are_printed_one_a_line_and_exit_with_1(folder: Path) -> None:
    file = folder / "pycrorm.db"
    ask_to_change(file, "UPDATE episode SET parked = 'event 7: by hand' WHERE number = 2")
    ask_to_change(file, "UPDATE episode SET refused = 'events 8 to 9 did not arrive' WHERE number = 3")
    field = b'{"name":"ID","column":"ID","type":"real","slot":2}'
    evil = b'{"kind":"action","dtype":"EvilAction","table":"evil_action","fields":[%b]}' % field
    log = await opened(f"sqlite:///{file}")
    await log.append([declaration(evil)])
    await log.close()
    lines = [
        "parked: episode 2: event 7: by hand",
        "refused: episode 3: events 8 to 9 did not arrive",
        "no tables: 'EvilAction': EvilAction: field 'ID' has a reserved name (id)",
    ]
    done = pycrorm("verify", cwd=folder)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.splitlines()[:-1] == lines
    assert ": 2 episodes are stopped, 1 types have no tables, no other problem" in done.stdout.splitlines()[-1]
    assert pycrorm("verify", "--episode", "1", cwd=folder).returncode == 0
    assert pycrorm("verify", "--episode", "2", cwd=folder).stdout.splitlines()[0] == lines[0]
    document = answer("verify", cwd=folder, code=1)
    assert document["stopped"] == [
        {"episode": ID.format(2), "number": 2, "how": "parked", "reason": "event 7: by hand"},
        {"episode": ID.format(3), "number": 3, "how": "refused", "reason": "events 8 to 9 did not arrive"},
    ]
    assert document["unmade"] == {"EvilAction": "EvilAction: field 'ID' has a reserved name (id)"}

    ask_to_change(file, "UPDATE pycrorm_generation SET version = version - 1")
    done = pycrorm("verify", cwd=folder)
    assert (done.returncode, done.stderr) == (1, "")
    assert [each for each in done.stdout.splitlines() if each.startswith("outdated: the tables were made by version ")]
    assert answer("verify", cwd=folder, code=1)["outdated"].endswith("run `pycrorm rebuild`")


@pytest.mark.soak
async def test_on_postgresql_every_role_that_may_read_may_verify(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    database = urlsplit(url).path.removeprefix("/")
    await memory(url)
    change_each(url, GRANTS)
    ask(url, f"CREATE ROLE ada_of_{database} LOGIN IN ROLE pycrorm_reader")
    # The role may also read tables that a folder makes later.
    ask(url, f"CREATE ROLE robot_of_{database} LOGIN IN ROLE pycrorm_folder")
    ask(url, f"ALTER ROLE robot_of_{database} IN DATABASE {database} SET role = 'pycrorm_folder'")
    reader = server.url(database, user=f"ada_of_{database}")
    assert answer("verify", "--url", reader, cwd=tmp_path)["events"] == 60
    folder = server.url(database, user=f"robot_of_{database}")
    assert pycrorm("rebuild", "--url", folder, cwd=tmp_path).returncode == 0
    ask(url, "UPDATE memory_tables.zz_state_sample__1002 SET value = 2.5 WHERE channel = 'torso' AND id >> 31 = 2")
    done = pycrorm("verify", "--url", reader, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.splitlines()[0] == "drift: episode 2, event 12: state_sample.value is 2.5, and should be 0.2"
