"""The fold workers of a daemon and of a rebuild: shown, restarted, replaced after each fault, and ended."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import signal
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.operations import rebuild as rebuilding
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.workers import Assignment, DaemonNote, Failure, FoldWorkerState, Write, _RequestHandler
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.custom import Changes, Event, Projection
from pycrorm_async.projections.fold import TableRows
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.commands import FORKED, NOTES_PLAN, Started, answer, fork, pycrorm
from tests.databases import ask
from tests.projections.event_script import append_and_fold
from tests.projections.rebuild_cases import TYPES, picking
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


# === fold workers =============================================================================================
#
# The fold workers of `pycrorm writer`: shown by `status`, restarted after their death, and ended with their daemon.


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    return tmp_path


@pytest.fixture
def daemon(folder: Path) -> Iterator[Started]:
    process = Started("writer", cwd=folder)
    assert process.stderr.readline().startswith("draining")
    yield process
    process.kill()
    process.communicate()


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


def test_a_terminal_signal_to_both_ends_a_worker_with_the_daemon_and_no_sooner(folder: Path, daemon: Started) -> None:
    end = signal.SIGINT
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


# === faults ===================================================================================================
#
# Inject a fault into a fold worker: at the next batch that it has written and not committed, the fault happens.
#
# A daemon passes its workers the projection `Trapped`, so that they import this module. The daemon's own process is not
# affected. The word in the file that PYCRORM_TRAP names is removed before the fault, so that it happens once.

TRAP = "PYCRORM_TRAP"


class Trapped(Projection):
    name = "trapped"
    version = 1
    tables: ClassVar = {"trapped": {"what": "text"}}

    def fold(self, event: Event, rows: Changes) -> None:
        """Fold nothing: the projection exists so that workers import this module."""


def arm(trap: Path, word: str) -> None:
    """Set the fault: a signal's name, `exit` or `raise`."""
    trap.with_suffix(".making").write_text(word)
    trap.with_suffix(".making").rename(trap)


def _spring() -> None:
    trap = Path(os.environ[TRAP])
    try:
        word = trap.read_text()
        trap.unlink()
    except FileNotFoundError:
        return
    match word:
        case "exit":
            os._exit(3)
        case "raise":
            raise MemoryError("no memory left")
        case _:
            os.kill(os.getpid(), signal.Signals[word])


def _trapped(write_rows: Callable[..., Any]) -> Callable[..., Any]:
    async def write(*values: Any) -> None:
        await write_rows(*values)
        _spring()

    return write


if TRAP in os.environ and os.environ[TRAP + "_DAEMON"] != str(os.getpid()):
    TableRows.write = _trapped(TableRows.write)  # type: ignore[method-assign]


# === daemonic process =========================================================================================
#
# A rebuild with fold workers in a daemonic process of multiprocessing, which must not start processes.


def rebuild_with_two_workers(url: str, output: str) -> None:
    logging.basicConfig(filename=output, format="%(message)s", level="WARNING")
    rebuilding._SHARE_EVENTS_MIN = 1
    asyncio.run(rebuilding.rebuild_memory(url, workers=2))


def test_a_rebuild_in_a_daemonic_process_folds_without_workers(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    asyncio.run(append_and_fold(url, [*TYPES, *picking(1).records, *picking(2).records]))
    before = tables_of(url)
    arguments = (url, f"{tmp_path}/log")
    process = FORKED.Process(target=rebuild_with_two_workers, args=arguments, daemon=True)
    fork(process)
    process.join(120)
    assert process.exitcode == 0
    assert differences(before, tables_of(url)) == []
    assert (tmp_path / "log").read_text() == (  # once, and without waiting to try again
        "a daemonic process of multiprocessing cannot start fold workers; it folds without them\n"
    )


# === faulty workers ===========================================================================================
#
# Faults of a fold worker during its transaction: the daemon reports them, replaces the worker, and folds everything.
#
# The daemon runs in this loop; its one worker is a process of its own, which is forked instead of spawned.

PATIENT = Settings(sync_interval_ms=5)
NOTES = 10


@pytest.fixture(autouse=True)
def quick_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pycrorm_async.operations.workers._RESTART_S", 0.1)


@dataclass
class JotActionPerformable(ActionAbstract):
    text: str

    async def perform(self) -> None: ...


class Lab:
    """A memory whose daemon has one fold worker with an injected fault."""

    def __init__(self, url: str, folder: Path, memory: Memory) -> None:
        self.url = url
        self.spool = Spool(folder / "spool")
        self.trap = folder / "trap"
        self.memory = memory
        self.lines: list[str] = []
        self.written = 0

    def worker(self) -> FoldWorkerState:
        note = self.spool.writer_note()
        return FoldWorkerState(1) if note is None else msgspec.json.decode(note, type=DaemonNote).fold_workers[0]

    async def worker_is(self, state: str, *, restarts: int = 0) -> FoldWorkerState:
        async with asyncio.timeout(60):
            while (now := self.worker()).state != state or now.restarts < restarts:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        return now

    async def wait_for_line(self, pattern: str) -> str:
        async with asyncio.timeout(60):
            while not (lines := [line for line in self.lines if re.search(pattern, line)]):  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        return lines[0]

    async def write(self) -> None:
        async with self.memory.episode(description="jotting"):
            for _ in range(NOTES):
                await JotActionPerformable(str(self.written)).perform()
                self.written += 1

    async def verify_all_is_folded(self) -> None:
        await self.memory.flush()
        notes = ask(self.url, "SELECT text FROM jot_action ORDER BY id")
        assert notes == [(str(number),) for number in range(self.written)]
        assert ask(self.url, "SELECT count(*) FROM episode WHERE parked IS NOT NULL") == [(0,)]


@asynccontextmanager
async def lab_at(url: str, folder: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Lab]:
    monkeypatch.setenv(TRAP, str(folder / "trap"))
    monkeypatch.setenv(TRAP + "_DAEMON", str(os.getpid()))
    leave, spool = asyncio.Event(), folder / "spool"
    async with Memory.open(url, spool=spool, writer="daemon", settings=settings) as memory:
        lab = Lab(url, folder, memory)
        served = serve(
            url,
            spool=spool,
            stop=leave,
            report=lab.lines.append,
            settings=settings,
            projections=[Trapped()],
            fold_workers=1,
        )
        daemon = asyncio.create_task(served)
        try:
            await lab.write()
            await lab.worker_is("running")
            yield lab
            await lab.verify_all_is_folded()
        finally:
            leave.set()
            await daemon


DEATHS = {"SIGKILL": "exited with signal 9", "exit": "exited with exit code 3"}


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.soak_on("postgresql")
async def test_a_worker_that_dies_in_its_transaction_is_restarted_after_longer_and_longer_pauses(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lab_at(database_url, tmp_path, PATIENT, monkeypatch) as lab:
        expected, pause_s = [], 0.1
        for deaths, (word, how) in enumerate(DEATHS.items(), start=1):
            pid = lab.worker().pid
            arm(lab.trap, word)
            await lab.write()
            again = await lab.worker_is("running", restarts=deaths)
            assert (again.restarts, again.reason, again.restart_wall_ns) == (deaths, how, None)
            assert again.pid != pid
            expected.append(f"fold worker 1 (pid {pid}) {how}; restarting it in {pause_s:g} s")
            pause_s *= 2
        assert [line for line in lab.lines if "restarting" in line] == expected
        assert not [line for line in lab.lines if "cannot be brought up to date" in line]  # a death is no fault of them


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.soak_on("postgresql")
async def test_an_exception_of_a_worker_is_reported_and_it_continues_to_fold(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lab_at(database_url, tmp_path, PATIENT, monkeypatch) as lab:
        before = lab.worker()
        arm(lab.trap, "raise")
        await lab.write()
        await lab.wait_for_line("the tables cannot be brought up to date: no memory left")
        await lab.memory.flush()
        assert (lab.worker().pid, lab.worker().restarts) == (before.pid, 0)


@pytest.mark.usefixtures("forked_workers")
async def test_a_worker_refuses_to_fold_another_database_than_its_daemons(tmp_path: Path) -> None:
    fold = _RequestHandler(Assignment(f"sqlite:///{tmp_path}/memory.db", "another log", []))
    missing = await fold.answer(Write())
    assert isinstance(missing, Failure)
    assert "does not exist" in missing.reason
    assert not (tmp_path / "memory.db").exists()
    log = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{tmp_path}/memory.db"), create=True)
    await log.close()
    answer = await fold.answer(Write())
    assert isinstance(answer, Failure)
    assert "was replaced while the daemon had it open" in answer.reason
