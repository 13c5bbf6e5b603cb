"""Actions that look for an object, and that bring one from where it is to where it shall be.

>>> milk = await DetectActionPerformable(BelieveObject("milk", ObjectType.MILK, Pose([1.3, 1, 0.9]))).perform()
>>> await TransportActionPerformable(milk, Arms.LEFT, Pose([1.3, 0.6, 0.95])).perform()
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pycrorm_async.plan.actions.basic import (
    CheckedAction,
    NavigateActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
)
from pycrorm_async.plan.current_robot import require_robot
from pycrorm_async.plan.failures import ObjectUnfetchable, ObjectUnreachable
from pycrorm_async.plan.geometry.gripper_checks import check_takable
from pycrorm_async.plan.language.resources import Resource, reaching
from pycrorm_async.plan.locations.designators import CostmapLocation
from pycrorm_async.plan.motions.motions import DetectingMotion
from pycrorm_async.plan.object_designators import ObjectDesignator, in_world
from pycrorm_async.world.enums import Arms, Grasp
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose

__all__ = ["DetectActionPerformable", "TransportActionPerformable"]


@dataclass
class DetectActionPerformable(CheckedAction):
    """Look for an object of this one's type, which may be one that is only believed; returns the best seen.

    The head does not turn. Raises `PerceptionObjectNotFound`, which says why nothing is seen.
    """

    concept: ClassVar[str | None] = "LookingFor"

    object_designator: ObjectDesignator | Object

    def resources(self) -> frozenset[Resource]:
        return frozenset({Resource.HEAD})

    async def perform(self) -> ObjectDesignator:
        return await DetectingMotion(self.object_designator.object_type).perform()


@dataclass
class TransportActionPerformable(CheckedAction):
    """Fetch an object with one arm, from the front, and put it down at `target_location`; arms are parked meanwhile.

    Places to stand are looked for on the way (`CostmapLocation`), with the torso as it is. What the arm holds
    already is only brought.

    Raises:
        ObjectUnfetchable: there is no place to stand and pick it up.
        ReachabilityFailure: there is none to put it down from; the arm holds it then.
        EndEffectorFailure: the arm holds something else.
        PerceptionObjectNotInWorld: there is no such object.
        IllPosedGoalFailure, CapabilityAbsenceFailure: not one arm, or nothing that can be held; no such arm.
    """

    concept: ClassVar[str | None] = "Transporting"

    object_designator: ObjectDesignator | Object
    arm: Arms
    target_location: Pose

    def resources(self) -> frozenset[Resource]:
        return reaching(Arms.BOTH)

    async def perform(self) -> None:
        robot = require_robot()
        tool_frame = robot.one_arm(self.arm).tool_frame
        wanted = in_world(self.object_designator)
        check_takable(robot, self.arm, wanted)
        await self._park_arms()
        if robot.body.attachments.get(wanted) != tool_frame:
            await NavigateActionPerformable(self._stand_to_fetch(robot.body)).perform()
            await PickUpActionPerformable(self.object_designator, self.arm, Grasp.FRONT).perform()
            await self._park_arms()
        there = CostmapLocation(self.target_location, reachable_for=robot.body, reachable_arm=self.arm).resolve()
        await NavigateActionPerformable(there.pose).perform()
        await PlaceActionPerformable(self.object_designator, self.arm, self.target_location).perform()
        await self._park_arms()

    async def _park_arms(self) -> None:
        arms = require_robot().description.arms
        await ParkArmsActionPerformable(Arms.BOTH if len(arms) > 1 else self.arm).perform()

    def _stand_to_fetch(self, body: Object) -> Pose:
        try:
            return CostmapLocation(self.object_designator, reachable_for=body, reachable_arm=self.arm).resolve().pose
        except ObjectUnreachable as unreachable:
            raise ObjectUnfetchable(unreachable.message, *unreachable.data) from unreachable
