"""Every episode holds what it was recorded with: source, libraries, settings, quality of the clock, and the world."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.clock import SYSTEM_CLOCK, Clock, clock_quality
from pycrorm_async.orm import PickUpWithContextView, ProcessMetaData
from pycrorm_async.plan import ParkArmsActionPerformable, PickUpActionPerformable, simulated_robot
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.record.episode_writer import PlanSource
from pycrorm_async.settings import Settings
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from tests.bullet import INSTALLED_BULLETS
from tests.commands import answer, pycrorm, run_script

SOURCE = PlanSource("ab" * 32, "cd" * 20, git_dirty=True)


async def episodes_of(memory: Memory) -> list[ProcessMetaData]:
    await memory.flush()
    async with memory.session() as session:
        return list(await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id)))


async def test_an_episode_holds_source_libraries_settings_and_clock(database_url: str, tmp_path: Path) -> None:
    settings = Settings(sync_interval_ms=20, on_full="fail")
    spool = tmp_path / "spool"
    async with Memory.open(database_url, spool=spool, settings=settings, plan_source=SOURCE) as memory:
        async with memory.episode(description="with all"):
            pass
        (episode,) = await episodes_of(memory)
        (summary,) = await memory.reading.episodes()
    quality = clock_quality()
    for each in (episode, summary):
        assert (each.plan_sha256, each.git_commit, each.git_dirty) == SOURCE
        assert each.settings == {"sync_interval_ms": 20, "on_full": "fail"}
        assert each.libraries is not None
        assert each.libraries["numpy"] == version("numpy")
        assert {"msgspec", "SQLAlchemy", "optik-py", *INSTALLED_BULLETS} <= set(each.libraries)
        assert ("pyjpt" in each.libraries) is (find_spec("jpt") is not None)  # it has no wheel for every Python
        assert each.clock_synchronized is (quality.synchronized if quality else None)
    assert "password" not in str(episode.settings)


async def test_what_is_not_known_is_null(database_url: str, tmp_path: Path) -> None:
    own_clock = Clock(SYSTEM_CLOCK.wall_ns, SYSTEM_CLOCK.monotonic_ns)
    async with Memory.open(database_url, spool=tmp_path / "spool", clock=own_clock) as memory:
        async with memory.episode(description="without source"):
            pass
        (episode,) = await episodes_of(memory)
    assert (episode.plan_sha256, episode.git_commit, episode.git_dirty, episode.settings) == (None,) * 4
    assert (episode.clock_synchronized, episode.clock_error_us, episode.world) == (None,) * 3


@pytest.mark.soak_on("postgresql")
async def test_the_scene_of_a_pick_up_is_the_world_that_its_episode_entered(database_url: str, tmp_path: Path) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:

        async def scenes() -> Sequence[str | None]:
            await memory.flush()
            async with memory.session() as session:
                return (await session.scalars(select(PickUpWithContextView.scene))).all()

        async with memory.episode(description="a pick-up"):
            with BulletWorld(), simulated_robot:
                Object("pr2", ObjectType.ROBOT)
                milk = Object("milk", ObjectType.MILK, pose=Pose([0.6, 0.2, 0.9]))
                with pytest.raises(PlanFailure):
                    await PickUpActionPerformable(milk, Arms.LEFT, Grasp.TOP).perform()
                assert await scenes() == ["pr2 (ROBOT), milk (MILK)"]  # while it runs
        assert await scenes() == ["BulletWorld (DIRECT): pr2 (ROBOT), milk (MILK)"]


@pytest.mark.soak_on("postgresql")
async def test_a_world_that_is_entered_inside_an_episode_is_described(database_url: str, tmp_path: Path) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="left before the end"):
            with BulletWorld(), simulated_robot:
                Object("pr2", ObjectType.ROBOT)
                await ParkArmsActionPerformable(Arms.BOTH).perform()
        with BulletWorld():
            Object("milk", ObjectType.MILK)
            async with memory.episode(description="entered before"):
                Object("bowl", ObjectType.BOWL)
        episode = memory.episode(description="open at the end")
        await episode.__aenter__()
        with BulletWorld():
            Object("spoon", ObjectType.SPOON)
            await episode.__aexit__(None, None, None)
        await memory.flush()
        worlds = [each.world for each in await episodes_of(memory)]
    assert worlds == [
        "BulletWorld (DIRECT): pr2 (ROBOT)",
        "BulletWorld (DIRECT): milk (MILK)",
        "BulletWorld (DIRECT): spoon (SPOON)",
    ]


@pytest.mark.soak_on("sqlite")
async def test_the_world_of_an_episode_that_runs_or_is_lost_is_that_of_its_objects(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:

        async def world() -> str | None:
            await memory.flush()
            return (await memory.reading.episode("last")).world

        with BulletWorld():
            Object("cup", ObjectType.JEROEN_CUP)  # in no episode
        async with memory.episode(description="running"):
            assert await world() is None
            with BulletWorld() as entered:
                assert await world() is None
                Object("pr2", ObjectType.ROBOT)
                bowl = Object("bowl", ObjectType.BOWL)
                assert await world() == "pr2 (ROBOT), bowl (BOWL)"
                bowl.remove()
                milk = Object("milk", ObjectType.MILK)
                assert await world() == "pr2 (ROBOT), milk (MILK)"
                milk.remove()
                Object("milk", ObjectType.MILK).set_pose(Pose([1, 0, 0]))
                assert await world() == "pr2 (ROBOT), milk (MILK)"
                entered.object("pr2").remove()
            assert await world() == "pr2 (ROBOT), bowl (BOWL), milk (MILK)"
        assert await world() == "BulletWorld (DIRECT): milk (MILK)"


@pytest.mark.slow
def test_a_lost_episode_names_the_objects_of_its_world(tmp_path: Path) -> None:
    program = """
import asyncio, os, signal
from pycrorm_async import Memory
from pycrorm_async.world import BulletWorld, Object, ObjectType
async def main():
    async with Memory.open("sqlite:///memory.db") as memory:
        async with memory.episode(description="killed"):
            with BulletWorld():
                Object("pr2", ObjectType.ROBOT)
                Object("bowl", ObjectType.BOWL).remove()
                Object("milk", ObjectType.MILK)
                os.kill(os.getpid(), signal.SIGKILL)
asyncio.run(main())
"""
    assert run_script(program, cwd=tmp_path).returncode == -signal.SIGKILL
    url = f"sqlite:///{tmp_path}/memory.db"
    assert pycrorm("writer", "--once", "--url", url, cwd=tmp_path).returncode == 0
    [episode] = answer("episodes", "--url", url, cwd=tmp_path)
    assert (episode["status"], episode["world"]) == ("LOST", "pr2 (ROBOT), milk (MILK)")
    assert "pr2 (ROBOT), milk (MILK)" in pycrorm("show", "1", "--url", url, cwd=tmp_path).stdout


@pytest.mark.slow
def test_a_plans_process_starts_no_git_on_its_own(tmp_path: Path) -> None:
    program = """
import asyncio, subprocess, sys
def refuse(event, arguments):
    if event in ("subprocess.Popen", "os.posix_spawn", "os.system"):
        print("started", arguments)
sys.addaudithook(refuse)
from pycrorm_async import Memory
async def main():
    async with Memory.open("sqlite:///memory.db") as memory:
        async with memory.episode(description="quiet"):
            pass
asyncio.run(main())
"""
    ran = run_script(program, cwd=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert "git" not in ran.stdout
