"""Which world a plan acts in, and which robot: those of its context. Without one the caller is told what to do."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.plan.errors import NoRobotHere
from pycrorm_async.plan.failures import CapabilityAbsenceFailure, IllPosedGoalFailure
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.errors import NoWorld
from pycrorm_async.world.observers import current_world
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.robots.robot_description import ArmDescription, RobotDescription

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.objects import Object

__all__ = ["RobotHere", "check_in_map", "world_here", "robot_here"]


class RobotHere(NamedTuple):
    """The robot of this context: the object in the world, and what is known of its kind."""

    body: Object
    description: RobotDescription

    def one_arm(self, arm: Arms) -> ArmDescription:
        """The arm's description.

        Raises:
            IllPosedGoalFailure: it is `Arms.BOTH`.
            CapabilityAbsenceFailure: the robot has no such arm.
        """
        if arm is Arms.BOTH:
            raise IllPosedGoalFailure("this is done with one arm, LEFT or RIGHT, not with BOTH", arm)
        found = self.description.arms.get(arm)
        if found is None:
            raise CapabilityAbsenceFailure(f"{self.body.name} has no {arm.name} arm", self.body.name, arm)
        return found

    def each_arm(self, arm: Arms) -> dict[Arms, ArmDescription]:
        """The arm, or for `Arms.BOTH` the two. Raises `CapabilityAbsenceFailure` for one that the robot lacks."""
        return {each: self.one_arm(each) for each in ((Arms.LEFT, Arms.RIGHT) if arm is Arms.BOTH else (arm,))}

    def with_load(self) -> frozenset[Object]:
        """The robot and all that is attached to it, however deep."""
        return frozenset({self.body, *self.body.world.attachments.below(self.body)})


def world_here() -> BulletWorld:
    """The world of the innermost `with BulletWorld()` of this context. Raises `NoWorld`."""
    world = current_world.get()
    if world is None:
        raise NoWorld("the plan")
    return world


def robot_here() -> RobotHere:
    """The robot in that world. Raises `NoWorld`, `NoRobotHere`."""
    body = world_here().robot
    if body is None:
        raise NoRobotHere('no robot in the world: add one, e.g. Object("pr2", ObjectType.ROBOT)')
    description = body.robot_description
    if description is None:
        raise NoRobotHere(f"the robot {body.name!r} is not of a kind that is known here")
    return RobotHere(body, description)


def check_in_map(target: Pose) -> None:
    """Raise `CallerError` if the pose is in another frame than what is in the world, or not finite."""
    if target.frame != "map":
        raise CallerError(f"the target is in frame {target.frame!r}, the robot in 'map': transform it first")
    if not math.isfinite(sum(target.position) + sum(target.orientation)):
        raise CallerError(f"the target is not finite: {target!r}")
