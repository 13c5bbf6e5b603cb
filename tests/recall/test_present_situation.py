"""The present situation of an object has the features that the case of an action has which starts now."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.plan import ActionAbstract, PickUpAction, PlanFailure, simulated_robot
from pycrorm_async.plan.objects import ObjectDesignator, ObjectDesignatorDescription
from pycrorm_async.recall.recall import present_situation
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose

pytestmark = pytest.mark.slow


@dataclass
class InspectActionPerformable(ActionAbstract):
    """Fails where the object is far."""

    item: ObjectDesignator
    slowly: bool = True

    async def perform(self) -> None:
        if self.item.pose.position.x > 1.5:
            raise PlanFailure("it is too far")


async def inspect(milk: Object) -> None:
    designator = ObjectDesignatorDescription(names=[milk.name]).resolve()
    try:
        await InspectActionPerformable(designator).perform()
    except PlanFailure:
        return


async def test_the_present_has_the_features_of_the_case_that_starts_now() -> None:
    async with Memory.open("sqlite://") as memory:
        with BulletWorld(), simulated_robot:
            robot = Object("pr2", ObjectType.ROBOT, pose=Pose([0.2, 0.1, 0], [0, 0, 0.6, 0.8]))
            milk = Object("milk", ObjectType.MILK, pose=Pose([1, 0.5, 0.9]))
            Object("bowl", ObjectType.BOWL, pose=Pose([1.1, 0.4, 0.9]))
            spoon = Object("spoon", ObjectType.SPOON, pose=Pose([0.5, 0.1, 0.9]))
            robot.attach(spoon, "l_gripper_tool_frame")
            async with memory.episode():
                symbols, numbers = present_situation(milk, InspectActionPerformable)
                await inspect(milk)
                [found] = await memory.recall(InspectActionPerformable)
                assert {**symbols, "slowly": "True"} == found.symbols
                assert symbols["near"] == ("BOWL",)
                assert symbols["held"] == ("SPOON",)
                assert numbers == pytest.approx(dict(found.numbers), abs=1e-6)
                assert {"stand_x", "stand_yaw", "object_z", "torso"} <= numbers.keys()

                assert (
                    present_situation(milk, PickUpAction)
                    == present_situation(milk, "PickUpAction")
                    == (symbols, numbers)
                )

                milk.set_pose(Pose([2.0, 0.5, 0.9]))
                await inspect(milk)
                await inspect(milk)
                answer = await memory.recall.similar_to_now(milk, InspectActionPerformable)
                assert [each.status for each in answer] == ["FAILED", "FAILED", "SUCCEEDED"]
                assert answer[0].score > answer[2].score
                assert "object_name" not in dict(answer.cue.has)
                slow = await memory.recall.similar_to_now(milk, InspectActionPerformable, has={"slowly": False}, k=1)
                assert slow.never_seen == (("slowly", "False"),)
                assert len(slow) == 1
            milk.remove()
            with pytest.raises(CallerError, match="is not an object in a world"):
                await memory.recall.similar_to_now(milk, InspectActionPerformable)
            with pytest.raises(CallerError, match="is not a designator class"):
                await memory.recall.similar_to_now(robot, int)
