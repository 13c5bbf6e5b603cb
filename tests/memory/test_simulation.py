"""A memory keeps simulations apart from what really happened."""

from __future__ import annotations

import asyncio
import signal
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.operations.recovery import recover
from pycrorm_async.orm import (
    Action,
    Attachment,
    MoveAndPickUpAction,
    Object,
    PickUpWithContextView,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.plan import (
    ActionAbstract,
    MoveAndPickUpPerformable,
    MoveTorsoActionPerformable,
    ObjectDesignator,
    PlanFailure,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.world import Arms, BulletWorld, Grasp, ObjectType, Pose
from pycrorm_async.world import Object as WorldObject
from pycrorm_async.world.pose import yaw_quaternion
from tests.commands import pycrorm, run_script
from tests.databases import ask
from tests.memory.note_actions import NoteActionPerformable, texts, url_of

pytestmark = pytest.mark.slow

TOO_FAR = Pose([-2, 0, 0])
NEAR = Pose([0.6, 0.9, 0], yaw_quaternion(-0.27))


@dataclass
class FetchFromAnywhereActionPerformable(ActionAbstract):
    """Simulate picking the object up from several places, and do it from the first place that works."""

    thing: ObjectDesignator

    async def perform(self) -> None:
        for stand in (TOO_FAR, NEAR):
            fetching = MoveAndPickUpPerformable(stand, self.thing, Arms.RIGHT, Grasp.FRONT)
            try:
                with SimulatedTaskTree(f"from x = {stand.position.x:g}"):
                    await fetching.perform()
            except PlanFailure:
                continue
            await fetching.perform()
            return


async def fetched(url: str) -> None:
    """Record one real episode, in which one simulation failed and one succeeded."""
    async with Memory.open(url) as memory, memory.episode(description="fetch the cereal"):
        with BulletWorld(), simulated_robot:
            WorldObject("pr2", ObjectType.ROBOT)
            WorldObject("kitchen", ObjectType.ENVIRONMENT)
            cereal = WorldObject("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.3, 0.7, 0.95]))
            await MoveTorsoActionPerformable(0.3).perform()
            await FetchFromAnywhereActionPerformable(designator_of(cereal)).perform()


async def test_simulations_are_left_out_unless_they_are_asked_for(tmp_path: Path) -> None:
    await fetched(url_of(tmp_path))
    async with Reading.open(url_of(tmp_path)) as reading:
        async with reading.session() as session:
            assert [each.dtype for each in await session.scalars(select(Action).order_by(Action.id))] == [
                "MoveTorsoAction", "FetchFromAnywhereAction", "MoveAndPickUpAction", "NavigateAction", "FaceAtAction",
                "NavigateAction", "LookAtAction", "PickUpAction",
            ]  # fmt: skip
            done = (await session.scalars(select(MoveAndPickUpAction))).one()
            assert (done.standing_position.x, done.object.name) == (0.6, "cereal")
            positions = {(each.pose.x, each.pose.y) for each in await session.scalars(select(Object)) if each.pose}
            assert (-2.0, 0.0) not in positions
            assert set(await session.scalars(select(TaskTreeNode.simulated))) == {False}
        async with reading.session(simulated=True) as session:
            episodes = (await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id))).all()
            assert [(each.description, each.simulated, each.status) for each in episodes] == [
                ("fetch the cereal", False, "SUCCEEDED"),
                ("from x = -2", True, "FAILED"),
                ("from x = 0.6", True, "SUCCEEDED"),
            ]
            thinker = await session.scalar(select(TaskTreeNode).where(TaskTreeNode.dtype == "FetchFromAnywhereAction"))
            assert thinker is not None
            assert {(each.thought_by, each.thought_by_node) for each in episodes[1:]} == {
                (episodes[0].uuid, thinker.id >> 5 & 2**26 - 1)
            }
            held = (await session.scalars(select(Attachment).order_by(Attachment.id))).all()
            assert [each.process_metadata_id for each in held] == [1, 3]
        frames = [await reading.dataframe(select(PickUpWithContextView), simulated=each) for each in (False, True)]
        assert [sorted(each.status) for each in frames] == [["SUCCEEDED"], ["FAILED", "SUCCEEDED", "SUCCEEDED"]]
    counts = "SELECT (SELECT count(*) FROM pick_up_action), (SELECT count(*) FROM process_metadata)"
    assert ask(url_of(tmp_path), counts) == [(1, 1)]
    url = ("--url", url_of(tmp_path))
    assert pycrorm("episodes", "--simulated", *url, cwd=tmp_path).stdout.count("by FetchFromAnywhereAction of") == 2
    assert "simulated by FetchFromAnywhereAction of episode 1" in pycrorm("show", "3", *url, cwd=tmp_path).stdout
    assert "simulated in episodes 2, 3" in pycrorm("show", "last", *url, cwd=tmp_path).stdout


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
