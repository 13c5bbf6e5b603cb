"""Build the scene of a rollout: a world with a robot, one object to pick up, and optionally a kitchen."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from pycrorm_async.plan.motions import simulated_robot_within
from pycrorm_async.world.bullet import BulletWorld, Object
from pycrorm_async.world.pose import ObjectType, Pose, yaw_quaternion
from pycrorm_async.world.urdf import Limits


@dataclass(frozen=True)
class Scene:
    """The parameters of a world for rollouts; the default is the thesis' scene (5.2): milk in the air, nothing else.

    Attributes:
        name, object_type: name and type of the object.
        position: position of the object in the map frame, m.
        yaw: rotation of the object about the vertical, rad.
        torso_height: torso height at the start of every rollout, m. The thesis' rollouts have 0.
        limits: joint limits of the arms. Within soft limits and with the torso at 0 no grasp from above is reachable.
        collisions: whether a base or an arm in collision is a failure; if False, collisions are not checked.
        kitchen: whether the world contains the kitchen.
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
        """Describe the scene in words. Queries select rollouts by these words; no two scenes have the same."""
        kind = self.object_type.name.lower()
        label = kind if self.name == kind else f"{self.name} ({kind})"
        parts = [f"{label} at {', '.join(map(_digits, self.position))} m"]
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
        """Build the world, enter it, and choose its robot; the world closes with the context."""
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
    """A scene's world, its robot and its object, with a method to restore them."""

    scene: Scene
    world: BulletWorld
    robot: Object
    target: Object

    def reset(self) -> None:
        """Restore the start of a rollout. Moves only what has changed: a fifth of the time of Bullet's own reset."""
        self.world.reset()
        description = self.robot.robot_description
        torso = description.torso_joint if description is not None else None
        if self.scene.torso_height and torso is not None:
            self.robot.set_joint_position(torso, self.scene.torso_height)


def _digits(number: float) -> str:
    return f"{number:.9g}"
