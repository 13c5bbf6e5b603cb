"""`pycrorm status` names the running episodes and their robots."""

from __future__ import annotations

import asyncio
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.cli.status import RUNNING_MAX
from pycrorm_async.world import COURIER, BulletWorld, Object, ObjectType
from tests.commands import answer, pycrorm

pytestmark = pytest.mark.slow

MEMORY_OF_0_1_0 = Path(__file__).parents[1] / "golden" / "memory_v1.tar.gz"


@pytest.mark.soak_on("postgresql")
async def test_a_running_episode_is_named_with_its_robots_until_it_ends(database_url: str, tmp_path: Path) -> None:
    asked = "--url", database_url
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="before"):
            pass
        with BulletWorld():
            Object("eve", ObjectType.ROBOT, robot=replace(COURIER, serial="C-03"))
            async with memory.episode(description="tidy up"):
                Object("courier", ObjectType.ROBOT)
                await memory.flush()
                document = await asyncio.to_thread(answer, "status", *asked, cwd=tmp_path)
                shown = await asyncio.to_thread(pycrorm, "status", *asked, cwd=tmp_path)
        await memory.flush()
        assert document["running_total"] == 1
        [running] = document["running"]
        [_, summary] = await memory.reading.episodes()
    assert (running["number"], running["id"], running["description"]) == (2, summary.id, "tidy up")
    assert [(each["name"], each["model"], each["serial"]) for each in running["robots"]] == [
        ("eve", "courier", "C-03"),
        ("courier", "courier", None),
    ]
    assert all(each["description"] for each in running["robots"])
    assert "Running episodes" in shown.stdout
    assert "eve (courier C-03), courier" in shown.stdout
    after = answer("status", *asked, cwd=tmp_path)
    assert (after["running"], after["running_total"]) == ([], 0)
    assert "Running episodes" not in pycrorm("status", *asked, cwd=tmp_path).stdout


async def test_of_many_running_episodes_the_newest_are_listed(tmp_path: Path) -> None:
    url, count = f"sqlite:///{tmp_path}/memory.db", RUNNING_MAX + 2
    started, done = asyncio.Barrier(count + 1), asyncio.Event()

    async def run(number: int) -> None:
        async with memory.episode(description=f"number {number}"):
            await started.wait()
            await done.wait()

    async with Memory.open(url) as memory, asyncio.TaskGroup() as tasks:
        for number in range(count):
            tasks.create_task(run(number))
        await started.wait()
        await memory.flush()
        document = await asyncio.to_thread(answer, "status", "--url", url, cwd=tmp_path)
        shown = await asyncio.to_thread(pycrorm, "status", "--url", url, cwd=tmp_path)
        done.set()
    assert document["running_total"] == count
    assert [each["number"] for each in document["running"]] == list(range(count, 2, -1))
    assert f"The {RUNNING_MAX} newest of {count} running episodes" in shown.stdout


def test_a_memory_whose_tables_are_those_of_another_version_has_a_status(tmp_path: Path) -> None:
    with tarfile.open(MEMORY_OF_0_1_0) as archive:
        archive.extractall(tmp_path, filter="data")
    document = answer("status", "--url", f"sqlite:///{tmp_path}/memory.db", cwd=tmp_path)
    assert (document["database"], document["running"], document["running_total"]) == ("ok", [], 0)
