"""`pycrorm rebuild` as an operator runs it: in a process of its own without the code of the plan."""

from __future__ import annotations

import asyncio
import os
import signal
import sqlite3
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import pytest

from pycrorm_async.projections.rebuild import claimed
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.commands import COMMAND, answer, environment, one_line_of, pycrorm
from tests.projections.factories import append_and_fold
from tests.projections.rebuild_cases import TYPES, parking, picking, str_of, traces
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow

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
        "generation": 1002, "events": 6, "episodes": 1, "seconds": 0, "parked": {}, "left": []
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


@pytest.mark.parametrize(
    ("arguments", "code", "line"),
    [
        (["--url", "sqlite:///none.db"], 3, "none.db does not exist"),
        (["--url", "sqlite://"], 2, "sqlite:// exists only in its own process"),
        (["--url", "sqlite:///text.db"], 3, "is not a database"),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, arguments: Sequence[str], code: int, line: str) -> None:
    (tmp_path / "text.db").write_text("no database at all, " * 100)
    done = pycrorm("rebuild", *arguments, cwd=tmp_path)
    assert done.returncode == code
    assert line in one_line_of(done)
    assert [each.name for each in tmp_path.iterdir()] == ["text.db"]


async def test_a_second_rebuild_is_refused_with_one_line(database_url: str, tmp_path: Path) -> None:
    await append_and_fold(database_url, [*TYPES, *picking(1).records])
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    async with claimed(log):
        done = await asyncio.to_thread(pycrorm, "rebuild", "--url", database_url, cwd=tmp_path)
    await log.close()
    assert done.returncode == 2
    assert one_line_of(done).endswith("another `pycrorm rebuild` is running: wait for it to end")


def start_rebuild(folder: Path, workers: str) -> subprocess.Popen[str]:
    """Start a rebuild in a process group of its own."""
    command = [*COMMAND, "rebuild", "--workers", workers]
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


@pytest.mark.soak_on("1")
@pytest.mark.parametrize("workers", ["1", "2"])
def test_an_interrupted_rebuild_exits_with_130_and_the_next_one_continues(tmp_path: Path, workers: str) -> None:
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    asyncio.run(append_and_fold(url, [*TYPES, *(each for number in range(1, 50) for each in picking(number).records)]))
    before = tables_of(url)
    blocker = sqlite3.connect(tmp_path / "pycrorm.db", isolation_level=None, timeout=0)
    making = "SELECT generation FROM pycrorm_generation WHERE projection = 'tables/making'"
    for _ in range(20):  # a rebuild may end before the lock is taken
        process = start_rebuild(tmp_path, workers)
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
