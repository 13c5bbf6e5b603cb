"""A simulated plan shows its effects, refers to objects of the copy, and changes nothing in the real world."""

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
    CostmapLocation,
    IKError,
    LocatedObjectDescription,
    MoveAndPickUpPerformable,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectDesignatorDescription,
    ObjectPart,
    PickUpActionPerformable,
    SimulatedTaskTree,
    TransportActionPerformable,
    collected_tree,
)
from pycrorm_async.plan.execution import current_simulation
from pycrorm_async.plan.failures import PerceptionObjectNotInWorld
from pycrorm_async.plan.objects import designator_of, in_world
from pycrorm_async.plan.task import current_node
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose, current_world
from pycrorm_async.world.pose import WorldClosed, yaw_quaternion
from tests.plan.conftest import Scene
from tests.plan.fakes import Recording
from tests.world.fakes import ChangeLog

# === simulation ===============================================================================================
#
# A simulated plan shows its effects, and changes nothing in the real world.

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


# === simulated objects ========================================================================================
#
# Designators, locations and attachments refer to objects of the copy in a simulation, and to real ones outside.

AT_THE_CEREAL = Pose([0.6, 0.9, 0], yaw_quaternion(-0.27))


async def test_designators_refer_to_the_copy_inside_and_to_the_real_object_outside(scene: Scene) -> None:
    milk = ObjectDesignatorDescription(names=["milk"]).resolve()
    part = ObjectPart("torso_lift_link", scene.robot)
    real_part = part.pose
    with SimulatedTaskTree():
        copy = current_world.get()
        assert copy is not None
        copied_milk = copy.object("milk")
        assert in_world(milk) is in_world(scene.milk) is copied_milk
        copied_milk.set_pose(Pose([5, 5, 5]))
        assert milk.pose == designator_of(scene.milk).pose == Pose([5, 5, 5])
        assert milk.frozen_copy().pose == Pose([5, 5, 5])
        copy.object("pr2").set_pose(Pose([7, 0, 0]))
        assert part.pose.position.x == pytest.approx(real_part.position.x + 7, abs=1e-6)
        inside = ObjectDesignatorDescription(names=["milk"]).resolve()
        assert inside.world_object is copied_milk
    assert milk.pose == Pose([1.3, 1, 0.9])
    assert part.pose == real_part
    assert inside.pose == Pose([1.3, 1, 0.9])
    assert in_world(inside) is in_world(copied_milk) is scene.milk


async def test_a_world_object_as_an_argument_refers_to_the_copy_too(scene: Scene) -> None:
    """MoveAndPickUp faces it, picks it up and holds it: all in the copy, though the plan names the real object."""
    with SimulatedTaskTree() as tree:
        copy = current_world.get()
        assert copy is not None
        copy.object("cereal").set_pose(Pose([1.3, 0.75, 0.95]))
        await MoveTorsoActionPerformable(0.3).perform()
        await MoveAndPickUpPerformable(AT_THE_CEREAL, scene.cereal, Arms.RIGHT, Grasp.FRONT).perform()
        assert copy.object("cereal").attached_to is copy.object("pr2")
        faced = next(node.designator for node in tree if type(node.designator).__name__ == "FaceAtPerformable")
        assert faced.pose == Pose([1.3, 0.75, 0.95])  # type: ignore[union-attr]
    assert scene.cereal.attached_to is None
    assert scene.robot.pose == Pose()


async def test_locations_are_resolved_in_the_copy_to_plain_poses(scene: Scene) -> None:
    """The milk is moved in the simulation, and the base poses are beside its simulated pose."""
    with SimulatedTaskTree():
        in_world(scene.milk).set_pose(Pose([1.3, -0.5, 0.9]))
        await MoveTorsoActionPerformable(0.3).perform()
        stand = CostmapLocation(scene.milk, reachable_for=scene.robot).resolve()
    assert stand.pose.distance(Pose([1.3, -0.5, 0])) < 1.0
    await NavigateActionPerformable(stand.pose).perform()
    assert scene.robot.pose == stand.pose


async def test_an_object_is_not_located_relative_to_itself_in_a_copy_either(scene: Scene) -> None:
    located = LocatedObjectDescription([scene.milk], types=[ObjectType.MILK, ObjectType.BREAKFAST_CEREAL])
    with SimulatedTaskTree():
        assert [each.name for each in located] == ["cereal"]


async def test_an_object_that_is_only_in_the_copy_is_not_in_the_real_world(scene: Scene) -> None:
    with SimulatedTaskTree():
        spoon = designator_of(Object("spoon", ObjectType.SPOON, pose=Pose([1, 1, 1])))
        assert in_world(spoon).pose == spoon.pose == Pose([1, 1, 1])
        in_world(scene.milk).remove()
        with pytest.raises(PerceptionObjectNotInWorld, match="milk is not an object of the world"):
            in_world(scene.milk)
    with pytest.raises(PerceptionObjectNotInWorld, match="spoon is not an object of the world"):
        in_world(spoon)
    with pytest.raises(PerceptionObjectNotInWorld):
        await PickUpActionPerformable(spoon, Arms.LEFT, Grasp.FRONT).perform()
    assert spoon.pose == Pose([1, 1, 1])  # the last known pose
    assert in_world(scene.milk) is scene.milk


async def test_an_object_removed_before_or_during_a_simulation_is_not_in_the_world(scene: Scene) -> None:
    milk, cereal = designator_of(scene.milk), designator_of(scene.cereal)
    scene.milk.remove()
    with SimulatedTaskTree():
        with pytest.raises(PerceptionObjectNotInWorld):
            in_world(milk)
        inside = ObjectDesignatorDescription(names=["cereal"]).resolve()
        scene.cereal.remove()
        assert in_world(cereal) is inside.world_object
    with pytest.raises(PerceptionObjectNotInWorld):
        in_world(inside)


async def test_an_object_of_another_world_is_not_touched(scene: Scene) -> None:
    with BulletWorld():
        spoon = Object("milk", ObjectType.MILK, pose=Pose([9, 9, 9]))
        assert in_world(scene.milk) is scene.milk
    with SimulatedTaskTree():
        assert designator_of(spoon).pose == Pose([9, 9, 9])


async def test_a_designator_resolved_in_one_simulation_refers_to_the_copy_in_the_next(scene: Scene) -> None:
    with SimulatedTaskTree():
        resolved = ObjectDesignatorDescription(names=["milk"]).resolve()
        in_world(resolved).set_pose(Pose([9, 9, 9]))
    with SimulatedTaskTree():
        assert resolved.pose == Pose([1.3, 1, 0.9])
        assert in_world(resolved).world is current_world.get()
