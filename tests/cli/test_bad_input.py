"""Bad input, a bad database or server: one line that names the fault, the documented exit code, no lost event."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.commands import COMMAND, Started, answer, environment, one_line_of, pycrorm
from tests.databases import Server
from tests.store.test_postgresql_logins import WRITTEN, guarded_in

pytestmark = pytest.mark.slow


# === bad input ================================================================================================
#
# Bad input: one line that names the fault, the documented exit code, and no loss of recorded events.


@pytest.mark.parametrize(
    ("arguments", "code", "line"),
    [
        (["run", "plans.py", "--url", "mongodb://lab/memory"], 2, "mongodb:// is not a supported database"),
        (["episodes", "--url", "sqlite"], 2, "this is not a database URL"),
        (["run", "plans.py", "--url", "sqlite:////proc/none/x.db"], 3, "/proc/none"),
        (["episodes", "--url", "sqlite:///none.db"], 3, "none.db does not exist"),
        (["show", "1", "--url", "sqlite:///none.db"], 3, "none.db does not exist"),
        (["show", "1", "--url", "sqlite:///."], 3, "sqlite:///. cannot be opened: Is a directory ("),
        (["show", "1", "--url", "sqlite:///plans.py/x.db"], 3, "cannot be opened: Not a directory ("),
        (["show", "1", "--url", "sqlite:////dev/null"], 3, "sqlite:////dev/null cannot be opened: Is no file (/dev/"),
        (["show", "1", "--url", f"sqlite:///{'x' * 300}.db"], 3, "cannot be opened: File name too long ("),
        (["show", "1", "--url", "sqlite://"], 2, "sqlite:// exists only in its own process"),
        (["export", "1", "--url", "sqlite://"], 2, "sqlite:// exists only in its own process"),
        (["show", "1", "--url", "sqlite:///\udcff.db"], 2, "this is not a database URL"),
        (["mcp", "--url", "sqlite://"], 2, "sqlite:// exists only in its own process"),
        (["spool", "inspect", "--url", "sqlite://"], 2, "sqlite:// exists only in its own process"),
        (["picture", "1", "--out", "scene.jpg"], 2, "--out scene.jpg must end in .png"),
        (["run", "none.py"], 2, "the plan file 'none.py' does not exist"),
        (["run", "."], 2, "'.' is a folder: name the plan file in it"),
        (["run", "broken.py"], 2, "broken.py:2 cannot be imported: AttributeError: module 'math' has no attribute"),
        (["run", "wrong.py"], 2, "wrong.py:1 cannot be imported: SyntaxError"),
        (["run", "leaving.py"], 2, "leaving.py exits the program when it is imported (exit code 4)"),
        (["run", "plans.py:none"], 2, "plans.py has no function 'none'; its async functions: plan,"),
        (["run", "plans.py:sync"], 2, "plans.py:sync is not an async function: write `async def sync()`"),
        (["run", "plans.py:greedy"], 2, "plans.py:greedy takes memory, world: a plan takes the memory or no argument"),
        (
            ["run", "plans.py:opening", "--tag", "a"],
            2,
            "pass `memory.episode(tags=[...])` there, or tag them afterwards",
        ),
        (["run", "turtle.py"], 2, "turtle.py has the name of a standard or already loaded module"),
        (["writer", "--once", "--url", "sqlite://"], 2, "sqlite:// exists only in its own process"),
        (["verify", "--url", "sqlite://"], 2, "sqlite:// exists only in its own process"),
        (["status", "--url", "sqlite:///none.db"], 3, "none.db does not exist"),
        (["rebuild", "--url", "sqlite:///none.db"], 3, "none.db does not exist"),
        (["run", "plans.py", "--url", "sqlite://", "--writer", "daemon"], 2, "no daemon can write it"),
        (["copy"], 2, "missing option '--to'"),
        (["run", "plans.py", "--spool", "plans.py"], 3, "plans.py"),
        (["run", "plans.py", "--seed", "x"], 2, "invalid value for '--seed'"),
        (["run", "plans.py", "--writer", "x"], 2, "'process', 'daemon'; `pycrorm run --help` lists"),
        (["run", "plans.py", "--colour", "x"], 2, "no such option: --colour"),
        (["run"], 2, "missing argument 'PLAN.py[:function]'"),
        (["xyz", "plans.py"], 2, "no such command 'xyz'; `pycrorm --help` lists the commands"),
    ],
)
def test_an_impossible_call_is_reported_in_one_line(folder: Path, arguments: list[str], code: int, line: str) -> None:
    done = pycrorm(*arguments, cwd=folder)
    assert line in one_line_of(done)
    assert done.returncode == code
    assert arguments[0] == "status" or done.stdout == ""  # `status` also describes the spool


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["queri", "SELECT 1"], "no such command 'queri'; did you mean query?"),
        (["reco"], "no such command 'reco'; did you mean report or recall?"),
        (["spool", "inspct"], "no such command 'inspct'; did you mean inspect?"),
        (["query", "SELECT 1", "--limt", "5"], "no such option: --limt; did you mean --limit?"),
        (["recall", "X", "--since", "7d"], "no such option: --since; `pycrorm recall --help` lists the arguments"),
        (["query", "SELECT 1", "--url"], "option '--url' requires an argument"),
    ],
)
def test_a_mistyped_verb_or_option_is_answered_with_the_nearest_ones(
    folder: Path, arguments: list[str], line: str
) -> None:
    done = pycrorm(*arguments, cwd=folder)
    assert (done.returncode, one_line_of(done)) == (2, f"pycrorm: {line}")


@pytest.mark.parametrize(
    ("function", "line", "status"),
    [
        ("raises", "the plan plans.py:raises failed: ValueError: the milk is sour (plans.py:", "ERROR"),
        ("fails", "the plan plans.py:fails failed: PlanFailure: the milk is out of reach (plans.py:", "FAILED"),
        ("cancels", "the plan plans.py:cancels failed: CancelledError (plans.py:", "INTERRUPTED"),
        ("list_for_a_pose", "expected Pose, got list [0.6, 0.4, 0] (plans.py:", "ERROR"),
        ("two_episodes", "is open in this task already", "ERROR"),
        ("leaves", "the plan plans.py:leaves failed: SystemExit: 5 (plans.py:", "ERROR"),
    ],
)
def test_a_plan_that_fails_ends_with_one_line_and_what_it_did_is_recorded(
    folder: Path, function: str, line: str, status: str
) -> None:
    done = pycrorm("run", f"plans.py:{function}", cwd=folder)
    assert line in one_line_of(done)
    assert done.returncode == 1
    shown = answer("show", "last", cwd=folder)
    assert shown["episode"]["status"] == status
    notes = [node for node in shown["tree"] if node["dtype"] == "NoteAction"]
    assert [(node["parameters"]["text"], node["status"]) for node in notes] == [("a", "SUCCEEDED")]


@pytest.mark.parametrize(
    ("function", "line", "second"),
    [
        ("unrecordable", "NoteAction.weight is recorded as missing: declared as float, got a str", "NoteAction"),
        ("without_column", "BadAction.words is recorded as missing: has the type set[str], which has no", "BadAction"),
        ("twins", "plans.NoteActionPerformable already has the dtype or table 'NoteAction'", None),
    ],
)
def test_a_plan_with_an_unrecordable_value_runs_to_its_end_with_a_warning(
    folder: Path, function: str, line: str, second: str | None
) -> None:
    done = pycrorm("run", f"plans.py:{function}", cwd=folder)
    assert line in " ".join(done.stderr.split())
    assert done.returncode == 0
    shown = answer("show", "last", cwd=folder)
    assert [(node["dtype"], node["status"]) for node in shown["tree"][1:]] == [
        ("NoteAction", "SUCCEEDED"),
        (second, "SUCCEEDED"),
    ]


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_in_a_plan_that_never_suspends_ends_the_episode_as_interrupted(
    folder: Path, signal_number: signal.Signals
) -> None:
    process = Started("run", "plans.py:endless", cwd=folder)
    assert process.stdout.read(1) == "."
    time.sleep(0.05)
    process.send_signal(signal_number)
    output, errors = process.communicate(30)
    dots = 1 + output.count(".")
    assert process.returncode == 130
    *note, reason = errors.splitlines()
    assert note in ([], ["recorded events are being stored; Ctrl-C again exits at once without losing any"])  # if slow
    assert reason == "pycrorm: interrupted; all events recorded so far are kept"
    shown = answer("show", "last", cwd=folder)
    assert shown["episode"]["status"] == "INTERRUPTED"
    notes = [node for node in shown["tree"] if node["dtype"] == "NoteAction"]
    ended = [node for node in notes if node["status"] == "SUCCEEDED"]
    assert len(ended) == dots
    assert len(notes) - len(ended) <= 1
    assert shown["tree"][0]["status"] == "CANCELLED"


def test_without_episodes_one_line_names_the_command_that_records_one(folder: Path) -> None:
    assert pycrorm("writer", "--once", "--url", "sqlite:///new.db", cwd=folder).returncode == 0
    how = "record one with `pycrorm run` or `pycrorm demo`"
    done = pycrorm("show", "last", "--url", "sqlite:///new.db", cwd=folder)
    assert (done.returncode, one_line_of(done)) == (
        2,
        f"pycrorm: there is no episode 'last' (this memory has none yet: {how})",
    )
    done = pycrorm("episodes", "--url", "sqlite:///new.db", cwd=folder)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", f"no episode yet: {how}\n")
    done = pycrorm("episodes", "--status", "FAILED", "--url", "sqlite:///new.db", cwd=folder)
    assert (done.stdout, done.stderr) == ("", "no episode matches these options; `pycrorm episodes` lists all\n")


def test_the_settings_may_come_from_the_environment(folder: Path) -> None:
    running = Started("run", "plans.py", cwd=folder, PYCRORM_URL="sqlite:///mine.db", PYCRORM_SPOOL="mine.spool")
    _, errors = running.communicate()
    assert running.returncode == 0, errors
    assert (folder / "mine.db").exists()
    assert (folder / "mine.spool").is_dir()
    assert not os.path.lexists(folder / "pycrorm.db")


def test_a_json_answer_is_one_document_whatever_the_plan_prints(folder: Path) -> None:
    (folder / "loud.py").write_text("async def plan():\n    print('hello')\n")
    done = answer("run", "loud.py", cwd=folder)
    assert (done["failure"], [each["status"] for each in done["episodes"]]) == (None, ["SUCCEEDED"])
    failed = answer("run", "plans.py:cancels", cwd=folder, code=1)
    assert failed["failure"].startswith("CancelledError")
    assert [each["status"] for each in failed["episodes"]] == ["INTERRUPTED"]


def test_an_answer_that_cannot_be_written_is_reported_in_one_line(folder: Path) -> None:
    assert pycrorm("run", "plans.py", cwd=folder).returncode == 0
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, "episodes"],
            cwd=folder,
            env=environment(),
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert "No space left on device" in done.stderr.splitlines()[0]
    assert "Traceback" not in done.stderr
    assert done.returncode != 0


# === bad plans ================================================================================================
#
# Hold the text of plans that fail, exit, never suspend, or pass values that cannot be recorded.

PLANS = '''
import asyncio, os, sys
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract, NavigateActionPerformable, PlanFailure

@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    weight: float = 0.0
    async def perform(self):
        return None

async def plan():
    """Take a note."""
    await NoteActionPerformable("a").perform()

def sync():
    pass

async def greedy(memory, world):
    pass

async def raises():
    await NoteActionPerformable("a").perform()
    raise ValueError("the milk is sour")

async def fails():
    await NoteActionPerformable("a").perform()
    raise PlanFailure("the milk is out of reach")

async def cancels():
    await NoteActionPerformable("a").perform()
    asyncio.current_task().cancel()
    await asyncio.sleep(1)

async def unrecordable():
    await NoteActionPerformable("a").perform()
    await NoteActionPerformable("b", weight="heavy").perform()

async def without_column():
    @dataclass
    class BadActionPerformable(ActionAbstract):
        words: set[str]
        async def perform(self):
            return None
    await NoteActionPerformable("a").perform()
    await BadActionPerformable({"x"}).perform()

async def twins():
    @dataclass
    class NoteAction(ActionAbstract):
        async def perform(self):
            return None
    await NoteActionPerformable("a").perform()
    await NoteAction().perform()

async def list_for_a_pose():
    await NoteActionPerformable("a").perform()
    NavigateActionPerformable([0.6, 0.4, 0])

async def two_episodes(memory):
    async with memory.episode(description="outer"):
        await NoteActionPerformable("a").perform()
        async with memory.episode(description="inner"):
            pass

async def leaves():
    await NoteActionPerformable("a").perform()
    sys.exit(5)

async def opening(memory):
    pass

async def endless():
    """Never suspends."""
    while True:
        await NoteActionPerformable("a").perform()
        os.write(1, b".")
'''


# === fixtures =================================================================================================
#
# Provide a folder with plans that go wrong, and with modules that cannot be imported as plans.


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "plans.py").write_text(PLANS)
    (tmp_path / "broken.py").write_text("import math\nmath.no_such_thing\n")
    (tmp_path / "wrong.py").write_text("def plan(:\n")
    (tmp_path / "turtle.py").write_text("async def plan(): pass\n")
    (tmp_path / "leaving.py").write_text("raise SystemExit(4)\n")
    return tmp_path


# === bad database =============================================================================================
#
# A database that is none, is newer, belongs to another program or may only be read is refused in one line.


def test_a_file_that_is_no_database_is_left_unchanged(folder: Path) -> None:
    for arguments in (["run", "plans.py"], ["episodes"]):
        done = pycrorm(*arguments, "--url", "sqlite:///plans.py", cwd=folder)
        assert "plans.py" in one_line_of(done)
        assert done.returncode == 3
    assert (folder / "plans.py").read_text() == PLANS


def test_a_database_in_a_folder_without_write_permission_is_reported_with_its_path(folder: Path) -> None:
    assert pycrorm("run", "plans.py", cwd=folder).returncode == 0
    (folder / "pycrorm.db-wal").mkdir()  # SQLite cannot make its file there: as on a read-only disk
    for arguments in (["run", "plans.py"], ["episodes"]):
        done = pycrorm(*arguments, "--url", f"sqlite:///{folder}/pycrorm.db", cwd=folder)
        assert one_line_of(done) == (
            f"pycrorm: sqlite:///{folder}/pycrorm.db cannot be opened: the file must be readable and its folder"
            " writable, because SQLite creates files beside it, also for reading"
        )
        assert done.returncode == 3
    (folder / "pycrorm.db-wal").rmdir()
    assert len(answer("episodes", cwd=folder)) == 1


def bound() -> list[str]:
    """Return the command that runs another one as a user whom the modes of files bind, as they do not bind root."""
    return ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []


def without_rights(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [*bound(), *COMMAND, *arguments]
    return subprocess.run(command, cwd=cwd, env=environment(), capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.soak  # the test before it opens the file only
def test_a_file_that_may_only_be_read_is_refused_before_the_plan_runs_and_can_be_read(folder: Path) -> None:
    assert pycrorm("run", "plans.py", cwd=folder).returncode == 0
    (folder / "pycrorm.db").chmod(0o444)
    done = without_rights("run", "plans.py", cwd=folder)
    reason = "this user may only read it: record with a user who may write it, or name another file"
    assert one_line_of(done) == f"pycrorm: sqlite:///pycrorm.db cannot be written: {reason}"
    assert (done.returncode, done.stdout) == (3, "")
    assert json.loads(without_rights("episodes", "--json", cwd=folder).stdout)[0]["number"] == 1
    for each in folder.glob("pycrorm.db-*"):
        each.unlink()
    folder.chmod(0o555)
    done = without_rights("episodes", cwd=folder)
    folder.chmod(0o755)
    assert "the file must be readable and its folder writable" in one_line_of(done)
    assert done.returncode == 3


# === unavailable server =======================================================================================
#
# A PostgreSQL that cannot be used is one line, exit code 3 or 2, and no password on the screen.


@pytest.mark.parametrize("verb", [["episodes"], ["show", "last"], ["run", "plans.py"], ["writer", "--once"]])
def test_an_unreachable_server_is_one_line_without_a_password(folder: Path, verb: list[str]) -> None:
    done = pycrorm(*verb, "--url", "postgresql://ada:s3cr@127.0.0.1:1/memory", cwd=folder)
    assert (done.returncode, done.stdout) == (3, "")
    message = one_line_of(done)
    reached = "cannot be reached: Connection refused: start the server, or correct the URL"
    assert message == f"pycrorm: postgresql://ada:***@127.0.0.1:1/memory: {reached}"


async def test_a_wrong_password_is_one_line_and_the_right_one_stores_the_waiting_events(
    server: Server, folder: Path
) -> None:
    database = guarded_in(server)
    wrong = server.url(database, user="guarded", password="s3cr-wrong")
    right = server.url(database, user="guarded", password=WRITTEN)
    assert pycrorm("run", "plans.py", "--writer", "daemon", "--spool", "spool", cwd=folder).returncode == 0
    for verb in (["run", "plans.py"], ["writer"], ["writer", "--once"], ["episodes"]):
        done = pycrorm(*verb, "--url", wrong, "--spool", "spool", cwd=folder)
        message = one_line_of(done)
        advice = "put the right password into PYCRORM_URL or ~/.pgpass"
        assert message.endswith(f'password authentication failed for user "guarded": {advice}')
        assert (done.returncode, done.stdout, "s3cr" in message) == (3, "", False)
    assert answer("writer", "--once", "--url", right, "--spool", "spool", cwd=folder)["events_stored"] == 7


# === unusable spool ===========================================================================================
#
# A spool whose disk is full or may only be read is one line and exit code 3.

REFUSING = """
import errno, os, sys
place, fault = sys.argv.pop(1), getattr(errno, sys.argv.pop(1))
def refusing(call):
    def refused(path, *rest, **options):
        where = os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else os.path.abspath(path)
        if where.startswith(place):
            raise OSError(fault, os.strerror(fault), where)
        return call(path, *rest, **options)
    return refused
os.posix_fallocate = refusing(os.posix_fallocate)
if fault == errno.EROFS:
    os.mkdir = refusing(os.mkdir)
from pycrorm_async.cli.main import main
main()
"""
"""Run the command on a machine that can make no file below a place."""


@pytest.mark.parametrize(
    ("fault", "reason"), [("EROFS", "Read-only file system"), ("ENOSPC", "No space left on device")]
)
def test_a_spool_on_a_disk_that_takes_no_file_is_refused_in_one_line(folder: Path, fault: str, reason: str) -> None:
    spool = folder / "disk" / "spool"
    spool.parent.mkdir()
    words = [sys.executable, "-c", REFUSING, str(spool), fault, "run", "plans.py", "--spool", str(spool)]
    done = subprocess.run(words, cwd=folder, env=environment(), capture_output=True, text=True, check=False)
    assert one_line_of(done).startswith(f"pycrorm: spool {spool}")
    assert reason in one_line_of(done)
    assert (done.returncode, done.stdout) == (3, "")
