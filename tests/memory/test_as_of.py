"""Perform real plans in a real world: the memory has the task tree and the world of every moment.

The tests keep their own oracle while the plan runs: observers that query the world and the nodes of the plan, and
actions that save the state of the world in the middle of a plan.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.clock import SYSTEM_CLOCK, Clock, monotonic_ns
from pycrorm_async.errors import UnknownEpisode
from pycrorm_async.plan import (
    ActionAbstract,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    PlanFailure,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.plan.execution import PlanObserver, recorder
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.plan.task import TaskTreeNode as Node
from pycrorm_async.query.snapshot import Moment, WorldThen
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose, WorldState, current_world
from tests.promises.chronicle import joints_of_bullet, numbers
from tests.promises.lab import WITHIN_REACH, FailingActionPerformable, lab, url_of

pytestmark = pytest.mark.slow

ARM = "l_gripper_tool_frame"


class StateObserver:
    """Observe every change of nodes and world after the memory did, and note the state that results.

    The observer queries only the objects that a change touches; the rest is as it was at the change before.
    """

    def __init__(self, behind: PlanObserver) -> None:
        self.behind = behind
        self.notes: list[tuple[list[tuple[str, str, str | None]], dict[str, Any]]] = []
        self._nodes: list[Node] = []
        self._things: dict[str, dict[str, Any]] = {}

    def _note(self) -> None:
        tree = [(_dtype(node), node.status.name, _dtype(node.parent) if node.parent else None) for node in self._nodes]
        self.notes.append((tree, {name: dict(facts) for name, facts in self._things.items()}))

    def admit(self) -> Awaitable[None] | None:
        return self.behind.admit()

    def node_started(self, node: Node) -> None:
        self.behind.node_started(node)
        self._nodes.append(node)
        self._note()

    def node_ended(self, node: Node) -> None:
        self.behind.node_ended(node)
        self._note()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.behind, name)

    def object_added(self, added: Object) -> None:
        self._things[added.name] = {"pose": numbers(added.pose), "joints": added.joint_positions(), "on": None}
        self._note()

    def object_removed(self, removed: Object) -> None:
        del self._things[removed.name]
        self._note()

    def object_moved(self, moved: Object) -> None:
        self._things[moved.name]["pose"] = numbers(moved.pose)
        self._note()

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        self._things[moved.name]["joints"] = moved.joint_positions()
        self._note()

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        self._things[child.name]["on"] = (parent.name, link)
        self._note()

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        self._things[child.name]["on"] = None
        self._note()


def _dtype(node: Node) -> str:
    assert node.designator is not None
    return type(node.designator).__dtype__


def state_at(then: Moment) -> tuple[list[tuple[str | None, str, str | None]], dict[str, Any]]:
    """Return the same state from a snapshot, without the episode's root."""
    dtypes = {each.id: each.dtype for each in then.tree}
    nodes = sorted(then.tree, key=lambda each: each.sequence)[1:]
    tree = [(each.dtype, each.status, dtypes[each.parent_id or 0]) for each in nodes]
    objects_by_name = {
        each.name: {"pose": numbers(each.pose), "joints": each.joints, "on": each.attached_to}
        for each in then.world.objects
    }
    return tree, objects_by_name


@contextmanager
def observed() -> Iterator[StateObserver]:
    """Place a state observer between the plans of this context and their memory."""
    behind = recorder.get()
    assert behind is not None
    keeper = StateObserver(behind)
    token = recorder.set(keeper)
    try:
        yield keeper
    finally:
        recorder.reset(token)


async def test_snapshots_equal_the_observed_tree_and_world_after_every_event_of_a_plan(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path), settings=Settings(sample_interval_ms=1)) as memory:
        async with memory.episode(description="a test") as episode:
            with observed() as keeper, lab(keeper) as scene:
                spoon = Object("spoon", ObjectType.SPOON, pose=Pose([1.3, 1, 1.05]))
                await (ParkArmsActionPerformable(Arms.RIGHT) | MoveTorsoActionPerformable(0.1)).perform()
                await NavigateActionPerformable(WITHIN_REACH).perform()
                scene.milk.attach(spoon)
                await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
                await NavigateActionPerformable(Pose([0.5, 0.8, 0], (0, 0, 0.6, 0.8))).perform()
                with pytest.raises(PlanFailure):
                    await (FailingActionPerformable(PlanFailure("no")) + MoveTorsoActionPerformable(0.3)).perform()
                await PlaceActionPerformable(scene.milk, Arms.LEFT, Pose([0.9, 1.2, 0.9])).perform()
                spoon.remove()
                scene.cereal.remove()
                Object("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([2, 2, 0]))
                scene.world.reset()
        await memory.flush()
        assert memory.status.faults.total == 0
        end = await memory.as_of(episode, time=1e9)
        moments = [await memory.as_of(episode, sequence=each) for each in range(1, end.sequence + 1)]
    # The events begin and end with the episode and its root, and the world is left before the end.
    changes = [then for before, then in itertools.pairwise(moments) if state_at(before) != state_at(then)]
    assert len(keeper.notes) > 60
    expected = [note for before, note in zip([([], {}), *keeper.notes], keeper.notes, strict=False) if before != note]
    assert [state_at(then) for then in changes[: len(expected)]] == expected
    assert (end.status, end.tree[0].status, end.world.objects) == ("SUCCEEDED", "SUCCEEDED", ())
    assert {then.status for then in moments[:-1]} == {"RUNNING"}
    assert [then.time_s for then in moments] == sorted(then.time_s for then in moments)


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
