"""The names of objects in plans: searched in the world, live, frozen, parts, believed."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import pytest

from pycrorm_async.plan import (
    BelieveObject,
    LocatedObject,
    LocatedObjectDescription,
    ObjectDesignator,
    ObjectDesignatorDescription,
    ObjectPart,
    ResolutionError,
)
from pycrorm_async.plan.failures import ObjectNotFound, PerceptionObjectNotInWorld
from pycrorm_async.plan.objects import designator_of, in_world
from pycrorm_async.world import ObjectType, Pose
from pycrorm_async.world.pose import NoWorld, UnknownLink, yaw_quaternion
from tests.plan.conftest import Scene


def names(description: ObjectDesignatorDescription) -> list[str]:
    return [each.name for each in description]


def test_a_description_matches_by_name_by_type_and_by_both(scene: Scene) -> None:
    both = [ObjectType.MILK, ObjectType.BREAKFAST_CEREAL]
    assert names(ObjectDesignatorDescription()) == ["pr2", "kitchen", "milk", "cereal"]
    assert names(ObjectDesignatorDescription(names=["cereal", "spoon", "milk", "cereal"])) == ["cereal", "milk"]
    assert names(ObjectDesignatorDescription(types=both[::-1])) == ["milk", "cereal"]
    assert names(ObjectDesignatorDescription(names=["pr2", "cereal"], types=both)) == ["cereal"]
    assert names(ObjectDesignatorDescription(names=[])) == []
    designator = ObjectDesignatorDescription(names=["milk"]).resolve()
    assert (designator.name, designator.object_type, designator.world_object) == ("milk", ObjectType.MILK, scene.milk)


def test_a_description_without_a_match_lists_the_objects_of_the_world(scene: Scene) -> None:
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


def test_a_believed_object_is_at_its_believed_pose() -> None:
    cup = BelieveObject("cup", ObjectType.JEROEN_CUP, Pose([1, 2, 3]))
    assert (cup.pose, cup.world_object, cup.frozen_copy()) == (Pose([1, 2, 3]), None, cup)
    assert cup != ObjectDesignator("cup", ObjectType.JEROEN_CUP, None, Pose([1, 2, 3]))


def test_a_designator_needs_an_object_or_a_belief() -> None:
    with pytest.raises(ResolutionError, match="world_object or frozen_pose"):
        ObjectDesignator("cup", ObjectType.JEROEN_CUP)


def test_a_designator_resolves_to_the_world_object_or_is_a_failure(scene: Scene) -> None:
    milk = designator_of(scene.milk)
    assert (designator_of(milk), in_world(milk), in_world(scene.milk)) == (milk, scene.milk, scene.milk)
    scene.world.remove(scene.milk)
    for gone in (milk, scene.milk, milk.frozen_copy(), ObjectPart("sink_area", scene.kitchen)):
        with pytest.raises(PerceptionObjectNotInWorld, match=gone.name):
            in_world(gone)


NOON = datetime(2024, 7, 30, 14, 0, 0, 123456, timezone(timedelta(hours=2)))


def test_a_located_object_is_at_its_pose_relative_to_the_reference_and_moves_with_it(scene: Scene) -> None:
    cup = LocatedObject("cup", ObjectType.JEROEN_CUP, Pose([0, 0.2, 0.1]), scene.milk, NOON)
    assert (cup.name, cup.object_type, cup.timestamp) == ("cup", ObjectType.JEROEN_CUP, NOON)
    assert (cup.reference, cup.relative_pose) == (designator_of(scene.milk), Pose([0, 0.2, 0.1]))
    assert cup.pose == Pose([1.3, 1.2, 1.0])
    # 2024-07-30 12:00:00.123456 UTC, by `date -d`
    assert cup.pose.time_ns == 1_722_340_800_123_456_000
    before = cup.frozen_copy()
    scene.milk.set_pose(Pose([1, 0, 0.5], yaw_quaternion(math.pi / 2)))
    assert cup.pose.position == pytest.approx((0.8, 0, 0.6))
    assert cup.pose.yaw == pytest.approx(math.pi / 2)
    assert (before.pose, before.pose.time_ns) == (Pose([1.3, 1.2, 1.0]), 1_722_340_800_123_456_000)
    assert isinstance(before, LocatedObject)
    assert (before.reference.pose, before.relative_pose, before.timestamp) == (
        Pose([1.3, 1, 0.9]),
        cup.relative_pose,
        NOON,
    )


def test_a_location_may_be_relative_to_a_part_or_to_another_location(scene: Scene) -> None:
    island = ObjectPart("kitchen_island_surface", scene.kitchen)
    plate = LocatedObject("plate", ObjectType.GENERIC_OBJECT, Pose([0.1, 0, 0]), island)
    spoon = LocatedObject("spoon", ObjectType.SPOON, Pose([0, -0.3, 0]), plate)
    assert plate.pose.position == pytest.approx((-1.35, 1.0, 0.9))
    assert spoon.pose.position == pytest.approx((-1.35, 0.7, 0.9))


def test_the_time_of_a_location_is_now_or_has_a_time_zone(scene: Scene) -> None:
    before = datetime.now(UTC)
    cup = LocatedObject("cup", ObjectType.JEROEN_CUP, Pose(), scene.milk)
    assert before - timedelta(microseconds=1) <= cup.timestamp <= datetime.now(UTC)
    with pytest.raises(ResolutionError, match=r"LocatedObject cannot be built; wrong: timestamp: .* time zone"):
        LocatedObject("cup", ObjectType.JEROEN_CUP, Pose(), scene.milk, datetime(2024, 7, 30))  # noqa: DTZ001


def test_objects_are_located_relative_to_each_of_the_others(scene: Scene) -> None:
    scene.cereal.set_pose(Pose([1.3, 0.7, 0.95], yaw_quaternion(math.pi / 2)))
    food = [ObjectType.MILK, ObjectType.BREAKFAST_CEREAL]
    designator = list(LocatedObjectDescription([scene.cereal, scene.kitchen], types=food))
    assert [(each.name, each.reference.name) for each in designator] == [
        ("milk", "cereal"),
        ("milk", "kitchen"),
        ("cereal", "kitchen"),
    ]
    # The milk is 0.3 m along map's y from the cereal, whose x points along y: straight ahead of it.
    assert designator[0].relative_pose.position == pytest.approx((0.3, 0, -0.05))
    for each in designator:
        assert each.pose.position == pytest.approx(in_world(each).pose.position)
    assert in_world(designator[0]) is scene.milk
    milk = LocatedObjectDescription([scene.cereal], names=["milk"]).resolve()
    assert (milk.name, milk.reference.name) == ("milk", "cereal")
    with pytest.raises(ObjectNotFound, match="no object is named milk, beside milk; in the world: pr2, kitchen"):
        LocatedObjectDescription([scene.milk], names=["milk"]).resolve()


def test_one_name_or_type_needs_no_list_and_a_name_is_not_split(scene: Scene) -> None:
    assert names(ObjectDesignatorDescription(names="milk")) == ["milk"]
    assert names(ObjectDesignatorDescription(types=ObjectType.MILK)) == ["milk"]
    assert names(LocatedObjectDescription([scene.kitchen], names="milk", types=ObjectType.MILK)) == ["milk"]


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (ObjectDesignatorDescription, lambda _: ([ObjectType.MILK],), "names: expected each str, got <ObjectType.MILK"),
        (ObjectDesignatorDescription, lambda _: (None, ["milk"]), "types: expected each ObjectType, got 'milk'"),
        (ObjectDesignatorDescription, lambda _: (None, 3), "types: expected each ObjectType, got 3"),
        (ObjectPart, lambda _: ("sink_area", "kitchen"), "expected an object or its designator, got 'kitchen'"),
        (LocatedObject, lambda _: ("milk", ObjectType.MILK, Pose(), None), "its designator, got None"),
        (ObjectPart, lambda s: (3, s.kitchen), "ObjectPart cannot be built; wrong: name: expected str, got 3"),
        (BelieveObject, lambda _: ("cup", "CUP", Pose()), "object_type: expected ObjectType, got 'CUP'"),
        (BelieveObject, lambda _: ("cup", ObjectType.JEROEN_CUP, [1, 0]), "frozen_pose: expected Pose, got [1, 0]"),
        (
            LocatedObject,
            lambda s: ("milk", ObjectType.MILK, [0, 0, 0], s.cereal, "now"),
            "relative_pose: expected Pose, got [0, 0, 0]; timestamp: expected datetime, got 'now'",
        ),
    ],
)
def test_an_invalid_object_name_type_or_location_is_refused_by_name(
    scene: Scene, kind: Any, arguments: Callable[[Scene], tuple[object, ...]], message: str
) -> None:
    with pytest.raises(ResolutionError, match=re.escape(message)):
        kind(*arguments(scene))
