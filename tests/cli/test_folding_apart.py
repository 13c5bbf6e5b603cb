"""The processes of `pycrorm writer` that fold, beside the one that appends: what becomes of them when one is gone."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.cli.notes import NOTES_PLAN
from tests.commands import COMMAND, answer, environment
from tests.databases import ask, ask_to_change


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    return tmp_path


@contextmanager
def started(folder: Path) -> Iterator[subprocess.Popen[str]]:
    command = [*COMMAND, "writer"]
    process = subprocess.Popen(command, cwd=folder, env=environment(), stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert process.stderr.readline().startswith("draining")
    yield process
    process.kill()
    process.communicate()


@pytest.fixture
def daemon(folder: Path) -> Iterator[subprocess.Popen[str]]:
    with started(folder) as process:
        yield process


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
    _, child = children_of(daemon)
    before = Path(f"/proc/{child}/stat").read_text()
    assert noted(folder) == 3
    assert Path(f"/proc/{child}/stat").read_text() != before  # it has worked


def test_when_it_is_killed_the_daemon_says_so_once_and_folds(folder: Path, daemon: subprocess.Popen[str]) -> None:
    assert noted(folder) == 3
    _, child = children_of(daemon)
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
    children = children_of(daemon)
    daemon.send_signal(end)
    daemon.communicate(timeout=15)
    assert len(children) == 2
    assert all(map(is_gone, children))


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT])
def test_what_a_terminal_sends_to_both_ends_it_with_the_daemon_and_no_sooner(
    folder: Path, daemon: subprocess.Popen[str], end: signal.Signals
) -> None:
    children = children_of(daemon)
    for child in children:
        os.kill(child, end)
    assert noted(folder) == 3
    assert children_of(daemon) == children
    for child in children:
        os.kill(child, end)
    daemon.send_signal(end)
    _, said = daemon.communicate(timeout=15)
    assert daemon.returncode == 0
    assert "died" not in said
    assert "Traceback" not in said
    assert all(map(is_gone, children))


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


MANY = 20_000
LONG_PLAN = NOTES_PLAN.replace('in "abc"', f"in map(str, range({MANY}))") + "    os.kill(os.getpid(), 9)\n"


def leave_many_notes(folder: Path) -> str:
    """A plan takes many notes and is killed before anybody drains it; the database that they will be in."""
    (folder / "long.py").write_text(f"import os\n{LONG_PLAN}")
    done = subprocess.run(
        [*COMMAND, "run", "long.py", "--writer", "daemon"], cwd=folder, env=environment(), check=False
    )
    assert done.returncode == -signal.SIGKILL
    return f"sqlite:///{folder}/pycrorm.db"


def worked_ms(process: int) -> int:
    """How long it had a processor."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return 1000 * (int(fields[11]) + int(fields[12])) // os.sysconf("SC_CLK_TCK")


def wait_for(url: str, question: str) -> None:
    """Until its answer is yes."""
    for _ in range(6_000):
        if ask(url, question)[0][0]:
            return
        time.sleep(0.01)
    raise AssertionError(question)


ALL = "SELECT coalesce(sum(head - folded), 1) = 0 AND max(ended_wall_ns) > 0 FROM episode"
SOME = "SELECT coalesce(sum(folded), 0) > 0 FROM episode"


def prove_that_each_note_is_there(folder: Path, url: str) -> None:
    notes = ask(url, "SELECT text FROM note_action ORDER BY id")
    assert notes == [(str(number),) for number in range(len(notes))]
    assert len(notes) >= MANY - 1_000  # what it did last may not have been handed over
    running = ask(url, "SELECT count(*) FROM task_tree_node WHERE status = 'RUNNING'")
    assert running == [(0,)]
    assert answer("verify", cwd=folder)["differences"] == []


def test_of_a_long_way_to_go_the_helper_goes_a_part(folder: Path) -> None:
    url = leave_many_notes(folder)
    with started(folder) as process:
        helper, child = children_of(process)
        wait_for(url, ALL)
        assert worked_ms(child) > 50
        assert worked_ms(helper) > 50
        prove_that_each_note_is_there(folder, url)


def test_that_the_helper_has_died_is_told_once(folder: Path) -> None:
    with started(folder) as process:
        helper, _ = children_of(process)
        os.kill(helper, signal.SIGKILL)
        assert is_gone(helper)
        process.send_signal(signal.SIGSTOP)
        url = leave_many_notes(folder)
        process.send_signal(signal.SIGCONT)
        wait_for(url, ALL)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=15)
    assert said.count("the process that helps to fold has died: folding is slower from now on\n") == 1
    prove_that_each_note_is_there(folder, url)


@pytest.mark.parametrize("victims", [[0], [1], [0, 1]])
def test_whoever_is_killed_on_the_way_the_others_go_on(folder: Path, victims: list[int]) -> None:
    url = leave_many_notes(folder)
    with started(folder) as process:
        children = children_of(process)
        wait_for(url, SOME)
        for each in victims:
            os.kill(children[each], signal.SIGKILL)
        wait_for(url, ALL)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=15)
    assert process.returncode == 0
    lines = [line for line in said.splitlines() if not line.startswith(("recorder ", "left after"))]
    if 1 in victims:
        lines.remove("the process that folds has died: from now on this one does")
    if 0 in victims and lines:  # it is noticed when it is needed
        lines.remove("the process that helps to fold has died: folding is slower from now on")
    assert lines == []
    prove_that_each_note_is_there(folder, url)
