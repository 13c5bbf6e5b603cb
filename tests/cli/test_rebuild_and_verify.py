"""`pycrorm verify` and `pycrorm rebuild` as an operator runs them, and the options that they share with all verbs."""

from __future__ import annotations

import asyncio
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import typer
from sqlalchemy import BigInteger, column, select, table
from typer.core import TyperGroup

from pycrorm_async.cli.main import app
from pycrorm_async.events.codec import Record
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.rebuild import claimed
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import GRANTS
from tests.commands import COMMAND, NOTES_PLAN, answer, environment, one_line_of, pycrorm
from tests.databases import Server, ask, ask_to_change, change_each
from tests.projections.event_script import append_and_fold
from tests.projections.rebuild_cases import TYPES, parking, picking, str_of, traces
from tests.projections.verify_cases import fold_in_batches, full, opened, visible_tables
from tests.store.factories import declaration
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


# === verify ===================================================================================================
#
# `pycrorm verify` as an operator runs it: its output, its exit codes, and the rights it needs.

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
        "failed_views": {}, "blobs": 0, "without_digest": 0, "deleted": [], "rows_without_event": 0, "undecided": 0,
        "erased": 0, "archived": 0,
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


# === options ==================================================================================================
#
# The options that all verbs share.


def test_every_verb_that_opens_a_database_accepts_its_spool_too() -> None:
    group = typer.main.get_command(app())
    assert isinstance(group, TyperGroup)
    options = {name: {option for each in verb.params for option in each.opts} for name, verb in group.commands.items()}
    assert {name for name, accepted in options.items() if "--url" in accepted and "--spool" not in accepted} == set()
    assert {"verify", "rebuild", "episodes"} <= {name for name, accepted in options.items() if "--url" in accepted}


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("pycrorm run --wr", "--writer"),
        ("pycrorm spool rep", "repair"),
    ],
)
def test_a_shell_completes_verbs_and_their_options(tmp_path: Path, words: str, completed: str) -> None:
    typed = {"_PYCRORM_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    script = Path(sys.executable).with_name("pycrorm")
    done = subprocess.run(
        [script], cwd=tmp_path, env=environment() | typed, capture_output=True, text=True, check=False
    )
    assert (done.stdout.strip(), done.stderr) == (completed, "")


@pytest.mark.parametrize("verb", ["verify", "rebuild"])
def test_verify_and_rebuild_name_the_events_that_wait_in_the_spool(tmp_path: Path, verb: str) -> None:
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    spool = tmp_path / "elsewhere"
    assert pycrorm("run", "notes.py", "--spool", spool, cwd=tmp_path).returncode == 0
    assert pycrorm("run", "notes.py", "--spool", spool, "--writer", "daemon", cwd=tmp_path).returncode == 0
    done = pycrorm(verb, "--spool", spool, cwd=tmp_path)
    assert done.returncode == 0
    assert done.stderr == (
        "1 dead recorder left events that are not in the database: "
        f"run `pycrorm writer --once --url sqlite:///pycrorm.db --spool {spool}` to store them.\n"
    )
    assert answer(verb, cwd=tmp_path)["episodes"] == 1


# === rebuild ==================================================================================================
#
# `pycrorm rebuild` as an operator runs it: in a process of its own without the code of the plan.

PLAN = '''
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract

@dataclass
class WeighActionPerformable(ActionAbstract):
    what: str
    grams: float
    async def perform(self): ...

async def plan():
    """Weigh it."""
    await WeighActionPerformable("milk", 0.1).perform()
'''


@pytest.mark.soak
def test_a_rebuild_needs_no_code_of_the_plan_and_reports_what_it_made(tmp_path: Path) -> None:
    (tmp_path / "weighing.py").write_text(PLAN)
    assert pycrorm("run", "weighing.py", cwd=tmp_path).returncode == 0
    (tmp_path / "weighing.py").unlink()
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    before = tables_of(url)
    assert next(iter(before["weigh_action"].values()))["grams"] == 0.1
    done = answer("rebuild", "--workers", "2", cwd=tmp_path)
    assert {**done, "seconds": 0} == {
        "generation": 1002, "events": 6, "episodes": 1, "seconds": 0, "parked": {}, "damaged": {}, "left": []
    }  # fmt: skip
    assert differences(before, tables_of(url)) == []
    assert traces(url) == []
    rebuilt = pycrorm("rebuild", cwd=tmp_path)
    assert (rebuilt.returncode, rebuilt.stderr) == (0, "")
    assert rebuilt.stdout.startswith("generation 1003: 6 events of 1 episode in ")


def test_an_episode_that_cannot_be_folded_is_reported_and_is_a_problem(tmp_path: Path) -> None:
    asyncio.run(append_and_fold(f"sqlite:///{tmp_path}/pycrorm.db", [*TYPES, *picking(1).records, *parking(2).records]))
    done = pycrorm("rebuild", cwd=tmp_path)
    assert done.returncode == 1
    assert one_line_of(done).startswith(f"episode {str_of(2)} is parked: event 3: ")


async def test_a_second_rebuild_is_refused_with_one_line(database_url: str, tmp_path: Path) -> None:
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    async with claimed(log):
        done = await asyncio.to_thread(pycrorm, "rebuild", "--url", database_url, cwd=tmp_path)
    await log.close()
    assert done.returncode == 2
    assert one_line_of(done).endswith("a `pycrorm rebuild` or `pycrorm archive` is running: wait for it to end")


def start_rebuild(folder: Path) -> subprocess.Popen[str]:
    """Start a rebuild with workers in a process group of its own."""
    command = [*COMMAND, "rebuild", "--workers", "2"]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=folder, env=environment(), stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )


def lock(blocker: sqlite3.Connection) -> None:
    """Let no other process write, from the end of the first transaction on: SQLite itself would try once in 0.1 s."""
    while True:
        with suppress(sqlite3.OperationalError):
            blocker.execute("BEGIN IMMEDIATE")
            return
        time.sleep(0.0005)


def test_an_interrupted_rebuild_exits_with_130_and_the_next_one_continues(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    asyncio.run(append_and_fold(url, [*TYPES, *(each for number in range(1, 50) for each in picking(number).records)]))
    before = tables_of(url)
    blocker = sqlite3.connect(tmp_path / "pycrorm.db", isolation_level=None, timeout=0)
    making = "SELECT generation FROM pycrorm_generation WHERE projection = 'tables/making'"
    for _ in range(20):  # a rebuild may end before the lock is taken
        process = start_rebuild(tmp_path)
        while not blocker.execute(making).fetchall() and process.poll() is None:
            time.sleep(0.001)
        lock(blocker)
        unfinished = blocker.execute(making).fetchall()
        if unfinished:
            break
        blocker.execute("ROLLBACK")
        assert process.communicate(timeout=120)[0].startswith("generation ")
    assert unfinished
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers too
    output, errors = process.communicate(timeout=120)
    blocker.execute("ROLLBACK")
    blocker.close()
    assert (process.returncode, output) == (130, ""), errors
    assert errors == "pycrorm: interrupted; all events recorded so far are kept\n"
    assert differences(before, tables_of(url)) == []
    assert answer("rebuild", cwd=tmp_path)["generation"] == unfinished[0][0]
    assert differences(before, tables_of(url)) == []
    assert traces(url) == []
