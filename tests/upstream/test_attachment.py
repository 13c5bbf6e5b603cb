"""PyCRAM's tests of attachments (July 2024), by name. A child refers to its parent here, without inverse attachment."""

from __future__ import annotations

from pycrorm_async.world import Pose
from pycrorm_async.world.world_copy import copied, counterpart
from tests.plan.conftest import Scene


def test_attach(scene: Scene) -> None:
    scene.milk.attach(scene.cereal)
    assert scene.milk.attachments == {scene.cereal: None}
    assert scene.cereal.attached_to is scene.milk


def test_detach(scene: Scene) -> None:
    scene.milk.attach(scene.cereal)
    scene.milk.detach(scene.cereal)
    assert scene.milk.attachments == {}
    assert scene.cereal.attached_to is None


def test_attachment_behavior(scene: Scene) -> None:
    scene.robot.attach(scene.milk)
    before = scene.milk.pose
    scene.robot.set_pose(Pose([1, 0, 0]))
    # the robot was at the origin
    assert scene.milk.pose.position == (before.position.x + 1, before.position.y, before.position.z)


def test_detachment_behavior(scene: Scene) -> None:
    scene.robot.attach(scene.milk)
    before = scene.milk.pose
    scene.robot.detach(scene.milk)
    scene.robot.set_pose(Pose([1, 0, 0]))
    assert scene.milk.pose == before


def test_prospection_object_attachments_not_changed_with_real_object(scene: Scene) -> None:
    with copied(scene.world) as copy:
        milk, cereal = counterpart(scene.milk, copy), counterpart(scene.cereal, copy)
        assert milk is not None
        assert cereal is not None
        scene.milk.attach(scene.cereal)
        assert (milk.attachments, cereal.attached_to) == ({}, None)
        milk.attach(cereal)
        scene.milk.detach(scene.cereal)
        assert milk.attachments == {cereal: None}
        assert scene.milk.attachments == {}
