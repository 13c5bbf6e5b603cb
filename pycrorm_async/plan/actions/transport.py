"""Actions that detect an object, and that transport one to a target pose.

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
from pycrorm_async.plan.geometry.grasp_poses import grasp_orientation
from pycrorm_async.plan.geometry.gripper_checks import check_fits, check_takable
from pycrorm_async.plan.language.resources import Resource, reaching
from pycrorm_async.plan.locations.designators import CostmapLocation
from pycrorm_async.plan.motions.motions import DetectingMotion
from pycrorm_async.plan.motions.robot_choice import collisions_count
from pycrorm_async.plan.object_designators import ObjectDesignator, in_world
from pycrorm_async.world.enums import Arms, Grasp
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.robots.robot_description import Drive

__all__ = ["DetectActionPerformable", "TransportActionPerformable"]


@dataclass
class DetectActionPerformable(CheckedAction):
    """Detect objects of the same type as the designated one and return the most visible one.

    The designated object may be a `BelieveObject`. The head does not move. Raises `PerceptionObjectNotFound`, which
    names the reason for each object.
    """

    concept: ClassVar[str | None] = "LookingFor"

    object_designator: ObjectDesignator | Object

    def resources(self) -> frozenset[Resource]:
        return frozenset({Resource.HEAD})

    async def perform(self) -> ObjectDesignator:
        return await DetectingMotion(self.object_designator.object_type).perform()


@dataclass
class TransportActionPerformable(CheckedAction):
    """Pick up an object from the front with one arm and place it at `target_location`; arms are parked while driving.

    The action searches its base poses itself (`CostmapLocation`), with the torso as it is. An object that the arm
    already holds is only delivered.

    Raises:
        ObjectUnfetchable: no base pose allows the pick-up.
        ReachabilityFailure: no base pose allows the placing; the arm keeps holding the object.
        EndEffectorFailure: the arm holds another object.
        PerceptionObjectNotInWorld: the object is not in the robot's world.
        IllPosedGoalFailure, CapabilityAbsenceFailure: `arm` is not a single arm, or a gripper cannot hold the object;
            the robot has no such arm, or collisions count and the object is wider than the gripper's opening.
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
        target = in_world(self.object_designator)
        check_takable(robot, self.arm, target)
        is_held = robot.body.attachments.get(target) == tool_frame
        if collisions_count() and not is_held:
            check_fits(robot, self.arm, target, grasp_orientation(target.pose, Grasp.FRONT))
        await self._park_arms()
        if not is_held:
            await self._drive(self._fetching_pose(robot.body))
            await PickUpActionPerformable(self.object_designator, self.arm, Grasp.FRONT).perform()
            await self._park_arms()
        place = CostmapLocation(self.target_location, reachable_for=robot.body, reachable_arm=self.arm).resolve()
        await self._drive(place.pose)
        await PlaceActionPerformable(self.object_designator, self.arm, self.target_location).perform()
        await self._park_arms()

    async def _park_arms(self) -> None:
        """Park every arm that has a park posture."""
        foldable = [arm for arm, each in require_robot().description.arms.items() if each.park]
        both = {Arms.LEFT, Arms.RIGHT}
        if both <= {*foldable}:
            foldable = [Arms.BOTH, *(arm for arm in foldable if arm not in both)]
        for arm in foldable:
            await ParkArmsActionPerformable(arm).perform()

    async def _drive(self, place: Pose) -> None:
        """Drive to a place; a robot with a fixed base is offered no other place than its own."""
        if require_robot().description.drive is not Drive.FIXED:
            await NavigateActionPerformable(place).perform()

    def _fetching_pose(self, body: Object) -> Pose:
        try:
            return CostmapLocation(self.object_designator, reachable_for=body, reachable_arm=self.arm).resolve().pose
        except ObjectUnreachable as unreachable:
            raise ObjectUnfetchable(unreachable.message, *unreachable.data) from unreachable
