"""Build the scene of a rollout: a world with a robot, an object to pick up, and optionally a table or a kitchen.

A scene can vary: the height, the heading and the kind of the object, and the table below it, are drawn for each rollout
from its seed and index. And it can disturb: the base misses its place, the object is not exactly where it is believed,
and a grasp slips. Neither uses the random numbers from which the policy samples.

>>> scene = Scene(heights=(0.6, 1.2), turned=True, table=True, disturbance=Disturbance(base_m=0.02))
>>> with scene.entered() as stage:
...     tally = await batch_rollout(MoveAndPickUp(stage.target), 500, seed=69, reset=stage.reset, prepare=stage.prepare)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields

import numpy as np

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import failures, geometry, objects
from pycrorm_async.plan.motions import ChosenRobot, MoveGripperMotion, MoveMotion, MoveTCPMotion, SimulatedModules
from pycrorm_async.plan.objects import CurrentRobot
from pycrorm_async.world.bounding_boxes import box_around
from pycrorm_async.world.bullet import BulletWorld, Object
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import Arms, GripperState, ObjectType, Pose, yaw_quaternion
from pycrorm_async.world.urdf import PR2, Limits, RobotDescription

# === disturbance ==============================================================================================
#
# Disturb the simulated robot: its drives, its knowledge of the object's pose, and its grip.

_TURN_ON_THE_SPOT_M = 1e-6
"""A drive shorter than this is a turn on the spot, which misses only its heading."""
_SLIP_WIDTH_M = 0.03
"""The distance of the object's middle from that between the fingers at which a grip slips eleven times as often."""


@dataclass(frozen=True)
class Disturbance:
    """The standard deviations of a simulated robot's errors; all 0 disturbs nothing.

    Attributes:
        base_m, base_rad: by how much a drive misses its goal, in x and in y, m, and in heading, rad.
        object_m, object_rad: by how much the object is not where it is believed when the gripper closes, along two
            horizontal axes, m, and about the vertical, rad. A finger that meets the object, or a gripper that closes on
            nothing, fails the pick-up.
        slip: probability, 0 to 1, that an object gripped in its middle slips when it is lifted.
    """

    base_m: float = 0.0
    base_rad: float = 0.0
    object_m: float = 0.0
    object_rad: float = 0.0
    slip: float = 0.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not 0 <= value < math.inf or (each.name == "slip" and value > 1):
                limits = "between 0 and 1" if each.name == "slip" else "finite and >= 0"
                raise CallerError(f"{each.name} of a disturbance must be {limits}, got {value}")

    def __str__(self) -> str:
        parts = [
            f"{name} off by {_digits(metres)} m and {_digits(math.degrees(angle))}°"
            for name, metres, angle in (
                ("base", self.base_m, self.base_rad),
                ("object", self.object_m, self.object_rad),
            )
            if metres or angle
        ]
        return ", ".join([*parts, f"{_digits(100 * self.slip)} % slip"] if self.slip else parts)

    @property
    def reaches_objects(self) -> bool:
        """Return whether closing the gripper can miss."""
        return bool(self.object_m or self.object_rad or self.slip)


class DisturbedModules(SimulatedModules):
    """The process modules of a simulated robot with errors, drawn from `rng` in the order of its motions."""

    def __init__(self, limits: Limits, disturbance: Disturbance, *, collisions: bool = False) -> None:
        super().__init__(limits, collisions=collisions)
        self._disturbance = disturbance
        self.errors = str(disturbance)
        self._slipping: set[Arms] = set()
        self.rng = np.random.default_rng(0)

    async def navigate(self, motion: MoveMotion) -> None:
        robot, by = objects.require_robot(), self._disturbance
        (x, y, z), here = motion.target.position, robot.body.pose.position
        drives = math.hypot(x - here.x, y - here.y) > _TURN_ON_THE_SPOT_M
        dx, dy, turn = self.rng.normal(0.0, 1.0, 3).tolist()
        if drives:
            x, y = x + by.base_m * dx, y + by.base_m * dy
        heading = yaw_quaternion(motion.target.yaw + by.base_rad * turn)
        await super().navigate(MoveMotion(Pose((x, y, z), heading, motion.target.frame)))

    async def move_tcp(self, motion: MoveTCPMotion) -> None:
        robot = objects.require_robot()
        if motion.arm in self._slipping:
            self._slipping.discard(motion.arm)
            for held, link in robot.body.attachments.items():
                if link == robot.one_arm(motion.arm).tool_frame:
                    robot.body.detach(held)
                    raise failures.ObjectLost(f"{held.name} slipped from the {motion.arm.name} gripper", held.name)
        await super().move_tcp(motion)

    async def move_gripper(self, motion: MoveGripperMotion) -> None:
        robot = objects.require_robot()
        if motion.motion is GripperState.CLOSE and self._disturbance.reaches_objects:
            for arm in robot.each_arm(motion.gripper):
                if (target := _between_fingers(robot, arm)) is not None:
                    self._close(robot, arm, target)
        await super().move_gripper(motion)

    def _close(self, robot: CurrentRobot, arm: Arms, target: Object) -> None:
        """Draw where the object really is, and raise a `PlanFailure` if the gripper misses it there."""
        by, described = self._disturbance, robot.one_arm(arm)
        dx, dy, turn = self.rng.normal(0.0, 1.0, 3).tolist()
        chance = self.rng.random()
        x, y, z = target.pose.position
        really = Pose((x + by.object_m * dx, y + by.object_m * dy, z), target.pose.orientation) @ Pose(
            orientation=yaw_quaternion(by.object_rad * turn)
        )
        to_tool = robot.tool_pose(arm).inverse() @ really @ target.pose.inverse()
        frames = [(to_tool @ target.link_pose(link), target.body.solids[link]) for link in target.links]
        box = box_around([((frame.position, frame.orientation), solids) for frame, solids in frames])
        if box is None:
            return
        off_m = max(abs(each) for each in (really.position.x - x, really.position.y - y))
        if any(low > 0 or high < 0 for low, high in zip(box.min, box.max, strict=True)):
            message = f"the {arm.name} gripper closed on nothing: {target.name} is {off_m:.3f} m from its believed pose"
            raise failures.GripperClosedCompletely(message, target.name, off_m)
        reach_m = max(box.max.y, -box.min.y)
        if described.opening_m is not None and reach_m > described.opening_m / 2:
            message = f"a finger of the {arm.name} gripper hits {target.name}, {off_m:.3f} m from its believed pose"
            raise failures.ManipulationGoalNotReached(message, target.name, off_m)
        if chance < by.slip * (1 + 10 * (box.centre.y / _SLIP_WIDTH_M) ** 2):
            self._slipping.add(arm)


def _between_fingers(robot: CurrentRobot, arm: Arms) -> Object | None:
    """Return the object that is believed to be where the gripper closes: the nearest one, if it is near enough."""
    tool = robot.tool_pose(arm)
    distances = {
        each: geometry.distance_to_box(tool, each.bounding_box())
        for each in robot.body.world.objects
        if each.object_type not in (ObjectType.ROBOT, ObjectType.ENVIRONMENT)
    }
    nearest = min(distances, key=distances.__getitem__, default=None)
    return nearest if nearest is not None and distances[nearest] <= geometry.HOLD_DISTANCE_M_MAX else None


# === scene ====================================================================================================

_TABLE_M = (0.7, 1.4, 2.0)
"""Depth, width and height of the table, m; it is solid, and lowered into the floor up to the height of its top."""
_EDGE_M = (0.08, 0.25)
"""Limits of the distance in m of the object's origin from the nearest edge of the table."""
_ALONG_M = 0.4
"""The greatest distance in m of the object's origin from the middle of that edge."""
_AWAY = Pose((100.0, 100.0, 0.0))
"""The pose of objects of the scene that are not used in a rollout."""


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
        heights: limits (low, high) of the object's height, m, drawn for each rollout; None keeps that of `position`.
        turned: whether the object's heading is drawn for each rollout, from the full circle; `yaw` is then ignored.
        others: further kinds of objects; for each rollout one of all kinds is drawn.
        table: whether the object stands on a table of 0.7 m by 1.4 m, turned at random for each rollout, 8 to 25 cm
            behind the middle 0.8 m of its long edge.
        parked: whether the arms are parked at the start of every rollout; otherwise their joints are at 0.
        disturbance: the errors of the robot.
        robot: the name of a built-in or registered robot, or a description of one, which processes of workers get too.
    """

    name: str = "milk"
    object_type: ObjectType = ObjectType.MILK
    position: tuple[float, float, float] = (1.3, 1.0, 0.9)
    yaw: float = 0.0
    torso_height: float = 0.0
    limits: Limits = Limits.SOFT
    collisions: bool = False
    kitchen: bool = False
    heights: tuple[float, float] | None = None
    turned: bool = False
    others: tuple[ObjectType, ...] = ()
    table: bool = False
    parked: bool = False
    disturbance: Disturbance = field(default_factory=Disturbance)
    robot: str | RobotDescription = PR2.name

    def __post_init__(self) -> None:
        if self.heights is not None and not 0 <= self.heights[0] <= self.heights[1] < math.inf:
            raise CallerError(f"heights of a scene are an interval (low, high) in m, got {self.heights}")
        if self.table and self.kitchen:
            raise CallerError("a scene has a table or the kitchen, not both")

    def __str__(self) -> str:
        """Describe the scene in words. Queries select rollouts by these words; no two scenes have the same."""
        kind = self.object_type.name.lower()
        label = kind if self.name == kind else f"{self.name} ({kind})"
        label = " or ".join([label, *(each.name.lower() for each in self.others)])
        parts = [f"{label} at {', '.join(map(_digits, self.position))} m"]
        if self.heights is not None:
            parts.append("{} to {} m high".format(*map(_digits, self.heights)))
        if self.turned:
            parts.append("turned at random")
        elif self.yaw:
            parts.append(f"turned by {_digits(math.degrees(self.yaw))}°")
        parts.append(f"torso at {_digits(self.torso_height)} m")
        if self.robot_name != PR2.name:
            parts.append(f"robot {self.robot_name}")
        parts.append(f"{self.limits.name.lower()} limits")
        if self.collisions:
            parts.append("collisions count")
        if self.kitchen:
            parts.append("in the kitchen")
        if self.table:
            parts.append("on a table")
        if self.parked:
            parts.append("arms parked")
        if disturbance := str(self.disturbance):
            parts.append(disturbance)
        return ", ".join(parts)

    @property
    def robot_name(self) -> str:
        """The name of the robot, in the world and in its description."""
        return self.robot if isinstance(self.robot, str) else self.robot.name

    @property
    def varies(self) -> bool:
        """Return whether rollouts differ by more than the sampled choice."""
        return bool(self.heights or self.turned or self.others or self.table or self.disturbance != Disturbance())

    @contextmanager
    def entered(self) -> Iterator[Stage]:
        """Build the world, enter it, and choose its robot; the world closes with the context."""
        modules = SimulatedModules(self.limits, collisions=self.collisions)
        if self.disturbance != Disturbance():
            modules = DisturbedModules(self.limits, self.disturbance, collisions=self.collisions)
        chosen = ChosenRobot("simulated", modules, limits=self.limits, collisions=self.collisions)
        with BulletWorld() as world, chosen:
            described = None if isinstance(self.robot, str) else self.robot
            robot = Object(self.robot_name, ObjectType.ROBOT, robot=described)
            if self.kitchen:
                Object("kitchen", ObjectType.ENVIRONMENT)
            pose = Pose(self.position, yaw_quaternion(self.yaw))
            targets = [Object(self.name, self.object_type, pose=pose)]
            targets += [Object(each.name.lower(), each, pose=_AWAY) for each in self.others]
            if self.table:
                depth, width, height = _TABLE_M
                across, along = (-depth / 2, depth / 2), (-width / 2, width / 2)
                urdf = box_urdf("table", x=across, y=along, z=(-height, 0.0))
                Object("table", ObjectType.ENVIRONMENT, urdf, pose=_AWAY)
            stage = Stage(self, world, robot, targets[0], tuple(targets), modules)
            stage.reset()
            yield stage


@dataclass(frozen=True)
class Stage:
    """A scene's world, its robot and its object, with methods to restore them and to prepare a rollout.

    Attributes:
        target: the object of `Scene.object_type`.
        targets: all objects of which a rollout may have one.
    """

    scene: Scene
    world: BulletWorld
    robot: Object
    target: Object
    targets: tuple[Object, ...]
    modules: SimulatedModules

    def reset(self) -> None:
        """Restore the start of a rollout. Moves only what has changed: a fifth of the time of Bullet's own reset."""
        self.world.reset()
        description = self.robot.robot_description
        torso = description.torso_joint if description is not None else None
        if self.scene.torso_height and torso is not None:
            self.robot.set_joint_position(torso, self.scene.torso_height)
        if self.scene.parked and description is not None:
            for each in description.arms.values():
                self.robot.set_joint_positions(dict(each.park))

    def prepare(self, seed: int, index: int) -> Object:
        """Draw what varies in the rollout of this seed and index, after `reset`, and return the object to pick up."""
        scene, rng = self.scene, np.random.default_rng((seed, index, 1))
        if isinstance(self.modules, DisturbedModules):
            self.modules.rng = np.random.default_rng((seed, index, 2))
        kind, height, heading, around, edge_m, along_m = rng.random(6).tolist()
        target = self.targets[int(kind * len(self.targets))]
        x, y, z = scene.position
        if scene.heights is not None:
            z = _between(scene.heights, height)
        pose = Pose((x, y, z), yaw_quaternion(math.tau * heading if scene.turned else scene.yaw))
        if target is not self.target:
            self.target.set_pose(_AWAY)
        target.set_pose(pose)
        if scene.table:
            under = target.bounding_box().min.z
            middle = Pose((x, y, under), yaw_quaternion(math.tau * around)) @ Pose(
                (_TABLE_M[0] / 2 - _between(_EDGE_M, edge_m), _between((-_ALONG_M, _ALONG_M), along_m), 0.0)
            )
            self.world.object("table").set_pose(middle)
        return target


def _between(limits: tuple[float, float], share: float) -> float:
    return limits[0] + share * (limits[1] - limits[0])


def _digits(number: float) -> str:
    return f"{number:.9g}"
