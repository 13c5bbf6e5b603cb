"""Basic actions: posture, driving, looking, picking up and placing.

Actions with handles and grippers are in `actions.manipulation`, detection and transport in `actions.transport`. Each
action is recorded with its fields; concepts are those of SOMA. Positions are in metres in the map, angles in rad.
Descriptions with alternatives are in `actions.descriptions`.

>>> await PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT).perform()
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from pycrorm_async.plan.current_robot import require_robot
from pycrorm_async.plan.designator import ActionAbstract
from pycrorm_async.plan.failures import ObjectLost
from pycrorm_async.plan.field_types import check_properties
from pycrorm_async.plan.geometry.grasp_poses import grasp_orientation, pick_up_poses, place_pose, retract
from pycrorm_async.plan.geometry.gripper_checks import check_fits, check_takable, take
from pycrorm_async.plan.language.resources import Resource, arms, reaching
from pycrorm_async.plan.motions.motions import (
    LookingMotion,
    MoveArmJointsMotion,
    MoveGripperMotion,
    MoveJointsMotion,
    MoveMotion,
    MoveTCPMotion,
)
from pycrorm_async.plan.motions.robot_choice import collisions_count
from pycrorm_async.plan.object_designators import ObjectDesignator, designator_of, in_world
from pycrorm_async.world.enums import Arms, Grasp, GripperState
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, yaw_quaternion

__all__ = [
    "FaceAtPerformable",
    "LookAtActionPerformable",
    "MoveAndPickUpPerformable",
    "MoveTorsoActionPerformable",
    "NavigateActionPerformable",
    "ParkArmsActionPerformable",
    "PickUpActionPerformable",
    "PlaceActionPerformable",
    "SetGripperActionPerformable",
]


class CheckedAction(ActionAbstract):
    """An action whose fields are checked when it is built. Raises `ResolutionError`."""

    def __post_init__(self) -> None:
        check_properties(self)


@dataclass
class MoveTorsoActionPerformable(CheckedAction):
    """Lift or lower the torso to `position` (m). Raises `TorsoGoalUnreachable`, `CapabilityAbsenceFailure`."""

    concept: ClassVar[str | None] = "MoveTorso"

    position: float

    def resources(self) -> frozenset[Resource]:
        return frozenset({Resource.TORSO})

    async def perform(self) -> None:
        await MoveJointsMotion([require_robot().torso_joint()], [self.position]).perform()


@dataclass
class SetGripperActionPerformable(CheckedAction):
    """Open or close a gripper."""

    concept: ClassVar[str | None] = "SettingGripper"

    gripper: Arms
    motion: GripperState

    def resources(self) -> frozenset[Resource]:
        return arms(self.gripper)

    async def perform(self) -> None:
        await MoveGripperMotion(self.motion, self.gripper).perform()


@dataclass
class ParkArmsActionPerformable(CheckedAction):
    """Move an arm, or both, to the folded park posture. Raises `CapabilityAbsenceFailure` for an arm without one."""

    concept: ClassVar[str | None] = "ParkingArms"

    arm: Arms

    def resources(self) -> frozenset[Resource]:
        return arms(self.arm)

    async def perform(self) -> None:
        robot = require_robot()
        parked = {arm: robot.parked(arm) for arm in robot.each_arm(self.arm)}
        if self.arm not in (Arms.LEFT, Arms.RIGHT, Arms.BOTH):
            joints = parked[self.arm]
            await MoveJointsMotion([*joints], [*joints.values()]).perform()
            return
        await MoveArmJointsMotion(parked.get(Arms.LEFT), parked.get(Arms.RIGHT)).perform()


@dataclass
class NavigateActionPerformable(CheckedAction):
    """Drive to a place."""

    concept: ClassVar[str | None] = "Navigating"

    target_location: Pose

    def resources(self) -> frozenset[Resource]:
        return frozenset({Resource.BASE})

    async def perform(self) -> None:
        await MoveMotion(self.target_location).perform()


@dataclass
class LookAtActionPerformable(CheckedAction):
    """Turn the head to a point."""

    concept: ClassVar[str | None] = "LookingAt"

    target: Pose

    def resources(self) -> frozenset[Resource]:
        return frozenset({Resource.HEAD})

    async def perform(self) -> None:
        await LookingMotion(self.target).perform()


@dataclass
class PickUpActionPerformable(CheckedAction):
    """Grasp an object with one arm and lift it by 3 cm; afterwards it is attached to the gripper.

    `grasp` sets the gripper's orientation in the object's own axes. The gripper opens 0.1 m before the object, measured
    along the direction in which it points when the action begins.

    Raises:
        IKError: one of the three goals of the arm is out of reach.
        EndEffectorFailure: the gripper holds another object.
        PerceptionObjectNotInWorld: the object is not in the robot's world.
        IllPosedGoalFailure: `arm` is not a single arm, or the object is furniture or a robot.
        CapabilityAbsenceFailure: the robot has no such arm; or the object is heavier than the arm's payload; or
            collisions count, and the object is wider than the gripper's opening.
    """

    concept: ClassVar[str | None] = "PickingUp"

    object_designator: ObjectDesignator | Object
    arm: Arms
    grasp: Grasp

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        robot = require_robot()
        target = in_world(self.object_designator)
        check_takable(robot, self.arm, target)
        if collisions_count():
            check_fits(robot, self.arm, target, grasp_orientation(target.pose, self.grasp))
        before, at, above = pick_up_poses(target.pose, self.grasp, robot.tool_pose(self.arm))
        await MoveTCPMotion(before, self.arm, allow_gripper_collision=True, _object_name=target.name).perform()
        await MoveGripperMotion(GripperState.OPEN, self.arm).perform()
        await MoveTCPMotion(at, self.arm, allow_gripper_collision=True, _object_name=target.name).perform()
        await MoveGripperMotion(GripperState.CLOSE, self.arm).perform()
        take(robot, self.arm, target)
        await MoveTCPMotion(above, self.arm, allow_gripper_collision=True, _object_name=target.name).perform()


@dataclass
class PlaceActionPerformable(CheckedAction):
    """Place the held object at `target_location`; the gripper ends 7 cm behind it.

    Raises:
        IKError: the target or the retracted pose is out of reach; only in the latter case the object is placed.
        ObjectLost: the gripper does not hold the object.
        PerceptionObjectNotInWorld: the object is not in the robot's world.
    """

    concept: ClassVar[str | None] = "Placing"

    object_designator: ObjectDesignator | Object
    arm: Arms
    target_location: Pose

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm)

    async def perform(self) -> None:
        robot = require_robot()
        body, held = robot.body, in_world(self.object_designator)
        tool_frame = robot.one_arm(self.arm).tool_frame
        if body.attachments.get(held) != tool_frame:
            raise ObjectLost(f"the {self.arm.name} gripper does not hold {held.name}", held.name)
        goal = place_pose(self.target_location, held.pose, robot.tool_pose(self.arm))
        await MoveTCPMotion(goal, self.arm, _object_name=held.name).perform()
        await MoveGripperMotion(GripperState.OPEN, self.arm).perform()
        body.detach(held)
        await MoveTCPMotion(retract(goal), self.arm, _object_name=held.name).perform()


@dataclass
class FaceAtPerformable(CheckedAction):
    """Rotate the base on the spot to face a point, and look at it."""

    concept: ClassVar[str | None] = "LookingAt"

    pose: Pose

    def resources(self) -> frozenset[Resource]:
        return frozenset({Resource.BASE, Resource.HEAD})

    async def perform(self) -> None:
        base = require_robot().body.pose
        dx, dy = self.pose.position.x - base.position.x, self.pose.position.y - base.position.y
        heading = yaw_quaternion(math.atan2(dy, dx))
        await NavigateActionPerformable(Pose(base.position, heading, base.frame)).perform()
        await LookAtActionPerformable(self.pose).perform()


@dataclass
class MoveAndPickUpPerformable(CheckedAction):
    """Drive to a place, face the object from there, and pick it up.

    Attributes:
        policy: name of the policy that chose place, arm and grasp; None if none did.
    """

    concept: ClassVar[str | None] = "Fetching"

    standing_position: Pose
    object_designator: ObjectDesignator | Object
    arm: Arms
    grasp: Grasp
    policy: str | None = field(default=None, kw_only=True)

    def resources(self) -> frozenset[Resource]:
        return reaching(self.arm) | {Resource.HEAD}

    async def perform(self) -> None:
        await NavigateActionPerformable(self.standing_position).perform()
        await FaceAtPerformable(designator_of(self.object_designator).pose).perform()
        await PickUpActionPerformable(self.object_designator, self.arm, self.grasp).perform()
