"""Designators, locations and attachments refer to objects of the copy in a simulation, and to real ones outside."""

from __future__ import annotations

import pytest

from pycrorm_async.plan import (
    CostmapLocation,
    LocatedObjectDescription,
    MoveAndPickUpPerformable,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectDesignator,
    ObjectDesignatorDescription,
    ObjectPart,
    PickUpActionPerformable,
    PlaceActionPerformable,
    SimulatedTaskTree,
)
from pycrorm_async.plan.failures import PerceptionObjectNotInWorld
from pycrorm_async.plan.objects import designator_of, in_world
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose, current_world
from pycrorm_async.world.pose import yaw_quaternion
from tests.plan.conftest import Scene

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


async def test_a_held_object_is_held_in_the_copy(scene: Scene) -> None:
    await MoveTorsoActionPerformable(0.3).perform()
    await NavigateActionPerformable(AT_THE_CEREAL).perform()
    await PickUpActionPerformable(scene.cereal, Arms.RIGHT, Grasp.FRONT).perform()
    held_at = scene.cereal.pose
    with SimulatedTaskTree():
        await NavigateActionPerformable(AT_THE_CEREAL).perform()
        target = Pose([1.3, 0.6, 0.95])
        await PlaceActionPerformable(scene.cereal, Arms.RIGHT, target).perform()
        assert designator_of(scene.cereal).pose.distance(target) < 0.01
        assert in_world(scene.cereal).attached_to is None
    assert scene.cereal.attached_to is scene.robot
    assert scene.cereal.pose == held_at


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


def test_a_frozen_copy_taken_in_a_simulation_keeps_the_simulated_pose() -> None:
    with BulletWorld():
        milk: ObjectDesignator = designator_of(Object("milk", ObjectType.MILK))
        with SimulatedTaskTree():
            in_world(milk).set_pose(Pose([4, 0, 0]))
            frozen = milk.frozen_copy()
        assert frozen.pose == Pose([4, 0, 0])
        assert milk.pose == Pose()
