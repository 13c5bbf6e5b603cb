"""Actions of one gripper: hold and release objects, grasp handles, open and close drawers and doors.

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
from pycrorm_async.plan.geometry.gripper_checks import check_fits, check_free, check_takable, take
from pycrorm_async.plan.language.resources import Resource, reaching
from pycrorm_async.plan.motions.motions import ClosingMotion, MoveGripperMotion, MoveTCPMotion, OpeningMotion
from pycrorm_async.plan.motions.robot_choice import collisions_count
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
    """Close the gripper on an object with `effort` (N); afterwards the object is attached to the gripper.

    The arm does not move. An object that is attached to another one is detached from it.

    Raises:
        GripperClosedCompletely: the tool frame is farther than `HOLD_DISTANCE_M_MAX` from the bounding boxes of all the
            object's links.
        EndEffectorFailure: the gripper holds another object.
        PerceptionObjectNotInWorld: the object is not in the robot's world.
        IllPosedGoalFailure: `gripper` is not a single arm, the effort is below 0, or the object is furniture or a
            robot.
        CapabilityAbsenceFailure: the robot has no such arm; or the object is heavier than the arm's payload; or
            collisions count, and the object is wider than the gripper's opening.
    """

    concept: ClassVar[str | None] = "Holding"

    gripper: Arms
    object_designator: ObjectDesignator | Object
    effort: float

    def resources(self) -> frozenset[Resource]:
        return reaching(self.gripper)

    async def perform(self) -> None:
        robot = require_robot()
        target = in_world(self.object_designator)
        if not self.effort >= 0:
            raise IllPosedGoalFailure(f"effort must be >= 0 N, got {self.effort} N", self.effort)
        check_takable(robot, self.gripper, target)
        tool = robot.tool_pose(self.gripper)
        distance = min(distance_to_box(tool, target.bounding_box(link)) for link in target.links)
        if distance > HOLD_DISTANCE_M_MAX:
            message = (
                f"the {self.gripper.name} gripper would close on nothing: {target.name} is {distance:.3f} m from it"
            )
            raise GripperClosedCompletely(message, target.name, distance)
        if collisions_count():
            check_fits(robot, self.gripper, target, tool.orientation)
        await MoveGripperMotion(GripperState.CLOSE, self.gripper).perform()
        take(robot, self.gripper, target)


@dataclass
class ReleaseActionPerformable(CheckedAction):
    """Open the gripper and detach the held object, which keeps its pose.

    Raises:
        ObjectLost: the gripper does not hold the object.
        PerceptionObjectNotInWorld: the object is not in the robot's world.
        IllPosedGoalFailure, CapabilityAbsenceFailure: `gripper` is not a single arm; the robot has no such arm.
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
    """Close the gripper around an object or a handle after a straight approach along its fingers; attaches nothing.

    The tool frame ends in the frame of the object or the handle, with its orientation; it approaches the handle of a
    door from the side of the hinge.

    Raises:
        IKError: the goal, or the pose 0.1 m before it, is out of reach.
        EndEffectorFailure: the gripper holds an object.
        PerceptionObjectNotInWorld: the object is not in the robot's world.
        IllPosedGoalFailure, CapabilityAbsenceFailure: `arm` is not a single arm; the robot has no such arm.
    """

    concept: ClassVar[str | None] = "Grasping"

    arm: Arms
    object_desig: ObjectDesignator | Object

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        robot = require_robot()
        goal, name = grasp_pose(self.object_desig), self.object_desig.name
        check_free(robot, self.arm)
        await MoveTCPMotion(approach(goal), self.arm, _object_name=name).perform()
        await MoveGripperMotion(GripperState.OPEN, self.arm).perform()
        await MoveTCPMotion(goal, self.arm, allow_gripper_collision=True, _object_name=name).perform()
        await MoveGripperMotion(GripperState.CLOSE, self.arm, allow_gripper_collision=True).perform()


@dataclass
class OpenActionPerformable(CheckedAction):
    """Open a drawer or a door by its handle, up to 0.05 m or rad before its limit; the open hand stays at the handle.

    `AccessingLocation` finds base poses for it.

    Raises:
        EnvironmentManipulationImpossible: no joint moves the handle.
        IKError: the handle is out of reach, or the hand cannot follow its whole path and remains closed on the handle.
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
