"""A memory with a writer process of its own: the same promises, whatever dies, is interrupted, forked or closed."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading, Settings
from pycrorm_async.errors import FlushTimeout
from pycrorm_async.operations import writer_process
from pycrorm_async.orm import ProcessMetaData
from pycrorm_async.queue import Spool
from tests.commands import answer, environment
from tests.databases import ask, put_memory
from tests.memory.note_actions import NoteActionPerformable, texts
from tests.writer.running_writers import QUICKLY_SYNCED, Start, until

pytestmark = pytest.mark.slow

NOTES = "SELECT text FROM note_action JOIN task_tree_node USING (id) ORDER BY id"
PLAN = """
import asyncio, itertools, os, sys, time
from dataclasses import dataclass
from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract

@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    async def perform(self): pass

async def main(url, spool, mode):
    async with Memory.open(url, spool=spool, writer="process") as memory, memory.episode(description="plan"):
        await NoteActionPerformable("first").perform()
        await memory.flush()
        if mode == "fork" and os.fork() == 0:
            time.sleep(600)
        os.write(1, b"%d\\n" % memory.status.writer_process.pid)
        for number in itertools.count():
            await NoteActionPerformable(str(number)).perform()
            os.write(1, b"%d\\n" % number)
            await asyncio.sleep(0.001)

asyncio.run(main(*sys.argv[1:]))  # unguarded: a process that imported this module would perform it again
"""


def processes() -> list[psutil.Process]:
    """Return the writer processes of this process that run."""
    running = []
    for each in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # also if it has ended and is not reaped yet
            if "writer_process" in " ".join(each.cmdline()):
                running.append(each)
    return running


def opened(url: str, spool: Path, settings: Settings = QUICKLY_SYNCED) -> Memory:
    return Memory.open(url, spool=spool, writer="process", settings=settings)


def killed(memory: Memory) -> None:
    """Kill the writer process of a memory."""
    state = memory.status.writer_process
    assert state is not None
    assert state.pid is not None
    os.kill(state.pid, signal.SIGKILL)


def is_drained(memory: Memory, *, restarts: int) -> bool:
    """Return whether this memory's process, or the one that replaced it, drains its folder."""
    state = memory.status.writer_process
    return state is not None and state.restarts == restarts and memory._open_parts.queue.is_drained


class Owner:
    """An endless plan in a process group of its own, with its notes and the pid of its writer process."""

    def __init__(self, url: str, spool: Path, folder: Path, mode: str = "plain") -> None:
        (folder / "plan.py").write_text(PLAN)
        command = [sys.executable, "plan.py", url, str(spool), mode]
        self.process = subprocess.Popen(
            command, cwd=folder, env=environment(), stdout=subprocess.PIPE, start_new_session=True, text=True
        )
        assert self.process.stdout is not None
        self.writer = psutil.Process(int(self.process.stdout.readline()))
        self.notes = [self.process.stdout.readline().strip() for _ in range(50)]

    def end(self, number: signal.Signals, *, group: bool = False) -> None:
        """Send a signal to the plan, or to its whole group, and read what it noted until then."""
        (os.killpg if group else os.kill)(self.process.pid, number)
        assert self.process.stdout is not None
        self.process.wait(300)
        os.set_blocking(self.process.stdout.fileno(), False)  # a forked child keeps it open
        while line := self.process.stdout.readline():
            self.notes.append(line.strip())
        self.process.stdout.close()

    async def writer_ended(self) -> None:
        await until(lambda: not self.writer.is_running() or self.writer.status() == psutil.STATUS_ZOMBIE)


@pytest.mark.soak_on("postgresql")
async def test_flushed_records_are_in_the_tables_and_closing_leaves_no_folder_and_no_process(
    database_url: str, tmp_path: Path
) -> None:
    async with opened(database_url, tmp_path / "spool") as memory:
        assert await texts_or_none(memory) == []
        await NoteActionPerformable("a").perform()
        await memory.flush()
        assert await texts(memory) == ["a"]
        status = memory.status
        assert status.written == status.synced == status.stored == status.folded
        assert (status.drained, status.writer, len(processes())) == (True, None, 1)
        await NoteActionPerformable("b").perform()
    assert (processes(), Spool(tmp_path / "spool").recorders()) == ([], [])
    shown = await asyncio.to_thread(
        answer, "status", "--url", database_url, "--spool", tmp_path / "spool", cwd=tmp_path
    )
    assert [each["behind"] for each in shown["projections"]] == [0]
    async with Reading.open(database_url) as reading:
        assert await texts(reading) == ["a", "b"]


async def texts_or_none(memory: Memory) -> list[str]:
    """Query a memory before its process is ready."""
    async with memory.session() as session:
        return [str(each) for each in await session.scalars(select(ProcessMetaData.id))]


@pytest.mark.soak_on("postgresql")
async def test_a_process_that_is_killed_again_and_again_is_replaced_and_loses_nothing(
    database_url: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    words = [f"{number:04}" for number in range(400)]
    async with opened(database_url, tmp_path / "spool") as memory, memory.episode(description="e"):
        for number, word in enumerate(words):
            await NoteActionPerformable(word).perform()
            if number in (100, 300):
                restarts = number // 200
                await until(lambda restarts=restarts: is_drained(memory, restarts=restarts))  # type: ignore[misc]
                killed(memory)
        await memory.flush()
        assert await texts(memory) == words
        state = memory.status.writer_process
        assert state is not None
        assert (state.restarts, state.reason) == (2, "was killed by signal 9")
        assert memory.status.faults.total == 0
    lines = [each.getMessage() for each in caplog.records if each.levelno >= logging.WARNING]
    assert len(lines) == 1, lines  # the same reason again is no news
    assert lines[0].startswith("the writer process (pid ")
    assert lines[0].endswith(") was killed by signal 9; starting another in 0.1 s; nothing recorded is lost")


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize("mode", ["plain", "fork"])
async def test_the_process_of_a_killed_plan_stores_the_rest_and_ends(
    database_url: str, tmp_path: Path, mode: str
) -> None:
    owner = Owner(database_url, tmp_path / "spool", tmp_path, mode)
    forked = [each for each in psutil.Process(owner.process.pid).children() if each != owner.writer]
    try:
        owner.end(signal.SIGKILL)
        await owner.writer_ended()
    finally:
        for each in forked:
            each.kill()
    assert len(forked) == (mode == "fork")
    stored = [text for (text,) in ask(database_url, NOTES)]
    assert stored[: len(owner.notes) + 1] == ["first", *owner.notes]
    assert len(stored) <= len(owner.notes) + 2  # it may have been killed before it wrote the last number
    assert ask(database_url, "SELECT status FROM process_metadata") == [("LOST",)]
    assert Spool(tmp_path / "spool").recorders() == []


async def test_ctrl_c_reaches_the_plan_and_its_process_ends_after_it(tmp_path: Path) -> None:
    url = put_memory(tmp_path / "memory.db")
    owner = Owner(url, tmp_path / "spool", tmp_path)
    owner.end(signal.SIGINT, group=True)
    await owner.writer_ended()
    assert owner.process.returncode == -signal.SIGINT
    assert [text for (text,) in ask(url, NOTES)][: len(owner.notes) + 1] == ["first", *owner.notes]
    assert ask(url, "SELECT status FROM process_metadata") == [("INTERRUPTED",)]
    assert Spool(tmp_path / "spool").recorders() == []


async def test_a_hangup_and_a_termination_of_the_process_alone_do_not_end_it(tmp_path: Path) -> None:
    async with opened(put_memory(tmp_path / "memory.db"), tmp_path / "spool") as memory:
        await memory.flush()
        await until(lambda: memory._open_parts.queue.is_drained)
        [process] = processes()
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            process.send_signal(number)
        await NoteActionPerformable("a").perform()
        await memory.flush()
        assert processes() == [process]


@pytest.mark.soak_on("postgresql")
async def test_a_process_leaves_other_living_recorders_to_their_writers_and_drains_dead_ones(
    tmp_path: Path, database_url: str, daemon: Start, spool: Path
) -> None:
    async with Memory.open(database_url, spool=spool, writer="daemon", settings=QUICKLY_SYNCED) as other:
        await NoteActionPerformable("of another").perform()
        await other.synced()
        (tmp_path / "killed").mkdir()
        dead = Owner(database_url, spool, tmp_path / "killed")
        dead.writer.kill()
        dead.end(signal.SIGKILL)
        async with opened(database_url, spool) as memory:
            await until(lambda: len(Spool(spool).recorders()) == 2)
            await memory.flush()
        assert other.status.stored == 0
        async with daemon():
            await other.flush()
    assert ask(database_url, "SELECT count(*) FROM process_metadata") == [(2,)]


async def test_a_loop_that_closes_and_a_plan_that_never_awaits_are_drained_all_the_same(tmp_path: Path) -> None:
    url, spool = put_memory(tmp_path / "memory.db"), tmp_path / "spool"

    def elsewhere() -> Memory:
        async def connect() -> Memory:
            memory = await Memory.connect(url, spool=spool, writer="process", settings=QUICKLY_SYNCED)
            await NoteActionPerformable("a").perform()
            return memory

        memory = asyncio.run(connect())
        deadline_s = time.monotonic() + 60
        while memory.status.folded != memory.status.written and time.monotonic() < deadline_s:
            time.sleep(0.01)
        killed(memory)
        while memory.status.writer_process.restarts == 0 and time.monotonic() < deadline_s:  # type: ignore[union-attr]
            time.sleep(0.01)
        asyncio.run(NoteActionPerformable("b").perform())
        asyncio.run(memory.close())
        return memory

    memory = await asyncio.to_thread(elsewhere)
    assert memory.status.folded == memory.status.written
    assert [text for (text,) in ask(url, NOTES)] == ["a", "b"]


async def test_a_locked_database_delays_neither_the_plan_nor_closing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    url, spool = put_memory(tmp_path / "memory.db"), tmp_path / "spool"
    other = sqlite3.connect(tmp_path / "memory.db", isolation_level=None)
    async with opened(url, spool) as memory:
        await NoteActionPerformable("a").perform()
        await memory.flush()
        other.execute("BEGIN IMMEDIATE")
        await NoteActionPerformable("b").perform()
        await until(lambda: memory._open_parts.queue.external_drain_status.note.unavailable is not None)  # type: ignore[union-attr]
    assert processes() == []
    [line] = [each.getMessage() for each in caplog.records if each.levelno == logging.WARNING]
    assert "the writer process reports that the database is unavailable" in line
    other.execute("COMMIT")
    other.close()
    async with opened(url, spool) as memory:
        await until(lambda: len(Spool(spool).recorders()) == 1)
        await memory.flush()
        assert await texts(memory) == ["a", "b"]


async def test_a_close_that_is_cancelled_leaves_the_rest_to_the_process(tmp_path: Path) -> None:
    url, spool = put_memory(tmp_path / "memory.db"), tmp_path / "spool"
    memory = await opened(url, spool).__aenter__()
    for number in range(100):
        await NoteActionPerformable(str(number)).perform()
    closing = asyncio.create_task(memory.close())
    await asyncio.sleep(0.1)  # the process is starting
    closing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await closing
    await until(lambda: Spool(spool).recorders() == [] and processes() == [])
    assert ask(url, "SELECT count(*) FROM note_action") == [(100,)]


async def test_a_process_that_cannot_be_started_is_named_in_one_line_and_the_events_stay_safe(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, spool = put_memory(tmp_path / "memory.db"), tmp_path / "spool"
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no python"))
    async with opened(url, spool, replace(QUICKLY_SYNCED, flush_timeout_s=0.5)) as memory:
        await NoteActionPerformable("a").perform()
        with pytest.raises(FlushTimeout, match=r"the writer process cannot be started: .*No such file"):
            await memory.flush()
    first, last = [each.getMessage() for each in caplog.records if each.levelno == logging.WARNING]
    assert first.startswith("the writer process cannot be started: ")
    assert last.startswith(f"7 events are safe in {spool} and not in the database yet (the writer process cannot be")
    async with Memory.open(url, spool=spool) as memory:
        await until(lambda: len(Spool(spool).recorders()) == 1)
        await memory.flush()
        assert await texts(memory) == ["a"]


async def test_an_error_that_ends_the_process_is_in_its_reason(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = writer_process._COMMAND.replace("main()", "").replace("import main;", "import main, Folders")
    monkeypatch.setattr(writer_process, "_COMMAND", f"{command}\nFolders.__call__ = lambda *_: 1 / 0\nmain()")
    async with opened(put_memory(tmp_path / "memory.db"), tmp_path / "spool") as memory:
        await until(lambda: memory.status.writer_process.reason is not None)  # type: ignore[union-attr]
    assert "ended: ZeroDivisionError: division by zero; starting another in" in caplog.text
