"""A simulated plan shows its effects, and changes nothing in the real world."""

from __future__ import annotations

import asyncio
import contextvars
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import (
    ActionAbstract,
    IKError,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectDesignatorDescription,
    SimulatedTaskTree,
    TransportActionPerformable,
    collected_tree,
    simulated_robot,
)
from pycrorm_async.plan.execution import current_simulation
from pycrorm_async.plan.objects import designator_of, in_world
from pycrorm_async.plan.task import current_node
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, BulletWorld, Object, ObjectType, Pose, current_world
from pycrorm_async.world.pose import WorldClosed
from tests.plan.conftest import Scene
from tests.plan.fake_observer import Recording
from tests.world.fakes import ChangeLog

THERE = Pose([0.6, 0.4, 0])


@dataclass
class ThinkActionPerformable(ActionAbstract):
    """Simulate driving there, and return the state of the simulated world."""

    target: Pose

    async def perform(self) -> Any:
        with SimulatedTaskTree() as tree:
            await NavigateActionPerformable(self.target).perform()
            robot = current_world.get().robot  # type: ignore[union-attr]
            assert robot is not None
            return robot.pose, [str(node) for node in tree]


async def test_a_simulation_happens_in_a_copy_and_nowhere_else(scene: Scene) -> None:
    change_log = ChangeLog()
    scene.world.observe(change_log)
    before = scene.world.save_state()
    with SimulatedTaskTree() as tree:
        copy = current_world.get()
        assert copy is not None
        assert copy is not scene.world
        await MoveTorsoActionPerformable(0.3).perform()
        await NavigateActionPerformable(THERE).perform()
        assert copy.object("pr2").pose == THERE
        assert copy.object("pr2").joint_position("torso_lift_joint") == 0.3
    assert scene.world.save_state() == before
    assert change_log.notes == []
    assert current_world.get() is scene.world
    assert not copy.entered
    assert [(type(node.designator).__name__, node.status, tree.depth(node)) for node in tree] == [
        ("MoveTorsoActionPerformable", TaskStatus.SUCCEEDED, 0),
        ("MoveJointsMotion", TaskStatus.SUCCEEDED, 1),
        ("NavigateActionPerformable", TaskStatus.SUCCEEDED, 0),
        ("MoveMotion", TaskStatus.SUCCEEDED, 1),
    ]


async def test_the_result_of_a_simulation_comes_true_to_the_last_bit(scene: Scene) -> None:
    """The same plan, simulated and then performed: both worlds end in the same state."""
    target = Pose([1.3, 1.0, 0.95])

    async def plan() -> None:
        await TransportActionPerformable(cereal, Arms.LEFT, target).perform()

    scene.milk.remove()
    cereal = ObjectDesignatorDescription(names=["cereal"]).resolve()
    await MoveTorsoActionPerformable(0.3).perform()
    with SimulatedTaskTree() as tree:
        await plan()
        simulated = current_world.get().save_state()  # type: ignore[union-attr]
    assert scene.cereal.pose == Pose([1.3, 0.7, 0.95])
    with collected_tree() as real:
        await plan()
    assert scene.world.save_state() == simulated
    assert [str(node) for node in tree] == [str(node) for node in real]
    assert scene.cereal.pose.distance(target) < 0.01


async def test_a_simulation_without_a_world_is_only_a_tree_of_its_own() -> None:
    @dataclass
    class NothingActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            assert current_world.get() is None

    with collected_tree() as around, SimulatedTaskTree() as tree:
        await NothingActionPerformable().perform()
    assert (len(around), len(tree)) == (0, 1)


async def test_a_simulation_has_its_own_root_and_the_tree_around_continues_without_it(scene: Scene) -> None:
    with collected_tree() as around:
        pose, inner = await ThinkActionPerformable(THERE).perform()
        await NavigateActionPerformable(Pose([0.1, 0, 0])).perform()
    assert pose == THERE
    assert inner == ["<NavigateActionPerformable SUCCEEDED>", "<MoveMotion SUCCEEDED>"]
    names = [(type(node.designator).__name__, around.depth(node)) for node in around]
    assert names == [("ThinkActionPerformable", 0), ("NavigateActionPerformable", 0), ("MoveMotion", 1)]
    assert scene.robot.pose == Pose([0.1, 0, 0])


@pytest.mark.parametrize("raised", [IKError(Pose(), Arms.LEFT, "tool", "no"), ValueError("sour"), KeyboardInterrupt()])
async def test_an_exception_leaves_a_simulation_and_the_world_is_as_before(scene: Scene, raised: BaseException) -> None:
    before = scene.world.save_state()
    with pytest.raises(type(raised)) as caught, SimulatedTaskTree() as tree:
        await NavigateActionPerformable(THERE).perform()
        raise raised
    assert caught.value is raised
    assert scene.world.save_state() == before
    assert (current_world.get(), current_node.get(), current_simulation.get()) == (scene.world, None, None)
    assert len(tree) == 2


async def test_a_cancelled_simulation_leaves_the_world_as_before(scene: Scene) -> None:
    began = asyncio.Event()

    async def dreaming() -> None:
        with SimulatedTaskTree():
            await NavigateActionPerformable(THERE).perform()
            began.set()
            await asyncio.sleep(60)

    task = asyncio.create_task(dreaming())
    await began.wait()
    assert scene.robot.pose == Pose()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert scene.robot.pose == Pose()


class Suspended:
    """An await that never ends."""

    def __await__(self) -> Generator[None, None, None]:
        yield


async def test_an_abandoned_simulation_is_closed_without_changing_its_surroundings(scene: Scene) -> None:
    copies: list[BulletWorld | None] = []

    async def dreaming() -> None:
        with SimulatedTaskTree():
            copies.append(current_world.get())
            await Suspended()

    listening = Recording()
    with listening.listening():
        dream = dreaming()
        contextvars.copy_context().run(dream.send, None)
        (copy,) = copies
        assert copy is not None
        assert copy.entered
        dream.close()
    assert not copy.entered
    assert (current_world.get(), current_node.get(), current_simulation.get()) == (scene.world, None, None)
    assert listening.notes == ["think None", "thought GeneratorExit"]


async def test_simulations_nest(scene: Scene) -> None:
    with SimulatedTaskTree() as outer:
        await NavigateActionPerformable(THERE).perform()
        with SimulatedTaskTree() as inner:
            assert in_world(scene.robot).pose == THERE
            await NavigateActionPerformable(Pose([2, 2, 0])).perform()
            assert in_world(scene.robot).pose == Pose([2, 2, 0])
            resolved = designator_of(in_world(scene.milk))
        assert in_world(scene.robot).pose == THERE
        assert in_world(resolved).world is current_world.get()
    assert (len(outer), len(inner)) == (2, 2)
    assert in_world(resolved) is scene.milk
    assert scene.robot.pose == Pose()


async def test_two_tasks_simulate_concurrently_while_a_third_acts(scene: Scene) -> None:
    ready = asyncio.Barrier(3)

    async def dreaming(x: float) -> tuple[Pose, int]:
        with SimulatedTaskTree() as tree:
            await ready.wait()
            await NavigateActionPerformable(Pose([x, 0, 0])).perform()
            await asyncio.sleep(0.01)
            return in_world(scene.robot).pose, len(tree)

    async def acting() -> None:
        await ready.wait()
        await NavigateActionPerformable(THERE).perform()

    first, second, _ = await asyncio.gather(dreaming(1), dreaming(2), acting())
    assert (first, second) == ((Pose([1, 0, 0]), 2), (Pose([2, 0, 0]), 2))
    assert scene.robot.pose == THERE


async def test_a_task_begun_in_a_simulation_uses_the_copy_and_then_finds_it_closed(scene: Scene) -> None:
    closing = asyncio.Event()

    async def late() -> None:
        await closing.wait()
        await NavigateActionPerformable(THERE).perform()

    with SimulatedTaskTree():
        task = asyncio.create_task(late())
        await asyncio.create_task(NavigateActionPerformable(THERE).perform())
        assert in_world(scene.robot).pose == THERE
    closing.set()
    with pytest.raises(WorldClosed):
        await task
    assert scene.robot.pose == Pose()


async def test_the_recorder_is_notified_when_a_simulation_begins_and_ends(scene: Scene) -> None:
    listening = Recording()
    with listening.listening():
        with SimulatedTaskTree(description="what if"):
            await NavigateActionPerformable(THERE).perform()
        with pytest.raises(ValueError, match="sour"), SimulatedTaskTree():
            raise ValueError("sour")
    assert listening.notes == [
        "think what if",
        "start NavigateActionPerformable",
        "start MoveMotion",
        "end MoveMotion SUCCEEDED",
        "end NavigateActionPerformable SUCCEEDED",
        "thought through",
        "think None",
        "thought ValueError",
    ]


async def test_a_robot_chosen_inside_a_simulation_is_not_chosen_outside() -> None:
    with BulletWorld() as world:
        robot = Object("pr2", ObjectType.ROBOT)
        with SimulatedTaskTree(), simulated_robot:
            await NavigateActionPerformable(THERE).perform()
        with pytest.raises(CallerError, match="robot"):
            await NavigateActionPerformable(THERE).perform()
        assert (robot.pose, world.robot) == (Pose(), robot)


def test_a_simulation_is_entered_once_and_described_in_words() -> None:
    simulated = SimulatedTaskTree()
    with simulated:
        pass
    with pytest.raises(CallerError, match="entered once; make a new SimulatedTaskTree"), simulated:
        pass
    with pytest.raises(CallerError, match="a str, not 3"):
        SimulatedTaskTree(description=3)  # type: ignore[arg-type]


def test_a_simulation_of_a_world_that_was_left_is_refused_and_changes_nothing() -> None:
    with BulletWorld() as world:
        pass
    token = current_world.set(world)
    try:
        with pytest.raises(WorldClosed), SimulatedTaskTree():
            pass
        assert (current_world.get(), current_simulation.get()) == (world, None)
    finally:
        current_world.reset(token)
