"""Actions of one hand on things that are there: hold and let go, grasp a handle, open and close with it.

>>> handle = ObjectPart("sink_area_drawer_handle", kitchen)
>>> await OpenActionPerformable(handle, Arms.LEFT).perform()
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pycrorm_async.plan.actions.basic import CheckedAction
from pycrorm_async.plan.current_robot import require_robot
from pycrorm_async.plan.failures import GripperClosedCompletely, IllPosedGoalFailure, ObjectLost
from pycrorm_async.plan.geometry.articulation import grasp_pose, handle_of
from pycrorm_async.plan.geometry.grasp_poses import HOLD_DISTANCE_M_MAX, approach, distance_to_box
from pycrorm_async.plan.geometry.gripper_checks import check_free, check_takable, take
from pycrorm_async.plan.language.resources import Resource, reaching
from pycrorm_async.plan.motions.motions import ClosingMotion, MoveGripperMotion, MoveTCPMotion, OpeningMotion
from pycrorm_async.plan.object_designators import ObjectDesignator, ObjectPart, in_world
from pycrorm_async.world.enums import Arms, GripperState
from pycrorm_async.world.objects import Object

__all__ = [
    "CloseActionPerformable",
    "GraspingActionPerformable",
    "GripActionPerformable",
    "OpenActionPerformable",
    "ReleaseActionPerformable",
]


@dataclass
class GripActionPerformable(CheckedAction):
    """Close the gripper on an object where it is, with `effort` (N); the object is attached to the gripper afterwards.

    The arm does not move. An object that hung on something else is taken over.

    Raises:
        GripperClosedCompletely: it would, for the tool frame is farther than `HOLD_DISTANCE_M_MAX` from the bounding
            boxes of all the object's links.
        EndEffectorFailure: the gripper holds something else.
        PerceptionObjectNotInWorld: there is no such object.
        IllPosedGoalFailure: not one arm, an effort below zero, or furniture or a robot is to be held.
        CapabilityAbsenceFailure: the robot has no such arm.
    """

    concept: ClassVar[str | None] = "Holding"

    gripper: Arms
    object_designator: ObjectDesignator | Object
    effort: float

    def resources(self) -> frozenset[Resource]:
        return reaching(self.gripper)

    async def perform(self) -> None:
        robot = require_robot()
        tool_frame = robot.one_arm(self.gripper).tool_frame
        wanted = in_world(self.object_designator)
        if not self.effort >= 0:
            raise IllPosedGoalFailure(f"an effort of {self.effort} N holds nothing", self.effort)
        check_takable(robot, self.gripper, wanted)
        tool = robot.body.link_pose(tool_frame)
        apart = min(distance_to_box(tool, wanted.bounding_box(link)) for link in wanted.links)
        if apart > HOLD_DISTANCE_M_MAX:
            message = f"the {self.gripper.name} gripper would close on nothing: {wanted.name} is {apart:.3f} m from it"
            raise GripperClosedCompletely(message, wanted.name, apart)
        await MoveGripperMotion(GripperState.CLOSE, self.gripper).perform()
        take(robot, self.gripper, wanted)


@dataclass
class ReleaseActionPerformable(CheckedAction):
    """Open the gripper and let go of the object it holds, which stays where it is.

    Raises:
        ObjectLost: the gripper does not hold it.
        PerceptionObjectNotInWorld: there is no such object.
        IllPosedGoalFailure, CapabilityAbsenceFailure: not one arm; no such arm.
    """

    concept: ClassVar[str | None] = "Releasing"

    gripper: Arms
    object_designator: ObjectDesignator | Object

    def resources(self) -> frozenset[Resource]:
        return reaching(self.gripper)

    async def perform(self) -> None:
        robot = require_robot()
        tool_frame = robot.one_arm(self.gripper).tool_frame
        held = in_world(self.object_designator)
        if robot.body.attachments.get(held) != tool_frame:
            raise ObjectLost(f"the {self.gripper.name} gripper does not hold {held.name}", held.name)
        await MoveGripperMotion(GripperState.OPEN, self.gripper).perform()
        robot.body.detach(held)


@dataclass
class GraspingActionPerformable(CheckedAction):
    """Close the gripper around an object or a handle, coming straight along the way it will point; nothing is attached.

    The tool frame ends in the frame of the object or the handle, turned like it; on the handle of a door it comes
    from the side of the hinge.

    Raises:
        IKError: it is out of reach, or the place 0.1 m before it is.
        EndEffectorFailure: the gripper holds something.
        PerceptionObjectNotInWorld: there is no such object.
        IllPosedGoalFailure, CapabilityAbsenceFailure: not one arm; no such arm.
    """

    concept: ClassVar[str | None] = "Grasping"

    arm: Arms
    object_desig: ObjectDesignator | Object

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        robot = require_robot()
        goal = grasp_pose(self.object_desig)
        check_free(robot, self.arm)
        await MoveTCPMotion(approach(goal), self.arm).perform()
        await MoveGripperMotion(GripperState.OPEN, self.arm).perform()
        await MoveTCPMotion(goal, self.arm, allow_gripper_collision=True).perform()
        await MoveGripperMotion(GripperState.CLOSE, self.arm, allow_gripper_collision=True).perform()


@dataclass
class OpenActionPerformable(CheckedAction):
    """Open a drawer or a door by its handle, up to 0.05 m or rad before its end; the open hand stays at the handle.

    Where to stand for that, `AccessingLocation` knows.

    Raises:
        EnvironmentManipulationImpossible: no joint moves the handle.
        IKError: the handle is out of reach, or the hand cannot follow it all the way; then it holds the handle.
        EndEffectorFailure, PerceptionObjectNotInWorld, IllPosedGoalFailure, CapabilityAbsenceFailure: as for grasping.
    """

    concept: ClassVar[str | None] = "Opening"

    object_designator: ObjectPart
    arm: Arms

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        handle_of(self.object_designator)
        await GraspingActionPerformable(self.arm, self.object_designator).perform()
        await OpeningMotion(self.object_designator, self.arm).perform()
        await MoveGripperMotion(GripperState.OPEN, self.arm, allow_gripper_collision=True).perform()


@dataclass
class CloseActionPerformable(CheckedAction):
    """Close a drawer or a door by its handle; the open hand stays at the handle. Raises as `OpenAction` does."""

    concept: ClassVar[str | None] = "Closing"

    object_designator: ObjectPart
    arm: Arms

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        handle_of(self.object_designator)
        await GraspingActionPerformable(self.arm, self.object_designator).perform()
        await ClosingMotion(self.object_designator, self.arm).perform()
        await MoveGripperMotion(GripperState.OPEN, self.arm, allow_gripper_collision=True).perform()
