"""Ctrl-C while a plan's events cannot be stored: the command ends at once, and loses nothing."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pycrorm_async.cli.interruption import interrupt_on_termination
from tests.commands import answer, pycrorm, run_script

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

PLAN = """
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
    (tmp_path / "waits.py").write_text(PLAN)
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


def test_an_interrupt_while_events_are_stored_ends_at_once_and_the_line_before_announced_it(tmp_path: Path) -> None:
    done = run_script(STORING, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.splitlines() == [
        "recorded events are being stored; Ctrl-C again exits at once without losing any",
        "pycrorm: interrupted; events not stored yet are safe in the spool, and the next start stores them",
    ]


def test_an_interrupt_while_a_private_memory_stores_ends_with_what_is_lost(tmp_path: Path) -> None:
    done = run_script(STORING, "private", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.splitlines() == [
        "recorded events are being stored; Ctrl-C again exits at once and all events of sqlite:// are lost",
        "pycrorm: interrupted; the events of sqlite:// are lost, because this memory ends with its process",
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
