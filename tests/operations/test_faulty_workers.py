"""Faults of a fold worker during its transaction: the daemon reports them, replaces the worker, and folds everything.

The daemon runs in this loop; its one worker is a process of its own, which is forked instead of spawned.
"""

from __future__ import annotations

import asyncio
import os
import re
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.workers import Assignment, DaemonNote, Failure, FoldWorkerState, Write, _RequestHandler
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import ask
from tests.operations.faults import TRAP, Trapped, arm

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("forked_workers")]

PATIENT = Settings(sync_interval_ms=5, fold_worker_restart_s=0.1, fold_worker_report_s=0.1)
IMPATIENT = replace(PATIENT, fold_worker_stopped_s=0.6)
HURRIED = replace(PATIENT, fold_worker_answer_s=10.0)
"""The limit on the start of a worker, which takes a few seconds on a busy machine."""
NOTES = 10


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


DEATHS = {"SIGKILL": "exited with signal 9", "SIGSEGV": "exited with signal 11", "exit": "exited with exit code 3"}


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


@pytest.mark.soak_on("postgresql")
async def test_status_keeps_the_batch_count_of_a_worker_that_has_ended(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lab_at(database_url, tmp_path, PATIENT, monkeypatch) as lab:
        before = lab.worker().batches
        for _ in range(3):
            await lab.write()
            await lab.memory.flush()
        async with asyncio.timeout(20):
            while lab.worker().batches < before + 3:  # noqa: ASYNC110
                await asyncio.sleep(0.01)


async def test_a_worker_that_is_suspended_in_its_transaction_is_named_and_then_replaced(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lab_at(database_url, tmp_path, IMPATIENT, monkeypatch) as lab:
        pid = lab.worker().pid
        arm(lab.trap, "SIGSTOP")
        await lab.write()
        named = await lab.wait_for_line("is stopped")
        assert named.startswith(
            f"fold worker 1 (pid {pid}) is stopped while it writes a batch and holds locks of the database; replacing"
        )
        killed = await lab.wait_for_line("restarting")
        assert re.fullmatch(
            rf"fold worker 1 \(pid {pid}\) was stopped for \d\.\d s while it writes a batch and holds locks of the"
            r" database, and was killed; restarting it in 0\.1 s",
            killed,
        )
        await lab.worker_is("running", restarts=1)


@pytest.mark.soak_on("postgresql")
async def test_a_worker_that_continues_in_time_is_not_replaced(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lab_at(database_url, tmp_path, PATIENT, monkeypatch) as lab:
        pid = lab.worker().pid
        arm(lab.trap, "SIGSTOP")
        await lab.write()
        assert (await lab.worker_is("stopped")).pid == pid
        assert pid is not None
        os.kill(pid, signal.SIGCONT)
        assert await lab.wait_for_line(r"\) continues$") == f"fold worker 1 (pid {pid}) continues"
        await lab.memory.flush()
        assert (lab.worker().state, lab.worker().pid, lab.worker().restarts) == ("running", pid, 0)


async def test_a_worker_that_never_answers_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with lab_at(f"sqlite:///{tmp_path}/memory.db", tmp_path, HURRIED, monkeypatch) as lab:
        arm(lab.trap, "hang")
        await lab.write()
        assert "gave no answer for" in await lab.wait_for_line("restarting")


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
