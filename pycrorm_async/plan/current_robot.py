"""Look up the world and the robot of the current context, with an error that names the missing statement."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.plan.errors import NoRobotHere
from pycrorm_async.plan.failures import CapabilityAbsenceFailure, IllPosedGoalFailure
from pycrorm_async.world.enums import Arms, GripperState
from pycrorm_async.world.errors import NoWorld
from pycrorm_async.world.observers import current_world
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.robots.acting_robot import acting_robot
from pycrorm_async.world.robots.robot_description import ArmDescription, RobotDescription

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.objects import Object


class CurrentRobot(NamedTuple):
    """A robot: its object in the world and the description of its kind."""

    body: Object
    description: RobotDescription

    def one_arm(self, arm: Arms) -> ArmDescription:
        """Return the description of a single arm.

        Raises:
            IllPosedGoalFailure: `arm` is `Arms.BOTH`.
            CapabilityAbsenceFailure: the robot has no such arm.
        """
        if arm is Arms.BOTH:
            raise IllPosedGoalFailure("this designator needs one arm, LEFT or RIGHT, and does not work with BOTH", arm)
        arm_description = self.description.arms.get(arm)
        if arm_description is None:
            raise CapabilityAbsenceFailure(f"{self.body.name} has no {arm.name} arm", self.body.name, arm)
        return arm_description

    def each_arm(self, arm: Arms) -> dict[Arms, ArmDescription]:
        """Return the arm, or both for `Arms.BOTH`. Raises `CapabilityAbsenceFailure` for an arm the robot lacks."""
        return {each: self.one_arm(each) for each in ((Arms.LEFT, Arms.RIGHT) if arm is Arms.BOTH else (arm,))}

    def base_links(self) -> tuple[str, ...]:
        """Return the links with a shape that no arm moves: the base, and the torso and head on it."""
        first_joints = {arm.joints[0] for arm in self.description.arms.values()}
        body = self.body
        return tuple(
            link for link in body.links if body.body.solids[link] and first_joints.isdisjoint(body.joints_above(link))
        )

    def absence(self, capability: str) -> CapabilityAbsenceFailure:
        """Return the failure of an action for which the robot lacks a part."""
        return CapabilityAbsenceFailure(f"{self.body.name} has no {capability}", self.body.name, capability)

    def torso_joint(self) -> str:
        """Return the joint that lifts the torso. Raises `CapabilityAbsenceFailure`."""
        if self.description.torso_joint is None:
            raise self.absence("torso to lift")
        return self.description.torso_joint

    def gripper_joints(self, arm: Arms, state: GripperState) -> Mapping[str, float]:
        """Return the positions of a gripper's joints. Raises `CapabilityAbsenceFailure` without a gripper."""
        joints = self.one_arm(arm).gripper_joints.get(state)
        if not joints:
            raise self.absence(f"gripper at its {arm.name} arm")
        return joints

    def parked(self, arm: Arms) -> dict[str, float]:
        """Return the posture of a parked arm. Raises `CapabilityAbsenceFailure` if the arm has none."""
        park = self.one_arm(arm).park
        if not park:
            raise self.absence(f"park posture of its {arm.name} arm")
        return dict(park)

    def tool_pose(self, arm: Arms) -> Pose:
        """Return the current pose of an arm's tool frame."""
        described = self.one_arm(arm)
        return in_link(self.body.link_pose(described.tool_frame), described.tool_in_link)

    def camera_pose(self) -> Pose:
        """Return the current pose of the camera's optical frame. Raises `CapabilityAbsenceFailure` without a camera."""
        if self.description.camera_link is None:
            raise self.absence("camera")
        return in_link(self.body.link_pose(self.description.camera_link), self.description.camera_in_link)

    def camera_heights_m(self) -> tuple[float, float]:
        """Return the lowest and the highest height of the camera above the floor."""
        if self.description.camera_height_m is not None:
            return self.description.camera_height_m
        height = self.camera_pose().position.z
        return height, height

    def with_load(self) -> frozenset[Object]:
        """Return the robot and all objects attached to it, directly or indirectly."""
        return frozenset({self.body, *self.body.world.attachments.below(self.body)})


def in_link(link: Pose, frame: Pose | None) -> Pose:
    """Return the pose of a frame that is fixed to a link; None is the link's own frame."""
    return link if frame is None else link @ frame


def require_world() -> BulletWorld:
    """Return the world of the innermost `with BulletWorld()` of this context. Raises `NoWorld`."""
    world = current_world.get()
    if world is None:
        raise NoWorld("the plan")
    return world


def require_robot() -> CurrentRobot:
    """Return the robot that acts in the current world (`robot_acting`). Raises `NoWorld`, `NoRobotHere`."""
    world = require_world()
    body = acting_robot(world)
    if body is None:
        if world.robot is not None:
            raise NoRobotHere("the robot that acts here (robot_acting) is not in the current world")
        raise NoRobotHere('no robot in the world: add one, e.g. Object("pr2", ObjectType.ROBOT)')
    description = body.robot_description
    if description is None:
        raise NoRobotHere(
            f"no robot description is registered for the robot {body.name!r}: pass one, as in Object(..., robot=PR2)"
        )
    return CurrentRobot(body, description)


def check_in_map(target: Pose) -> None:
    """Raise `CallerError` if the pose is not in the frame "map", or not finite."""
    if target.frame != "map":
        raise CallerError(f"the target is in frame {target.frame!r}, the robot in 'map': transform it first")
    if not math.isfinite(sum(target.position) + sum(target.orientation)):
        raise CallerError(f"the target is not finite: {target!r}")
