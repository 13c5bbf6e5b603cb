"""A memory keeps simulations apart from what really happened."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.operations.recovery import recover
from pycrorm_async.plan import (
    SimulatedTaskTree,
)
from tests.commands import run_script
from tests.memory.note_actions import NoteActionPerformable, texts, url_of

pytestmark = pytest.mark.slow


async def test_a_memory_closed_in_a_simulation_ends_it(tmp_path: Path) -> None:
    with SimulatedTaskTree():
        async with Memory.open(url_of(tmp_path)):
            with SimulatedTaskTree():
                await NoteActionPerformable("a").perform()
                memory = Memory.open(f"sqlite:///{tmp_path}/other.db")
                await memory.__aenter__()
                with SimulatedTaskTree():
                    await memory.__aexit__(None, None, None)
    async with Reading.open(f"sqlite:///{tmp_path}/other.db") as reading:
        assert [each.status for each in await reading.episodes(simulated=True)] == ["INTERRUPTED"]


async def test_a_simulation_whose_process_is_killed_is_lost_with_the_episode_around_it(tmp_path: Path) -> None:
    script = (
        "import asyncio, os, signal, sys\n"
        "from pycrorm_async.plan import SimulatedTaskTree\n"
        "from tests.memory.note_actions import Memory, NoteActionPerformable\n"
        "async def main():\n"
        "    async with Memory.open(sys.argv[1]) as memory, memory.episode(description='killed'):\n"
        "        await NoteActionPerformable('real').perform()\n"
        "        with SimulatedTaskTree():\n"
        "            await NoteActionPerformable('thought').perform()\n"
        "            os.kill(os.getpid(), signal.SIGKILL)\n"
        "asyncio.run(main())\n"
    )
    done = await asyncio.to_thread(run_script, script, url_of(tmp_path))
    assert done.returncode == -signal.SIGKILL
    assert (await recover(url_of(tmp_path))).failed == {}
    async with Reading.open(url_of(tmp_path)) as reading:
        episodes = await reading.episodes(simulated=True)
        assert [(each.description, each.status, each.simulated) for each in episodes] == [
            ("killed", "LOST", False),
            ("simulation", "LOST", True),
        ]
        assert await texts(reading) == ["real"]
