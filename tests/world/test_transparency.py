"""Transparent objects do not affect visibility: the same rays hit the same in a world without them."""

from __future__ import annotations

from pycrorm_async.world import Arms, BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.kinematics import solve


def test_a_transparent_hand_in_front_of_an_object_does_not_hide_it(world: BulletWorld) -> None:
    """The rays pass a long way through the stretched arm and its load, and then into the counter."""
    Object("kitchen", ObjectType.ENVIRONMENT)
    cereal = Object("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.56, 1.022, 0.8]))
    eye = (0.65, 0.9455, 1.2573)
    without_hand = world.met_towards(cereal, eye)
    assert {None if each is None else each.name for each in without_hand} == {"cereal", "kitchen"}
    robot = Object("pr2", ObjectType.ROBOT, pose=Pose([0.6, 0.9, 0]))
    robot.set_joint_positions(solve(robot, Arms.LEFT, Pose([1.3, 1, 0.93])))
    milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.93]))
    assert world.met_towards(cereal, eye) != without_hand
    for _ in range(2):
        assert world.met_towards(cereal, eye, ignore={robot, milk}) == without_hand
    assert world.met_towards(cereal, eye, ignore={milk}) != without_hand
    world.remove(milk)
    assert world.met_towards(cereal, eye, ignore={robot, milk}) == without_hand


def test_an_object_is_opaque_again_after_the_query(world: BulletWorld) -> None:
    robot = Object("pr2", ObjectType.ROBOT, pose=Pose([1, 0, 0]))
    ray = ([(0.0, 0.0, 0.2)], [(2.0, 0.0, 0.2)])
    assert world.ray_test(*ray) == [robot]
    assert world.ray_test(*ray, ignore=[robot]) == [None]
    assert world.ray_test(*ray) == [robot]
