"""The life of a memory: opened, recorded into, queried, and closed."""

import asyncio
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.orm import ProcessMetaData, TaskTreeNode
from pycrorm_async.plan import ActionAbstract, PlanFailure
from pycrorm_async.task_status import TaskStatus
from tests.commands import environment
from tests.memory.note_actions import NoteActionPerformable, texts, url_of


@pytest.mark.slow
async def test_a_temporary_memory_answers_queries_and_leaves_no_files() -> None:
    place = Path("/dev/shm")
    before = {path.name for path in place.glob("pycrorm-*/")}
    async with Memory.open("sqlite://") as memory:
        await NoteActionPerformable("gone soon").perform()
        await memory.flush()
        assert await texts(memory) == ["gone soon"]
        assert {path.name for path in place.glob("pycrorm-*/")} - before
    assert {path.name for path in place.glob("pycrorm-*/")} <= before


@pytest.mark.slow
async def test_flushed_records_are_in_the_tables_and_in_the_database_file(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="e"):
            await NoteActionPerformable("a").perform()
            await memory.flush()
            assert await texts(memory) == ["a"]
            with closing(sqlite3.connect(tmp_path / "memory.db")) as plain, plain:
                rows = plain.execute("SELECT text, status FROM note_action JOIN task_tree_node USING (id)").fetchall()
                assert rows == [("a", "SUCCEEDED")]
            plain.close()
            await NoteActionPerformable("b").perform()
        status = memory.status
        assert status.written >= status.synced >= status.stored
        assert status.faults.total == 0
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["a", "b"]


async def test_an_exception_leaves_the_plan_unchanged_and_is_recorded(tmp_path: Path) -> None:
    with pytest.raises(PlanFailure, match="spilled"):
        async with Memory.open(url_of(tmp_path)) as memory, memory.episode(description="e"):
            await NoteActionPerformable("a").perform()
            raise PlanFailure("spilled")
    async with Reading.open(url_of(tmp_path)) as reading:
        (episode,) = await reading.episodes()
        assert (episode.status, episode.nodes) == ("FAILED", 2)
        async with reading.session() as session:
            metadata = (await session.scalars(select(ProcessMetaData))).one()
            assert metadata.failure_type == "pycrorm_async.plan.failures.PlanFailure"
            assert metadata.failure_message == "spilled"


@pytest.mark.slow
async def test_a_cancelled_node_has_the_status_cancelled(tmp_path: Path) -> None:
    @dataclass
    class WaitActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            begun.set()
            await asyncio.sleep(60)

    begun = asyncio.Event()
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="e"):
            task = asyncio.create_task(WaitActionPerformable().perform())
            await begun.wait()
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        await memory.flush()
        async with memory.session() as session:
            node = (await session.scalars(select(TaskTreeNode).where(TaskTreeNode.dtype == "WaitAction"))).one()
            assert node.status == TaskStatus.CANCELLED
            assert node.reason == "CancelledError"


async def test_importing_the_package_loads_no_optional_library() -> None:
    script = (
        "import sys, pycrorm_async; print([name for name in sys.modules if 'sqlalchemy' in name or 'bullet' in name])"
    )
    done = await asyncio.to_thread(
        subprocess.run, [sys.executable, "-c", script], env=environment(), capture_output=True, text=True, check=False
    )
    assert done.stdout == "[]\n", done.stderr
    assert os.environ.get("PYCRORM_URL") is None
