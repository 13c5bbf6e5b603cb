"""The process of `pycrorm writer` that folds, beside the one that appends: what becomes of either when one is gone."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.notes import NOTES_PLAN
from tests.commands import COMMAND, answer, environment
from tests.databases import ask, ask_to_change


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    return tmp_path


@pytest.fixture
def daemon(folder: Path) -> Iterator[subprocess.Popen[str]]:
    command = [*COMMAND, "writer"]
    process = subprocess.Popen(command, cwd=folder, env=environment(), stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert process.stderr.readline().startswith("draining")
    yield process
    process.kill()
    process.communicate()


def children_of(process: subprocess.Popen[str]) -> list[int]:
    return [int(each) for each in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


def is_gone(process: int) -> bool:
    """Within some seconds."""
    for _ in range(500):
        status = Path(f"/proc/{process}/stat")
        if not status.exists() or status.read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.01)
    return False


def noted(folder: Path) -> int:
    """How many notes a plan beside the daemon left in the tables when it was over."""
    answer("run", "notes.py", "--writer", "daemon", cwd=folder)
    return int(ask(f"sqlite:///{folder}/pycrorm.db", "SELECT count(*) FROM note_action")[0][0])


def test_another_process_folds(folder: Path, daemon: subprocess.Popen[str]) -> None:
    (child,) = children_of(daemon)
    before = Path(f"/proc/{child}/stat").read_text()
    assert noted(folder) == 3
    assert Path(f"/proc/{child}/stat").read_text() != before  # it has worked


def test_when_it_is_killed_the_daemon_says_so_once_and_folds(folder: Path, daemon: subprocess.Popen[str]) -> None:
    assert noted(folder) == 3
    (child,) = children_of(daemon)
    os.kill(child, signal.SIGKILL)
    assert is_gone(child)
    assert noted(folder) == 6
    assert noted(folder) == 9
    daemon.send_signal(signal.SIGTERM)
    _, said = daemon.communicate(timeout=15)
    assert daemon.returncode == 0
    assert said.count("the process that folds has died: from now on this one does\n") == 1
    assert "Traceback" not in said


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_it_ends_with_the_daemon(folder: Path, daemon: subprocess.Popen[str], end: signal.Signals) -> None:
    assert noted(folder) == 3
    (child,) = children_of(daemon)
    daemon.send_signal(end)
    daemon.communicate(timeout=15)
    assert is_gone(child)


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT])
def test_what_a_terminal_sends_to_both_ends_it_with_the_daemon_and_no_sooner(
    folder: Path, daemon: subprocess.Popen[str], end: signal.Signals
) -> None:
    (child,) = children_of(daemon)
    os.kill(child, end)
    assert noted(folder) == 3
    assert children_of(daemon) == [child]
    os.kill(child, end)
    daemon.send_signal(end)
    _, said = daemon.communicate(timeout=15)
    assert daemon.returncode == 0
    assert "died" not in said
    assert "Traceback" not in said
    assert is_gone(child)


def test_what_keeps_it_from_folding_is_told(folder: Path, daemon: subprocess.Popen[str]) -> None:
    assert noted(folder) == 3
    ask_to_change(f"sqlite:///{folder}/pycrorm.db", "DROP TABLE task_tree_node__1")
    plan = subprocess.Popen([*COMMAND, "run", "notes.py", "--writer", "daemon"], cwd=folder, env=environment())
    assert daemon.stderr is not None
    said = ""
    while "cannot be brought" not in said:
        said = daemon.stderr.readline()
        assert said, "the daemon has ended"
    ended = "SELECT count(*) FROM event WHERE type = 'NodeEnded'"
    while ask(f"sqlite:///{folder}/pycrorm.db", ended) != [(8,)]:  # appending goes on
        time.sleep(0.01)
    plan.kill()
    plan.wait()
    assert "no such table: task_tree_node__1" in said
