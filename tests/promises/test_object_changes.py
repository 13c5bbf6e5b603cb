"""Every change of every object is in the memory: its kind, its time, the new state, and the node that caused it."""

from __future__ import annotations

import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Reading
from pycrorm_async.plan import (
    ActionAbstract,
    NavigateActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
)
from pycrorm_async.world import Arms, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from tests.promises.chronicle import Chronicle, assert_same, read_from_memory
from tests.promises.lab import WITHIN_REACH, Lab, lab, recorded, url_of

pytestmark = pytest.mark.slow

ARM = "l_gripper_tool_frame"


@dataclass
class RearrangingActionPerformable(ActionAbstract):
    """Change the world directly, as a simulation of persons or of processes does."""

    _change: Any

    async def perform(self) -> None:
        self._change()


async def test_every_change_by_a_plan_is_recorded_with_its_cause(tmp_path: Path) -> None:
    async with recorded(tmp_path) as memory:
        chronicle = Chronicle()
        with lab(chronicle) as scene:
            spoon = Object("spoon", ObjectType.SPOON, pose=Pose([1.3, 1, 1.05]))
            scene.cereal.set_pose(Pose([1.4, 0.5, 0.95], yaw_quaternion(0.3)))
            await NavigateActionPerformable(WITHIN_REACH).perform()
            scene.milk.attach(spoon)
            await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
            await NavigateActionPerformable(Pose([0.5, 0.8, 0], yaw_quaternion(0.2))).perform()
            await PlaceActionPerformable(scene.milk, Arms.LEFT, Pose([1.2, 1.0, 0.9])).perform()
            await RearrangingActionPerformable(lambda: scene.milk.set_pose(Pose([3, 3, 0]))).perform()
            await RearrangingActionPerformable(spoon.remove).perform()
            chronicle.assert_no_unreported_change(scene.world)
        await memory.flush()
        assert [each for each in chronicle.short() if each[0] != "added"] == [
            ("moved", "cereal", None),
            ("moved", "pr2", "MoveMotion"),
            ("attached", "milk", None),
            ("joints", "pr2", "MoveTCPMotion"),
            ("joints", "pr2", "MoveGripperMotion"),
            ("joints", "pr2", "MoveTCPMotion"),
            ("joints", "pr2", "MoveGripperMotion"),
            ("attached", "pr2", "PickUpAction"),
            ("joints", "pr2", "MoveTCPMotion"),
            ("moved", "milk", "MoveTCPMotion"),
            ("moved", "spoon", "MoveTCPMotion"),
            ("moved", "pr2", "MoveMotion"),
            ("moved", "milk", "MoveMotion"),
            ("moved", "spoon", "MoveMotion"),
            ("joints", "pr2", "MoveTCPMotion"),
            ("moved", "milk", "MoveTCPMotion"),
            ("moved", "spoon", "MoveTCPMotion"),
            ("joints", "pr2", "MoveGripperMotion"),
            ("detached", "pr2", "PlaceAction"),
            ("joints", "pr2", "MoveTCPMotion"),
            ("moved", "milk", "RearrangingAction"),
            ("moved", "spoon", "RearrangingAction"),
            ("detached", "milk", "RearrangingAction"),
            ("removed", "spoon", "RearrangingAction"),
        ]
        in_memory = await read_from_memory(memory)
        assert_same(in_memory[: len(chronicle.entries)], chronicle.entries)
        # The world was left inside the episode: then it is empty, and no node caused that.
        assert [(each.what, each.cause) for each in in_memory[len(chronicle.entries) :]] == [
            (("removed", name, chronicle.known_pose(name)), None) for name in ("pr2", "milk", "cereal")
        ]


class RandomChanger:
    """Apply every operation to the objects of a world, at random."""

    def __init__(self, scene: Lab, seed: int) -> None:
        self.rng = random.Random(seed)
        self.world = scene.world
        self.made = 0
        self.state = scene.world.save_state()

    def change(self) -> None:
        choices = [self.move, self.move, self.turn, self.attach, self.detach, self.add, self.remove]
        self.rng.choice([*choices, self.reset, self.save, self.restore])()

    def any_change(self) -> Object:
        return self.rng.choice(self.world.objects)

    def move(self) -> None:
        place = [self.rng.uniform(-3, 3) for _ in range(3)]
        self.any_change().set_pose(Pose(place, [self.rng.gauss(0, 1) for _ in range(4)]))

    def turn(self) -> None:
        robot = self.world.object("pr2")
        joints = self.rng.sample(["torso_lift_joint", "l_shoulder_pan_joint", "r_wrist_roll_joint"], 2)
        robot.set_joint_positions({joint: self.rng.uniform(0, 0.3) for joint in joints})

    def attach(self) -> None:
        parent, child = self.any_change(), self.any_change()
        above: Object | None = parent
        while above is not None and above is not child:
            above = above.attached_to
        if above is None and child.attached_to is None:
            parent.attach(child, self.rng.choice([None, ARM]) if parent.name == "pr2" else None)

    def detach(self) -> None:
        held = list(self.world.attachments)
        if held:
            each = self.rng.choice(held)
            each.parent.detach(each.child)

    def add(self) -> None:
        self.made += 1
        Object(f"bowl {self.made}", ObjectType.BOWL, pose=Pose([self.made, 0, 0]), world=self.world)

    def remove(self) -> None:
        world_object = self.any_change()
        if world_object.object_type is ObjectType.BOWL:
            world_object.remove()

    def reset(self) -> None:
        self.world.reset()

    def save(self) -> None:
        self.state = self.world.save_state()

    def restore(self) -> None:
        names = {world_object.name for world_object in self.world.objects}
        if set(self.state.objects) <= names:
            self.world.restore_state(self.state)


async def test_every_operation_on_a_world_is_recorded(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        chronicle = Chronicle()
        with lab(chronicle) as scene:
            meddler = RandomChanger(scene, 0)
            for index in range(300):
                if index % 3:
                    await RearrangingActionPerformable(meddler.change).perform()
                else:
                    meddler.change()
                chronicle.assert_no_unreported_change(scene.world)
    async with Reading.open(url_of(tmp_path)) as reading:
        in_memory = await read_from_memory(reading)
    assert_same(in_memory[: len(chronicle.entries)], chronicle.entries)
    kinds = {each.what[0] for each in chronicle.entries}
    assert kinds == {"added", "moved", "joints", "attached", "detached", "removed"}
    assert {each.cause for each in chronicle.entries} == {None, "RearrangingAction"}
    assert len(chronicle.entries) > 250
