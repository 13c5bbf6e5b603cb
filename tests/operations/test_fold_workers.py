"""The fold workers of `pycrorm writer`: shown by `status`, restarted after their death, and ended with their daemon."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.cli.note_plan import NOTES_PLAN
from tests.commands import Started, answer, pycrorm
from tests.databases import ask, ask_to_change

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    return tmp_path


@contextmanager
def started(folder: Path) -> Iterator[Started]:
    process = Started("writer", cwd=folder)
    assert process.stderr.readline().startswith("draining")
    yield process
    process.kill()
    process.communicate()


@pytest.fixture
def daemon(folder: Path) -> Iterator[Started]:
    with started(folder) as process:
        yield process


def is_gone(process: int) -> bool:
    """Return whether the process ends within some seconds."""
    for _ in range(500):
        status = Path(f"/proc/{process}/stat")
        if not status.exists() or status.read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.01)
    return False


def noted(folder: Path) -> int:
    """Return the number of notes that a plan beside the daemon left in the tables at its end."""
    answer("run", "notes.py", "--writer", "daemon", cwd=folder)
    return int(ask(f"sqlite:///{folder}/pycrorm.db", "SELECT count(*) FROM note_action")[0][0])


def workers(folder: Path) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = answer("status", cwd=folder)["fold_workers"]
    return entries


def wait_for_workers(folder: Path, count: int) -> list[int]:
    """Wait until this many workers run, and return their processes."""
    for _ in range(200):
        pids = [each["pid"] for each in workers(folder) if each["state"] == "running"]
        if len(pids) == count:
            return pids
        time.sleep(0.1)
    raise AssertionError(workers(folder))


def test_a_worker_folds_and_its_death_is_reported_and_shown_and_it_is_restarted(folder: Path, daemon: Started) -> None:
    first, other = wait_for_workers(folder, 2)
    notes = 3
    assert noted(folder) == notes
    while workers(folder)[0]["batches"] == 0:  # the number is noted with a batch, once a second
        notes += 3
        assert noted(folder) == notes
        assert notes < 100
    os.kill(first, signal.SIGKILL)
    assert is_gone(first)
    assert noted(folder) == notes + 3
    second, _ = wait_for_workers(folder, 2)
    state = workers(folder)[0]
    assert (state["pid"], state["restarts"], state["reason"]) == (second, 1, "exited with signal 9")
    shown = pycrorm("status", cwd=folder).stdout
    assert "Fold workers of the daemon" in shown
    assert "exited with signal 9" in shown
    daemon.send_signal(signal.SIGTERM)
    _, output = daemon.communicate(timeout=15)
    assert daemon.returncode == 0
    assert output.count(f"fold worker 1 (pid {first}) exited with signal 9; restarting it in 1 s\n") == 1
    assert "Traceback" not in output
    assert is_gone(second)
    assert is_gone(other)
    assert workers(folder) == []


def test_a_suspended_worker_ends_with_a_daemon_that_is_killed(folder: Path, daemon: Started) -> None:
    assert noted(folder) == 3
    stopped, idle = wait_for_workers(folder, 2)
    os.kill(stopped, signal.SIGSTOP)
    daemon.kill()
    daemon.communicate(timeout=15)
    assert is_gone(stopped)
    assert is_gone(idle)


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT])
def test_a_terminal_signal_to_both_ends_a_worker_with_the_daemon_and_no_sooner(
    folder: Path, daemon: Started, end: signal.Signals
) -> None:
    pids = wait_for_workers(folder, 2)
    for each in pids:
        os.kill(each, end)
    assert noted(folder) == 3
    assert wait_for_workers(folder, 2) == pids
    for each in pids:
        os.kill(each, end)
    daemon.send_signal(end)
    _, output = daemon.communicate(timeout=15)
    assert daemon.returncode == 0
    assert "exited" not in output
    assert "Traceback" not in output
    assert all(map(is_gone, pids))


def test_the_reason_why_a_worker_cannot_fold_is_reported(folder: Path, daemon: Started) -> None:
    assert noted(folder) == 3
    ask_to_change(f"sqlite:///{folder}/pycrorm.db", "DROP TABLE zz_task_tree_node__1001")
    plan = Started("run", "notes.py", "--writer", "daemon", cwd=folder)
    output = ""
    while "cannot be brought" not in output:
        output = daemon.stderr.readline()
        assert output, "the daemon has ended"
    ended = "SELECT count(*) FROM event WHERE type = 'NodeEnded'"
    while ask(f"sqlite:///{folder}/pycrorm.db", ended) != [(8,)]:  # appending continues
        time.sleep(0.01)
    plan.kill()
    plan.communicate()
    assert "no such table: zz_task_tree_node__1001" in output


MANY = 12_000
LONG_PLAN = NOTES_PLAN.replace('in "abc"', f"in map(str, range({MANY}))") + "    os.kill(os.getpid(), 9)\n"


def leave_many_notes(folder: Path) -> str:
    """Run a plan that takes many notes and is killed before they are drained; return the URL of their database."""
    (folder / "long.py").write_text(f"import os\n{LONG_PLAN}")
    assert pycrorm("run", "long.py", "--writer", "daemon", cwd=folder).returncode == -signal.SIGKILL
    return f"sqlite:///{folder}/pycrorm.db"


def wait_for(url: str, question: str) -> None:
    """Wait until the condition holds."""
    for _ in range(6_000):
        if ask(url, question)[0][0]:
            return
        time.sleep(0.01)
    raise AssertionError(question)


ALL = "SELECT coalesce(sum(head - folded), 1) = 0 AND count(ended_wall_ns) = 1 FROM episode"


def verify_each_note_is_stored(folder: Path, url: str) -> None:
    notes = ask(url, "SELECT text FROM note_action ORDER BY id")
    assert notes == [(str(number),) for number in range(len(notes))]
    assert len(notes) >= MANY - 1_000  # its last notes may not have been put
    running = ask(url, "SELECT count(*) FROM task_tree_node WHERE status = 'RUNNING'")
    assert running == [(0,)]
    assert answer("verify", cwd=folder)["differences"] == []


@pytest.mark.soak  # test_faulty_workers kills one in its transaction
def test_a_daemon_whose_workers_are_both_killed_continues_to_fold(folder: Path) -> None:
    url = leave_many_notes(folder)
    with started(folder) as process:
        pids = wait_for_workers(folder, 2)
        for each in pids:
            os.kill(each, signal.SIGKILL)
        while not all(each["reason"] for each in workers(folder)):
            time.sleep(0.05)
        wait_for(url, ALL)
        process.send_signal(signal.SIGTERM)
        _, output = process.communicate(timeout=15)
    assert process.returncode == 0
    lines = [line for line in output.splitlines() if not line.startswith(("recorder ", "stopped after"))]
    assert sorted(lines) == [
        f"fold worker {number} (pid {pid}) exited with signal 9; restarting it in 1 s"
        for number, pid in enumerate(pids, start=1)
    ]
    verify_each_note_is_stored(folder, url)
