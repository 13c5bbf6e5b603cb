"""Fixtures of the export's tests: a memory of real episodes and one written by a script, which the tests only read."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path

import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory, Reading, UserView
from pycrorm_async.cli.demo import kitchen_world
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.plan import (
    NavigateAction,
    ObjectDesignatorDescription,
    ParkArmsAction,
    PickUpAction,
    PlanFailure,
    TransportAction,
    simulated_robot,
)
from pycrorm_async.settings import Settings
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from tests.databases import run_in_own_loop
from tests.projections.event_script import NAVIGATE, PICK_UP, SAYING, append_and_fold, declarations
from tests.query.test_reading import episode
from tests.shared_folders import made_once

LONGEST = UserView(
    "longest", select(TaskTreeNode.dtype, func.max(TaskTreeNode.duration).label("s")).group_by(TaskTreeNode.dtype)
)


async def breakfast(*, fails: bool) -> None:
    """Bring the milk, after two pick-ups that fail, or without them."""
    with BulletWorld(), simulated_robot:
        kitchen_world()
        milk = ObjectDesignatorDescription(names=["milk"])
        await ParkArmsAction([Arms.BOTH]).resolve().perform()
        for arm in (Arms.RIGHT, Arms.LEFT) if fails else ():
            try:
                await PickUpAction(milk, [arm], [Grasp.FRONT]).resolve().perform()
            except PlanFailure:
                continue
        await TransportAction(milk, [Arms.LEFT], [Pose([1.3, 0.45, 0.9])]).resolve().perform()


async def drive() -> None:
    """Drive the courier, whose joints are not those of the PR2."""
    with BulletWorld(), simulated_robot:
        Object("courier", ObjectType.ROBOT)
        await NavigateAction([Pose([1, 0.5, 0])]).resolve().perform()


async def nothing() -> None:
    """Move an object without a robot."""
    with BulletWorld():
        Object("milk", ObjectType.MILK, pose=Pose([1, 0, 1])).set_pose(Pose([2, 0, 1]))


async def _record(url: str) -> None:
    async with Memory.open(url, settings=Settings(sample_interval_ms=1), views=[LONGEST]) as memory:
        for name, plan in (
            ("fails", partial(breakfast, fails=True)),
            ("succeeds", partial(breakfast, fails=False)),
            ("courier", drive),
            ("no robot", nothing),
        ):
            async with memory.episode(description=name):
                await plan()
        await memory.flush()


@pytest.fixture(scope="session")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a memory: episode 1 has failures, 2 has none, 3 is a courier's, 4 has no robot."""
    return made_once(tmp_path_factory, "kitchen", lambda folder: asyncio.run(_record(f"sqlite:///{folder}/pycrorm.db")))


@pytest.fixture
async def reading(kitchen: Path) -> AsyncIterator[Reading]:
    async with Reading.open(f"sqlite:///{kitchen}/pycrorm.db") as opened:
        yield opened


async def write_script(url: str) -> None:
    """Make a memory in which episode 1 still runs and episode 2 has ended."""
    await append_and_fold(url, [*declarations(NAVIGATE, PICK_UP, SAYING), *episode(1).records, *episode(2).records])


@pytest.fixture(scope="session")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(
        tmp_path_factory, "script", lambda folder: run_in_own_loop(write_script(f"sqlite:///{folder}/memory.db"))
    )


@pytest.fixture
async def scripted(script: Path) -> AsyncIterator[Reading]:
    """Yield a memory in which episode 1 still runs and episode 2 has ended."""
    async with Reading.open(f"sqlite:///{script}/memory.db") as opened:
        yield opened
