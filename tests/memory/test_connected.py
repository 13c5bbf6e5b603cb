"""A connected memory and world serve every context without its own: cells, tasks and threads."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import threading
from contextvars import Context
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.orm import ProcessMetaData
from pycrorm_async.plan.execution import recorder
from pycrorm_async.world import BulletWorld, Object, ObjectType
from pycrorm_async.world.pose import NoWorld, WorldClosed
from tests.commands import pycrorm
from tests.memory.note_actions import NoteActionPerformable, texts, url_of

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent


async def in_a_cell(text: str) -> None:
    """Run it as a cell of a notebook does: in a task with a new context, which has no memory yet."""
    await asyncio.get_running_loop().create_task(NoteActionPerformable(text).perform(), context=Context())


async def test_a_context_without_a_memory_uses_the_one_that_was_connected_last(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in "abc"]
    for each in folders:
        each.mkdir()
    first = await Memory.connect(url_of(folders[0]))
    await in_a_cell("1")
    second = await Memory.connect(url_of(folders[1]))
    await in_a_cell("2")
    async with Memory.open(url_of(folders[2])):
        await NoteActionPerformable("3").perform()  # this context has its own
        await in_a_cell("4")
    thread = threading.Thread(target=lambda: asyncio.run(NoteActionPerformable("5").perform()))
    thread.start()
    thread.join()
    await second.close()
    await second.close()
    await in_a_cell("6")
    await first.close()
    await in_a_cell("7")
    assert recorder.get() is None
    texts_of_episodes = []
    for each in folders:
        async with Reading.open(url_of(each)) as reading:
            texts_of_episodes.append(await texts(reading))
    assert texts_of_episodes == [["1", "6"], ["2", "4", "5"], ["3"]]


async def test_closing_while_an_episode_is_open_ends_it_as_interrupted(tmp_path: Path) -> None:
    memory = await Memory.connect(url_of(tmp_path))
    async with memory.episode(description="left open"):
        await NoteActionPerformable("kept").perform()
        await memory.close()
        await NoteActionPerformable("not recorded").perform()
    with pytest.raises(CallerError, match="not open"):
        await memory.flush()
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["kept"]
        async with reading.session() as session:
            assert (await session.scalars(select(ProcessMetaData.status))).all() == ["INTERRUPTED"]


def test_a_connected_world_serves_every_context_until_it_is_closed() -> None:
    outer = BulletWorld().connect()
    milk = Context().run(Object, "milk", ObjectType.MILK)
    assert milk.world is outer
    with BulletWorld() as inner:
        assert Object("milk", ObjectType.MILK).world is inner
    later = BulletWorld().connect()
    assert Context().run(Object, "milk", ObjectType.MILK).world is later
    later.close()
    later.close()
    assert Context().run(Object, "cup", ObjectType.JEROEN_CUP).world is outer
    outer.close()
    with pytest.raises(NoWorld):
        Object("milk", ObjectType.MILK)
    with pytest.raises(WorldClosed):
        outer.connect()


async def run_python(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    def run() -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"PYTHONPATH": str(HERE.parent.parent)}
        command = [sys.executable, *arguments]
        return subprocess.run(
            command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=200, check=False
        )

    return await asyncio.to_thread(run)


FORGETS = """
import asyncio
from pycrorm_async import Memory
from tests.commands import pycrorm
from tests.memory.note_actions import NoteActionPerformable

async def main():
    memory = await Memory.connect("sqlite:///memory.db")
    await NoteActionPerformable("kept").perform()

asyncio.run(main())
"""


@pytest.mark.soak  # recording/test_sync_memory
async def test_a_memory_that_is_never_closed_loses_nothing_and_ends_without_a_traceback(tmp_path: Path) -> None:
    ran = await run_python("-c", FORGETS, cwd=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    stored = await asyncio.to_thread(pycrorm, "writer", "--once", "--url", url_of(tmp_path), cwd=tmp_path)
    assert stored.returncode == 0, stored.stderr
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["kept"]
