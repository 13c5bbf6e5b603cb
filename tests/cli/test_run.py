"""`pycrorm run`: its options, the source that it records, the mistakes of a plan, and Ctrl-C."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.cli import run as reader
from pycrorm_async.cli.interruption import interrupt_on_termination
from pycrorm_async.cli.run import plan_source
from pycrorm_async.record.opening import PlanSource
from tests.bullet import ENGINE, INSTALLED_ENGINES
from tests.commands import answer, one_line_of, pycrorm, run_script

# === run options ==============================================================================================
#
# `pycrorm run` accepts the settings of a recording as options, and refuses a wrong one in one line.

PLAN = """
async def settings(memory):
    used = memory._settings
    print(used.sample_interval_ms, used.on_unrecordable, used.on_full, used.record_meshes, used.file_access)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "plan.py").write_text(PLAN)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "settings"),
    [
        ("", "None record_missing wait boxes owner"),
        (
            "--sample-interval-ms 7 --on-unrecordable refuse --on-full fail --record-meshes files --file-access group",
            "7 refuse fail files group",
        ),
    ],
)
def test_the_settings_of_a_recording_are_options(folder: Path, options: str, settings: str) -> None:
    ran = pycrorm("run", "plan.py:settings", *options.split(), cwd=folder)
    assert (ran.returncode, ran.stdout.splitlines()[0]) == (0, settings), ran.stderr


INTEGER = "Input should be a valid integer, unable to parse string as an integer"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "value", "reason"),
    [
        ("--sample-interval-ms", "0", "Input should be greater than or equal to 1"),
        ("--sample-interval-ms", "2.5", INTEGER),
        ("--on-unrecordable", "record", "'record' is not one of 'record_missing', 'refuse'"),
    ],
)
def test_a_wrong_option_is_one_line_and_nothing_runs(folder: Path, option: str, value: str, reason: str) -> None:
    ran = pycrorm("run", "plan.py:settings", f"{option}={value}", cwd=folder)
    assert (ran.returncode, ran.stdout) == (2, "")
    listed = "`pycrorm run --help` lists the arguments"
    assert one_line_of(ran) == f"pycrorm: invalid value for '{option}': {reason}; {listed}"
    assert not (folder / "pycrorm.db").exists()


# === interruption =============================================================================================
#
# Ctrl-C while a plan's events cannot be stored: the command ends at once, and loses nothing.

LOADING = """
import builtins, os, signal, sys
load, interrupting = builtins.__import__, sys.argv[1]
def interrupted(name, *rest, **options):
    if name == interrupting:
        os.kill(os.getpid(), signal.SIGINT)
    return load(name, *rest, **options)
builtins.__import__ = interrupted
from pycrorm_async.__main__ import main
sys.argv = ["pycrorm", "run", "plan.py"]
main()
"""

READING_ARGUMENTS = """
import os, signal, sys
from typer.core import TyperGroup
read = TyperGroup.parse_args
def interrupted(*arguments):
    os.kill(os.getpid(), signal.SIGINT)
    return read(*arguments)
TyperGroup.parse_args = interrupted
sys.argv = ["pycrorm", "run", "plan.py"]
from pycrorm_async.__main__ import main
main()
"""

SPEAKING = """
import asyncio, os, signal
from pycrorm_async.cli.interruption import Interruption
from pycrorm_async.progress_bar import stderr

class Interrupted:
    def __rich_console__(self, console, options):
        os.kill(os.getpid(), signal.SIGINT)
        yield "the rest of the line"

async def main():
    with Interruption(plan_signals_max=1).handled():
        os.kill(os.getpid(), signal.SIGINT)
        stderr.print(Interrupted())

asyncio.run(main())
"""

STORING = """
import asyncio, os, signal, sys
from pycrorm_async.cli import interruption

interruption._NOTE_DELAY_S = 0.0

async def main():
    handling = interruption.Interruption(is_private=sys.argv[1:] == ["private"])
    with handling.handled():
        os.kill(os.getpid(), signal.SIGINT)
        try:
            await asyncio.sleep(60)
        except asyncio.CancelledError:  # the plan has ended, and its events are being stored
            handling.plan_ended()
            await asyncio.sleep(0.01)
            os.kill(os.getpid(), signal.SIGINT)
            print("not reached")

asyncio.run(main())
"""

INTERRUPTED_PLAN = """
import pathlib, time
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract

@dataclass
class WaitingAction(ActionAbstract):
    name: str

    async def perform(self):
        pathlib.Path("waits").touch()
        while not pathlib.Path("go").exists():
            time.sleep(0.01)

async def plan():
    await WaitingAction("for a sign").perform()
    pathlib.Path("done").touch()
"""


def _appears(path: Path) -> bool:
    end = time.monotonic() + 120
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.02)
    return path.exists()


@pytest.mark.soak  # the second signal while events are stored is also sent to a script, below
@pytest.mark.slow
def test_a_plan_whose_database_is_unavailable_at_its_end_is_interrupted_by_ctrl_c_and_stored_later(
    tmp_path: Path,
) -> None:
    (tmp_path / "waits.py").write_text(INTERRUPTED_PLAN)
    running = subprocess.Popen(
        [sys.executable, "-m", "pycrorm_async", "run", "waits.py"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert _appears(tmp_path / "waits")
        with contextlib.closing(sqlite3.connect(tmp_path / "pycrorm.db", isolation_level=None, timeout=60)) as other:
            other.execute("BEGIN IMMEDIATE")
            (tmp_path / "go").touch()
            assert _appears(tmp_path / "done")
            time.sleep(1)  # the plan waits for the database
            running.send_signal(signal.SIGINT)
            _, errors = running.communicate(timeout=60)  # and not after the five minutes that closing would wait
    finally:
        running.kill()
    assert running.returncode == 130
    assert "events not stored yet are safe in the spool" in errors
    assert pycrorm("writer", "--once", cwd=tmp_path).returncode == 0
    (episode,) = answer("episodes", cwd=tmp_path)
    assert episode["nodes"] == 2
    assert [node["status"] for node in answer("show", "1", cwd=tmp_path)["tree"]] == ["SUCCEEDED", "SUCCEEDED"]


@pytest.mark.parametrize("module", ["typer", "pycrorm_async.memory"])
def test_an_interrupt_during_loading_is_one_line(tmp_path: Path, module: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LOADING, module], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (130, "pycrorm: interrupted before the command started\n")
    assert not list(tmp_path.iterdir())


def test_an_interrupt_while_the_arguments_are_read_is_one_line(tmp_path: Path) -> None:
    done = run_script(READING_ARGUMENTS, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (130, "pycrorm: interrupted; all events recorded so far are kept\n")
    assert not list(tmp_path.iterdir())


def test_an_interrupt_during_output_comes_after_the_last_line(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SPEAKING], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    line = "pycrorm: interrupted; events not stored yet are safe in the spool, and the next start stores them\n"
    assert (done.returncode, done.stderr) == (130, line)


@pytest.mark.parametrize(
    ("memory", "announced", "last"),
    [
        (
            "stored",
            "Ctrl-C again exits at once without losing any",
            "events not stored yet are safe in the spool, and the next start stores them",
        ),
        (
            "private",
            "Ctrl-C again exits at once and all events of sqlite:// are lost",
            "the events of sqlite:// are lost, because this memory ends with its process",
        ),
    ],
)
def test_an_interrupt_while_events_are_stored_ends_at_once_and_the_line_before_announced_it(
    tmp_path: Path, memory: str, announced: str, last: str
) -> None:
    done = run_script(STORING, memory, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.splitlines() == [
        f"recorded events are being stored; {announced}",
        f"pycrorm: interrupted; {last}",
    ]


def test_a_plan_in_a_private_memory_that_is_interrupted_again_and_again_ends_with_what_is_lost(tmp_path: Path) -> None:
    (tmp_path / "waits.py").write_text(
        "import asyncio, os, signal\n\n"
        "async def plan():\n"
        "    for _ in range(3):\n"
        "        try:\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "            await asyncio.sleep(60)\n"
        "        except (asyncio.CancelledError, KeyboardInterrupt):\n"
        "            pass\n"
    )
    done = pycrorm("run", "waits.py", "--url", "sqlite://", cwd=tmp_path)
    assert done.returncode == 130
    assert done.stderr.endswith("the events of sqlite:// are lost, because this memory ends with its process\n")


def test_a_verb_that_writes_files_treats_sigterm_as_ctrl_c() -> None:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    cleaned: list[int] = []

    async def write() -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            await asyncio.sleep(20)
        finally:
            cleaned.append(1)

    try:
        for handler in (signal.default_int_handler, signal.SIG_IGN):
            signal.signal(signal.SIGINT, handler)
            interrupt_on_termination()
            with pytest.raises(KeyboardInterrupt):
                asyncio.run(write())
    finally:
        signal.signal(signal.SIGTERM, before[0])
        signal.signal(signal.SIGINT, before[1])
    assert cleaned == [1, 1]


# === plan source ==============================================================================================
#
# `pycrorm run` records the hash of the plan's file and the state of its git repository; git may be absent or slow.

EMPTY_PLAN = "async def plan():\n    pass\n"


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=me", "-c", "user.email=me@example.org")
    command = ["git", *identity, *arguments]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    (tmp_path / "myplan.py").write_text(EMPTY_PLAN)
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "myplan.py")
    git(tmp_path, "commit", "-q", "-m", "a plan")
    return tmp_path


def test_the_commit_is_clean_dirty_or_lacks_the_plan(repository: Path) -> None:
    commit = git(repository, "rev-parse", "HEAD")
    plan, other = repository / "myplan.py", repository / "another.py"
    (repository / "memory.db").write_text("an untracked file beside the plan changes nothing")
    assert plan_source(plan, "0") == PlanSource("0", commit, git_dirty=False)
    other.write_text(EMPTY_PLAN)
    assert plan_source(other, "0") == PlanSource("0", commit, git_dirty=True)
    plan.write_text(EMPTY_PLAN + "# changed\n")
    assert plan_source(plan, "0") == PlanSource("0", commit, git_dirty=True)


def test_without_a_repository_or_a_commit_only_the_hash_is_known(tmp_path: Path) -> None:
    plan = tmp_path / "myplan.py"
    plan.write_text(EMPTY_PLAN)
    assert plan_source(plan, "0") == PlanSource("0")
    git(tmp_path, "init", "-q")
    assert plan_source(plan, "0") == PlanSource("0")


@pytest.mark.parametrize("script", [None, "#!/bin/sh\nexit 128\n", "#!/bin/sh\nexec sleep 60\n"])
def test_git_may_be_absent_fail_or_hang(
    repository: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, script: str | None
) -> None:
    programs = tmp_path_factory.mktemp("programs")
    if script is not None:
        (programs / "git").write_text(script)
        (programs / "git").chmod(0o700)
    (programs / "sleep").symlink_to("/bin/sleep")
    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.setattr(reader, "_GIT_TIMEOUT_S", 0.3)
    began = time.monotonic()
    assert plan_source(repository / "myplan.py", "0") == PlanSource("0")
    assert time.monotonic() - began < 30


@pytest.mark.slow
def test_run_records_the_source_and_show_and_episodes_print_it(repository: Path) -> None:
    assert pycrorm("run", "myplan.py", cwd=repository).returncode == 0
    shown: list[dict[str, Any]] = json.loads(pycrorm("episodes", "--json", cwd=repository).stdout)
    commit = git(repository, "rev-parse", "HEAD")
    digest = hashlib.sha256(EMPTY_PLAN.encode()).hexdigest()
    assert [(each["plan_sha256"], each["git_commit"], each["git_dirty"]) for each in shown] == [(digest, commit, False)]
    assert set(INSTALLED_ENGINES) <= set(shown[0]["libraries"])
    assert shown[0]["settings"] is None
    (repository / "myplan.py").write_text(EMPTY_PLAN + "\n")
    assert pycrorm("run", "myplan.py", "--on-full", "fail", cwd=repository).returncode == 0
    text = pycrorm("show", "last", "--full", cwd=repository).stdout
    assert f"commit    {commit} and uncommitted changes" in text
    assert f"(sha256 {digest[:12]}…)" in pycrorm("show", "1", cwd=repository).stdout
    assert "on_full fail" in text
    assert all(f"{name} {version(name)}" in text for name in INSTALLED_ENGINES)
    assert os.sep not in json.dumps(shown[0]["libraries"])


# === run mistakes =============================================================================================
#
# `pycrorm run` names the usual mistakes of a plan in one line: no await, no resolve, an exit of its own.

MISTAKEN_PLAN = """
import asyncio
import sys

from pycrorm_async.plan import MoveTorsoAction, MoveTorsoActionPerformable
from pycrorm_async.world import BulletWorld

async def forgotten():
    with BulletWorld():
        MoveTorsoActionPerformable(0.1).perform()

async def unresolved():
    await MoveTorsoAction([0.1]).perform()

async def leaving():
    sys.exit(0)

async def leaving_in_a_task():
    async def leave():
        sys.exit(0)
    await asyncio.create_task(leave())

async def leaving_badly():
    async def leave():
        sys.exit(3)
    await asyncio.create_task(leave())
"""


@pytest.mark.slow
def test_a_forgotten_await_is_named_and_exits_1(tmp_path: Path) -> None:
    (tmp_path / "plan.py").write_text(MISTAKEN_PLAN)
    ran = pycrorm("run", "plan.py:forgotten", cwd=tmp_path)
    sentence = "MoveTorsoAction.perform() was called and never awaited, so it did not run: write `await`"
    assert ran.returncode == 1
    assert sentence in ran.stderr
    shown = pycrorm("run", "plan.py:forgotten", "--json", cwd=tmp_path)
    assert shown.returncode == 1
    assert json.loads(shown.stdout)["unawaited"] == [sentence]


@pytest.mark.slow
def test_a_missing_resolve_is_named(tmp_path: Path) -> None:
    (tmp_path / "plan.py").write_text(MISTAKEN_PLAN)
    ran = pycrorm("run", "plan.py:unresolved", cwd=tmp_path)
    assert ran.returncode == 1
    assert "NotResolved: MoveTorsoAction is a description and has no 'perform': resolve it first" in ran.stderr
    assert "MoveTorsoAction(…).resolve().perform() (plan.py:13)" in ran.stderr
    assert "Traceback" not in ran.stderr


@pytest.mark.slow
def test_a_plan_that_exits_the_program_is_reported_as_such(tmp_path: Path) -> None:
    (tmp_path / "plan.py").write_text(MISTAKEN_PLAN)
    for name, line in (("leaving", 16), ("leaving_in_a_task", 20)):
        ran = pycrorm("run", f"plan.py:{name}", cwd=tmp_path)
        assert (ran.returncode, "Traceback" in ran.stderr) == (0, False), ran.stderr
        assert f"the plan plan.py:{name} called sys.exit(0) (plan.py:{line})" in ran.stderr
    ran = pycrorm("run", "plan.py:leaving_badly", cwd=tmp_path)
    assert ran.returncode == 1
    assert "failed: SystemExit: 3 (plan.py:25)" in ran.stderr
    assert json.loads(pycrorm("episodes", "--json", cwd=tmp_path).stdout)


ENGINE_PLAN = """

from pycrorm_async.plan import MoveTorsoAction, simulated_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType

async def plan():
    with BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        await MoveTorsoAction([0.2]).resolve().perform()
"""


@pytest.mark.slow
def test_run_takes_the_engine_and_show_prints_it_with_its_version(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="needs mujoco-core, which the extra [test] installs")
    (tmp_path / "torso.py").write_text(ENGINE_PLAN)
    for words in (["--engine", "mujoco"], []):
        assert pycrorm("run", "torso.py", *words, cwd=tmp_path).returncode == 0
    lines = [pycrorm("show", number, cwd=tmp_path).stdout for number in "12"]
    assert f"BulletWorld (DIRECT, MuJoCo {version('mujoco-core')}): pr2 (ROBOT)" in lines[0]
    assert f"BulletWorld (DIRECT, {ENGINE}): pr2 (ROBOT)" in lines[1]
    shown: list[dict[str, Any]] = json.loads(pycrorm("episodes", "--json", cwd=tmp_path).stdout)
    assert all(each["libraries"]["mujoco-core"] == version("mujoco-core") for each in shown)
    refused = pycrorm("run", "torso.py", "--engine", "ode", cwd=tmp_path)
    assert refused.returncode == 2
    assert one_line_of(refused) == "pycrorm: unknown engine 'ode'; engines: bullet, mujoco"
