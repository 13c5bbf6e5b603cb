"""A moment of a plan that runs, and of a robot that the package does not describe."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import UnknownEpisode
from pycrorm_async.plan import (
    ActionAbstract,
    simulated_robot,
)
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.promises.lab import url_of

pytestmark = pytest.mark.slow


@dataclass
class WaitingActionPerformable(ActionAbstract):
    label: str
    _begun: asyncio.Event
    _go_on: asyncio.Event

    async def perform(self) -> None:
        self._begun.set()
        await self._go_on.wait()


async def test_a_snapshot_of_a_running_episode_has_its_running_node(tmp_path: Path) -> None:
    begun, go_on = asyncio.Event(), asyncio.Event()
    async with Memory.open(url_of(tmp_path)) as memory, memory.episode(description="running") as episode:
        with pytest.raises(UnknownEpisode):  # no event of it is in the database yet
            await memory.as_of("00000000-0000-7000-8000-000000000001", time=0)
        both = asyncio.create_task(
            (WaitingActionPerformable("a", begun, go_on) | WaitingActionPerformable("b", begun, go_on)).perform()
        )
        await begun.wait()
        await asyncio.sleep(0)
        await memory.flush()
        now = await memory.as_of(episode, time=1e9)
        assert [(each.depth, each.dtype, each.parameters) for each in now.running[2:]] == [
            (2, "WaitingAction", {"label": "a"}),
            (2, "WaitingAction", {"label": "b"}),
        ]
        assert now.status == "RUNNING"
        go_on.set()
        await both
        await memory.flush()
        assert await memory.as_of(episode, sequence=now.sequence) == now  # earlier snapshots do not change
        later = await memory.as_of(episode, time=1e9)
        assert [each.status for each in later.tree] == ["RUNNING", "SUCCEEDED", "SUCCEEDED", "SUCCEEDED"]


async def test_a_robot_without_a_local_description_has_a_base_and_no_torso(tmp_path: Path) -> None:
    urdf = tmp_path / "cart.urdf"
    urdf.write_text('<robot name="cart"><link name="base"/></robot>')
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="cart") as episode:
            with BulletWorld(), simulated_robot:
                Object("cart", ObjectType.ROBOT, urdf, Pose([1, 2, 0]))
                Object("pr2", ObjectType.ROBOT)
        await memory.flush()
        robot = (await memory.as_of(episode, sequence=4)).world.robot
        assert robot is not None
        assert (robot.name, robot.pose, robot.torso_height) == ("cart", Pose([1, 2, 0]), None)
