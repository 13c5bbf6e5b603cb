"""`pycrorm writer`, as a daemon and once, and `pycrorm status`, as users run them: in processes of their own."""

from __future__ import annotations

import asyncio
import json
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory
from pycrorm_async.cli.status import RUNNING_MAX
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.queue.sources import DeadLetters
from pycrorm_async.queue.spool import make_folder
from pycrorm_async.world import COURIER, BulletWorld, Object, ObjectType
from tests.commands import NOTES_PLAN, Started, answer, one_line_of, pycrorm
from tests.databases import ask_to_change

pytestmark = pytest.mark.slow


# === writer ===================================================================================================
#
# `pycrorm writer` as a daemon and `pycrorm status`, as users run them: in processes of their own.

PLAN = f"""
import asyncio, os
{NOTES_PLAN}

async def waits():
    await NoteActionPerformable("a").perform()
    os.write(1, b"waiting\\n")
    await asyncio.sleep(600)
"""
URL = "sqlite:///pycrorm.db"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "notes.py").write_text(PLAN)
    return tmp_path


@pytest.fixture
def daemon(folder: Path) -> Iterator[Started]:
    process = Started("writer", cwd=folder)
    assert process.stderr.readline() == f"draining {folder}/pycrorm.db.spool into {URL}\n"
    yield process
    if process.poll() is None:
        process.kill()
    process.communicate()


def output_until_exit(process: Started, with_signal: int) -> list[str]:
    """Return the lines until it exits, with code 0, within the time that it names."""
    process.send_signal(with_signal)
    _, errors = process.communicate(timeout=15)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    return errors.splitlines()


@pytest.mark.parametrize("with_signal", [signal.SIGTERM, signal.SIGINT])
def test_a_plan_beside_a_daemon_is_in_the_database_at_its_end(folder: Path, daemon: Started, with_signal: int) -> None:
    done = answer("run", "notes.py", "--writer", "daemon", cwd=folder)
    assert [(each["number"], each["status"], each["nodes"]) for each in done["episodes"]] == [(1, "SUCCEEDED", 4)]
    [appeared, ended, goodbye] = output_until_exit(daemon, with_signal)
    name = appeared.split()[1]
    assert appeared == f"recorder {name} appeared"
    assert ended == f"recorder {name} has ended; 11 events stored"
    assert goodbye == "stopped after 11 events of 1 recorder"
    assert [path for path in (folder / "pycrorm.db.spool").iterdir() if path.is_dir() and path.name != "stored"] == []


def test_the_environment_may_select_the_writer_and_without_a_daemon_nothing_is_lost(folder: Path) -> None:
    process = Started("run", "notes.py", cwd=folder, PYCRORM_WRITER="daemon")
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output) == (0, "")
    assert "11 events are safe in" in " ".join(errors.split())
    assert "start `pycrorm writer`" in " ".join(errors.split())
    assert not (folder / "pycrorm.db").exists()
    document = answer("status", cwd=folder, code=3)
    [recorder] = document["recorders"]
    assert (recorder["alive"], recorder["drained"], document["daemon"]) == (False, "nobody", False)
    assert "does not exist" in document["database"]
    shown = pycrorm("status", cwd=folder)
    assert "1 dead recorder left events" in shown.stderr
    assert "run `pycrorm writer --once --url sqlite:///" in shown.stderr
    assert answer("writer", "--once", cwd=folder)["events_stored"] == 11
    assert pycrorm("status", cwd=folder).stderr == ""
    assert len(answer("episodes", cwd=folder)) == 1


def test_status_names_a_spool_that_does_not_exist(folder: Path) -> None:
    (folder / "empty").mkdir()
    for spool, line in {"empty": "empty", "none": "none, which does not exist"}.items():
        shown = pycrorm("status", "--spool", spool, cwd=folder)
        assert shown.stdout.splitlines()[0] == f"No recorders below {line}"


def test_a_second_daemon_is_one_line_and_exit_code_3(folder: Path, daemon: Started) -> None:
    done = pycrorm("writer", cwd=folder)
    assert done.returncode == 3
    assert one_line_of(done) == (
        f"pycrorm: spool {folder}/pycrorm.db.spool: another `pycrorm writer` drains it already"
    )
    assert pycrorm("writer", "--once", cwd=folder).returncode == 0


def test_a_plan_killed_beside_a_daemon_is_recovered_by_it(folder: Path, daemon: Started) -> None:
    plan = Started("run", "notes.py:waits", "--writer", "daemon", cwd=folder)
    assert plan.stdout.readline() == "waiting\n"
    [recorder] = until(folder, lambda document: [r for r in document["recorders"] if r["folded"]])
    assert (recorder["alive"], recorder["drained"]) == (True, "another")
    assert recorder["synced"] == recorder["stored"] == recorder["folded"]
    plan.kill()
    plan.communicate()
    until(folder, lambda document: not document["recorders"])
    lines = output_until_exit(daemon, signal.SIGTERM)
    assert [line.split(" ", 2)[2] for line in lines[:4]] == [
        "appeared",
        f"died; {recorder['stored']} events stored",
        "is dead: recovering its folder",
        f"is recovered (1 episode LOST); {recorder['stored'] + 1} events stored",
    ]
    assert [each["status"] for each in answer("episodes", cwd=folder)] == ["LOST"]


def until(folder: Path, wanted: Any) -> Any:
    """Return the result of this query on the status, once it has one."""
    deadline = time.monotonic() + 60
    while True:
        done = pycrorm("status", "--json", cwd=folder)
        result = wanted(json.loads(done.stdout))
        if result:
            return result
        assert time.monotonic() < deadline, done.stdout


def test_a_plan_with_its_own_writer_is_not_drained_by_a_daemon(folder: Path, daemon: Started) -> None:
    plan = Started("run", "notes.py:waits", cwd=folder)
    assert plan.stdout.readline() == "waiting\n"
    time.sleep(1.2)  # the daemon scans twice
    [recorder] = answer("status", cwd=folder)["recorders"]
    assert (recorder["alive"], recorder["drained"], recorder["synced"]) == (True, "itself", None)
    plan.send_signal(signal.SIGINT)
    plan.communicate(timeout=60)
    assert output_until_exit(daemon, signal.SIGTERM) == ["stopped after 0 events of 0 recorders"]


def test_status_reports_stopped_episodes_and_how_far_the_tables_are_behind(folder: Path) -> None:
    assert pycrorm("run", "notes.py", cwd=folder).returncode == 0
    document = answer("status", cwd=folder)
    assert (document["recorders"], document["episodes"], document["database"]) == ([], [], "ok")
    assert "The tables show all stored events." in pycrorm("status", cwd=folder).stdout
    ask_to_change(f"sqlite:///{folder}/pycrorm.db", "UPDATE episode SET folded = 4")
    [behind] = answer("status", cwd=folder)["episodes"]
    assert (behind["head"], behind["folded"], behind["lag_events"]) == (10, 4, 6)
    assert 0 < behind["lag_s"] < 300
    ask_to_change(f"sqlite:///{folder}/pycrorm.db", "UPDATE episode SET parked = 'a column is in the way'")
    [stopped] = answer("status", cwd=folder, code=1)["episodes"]
    assert stopped["parked"] == "a column is in the way"
    done = pycrorm("status", cwd=folder)
    assert done.returncode == 1
    assert one_line_of(done).endswith("is stopped: a column is in the way")


# === drain once ===============================================================================================
#
# The exit code of `pycrorm writer --once`: 1 if the database refused anything, with and without --json.

RECORDER, EPISODE = "0190a000-0000-7000-8000-000000000001", "0190a000-0000-7000-8000-000000000002"


@pytest.mark.parametrize("alive", [True, False])
def test_an_earlier_refusal_is_a_problem_even_while_its_recorder_is_alive(tmp_path: Path, *, alive: bool) -> None:
    spool = tmp_path / "pycrorm.db.spool"
    folder, lock = make_folder(spool, RECORDER)
    refused = DeadLetters(folder)
    refused.put([Record(1, parse_episode_id(EPISODE), 5, "NodeStarted", 1, 7, 8, b"{}")])
    refused.release()
    if not alive:
        lock.release()
    kept = f"its events are kept in {folder}.{EPISODE}.refused"
    done = pycrorm("writer", "--once", cwd=tmp_path)
    reason = "was refused" if alive else "is stopped: events 1 to 4 did not arrive before event 5"
    assert (done.returncode, one_line_of(done)) == (1, f"pycrorm: episode {EPISODE} {reason}; {kept}")
    assert list(answer("writer", "--once", cwd=tmp_path, code=1)["dead_letters"]) == [EPISODE]
    lock.release()


# === running episodes =========================================================================================
#
# `pycrorm status` names the running episodes and their robots.


@pytest.mark.soak_on("postgresql")
async def test_a_running_episode_is_named_with_its_robots_until_it_ends(database_url: str, tmp_path: Path) -> None:
    asked = "--url", database_url
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="before"):
            pass
        with BulletWorld():
            Object("eve", ObjectType.ROBOT, robot=replace(COURIER, serial="C-03"))
            async with memory.episode(description="tidy up"):
                Object("courier", ObjectType.ROBOT)
                await memory.flush()
                document = await asyncio.to_thread(answer, "status", *asked, cwd=tmp_path)
                shown = await asyncio.to_thread(pycrorm, "status", *asked, cwd=tmp_path)
        await memory.flush()
        assert document["running_total"] == 1
        [running] = document["running"]
        [_, summary] = await memory.reading.episodes()
    assert (running["number"], running["id"], running["description"]) == (2, summary.id, "tidy up")
    assert [(each["name"], each["model"], each["serial"]) for each in running["robots"]] == [
        ("eve", "courier", "C-03"),
        ("courier", "courier", None),
    ]
    assert all(each["description"] for each in running["robots"])
    assert "Running episodes" in shown.stdout
    assert "eve (courier C-03), courier" in shown.stdout
    after = answer("status", *asked, cwd=tmp_path)
    assert (after["running"], after["running_total"]) == ([], 0)
    assert "Running episodes" not in pycrorm("status", *asked, cwd=tmp_path).stdout


async def test_of_many_running_episodes_the_newest_are_listed(tmp_path: Path) -> None:
    url, count = f"sqlite:///{tmp_path}/memory.db", RUNNING_MAX + 2
    started, done = asyncio.Barrier(count + 1), asyncio.Event()

    async def run(number: int) -> None:
        async with memory.episode(description=f"number {number}"):
            await started.wait()
            await done.wait()

    async with Memory.open(url) as memory, asyncio.TaskGroup() as tasks:
        for number in range(count):
            tasks.create_task(run(number))
        await started.wait()
        await memory.flush()
        document = await asyncio.to_thread(answer, "status", "--url", url, cwd=tmp_path)
        shown = await asyncio.to_thread(pycrorm, "status", "--url", url, cwd=tmp_path)
        done.set()
    assert document["running_total"] == count
    assert [each["number"] for each in document["running"]] == list(range(count, 2, -1))
    assert f"The {RUNNING_MAX} newest of {count} running episodes" in shown.stdout
