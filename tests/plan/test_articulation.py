"""The joint that a handle moves, its range, and its path, computed from the kitchen's drawing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pycrorm_async.plan import ObjectDesignator, ObjectPart
from pycrorm_async.plan.failures import EnvironmentManipulationImpossible, PerceptionObjectNotInWorld
from pycrorm_async.plan.geometry import (
    Handle,
    closed_position,
    grasp_pose,
    hand_poses,
    handle_of,
    handle_poses,
    opened_position,
)
from pycrorm_async.world import Object, ObjectType, Pose
from pycrorm_async.world.pose import UnknownLink
from tests.plan.conftest import Scene
from tests.world.fakes import CRANE, Z, matrix, shifted, turned

DRAWER, FRIDGE = "sink_area_drawer_handle", "fridge_door_handle"


def test_a_handle_moves_with_the_nearest_joint_above_it(scene: Scene) -> None:
    assert handle_of(ObjectPart(DRAWER, scene.kitchen)) == Handle(scene.kitchen, DRAWER, "sink_area_drawer_joint")
    assert handle_of(ObjectPart(FRIDGE, scene.kitchen)) == Handle(scene.kitchen, FRIDGE, "fridge_door_joint")
    crane = Object("crane", ObjectType.GENERIC_OBJECT, CRANE)
    assert handle_of(ObjectPart("hook", crane)).joint == "reaching"
    assert handle_of(ObjectPart("flag", crane)).joint == "turning"


def test_opening_leaves_a_margin_and_never_closes(scene: Scene) -> None:
    drawer = handle_of(ObjectPart(DRAWER, scene.kitchen))
    assert opened_position(drawer) == pytest.approx(0.30)
    assert closed_position(drawer) == 0.0
    scene.kitchen.set_joint_position(drawer.joint, 0.33)
    assert opened_position(drawer) == 0.33
    door = handle_of(ObjectPart(FRIDGE, scene.kitchen))
    assert [opened_position(door), closed_position(door)] == pytest.approx([1.85, 0.0])


def test_a_drawers_handle_moves_straight_in_steps_of_five_centimetres(scene: Scene) -> None:
    drawer = handle_of(ObjectPart(DRAWER, scene.kitchen))
    way = handle_poses(drawer, 0.30)
    # The front is at x 1.05, the handle 5 cm before it, in the middle of z 0.57 to 0.76.
    expected = [(1.0 - 0.05 * number, 1.3, 0.665) for number in range(7)]
    np.testing.assert_allclose([each.position for each in way], expected, atol=1e-9)
    assert {each.orientation for each in way} == {(0.0, 0.0, 0.0, 1.0)}
    assert scene.kitchen.joint_position(drawer.joint) == 0.0


@pytest.mark.parametrize(("start", "goal", "steps"), [(0.0, 1.85, 19), (1.0, 0.0, 10), (0.3, 0.3, 1)])
def test_a_doors_handle_moves_around_the_hinge_and_rotates_with_the_door(
    scene: Scene, start: float, goal: float, steps: int
) -> None:
    scene.kitchen.set_pose(Pose([0.1, -0.2, 0.0], [0, 0, 0.6, 0.8]))
    door = handle_of(ObjectPart(FRIDGE, scene.kitchen))
    way = handle_poses(door, goal, start)
    assert len(way) == steps + 1
    for number, pose in enumerate(way):
        angle = start + (goal - start) * number / steps
        expected = matrix(scene.kitchen.pose) @ shifted(1.05, -1.25, 0) @ turned(Z, angle) @ shifted(-0.10, 0.59, 0.95)
        np.testing.assert_allclose(matrix(pose), expected, atol=1e-9)
    assert scene.kitchen.joint_position(door.joint) == 0.0


@pytest.mark.parametrize("angle", [0.0, 0.7, 1.85])
def test_a_hand_grasps_a_drawer_from_the_front_and_a_door_from_the_side_of_its_hinge(
    scene: Scene, angle: float
) -> None:
    scene.kitchen.set_pose(Pose([0.1, -0.2, 0.0], [0, 0, 0.6, 0.8]))
    scene.kitchen.set_joint_position("fridge_door_joint", angle)
    drawer = ObjectPart(DRAWER, scene.kitchen)
    assert grasp_pose(drawer) == drawer.pose
    hinge = matrix(scene.kitchen.pose) @ shifted(1.05, -1.25, 0)
    # in the closed door's axes x points into the fridge, y from the hinge to the handle
    taken = shifted(-0.10, 0.59, 0.95) @ turned(Z, math.pi / 2)
    np.testing.assert_allclose(
        matrix(grasp_pose(ObjectPart(FRIDGE, scene.kitchen))), hinge @ turned(Z, angle) @ taken, atol=1e-9
    )
    way = hand_poses(handle_of(ObjectPart(FRIDGE, scene.kitchen)), 1.0, 0.5)
    for number, pose in enumerate(way):
        np.testing.assert_allclose(matrix(pose), hinge @ turned(Z, 0.5 + 0.1 * number) @ taken, atol=1e-9)
    assert len(way) == 6


def test_a_door_with_its_hinge_on_the_other_side_is_grasped_from_there(scene: Scene) -> None:
    mirrored = scene.kitchen.description_text.replace('xyz="-0.1 0.59 0.95"', 'xyz="-0.1 -0.59 0.95"')
    cupboard = Object("cupboard", ObjectType.ENVIRONMENT, mirrored)
    expected = shifted(1.05, -1.25, 0) @ shifted(-0.10, -0.59, 0.95) @ turned(Z, -math.pi / 2)
    np.testing.assert_allclose(matrix(grasp_pose(ObjectPart(FRIDGE, cupboard))), expected, atol=1e-9)


def test_objects_and_parts_without_a_joint_are_grasped_at_their_pose(scene: Scene) -> None:
    scene.milk.set_pose(Pose([1.3, 1, 0.9], [0.1, 0.2, 0.3, 0.9]))
    assert grasp_pose(scene.milk) == scene.milk.pose
    tap = ObjectPart("sink_area_tap", scene.kitchen)
    assert grasp_pose(tap) == tap.pose
    scene.world.remove(scene.milk)
    with pytest.raises(PerceptionObjectNotInWorld, match="milk"):
        grasp_pose(scene.milk)


def test_an_object_that_cannot_be_opened_is_refused_in_one_line(scene: Scene) -> None:
    for part, message in (
        (ObjectPart("kitchen_counter_surface", scene.kitchen), "no joint of kitchen moves kitchen_counter_surface"),
        (scene.kitchen, "kitchen is not part of an object"),
        (ObjectDesignator("milk", ObjectType.MILK, scene.milk), "milk is not part of an object"),
    ):
        with pytest.raises(EnvironmentManipulationImpossible, match=message) as caught:
            handle_of(part)
        assert caught.value.data[0] == part.name
    with pytest.raises(UnknownLink, match=r"no link 'window'"):
        handle_of(ObjectPart("window", scene.kitchen))
    crane = Object("crane", ObjectType.GENERIC_OBJECT, CRANE)
    for position in (opened_position, closed_position):
        with pytest.raises(EnvironmentManipulationImpossible, match="turning has no limits"):
            position(handle_of(ObjectPart("flag", crane)))
    assert math.isinf(crane.joint_limits("turning")[1])
    scene.world.remove(scene.kitchen)
    with pytest.raises(PerceptionObjectNotInWorld, match="kitchen is not an object of the world"):
        handle_of(ObjectPart(DRAWER, scene.kitchen))
