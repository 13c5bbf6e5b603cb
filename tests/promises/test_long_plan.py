"""A plan that suspends once in tens of thousands of actions is stored whole, and its process does not grow."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import environment
from tests.memory_in_use import ALLOCATING

pytestmark = pytest.mark.slow

SCRIPT = """
import asyncio, json, sys
from dataclasses import dataclass
from sqlalchemy import func, select
from pycrorm_async import Memory
from pycrorm_async.orm import Designator, TaskTreeNode
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.task_status import TaskStatus
from tests.memory_in_use import bytes_in_use

@dataclass
class CountActionPerformable(ActionAbstract):
    index: int

    async def perform(self):
        return None

async def main(url, total):
    sizes = []
    async with Memory.open(url) as memory:
        async with memory.episode(description="count"):
            for index in range(total):
                await CountActionPerformable(index).perform()
                if index % (total // 2) == total // 2 - 1:
                    await memory.flush()
                    sizes.append(bytes_in_use())
        await memory.flush()
        async with memory.session() as session:
            counting = memory.mapped(CountActionPerformable)
            rows = (await session.execute(select(func.count(), func.min(counting.index), func.max(counting.index),
                func.count(counting.index.distinct())))).one()
            done = await session.scalar(select(func.count()).where(TaskTreeNode.status == TaskStatus.SUCCEEDED))
    print(json.dumps({"sizes": sizes, "rows": list(rows), "done": done}))

asyncio.run(main(sys.argv[1], int(sys.argv[2])))
"""


@pytest.mark.soak  # test_defects_of_storage shows it of a shorter one
def test_a_long_plan_is_stored_whole_and_its_process_does_not_grow(tmp_path: Path) -> None:
    total = 400_000
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, f"sqlite:///{tmp_path}/long.db", str(total)],
        env=environment() | ALLOCATING,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["rows"] == [total, 0, total - 1, total]
    assert figures["done"] == total + 1  # the root of the episode as well
    # Over the second half. 32 kB a node, as in the reference system, would be 6.4 GB.
    middle, end = figures["sizes"]
    assert end - middle < 12_000 * 1024, figures["sizes"]
