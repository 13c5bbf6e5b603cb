"""Perform real plans in a real world: the memory has the task tree and the world of every moment.

The oracle are actions that save the state of the world in the middle of a plan.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.clock import SYSTEM_CLOCK, Clock, monotonic_ns
from pycrorm_async.errors import UnknownEpisode
from pycrorm_async.plan import (
    ActionAbstract,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.query.snapshot import WorldThen
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose, WorldState, current_world
from tests.promises.chronicle import joints_of_bullet, numbers
from tests.promises.lab import WITHIN_REACH, lab, url_of

pytestmark = pytest.mark.slow

ARM = "l_gripper_tool_frame"


@dataclass
class SavingActionPerformable(ActionAbstract):
    """Save the state of the world, and the time."""

    _saved: list[tuple[int, WorldState]] = field(default_factory=list)

    async def perform(self) -> None:
        world = current_world.get()
        assert world is not None
        self._saved.append((monotonic_ns(), world.save_state()))


def clock_from(start: list[int]) -> Clock:
    """Return the system's clock; it appends the first monotonic reading after `start` was emptied."""

    def read() -> int:
        now = monotonic_ns()
        if not start:
            start.append(now)
        return now

    return Clock(SYSTEM_CLOCK.wall_ns, read)


async def test_a_snapshot_at_any_time_equals_the_state_that_was_saved_then(tmp_path: Path) -> None:
    saved: list[tuple[int, WorldState]] = []
    start: list[int] = [0]
    async with Memory.open(url_of(tmp_path), clock=clock_from(start)) as memory:
        start.clear()
        async with memory.episode(description="a test") as episode:
            with lab() as scene:
                for action in (
                    MoveTorsoActionPerformable(0.2),
                    NavigateActionPerformable(WITHIN_REACH),
                    PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT),
                    NavigateActionPerformable(Pose([-1, 0, 0], (0, 0, 0.6, 0.8))),
                    ParkArmsActionPerformable(Arms.LEFT),
                ):
                    await action.perform()
                    await SavingActionPerformable(saved).perform()
        await memory.flush()
        for ns, state in saved:
            then = await memory.as_of(episode, time=(ns - start[0]) / 1e9)
            assert [each.dtype for each in then.running] == [None, "SavingAction"]
            assert then.world.state == state
            robot, pose = then.world.robot, state.objects["pr2"].pose
            assert robot is not None
            assert (robot.pose, robot.torso_height) == (pose, state.objects["pr2"].joints["torso_lift_joint"])
    assert len({numbers(state.objects["milk"].pose) for _, state in saved}) == 4
    # A world of today can be restored to that state.
    await assert_restored(then.world, saved[-1][1])


async def assert_restored(then: WorldThen, state: WorldState) -> None:
    with lab() as scene:
        scene.world.restore_state(then.state)
        assert scene.world.save_state() == state
        joints = joints_of_bullet(scene.robot)
        assert {joint: joints[joint] for joint in then.object("pr2").joints} == pytest.approx(
            dict(state.objects["pr2"].joints), abs=1e-9
        )
        assert scene.robot.attachments == {scene.milk: ARM}
        before = scene.milk.pose
        await NavigateActionPerformable(Pose([5, 5, 0])).perform()
        assert scene.milk.pose.distance(before) > 5  # the hand holds it again


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


async def test_a_simulation_has_moments_of_its_own_and_its_episode_has_none_of_them(tmp_path: Path) -> None:
    saved: list[tuple[int, WorldState]] = []
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="thinking"):
            with lab() as scene:
                await NavigateActionPerformable(WITHIN_REACH).perform()
                real = scene.world.save_state()
                with SimulatedTaskTree():
                    await PickUpActionPerformable(designator_of(scene.milk), Arms.LEFT, Grasp.FRONT).perform()
                    await SavingActionPerformable(saved).perform()
                await SavingActionPerformable(saved).perform()
        await memory.flush()
        simulation = await memory.as_of(2, time=1e9)
        (during,) = [each.sequence for each in simulation.tree if each.dtype == "SavingAction"]
        then = await memory.as_of(2, sequence=during)
        assert then.simulated
        assert then.world.state == saved[0][1]
        assert then.world.object("milk").attached_to == ("pr2", ARM)
        (during,) = [
            each.sequence for each in (await memory.as_of("last", time=1e9)).tree if each.dtype == "SavingAction"
        ]
        then = await memory.as_of("last", sequence=during)
        assert (then.number, then.simulated) == (1, False)
        assert then.world.state == saved[1][1] == real


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
