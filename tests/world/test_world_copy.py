"""A copy equals its world, notifies no observer, and shares no later change with it."""

from __future__ import annotations

import numpy as np
import pytest

from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose, current_world, watcher
from pycrorm_async.world.pose import WorldClosed, yaw_quaternion
from pycrorm_async.world.world_copy import copied, counterpart, original, related
from tests.world.fakes import CRANE, ChangeLog, crane_links, matrix

TURNED = {"turning": 2.5, "lifting": 0.8, "reaching": 0.3}


class Doorman:
    """A watcher that notes the worlds that were entered and left."""

    def __init__(self) -> None:
        self.notes: list[tuple[str, BulletWorld]] = []

    def world_entered(self, world: BulletWorld) -> None:
        self.notes.append(("entered", world))

    def world_left(self, world: BulletWorld) -> None:
        self.notes.append(("left", world))


@pytest.fixture
def yard(world: BulletWorld) -> BulletWorld:
    """Return a crane with a load on its hook and a label on the load, and a milk that is attached to nothing."""
    crane = Object("crane", ObjectType.GENERIC_OBJECT, CRANE, Pose([1, 2, 0], yaw_quaternion(0.4)))
    load = Object("load", ObjectType.BOWL, pose=Pose([3, 3, 3]))
    label = Object("label", ObjectType.SPOON, pose=Pose([3, 3.1, 3]))
    Object("milk", ObjectType.MILK, pose=Pose([0, -1, 0.5]), color=(1.0, 0.0, 0.0, 0.5))
    Object("pr2", ObjectType.ROBOT, pose=Pose([9, 9, 0]))
    load.attach(label)
    crane.attach(load, "hook")
    crane.set_joint_positions(TURNED)
    crane.set_pose(Pose([1.5, 2, 0.1], yaw_quaternion(-0.7)))
    return world


def test_a_copy_has_everything_of_the_world(yard: BulletWorld) -> None:
    before = yard.save_state()
    with copied(yard) as copy:
        assert copy is not yard
        assert copy.engine is not yard.engine
        for thing, twin in zip(yard.objects, copy.objects, strict=True):
            assert twin is not thing
            assert (twin.name, twin.object_type, twin.world) == (thing.name, thing.object_type, copy)
            assert (twin.pose, twin.pose.time_ns) == (thing.pose, thing.pose.time_ns)
            assert twin.joint_positions() == thing.joint_positions()
            assert twin.original_pose == thing.original_pose
            assert twin.description_text == thing.description_text
            assert (twin.color, twin.robot_description) == (thing.color, thing.robot_description)
            # The same numbers went through the same arithmetic: Bullet agrees to the last bit.
            assert [twin.link_pose(link) for link in twin.links] == [thing.link_pose(link) for link in thing.links]
            assert twin.bounding_box() == thing.bounding_box()
        assert copy.save_state() == before
        names = [(each.parent.name, each.child.name, each.link, each.relative) for each in copy.attachments]
        assert names == [(each.parent.name, each.child.name, each.link, each.relative) for each in yard.attachments]
        assert all(each.parent.world is each.child.world is copy for each in copy.attachments)
    assert yard.save_state() == before


def test_an_attached_object_in_a_copy_moves_by_geometry_and_neither_world_moves_the_other(yard: BulletWorld) -> None:
    """The expected pose of the label: on the hook, by matrices from the crane's drawing."""
    change_log = ChangeLog()
    yard.observe(change_log)
    state = yard.save_state()
    with copied(yard) as copy:
        crane, label = copy.object("crane"), copy.object("label")
        hook = crane_links(crane.pose, **TURNED)["hook"]
        on_hook = np.linalg.inv(hook) @ matrix(label.pose)
        crane.set_joint_positions({"turning": -1.0, "reaching": 0.1})
        crane.set_pose(Pose([-2, 0, 1]))
        hook_frame = crane_links(Pose([-2, 0, 1]), turning=-1.0, lifting=0.8, reaching=0.1)["hook"] @ on_hook
        assert np.allclose(matrix(label.pose), hook_frame, atol=1e-6)
        copy.object("milk").remove()
        Object("spoon", ObjectType.SPOON)
        crane.detach_all()
    assert yard.save_state() == state
    assert [each.name for each in yard.objects] == ["crane", "load", "label", "milk", "pr2"]
    assert change_log.notes == []
    with copied(yard) as copy:
        yard.object("crane").set_joint_position("turning", 0.0)
        yard.object("milk").remove()
        assert copy.save_state() == state
        assert copy.robot is copy.object("pr2")


def test_making_a_copy_notifies_no_observer(yard: BulletWorld) -> None:
    change_log, doorman = ChangeLog(), Doorman()
    yard.observe(change_log)
    token = watcher.set(doorman)
    try:
        with copied(yard) as copy:
            assert copy.observers == ()
    finally:
        watcher.reset(token)
    assert (change_log.notes, doorman.notes) == ([], [])
    assert yard.observers == (change_log,)


def test_a_copy_is_the_current_world_inside_and_closed_afterwards_however_it_is_left(yard: BulletWorld) -> None:
    with pytest.raises(ZeroDivisionError), copied(yard) as copy:
        assert current_world.get() is copy
        _ = 1 / 0
    assert current_world.get() is yard
    assert not copy.entered
    with pytest.raises(WorldClosed):
        copy.object("milk").set_pose(Pose())
    assert yard.entered


def test_counterparts_are_resolved_from_every_copy_to_every_other(yard: BulletWorld) -> None:
    milk = yard.object("milk")
    with copied(yard) as first:
        with copied(first) as second:
            deep = second.object("milk")
            assert counterpart(milk, second) is deep
            assert counterpart(deep, first) is first.object("milk")
            assert counterpart(deep, yard) is milk
            assert (original(second), related(second, yard)) == (yard, True)
        with copied(yard) as other:
            assert counterpart(deep, other) is other.object("milk")
            assert counterpart(milk, yard) is milk


def test_an_object_that_is_only_in_one_world_has_no_counterpart(yard: BulletWorld) -> None:
    removed, milk = yard.object("label"), yard.object("milk")
    removed.remove()
    with copied(yard) as copy:
        only_here = Object("only here", ObjectType.BOWL)
        again = Object("label", ObjectType.SPOON)
        assert counterpart(only_here, yard) is None
        assert counterpart(removed, copy) is None
        assert counterpart(removed, yard) is None
        assert counterpart(again, yard) is None
        twin = copy.object("milk")
        twin.remove()
        assert counterpart(milk, copy) is None
        assert counterpart(twin, yard) is milk
    with BulletWorld() as stranger:
        assert counterpart(milk, stranger) is None
        assert not related(stranger, yard)


def test_a_world_that_was_left_cannot_be_copied() -> None:
    with BulletWorld() as world:
        pass
    with pytest.raises(WorldClosed), copied(world):
        pass
