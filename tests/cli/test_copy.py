"""`pycrorm copy` as an operator uses it: in processes of its own."""

import asyncio
import contextlib
import os
import pty
import signal
import subprocess
from pathlib import Path
from urllib.parse import quote

import asyncpg
import pytest

from tests.commands import COMMAND, answer, environment, one_line_of, pycrorm
from tests.databases import Server
from tests.hand_written import fill, hand_written
from tests.operations.memories import assert_same
from tests.projections.event_script import append_and_fold
from tests.store.factories import episode, record, run_of
from tests.table_comparison import logs_of

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""These tests take long on a server, where they run in turns; other modules show that the server behaves alike."""

PLAN = """
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract

@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    async def perform(self): ...

async def plan():
    await NoteActionPerformable("a").perform()
"""


@pytest.fixture
async def folder(tmp_path: Path) -> Path:
    """A folder with a memory of two episodes."""
    await fill(f"sqlite:///{tmp_path}/a.db", [hand_written(1), hand_written(2)])
    return tmp_path


def ids(number: int) -> str:
    return f"00000000-0000-7000-8000-{number:012}"


def test_a_copy_reports_what_it_did_and_the_copy_of_the_copy_is_the_same(folder: Path, server: Server) -> None:
    server_url = server.new_database()
    document = answer("copy", "--from", "sqlite:///a.db", "--to", server_url, cwd=folder)
    assert document == {
        "source": "sqlite:///a.db",
        "target": server_url.replace(str(server.folder), quote(str(server.folder), safe="")),
        "episodes": [
            {"id": ids(n), "number": n, "were_there": 0, "copied": 12, "head": 12, "damage": None, "stopped": None}
            for n in (1, 2)
        ],
    }
    done = pycrorm(
        "copy", "--from", server_url, "--to", "sqlite:///b.db", "--episode", "1", "--episode", ids(2), cwd=folder
    )
    assert (done.returncode, done.stderr) == (0, "")
    rows = [line.split("│")[1:-1] for line in done.stdout.splitlines() if ids(0)[:20] in line]
    assert [[cell.strip() for cell in row] for row in rows] == [[f"{n}", ids(n), "0", "12", "12"] for n in (1, 2)]
    assert_same(f"sqlite:///{folder}/a.db", f"sqlite:///{folder}/b.db")


@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        (["--to", "sqlite:///a.db"], 2, "sqlite:///a.db and sqlite:///a.db are the same memory"),
        (["--to", "sqlite://"], 2, "sqlite:// exists only in its own process"),
        (["--to", "mysql://lab/b"], 2, "mysql:// is not a supported database"),
        (["--to", "sqlite:///b.db", "--episode", "3"], 2, "there is no episode '3'"),
        (["--to", "sqlite:///b.db", "--from", "sqlite:///none.db"], 3, "sqlite:///none.db does not exist"),
        (["--to", "sqlite:///none/b.db"], 3, "cannot be opened: No such file or directory"),
        (["--to", "postgresql://ada:s3cr@127.0.0.1:1/b"], 3, "ada:***@127.0.0.1:1/b: cannot be reached"),
    ],
)
def test_an_impossible_copy_is_one_line_and_makes_nothing(
    folder: Path, arguments: list[str], code: int, reason: str
) -> None:
    done = pycrorm("copy", "--from", "sqlite:///a.db", *arguments, cwd=folder)
    assert (done.returncode, done.stdout) == (code, "")
    assert reason in one_line_of(done)
    assert "s3cr" not in done.stderr
    assert {path.name for path in folder.iterdir()} <= {"a.db", "a.db-wal", "a.db-shm"}


async def test_two_memories_that_contradict_each_other_are_reported_and_the_rest_is_copied(folder: Path) -> None:
    other = f"sqlite:///{folder}/b.db"
    await append_and_fold(other, [hand_written(1).records[0]._replace(monotonic_ns=6)], folded=False)
    done = pycrorm("copy", "--from", "sqlite:///a.db", "--to", "sqlite:///b.db", cwd=folder)
    assert done.returncode == 4
    assert one_line_of(done) == (
        f"pycrorm: episode {ids(1)}, event 1: sqlite:///b.db has another event with this sequence than sqlite:///a.db"
    )
    assert [len(events) for events in logs_of(other).values()] == [1, 12]
    document = answer("copy", "--from", "sqlite:///a.db", "--to", "sqlite:///b.db", cwd=folder, code=4)
    assert [(each["copied"], each["damage"] is None) for each in document["episodes"]] == [(0, False), (0, True)]


async def test_an_episode_that_cannot_be_folded_is_copied_and_reported(folder: Path) -> None:
    await append_and_fold(f"sqlite:///{folder}/c.db", [record(episode(9), 1, kind="HandShaken", payload=b"{}")])
    done = pycrorm("copy", "--from", "sqlite:///c.db", "--to", "sqlite:///b.db", cwd=folder)
    assert done.returncode == 1
    name = "00000000-0000-0000-0000-000000000009"
    reason = "event 1: HandShaken is not an event type of this version"
    assert one_line_of(done) == f"pycrorm: episode {name} is stopped: {reason}"
    assert len(logs_of(f"sqlite:///{folder}/b.db")[name]) == 1


def test_a_copy_is_interrupted_at_once_and_the_next_one_takes_the_rest(tmp_path: Path, server: Server) -> None:
    source, target = f"sqlite:///{tmp_path}/pycrorm.db", server.new_database()
    asyncio.run(append_and_fold(source, run_of(episode(1), 1, 2_000), folded=False))
    asyncio.run(append_and_fold(target, run_of(episode(1), 1, 500)))
    # A terminal, so that the copy shows its progress.
    ours, its = pty.openpty()
    with asyncio.Runner() as runner:
        # The append of the copy waits for this lock.
        holding = runner.run(asyncpg.connect(target))
        runner.run(holding.execute("BEGIN; LOCK TABLE pycrorm.event IN EXCLUSIVE MODE"))
        before = signal.signal(signal.SIGINT, signal.default_int_handler)  # or the signal is ignored there too
        process = subprocess.Popen(
            [*COMMAND, "copy", "--to", target],
            cwd=tmp_path,
            env=environment() | {"TERM": "xterm"},
            stdout=subprocess.PIPE,
            stderr=its,
        )
        signal.signal(signal.SIGINT, before)
        os.close(its)
        shown = b""
        while b"2000/2000" not in shown:
            shown += os.read(ours, 1000)
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(OSError):  # when the other end is closed
            while True:
                shown += os.read(ours, 1000)
        code = process.wait(60)
        runner.run(holding.close())
    os.close(ours)
    assert process.communicate()[0] == b""
    assert code == 130, shown
    assert b"interrupted; all events recorded so far are kept" in shown
    assert b"Traceback" not in shown
    assert [len(events) for events in logs_of(target).values()] == [500]
    [done] = answer("copy", "--to", target, cwd=tmp_path)["episodes"]
    assert (done["were_there"], done["copied"], done["head"]) == (500, 1_500, 2_000)
    assert logs_of(target) == logs_of(source)
