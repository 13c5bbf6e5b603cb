"""A memory beside others: other memories, tasks and processes, and abandoned plans."""

import asyncio
import contextvars
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.plan.execution import recorder
from pycrorm_async.store.log import EventLog
from pycrorm_async.world.bullet import watcher
from tests.commands import run_script
from tests.memory.note_actions import NoteActionPerformable, texts, url_of

pytestmark = pytest.mark.slow


async def test_a_perform_is_recorded_by_the_memory_whose_episode_is_open(tmp_path: Path) -> None:
    first, second = f"sqlite:///{tmp_path}/1.db", f"sqlite:///{tmp_path}/2.db"
    async with Memory.open(first) as one, Memory.open(second) as two:
        await NoteActionPerformable("to the last opened").perform()
        async with one.episode(description="e"):
            await NoteActionPerformable("to the one with the episode").perform()
        await NoteActionPerformable("to the last opened again").perform()
        await one.flush()
        await two.flush()
        assert await texts(one) == ["to the one with the episode"]
        assert await texts(two) == ["to the last opened", "to the last opened again"]


async def test_a_forked_child_does_not_affect_the_memory_of_its_parent(tmp_path: Path) -> None:
    script = (
        "import asyncio, os, sys, warnings\n"
        # From Python 3.12 on it warns at each fork of a process with threads.
        "warnings.filterwarnings('ignore', 'This process', DeprecationWarning)\n"
        "from tests.memory.note_actions import Memory, NoteActionPerformable\n"
        "async def main():\n"
        "    async with Memory.open(sys.argv[1]) as memory, memory.episode(description='parent'):\n"
        "        await NoteActionPerformable('before').perform()\n"
        "        child = os.fork()\n"
        "        if child == 0:\n"
        "            await NoteActionPerformable('in the child').perform()\n"
        "            os._exit(7)\n"  # the exit of every worker of multiprocessing
        "        _, status = os.waitpid(child, 0)\n"
        "        assert os.waitstatus_to_exitcode(status) == 7\n"
        "        await NoteActionPerformable('after').perform()\n"
        "asyncio.run(main())\n"
    )
    done = await asyncio.to_thread(run_script, script, url_of(tmp_path), timeout_s=60)
    assert done.returncode == 0
    assert done.stderr.startswith("NoteAction leaves no record, because this process was forked"), done.stderr
    assert done.stderr.count("\n") == 1
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["before", "after"]
        assert [each.status for each in await reading.episodes()] == ["SUCCEEDED"]


async def test_memories_closed_in_another_order_than_opened_record_their_own_plans(tmp_path: Path) -> None:
    one, two = Memory.open(f"sqlite:///{tmp_path}/1.db"), Memory.open(f"sqlite:///{tmp_path}/2.db")
    await one.__aenter__()
    await two.__aenter__()
    await one.__aexit__(None, None, None)
    await NoteActionPerformable("to the second").perform()
    await two.flush()
    assert await texts(two) == ["to the second"]
    await two.__aexit__(None, None, None)
    assert recorder.get() is None
    assert watcher.get() is None


async def test_an_opening_that_is_cancelled_while_it_reads_the_types_closes_its_connection(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

    async def declarations(log: EventLog) -> list[bytes]:
        async with log.engine.connect() as connection:
            driver = (await connection.get_raw_connection()).driver_connection
        reached.set_result(driver)
        await asyncio.sleep(60)
        return []

    monkeypatch.setattr(EventLog, "declarations", declarations)
    task = asyncio.create_task(Memory.open(url_of(tmp_path)).__aenter__())
    driver = await reached
    assert driver._connection is not None
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert driver._connection is None


async def test_an_abandoned_plan_that_is_closed_in_another_context_leaves_the_episode_there_alone(
    tmp_path: Path,
) -> None:
    @dataclass
    class HangActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            await asyncio.sleep(60)

    async with Memory.open(url_of(tmp_path)) as memory:
        dropped = HangActionPerformable().perform()
        context = contextvars.copy_context()
        context.run(dropped.send, None)
        while recorder.get() is not None and not memory.recent_episodes:
            context.run(dropped.send, None)
        async with memory.episode(description="mine"):
            dropped.close()
            await NoteActionPerformable("here").perform()
        await memory.flush()
        result = {each.description: each.nodes for each in await memory.reading.episodes()}
        assert result == {"HangAction": 2, "mine": 2}
