"""How plans name objects: found in the world, live, frozen, parts, believed."""

from __future__ import annotations

import dataclasses

import pytest

from pycrorm_async.plan import (
    BelieveObject,
    ObjectDesignator,
    ObjectDesignatorDescription,
    ObjectPart,
    ResolutionError,
)
from pycrorm_async.plan.failures import ObjectNotFound, PerceptionObjectNotInWorld
from pycrorm_async.plan.objects import designator_of, in_world
from pycrorm_async.world import ObjectType, Pose
from pycrorm_async.world.errors import NoWorld, UnknownLink
from tests.plan.conftest import Scene


def names(description: ObjectDesignatorDescription) -> list[str]:
    return [each.name for each in description]


def test_a_description_finds_by_name_by_type_and_by_both(scene: Scene) -> None:
    both = [ObjectType.MILK, ObjectType.BREAKFAST_CEREAL]
    assert names(ObjectDesignatorDescription()) == ["pr2", "kitchen", "milk", "cereal"]
    assert names(ObjectDesignatorDescription(names=["cereal", "spoon", "milk", "cereal"])) == ["cereal", "milk"]
    assert names(ObjectDesignatorDescription(types=both[::-1])) == ["milk", "cereal"]
    assert names(ObjectDesignatorDescription(names=["pr2", "cereal"], types=both)) == ["cereal"]
    assert names(ObjectDesignatorDescription(names=[])) == []
    found = ObjectDesignatorDescription(names=["milk"]).resolve()
    assert (found.name, found.object_type, found.world_object) == ("milk", ObjectType.MILK, scene.milk)


def test_a_description_that_nothing_fits_says_what_there_is(scene: Scene) -> None:
    with pytest.raises(ObjectNotFound) as caught:
        ObjectDesignatorDescription(names=["bowl", "cup"], types=[ObjectType.BOWL]).resolve()
    assert str(caught.value) == (
        "no object is named bowl or cup and of type BOWL; in the world: pr2, kitchen, milk, cereal"
    )
    assert caught.value.data == (("bowl", "cup"), ("BOWL",))


def test_a_description_needs_a_world() -> None:
    with pytest.raises(NoWorld):
        ObjectDesignatorDescription(names=["milk"]).resolve()


def test_a_designator_is_live_and_its_copy_is_frozen(scene: Scene) -> None:
    milk = ObjectDesignatorDescription(names=["milk"]).resolve()
    before = milk.frozen_copy()
    scene.milk.set_pose(Pose([0, 0, 2]))
    assert (milk.pose, before.pose) == (Pose([0, 0, 2]), Pose([1.3, 1, 0.9]))
    assert (before.name, before.object_type, before.world_object) == ("milk", ObjectType.MILK, None)
    with pytest.raises(dataclasses.FrozenInstanceError):
        milk.name = "oat"  # type: ignore[misc]  # the fault this test is about


def test_a_part_has_the_pose_of_its_link(scene: Scene) -> None:
    island = ObjectPart("kitchen_island_surface", scene.kitchen)
    assert island.pose == scene.kitchen.link_pose("kitchen_island_surface")
    assert (island.name, island.part_of, island.world_object) == (
        "kitchen_island_surface",
        designator_of(scene.kitchen),
        None,
    )
    before = island.frozen_copy()
    assert isinstance(before, ObjectPart)
    scene.kitchen.set_pose(Pose([1, 0, 0]))
    assert island.pose.position.x == pytest.approx(before.pose.position.x + 1)
    with pytest.raises(UnknownLink):
        _ = ObjectPart("oven", scene.kitchen).pose
    assert ObjectPart("a", scene.kitchen) != ObjectPart("a", scene.milk)


def test_a_believed_object_is_where_it_is_believed_to_be() -> None:
    cup = BelieveObject("cup", ObjectType.JEROEN_CUP, Pose([1, 2, 3]))
    assert (cup.pose, cup.world_object, cup.frozen_copy()) == (Pose([1, 2, 3]), None, cup)
    assert cup != ObjectDesignator("cup", ObjectType.JEROEN_CUP, None, Pose([1, 2, 3]))


def test_a_designator_needs_something_to_stand_for() -> None:
    with pytest.raises(ResolutionError, match="world_object or frozen_pose"):
        ObjectDesignator("cup", ObjectType.JEROEN_CUP)


def test_what_is_meant_is_found_in_the_world_or_is_a_failure(scene: Scene) -> None:
    milk = designator_of(scene.milk)
    assert (designator_of(milk), in_world(milk), in_world(scene.milk)) == (milk, scene.milk, scene.milk)
    scene.world.remove(scene.milk)
    for gone in (milk, scene.milk, milk.frozen_copy(), ObjectPart("sink_area", scene.kitchen)):
        with pytest.raises(PerceptionObjectNotInWorld, match=gone.name):
            in_world(gone)
