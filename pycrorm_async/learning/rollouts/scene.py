"""Where rollouts take place: a robot, one object to be picked up, and maybe a kitchen around them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from pycrorm_async.plan.motions.process_modules import simulated_robot_within
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, yaw_quaternion
from pycrorm_async.world.robots.robot_description import Limits

__all__ = ["Scene", "Stage"]


@dataclass(frozen=True)
class Scene:
    """What a world for rollouts is made from; the default is that of the thesis (5.2): milk in the air, nothing else.

    Attributes:
        name, object_type: of the object.
        position: of the object, m in the map.
        yaw: how the object is turned about the vertical, rad.
        torso_height: m, at the start of every rollout. The thesis' rollouts have it at 0.
        limits: what the arms keep to. Within soft limits and with the torso at 0 nothing is grasped from above here.
        collisions: an arm that would be in something is a failure; otherwise nobody looks.
        kitchen: whether the kitchen is there.
    """

    name: str = "milk"
    object_type: ObjectType = ObjectType.MILK
    position: tuple[float, float, float] = (1.3, 1.0, 0.9)
    yaw: float = 0.0
    torso_height: float = 0.0
    limits: Limits = Limits.SOFT
    collisions: bool = False
    kitchen: bool = False

    def __str__(self) -> str:
        """In words, by which the rollouts in it are found again: no two scenes have the same."""
        kind = self.object_type.name.lower()
        what = kind if self.name == kind else f"{self.name} ({kind})"
        parts = [f"{what} at {', '.join(map(_digits, self.position))} m"]
        if self.yaw:
            parts.append(f"turned by {_digits(math.degrees(self.yaw))}°")
        parts.append(f"torso at {_digits(self.torso_height)} m")
        parts.append(f"{self.limits.name.lower()} limits")
        if self.collisions:
            parts.append("collisions count")
        if self.kitchen:
            parts.append("in the kitchen")
        return ", ".join(parts)

    @contextmanager
    def entered(self) -> Iterator[Stage]:
        """A world as described, entered, with its robot chosen."""
        with BulletWorld() as world, simulated_robot_within(self.limits, collisions=self.collisions):
            robot = Object("pr2", ObjectType.ROBOT)
            if self.kitchen:
                Object("kitchen", ObjectType.ENVIRONMENT)
            pose = Pose(self.position, yaw_quaternion(self.yaw))
            stage = Stage(self, world, robot, Object(self.name, self.object_type, pose=pose))
            stage.reset()
            yield stage


@dataclass(frozen=True)
class Stage:
    """A scene that is there, to be acted in and put back."""

    scene: Scene
    world: BulletWorld
    robot: Object
    target: Object

    def reset(self) -> None:
        """Everything as at the start. Only what is not so is touched: a fifth of the time that Bullet's own takes."""
        self.world.reset()
        description = self.robot.robot_description
        if self.scene.torso_height and description is not None:
            self.robot.set_joint_position(description.torso_joint, self.scene.torso_height)


def _digits(number: float) -> str:
    return f"{number:.9g}"
