"""Define motions, and the process modules that execute them.

**Motions.** Motions are single commands to a robot's controllers.

The robot chosen with `with simulated_robot:` executes them; each is recorded with its target. Concepts are the nearest
ones of SOMA.

>>> with simulated_robot:
...     await MoveMotion(Pose([0.6, 0.4, 0])).perform()
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Awaitable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, ClassVar, Literal, Protocol, Self, TypeAlias

from pycrorm_async.plan import failures, geometry, objects
from pycrorm_async.plan.execution import Seen, recorder
from pycrorm_async.plan.language import BaseMotion
from pycrorm_async.plan.task import Performable, current_node
from pycrorm_async.world import pose as poses
from pycrorm_async.world.arms import Chain
from pycrorm_async.world.bullet import Object, current_world
from pycrorm_async.world.kinematics import Unreachable, postures
from pycrorm_async.world.queries import collisions_at
from pycrorm_async.world.urdf import Drive, FieldOfView, Limits, PR2Description
from pycrorm_async.world.world_copy import acting_robot

# === looking ==================================================================================================
#
# Compute the joints of a robot's head that point its camera at a target: in closed form for the PR2, else by turns.
#
# The general method turns the head's joints one after the other, each so that the camera's axis comes as near to the
# target as that joint brings it, until nothing changes. Joints are clamped to their limits, so a target outside them is
# not looked at exactly, and no error is raised.

ROUNDS_MAX = 50
"""Bounds the rounds over the joints; a camera near its axes needs about ten."""
_TURN_MIN_RAD = 1e-9
"""The largest turn in rad of a round at which the iteration ends."""


def head_joints(robot: objects.CurrentRobot, target: poses.Pose) -> dict[str, float]:
    """Return joint positions (rad) that point the camera's axis at the target, clamped to the joints' limits.

    Raises `CapabilityAbsenceFailure` if the robot has no camera, or no joint that turns it.
    """
    if not robot.description.head_joints:
        raise robot.absence("head to turn")
    if isinstance(robot.description, PR2Description):
        return _pan_and_tilt(robot, robot.description, target)
    return _turned(robot, target)


def _pan_and_tilt(robot: objects.CurrentRobot, description: PR2Description, target: poses.Pose) -> dict[str, float]:
    """Pan about z of the pan link, tilt about y of the tilt link.

    The origin of the tilt link moves with pan, so tilt is computed for the head after panning.
    """
    body = robot.body
    pan_pose = body.link_pose(description.head_pan_link)
    tilt_origin = body.link_pose(description.head_tilt_link).relative_to(pan_pose).position
    point = target.relative_to(pan_pose).position
    turn = math.atan2(point.y, point.x)
    pan = math.remainder(body.joint_position(description.head_pan_joint) + turn, math.tau)
    ahead = math.hypot(point.x, point.y) - tilt_origin.x
    tilt = -math.atan2(point.z - tilt_origin.z, ahead)
    return {
        description.head_pan_joint: _clamp(pan, body.joint_limits(description.head_pan_joint)),
        description.head_tilt_joint: _clamp(tilt, body.joint_limits(description.head_tilt_joint)),
    }


def _turned(robot: objects.CurrentRobot, target: poses.Pose) -> dict[str, float]:
    body, description = robot
    if description.camera_link is None:
        raise robot.absence("camera")
    head = Chain(
        body.model,
        base_link="",
        tool_link=description.camera_link,
        tool_in_link=description.camera_in_link,
    )
    point = target.relative_to(body.root_pose()).position
    positions = body.joint_positions()
    for _ in range(ROUNDS_MAX):
        largest = 0.0
        for joint in description.head_joints:
            camera = head.forward(positions)
            towards = [to - at for to, at in zip(point, camera.position, strict=True)]
            turn = _angle_about(
                head.axes(positions)[joint], poses.rotated(camera.orientation, (0.0, 0.0, 1.0)), towards
            )
            before = positions[joint]
            positions[joint] = _clamp(before + turn, body.joint_limits(joint))
            largest = max(largest, abs(positions[joint] - before))
        if largest < _TURN_MIN_RAD:
            break
    return {joint: positions[joint] for joint in description.head_joints}


def _angle_about(axis: poses.Vector, one: Sequence[float], other: Sequence[float]) -> float:
    """Return the angle about the axis from one direction to the other, -π to π."""
    (ax, ay, az), (x, y, z) = axis, one
    along_one, along_other = poses.dot(axis, one), poses.dot(axis, other)
    across = (ay * z - az * y, az * x - ax * z, ax * y - ay * x)
    return math.atan2(poses.dot(across, other), poses.dot(one, other) - along_one * along_other)


def _clamp(value: float, limits: tuple[float, float]) -> float:
    return max(limits[0], min(limits[1], value))


# === motions ==================================================================================================


@dataclass
class MoveMotion(BaseMotion):
    """Drive the base to a pose in the map."""

    concept: ClassVar[str | None] = "Navigating"

    target: poses.Pose

    def resources(self) -> frozenset[failures.Resource]:
        return frozenset({failures.Resource.BASE})

    async def perform(self) -> None:
        await execute(self, "navigate")


@dataclass
class MoveTCPMotion(BaseMotion):
    """Move the tool frame of one arm to a pose in the map.

    Attributes:
        allow_gripper_collision: whether the gripper may be in an object at the goal, where collisions are checked.

    Raises:
        IKError: the pose is out of reach.
        CapabilityAbsenceFailure, IllPosedGoalFailure: the robot has no such arm; `arm` is BOTH.
    """

    concept: ClassVar[str | None] = "AssumingArmPose"

    target: poses.Pose
    arm: poses.Arms
    allow_gripper_collision: bool | None = None
    _object_name: str | None = field(default=None, repr=False, compare=False)
    """The object for which the arm reaches; not recorded with the motion, but with its failure."""

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm)

    async def perform(self) -> None:
        with failures.reaching_for(self._object_name):
            await execute(self, "move_tcp")


@dataclass
class LookingMotion(BaseMotion):
    """Turn the head to a point in the map."""

    concept: ClassVar[str | None] = "LookingAt"

    target: poses.Pose

    def resources(self) -> frozenset[failures.Resource]:
        return frozenset({failures.Resource.HEAD})

    async def perform(self) -> None:
        await execute(self, "looking")


@dataclass
class MoveGripperMotion(BaseMotion):
    """Open or close a gripper."""

    concept: ClassVar[str | None] = "SettingGripper"

    motion: poses.GripperState
    gripper: poses.Arms
    allow_gripper_collision: bool | None = None

    def resources(self) -> frozenset[failures.Resource]:
        return failures.arms(self.gripper)

    async def perform(self) -> None:
        await execute(self, "move_gripper")


@dataclass
class MoveArmJointsMotion(BaseMotion):
    """Move arm joints (by name) to positions in rad, both arms together.

    Raises `ConfigurationNotReached`, and `UnknownJoint` for a joint of another part.
    """

    concept: ClassVar[str | None] = "AssumingArmPose"

    left_arm_poses: dict[str, float] | None = None
    right_arm_poses: dict[str, float] | None = None

    def resources(self) -> frozenset[failures.Resource]:
        left = failures.arms(poses.Arms.LEFT) if self.left_arm_poses else failures.NOTHING
        return left | failures.arms(poses.Arms.RIGHT) if self.right_arm_poses else left

    async def perform(self) -> None:
        await execute(self, "move_arm_joints")


@dataclass
class MoveJointsMotion(BaseMotion):
    """Move joints to positions in rad or m, all together.

    Raises:
        TorsoGoalUnreachable: the torso is the only joint, and the position is outside its limits.
        ConfigurationNotReached: a position is outside its joint's limits.
        ResolutionError: the numbers of names and positions differ, or a name occurs twice.
    """

    concept: ClassVar[str | None] = "AssumingPose"

    names: list[str]
    positions: list[float]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.names) != len(self.positions):
            counts = f"expected {len(self.names)} values, one for each name, got {len(self.positions)}"
            raise failures.ResolutionError(type(self).__name__, wrong=[f"positions: {counts}"])
        if duplicates := {name for name in self.names if self.names.count(name) > 1}:
            raise failures.ResolutionError(
                type(self).__name__, wrong=[f"names: {', '.join(sorted(duplicates))} more than once"]
            )

    def resources(self) -> frozenset[failures.Resource]:
        world = current_world.get()
        robot = acting_robot(world) if world is not None else None
        description = robot.robot_description if robot is not None else None
        return failures.moving(self.names, description) if description is not None else failures.NOTHING

    async def perform(self) -> None:
        await execute(self, "move_joints")


@dataclass
class DetectingMotion(BaseMotion):
    """Detect objects of a type with the head's camera and return the most visible one.

    Raises `PerceptionObjectNotFound`, which names for each object of that type the reason why it is not visible.
    """

    concept: ClassVar[str | None] = "LookingFor"

    object_type: poses.ObjectType

    def resources(self) -> frozenset[failures.Resource]:
        return frozenset({failures.Resource.HEAD})

    async def perform(self) -> objects.ObjectDesignator:
        looking = execute(self, "detecting")
        return await report_perception(looking, source="camera", object_type=self.object_type)


@dataclass
class WorldStateDetectingMotion(BaseMotion):
    """Query the world for objects of a type, visible or not; return the first. Raises `PerceptionObjectNotFound`."""

    concept: ClassVar[str | None] = "CheckingObjectPresence"

    object_type: poses.ObjectType

    async def perform(self) -> objects.ObjectDesignator:
        asking = execute(self, "world_state_detecting")
        return await report_perception(asking, source="world_state", object_type=self.object_type)


@dataclass
class OpeningMotion(BaseMotion):
    """Open a drawer or a door with the hand on its handle, up to 0.05 m or rad before its limit; the hand follows.

    Raises:
        EnvironmentManipulationImpossible: no joint moves that part, or the hand is not on it.
        IKError: the hand cannot follow the whole path; nothing was moved.
        PerceptionObjectNotInWorld: the object that has the handle is not in the world.
    """

    concept: ClassVar[str | None] = "Opening"

    object_part: objects.ObjectPart
    arm: poses.Arms

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm)

    async def perform(self) -> None:
        with failures.reaching_for(self.object_part.name):
            await execute(self, "open")


@dataclass
class ClosingMotion(BaseMotion):
    """Close a drawer or a door with the hand on its handle; the hand follows. Raises what `OpeningMotion` raises."""

    concept: ClassVar[str | None] = "Closing"

    object_part: objects.ObjectPart
    arm: poses.Arms

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm)

    async def perform(self) -> None:
        with failures.reaching_for(self.object_part.name):
            await execute(self, "close")


@dataclass
class AccessingMotion(BaseMotion):
    """Move a joint by a distance with the hand on its handle; a positive distance opens, a negative one closes.

    Raises what `OpeningMotion` raises; also `EnvironmentManipulationImpossible` for a distance beyond its limits.

    Attributes:
        part_of: the furniture.
        gripper: the tool frame of the arm.
        drawer_joint: one of the joints above the handle.
        drawer_handle: the link that the hand holds.
        distance: m, or rad for a door.
    """

    concept: ClassVar[str | None] = "Accessing"

    part_of: objects.ObjectDesignator | Object
    arm: poses.Arms
    gripper: str
    drawer_joint: str
    drawer_handle: str
    distance: float

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm)

    async def perform(self) -> None:
        with failures.reaching_for(self.drawer_handle):
            await execute(self, "accessing")


# === perception ===============================================================================================
#
# Perceive objects of a type, with the head's camera or by a query of the world.
#
# The camera perceives an object whose centre is in the field of view and of which at most a fifth is hidden. If it
# perceives none, the failure names the reason for every object of that type.

Source: TypeAlias = Literal["camera", "world_state"]

SEEN_SHARE_MIN = 0.8
"""Minimum visible share of a perceived object."""


async def report_perception(
    looking: Awaitable[Sequence[Seen]], *, source: Source, object_type: poses.ObjectType
) -> objects.ObjectDesignator:
    """Report a perception to the observer, also an empty one, and return the designator of the first percept.

    That is the designator of the world object that it matches, with the object's pose in the world, or a
    `BelieveObject` with the perceived pose.

    Raises:
        PerceptionObjectNotFound: no object was perceived.
    """
    seen: tuple[Seen, ...] = ()
    try:
        seen = tuple(await looking)
    except failures.PerceptionObjectNotFound:
        _notify(source, object_type, seen)
        raise
    _notify(source, object_type, seen)
    if not seen:
        raise failures.PerceptionObjectNotFound(f"no {object_type.name} was perceived", object_type)
    return objects.designator_of(seen[0].thing)


def seen_by_camera(robot: objects.CurrentRobot, object_type: poses.ObjectType) -> tuple[Seen, ...]:
    """Return the objects of that type that the head's camera perceives, the most visible first.

    The robot itself and the objects it carries do not occlude.

    Raises:
        PerceptionObjectNotFound: no object is visible; its data are the type and the reason for each object by name.
    """
    camera = robot.camera_pose()
    seen: list[Seen] = []
    unseen: dict[str, str] = {}
    for obj in objects.require_world().objects:
        if obj.object_type is not object_type or obj is robot.body:
            continue
        share, reason = _visibility(robot, camera, obj)
        if reason is None:
            seen.append(Seen(obj, share))
        else:
            unseen[obj.name] = reason
    if not seen:
        reasons = "; ".join(f"{name} {reason}" for name, reason in unseen.items())
        count = f"{len(unseen)} in the world: {reasons}" if unseen else "there is none in the world"
        raise failures.PerceptionObjectNotFound(f"no {object_type.name} is seen; {count}", object_type, unseen)
    return tuple(sorted(seen, key=lambda each: -(each.visible or 0.0)))


def objects_in_world(object_type: poses.ObjectType) -> tuple[Seen, ...]:
    """Return the world's objects of that type in the order of their creation. Raises `PerceptionObjectNotFound`."""
    detections = tuple(Seen(obj) for obj in objects.require_world().objects if obj.object_type is object_type)
    if not detections:
        raise failures.PerceptionObjectNotFound(f"there is no {object_type.name} in the world", object_type)
    return detections


def in_field_of_view(camera: poses.Pose, view: FieldOfView, point: Sequence[float]) -> bool:
    """Return whether the point (m, map) is in the image of a camera whose optical frame is at that pose."""
    x, y, z = poses.Pose(point).relative_to(camera).position
    return abs(math.atan2(x, z)) <= view.horizontal / 2 and abs(math.atan2(y, z)) <= view.vertical / 2


def _notify(source: Source, object_type: poses.ObjectType, seen: tuple[Seen, ...]) -> None:
    observer = recorder.get()
    if observer is not None:
        observer.object_detected(source=source, object_type=object_type, seen=seen, node=current_node.get())


def _visibility(robot: objects.CurrentRobot, camera: poses.Pose, obj: Object) -> tuple[float, str | None]:
    """Return the object's visible share, and the reason why it is not perceived, or None if it is."""
    if not in_field_of_view(camera, robot.description.camera_view_rad, obj.bounding_box().centre):
        return 0.0, "is outside the camera's field of view"
    hits = obj.world.met_towards(obj, camera.position, ignore=robot.with_load())
    if not hits:
        return 0.0, "has no shape that could be seen"
    counts = Counter("the floor" if each is None else each.name for each in hits)
    share = counts.pop(obj.name, 0) / len(hits)
    if share >= SEEN_SHARE_MIN:
        return share, None
    hiding = ", ".join(f"{name} hides {count / len(hits):.0%}" for name, count in counts.most_common())
    return share, f"is hidden: {hiding} of it"


# === robot choice =============================================================================================
#
# Keep the robot chosen for the motions of the current context, and execute motions with its process modules.

_chosen: ContextVar[tuple[ChosenRobot, ...]] = ContextVar("_chosen", default=())


def execute(motion: Performable, module: str) -> Awaitable[Any]:
    """Execute the motion with the method of this name of the innermost choice; see `ProcessModules` for its result.

    Raises:
        NoRobotChosen: no robot is chosen in this context.
        CapabilityAbsenceFailure: the modules lack the method.
    """
    robot = innermost_choice()
    if robot is None:
        raise failures.NoRobotChosen(type(motion).__name__)
    method = getattr(robot.modules, module, None)
    if method is None:
        name = type(motion).__name__
        message = f"the {robot.name} robot cannot do {name}: {type(robot.modules).__name__} has no method {module!r}"
        raise failures.CapabilityAbsenceFailure(message, robot.name, name)
    executing: Awaitable[Any] = method(motion)
    return executing


def innermost_choice() -> ChosenRobot | None:
    """Return the innermost choice; None without one."""
    return next(reversed(_chosen.get()), None)


def chosen_limits() -> Limits:
    """Return the arm limits of the innermost choice; soft limits without a choice."""
    choice = innermost_choice()
    return choice.limits if choice is not None else Limits.SOFT


def collisions_count() -> bool:
    """Return whether collisions count for the innermost choice; False without a choice."""
    choice = innermost_choice()
    return choice is not None and choice.collisions


# === simulated robot ==========================================================================================
#
# Execute motions as exact jumps of the robot in the world: no duration, no noise, collision checks on request.
#
# A motion either has its whole effect, and the world notifies its observers once per moved object, or it fails and has
# none.


class SimulatedModules:
    """The process modules of `with simulated_robot:`; inverse kinematics keeps the arms within `limits`.

    `errors` are those that it makes, in words; this robot makes none.
    With `collisions` a goal is refused at which the arm or the held object, or the base, collides with another object;
    the gripper itself may collide if the motion allows it. Driving moves the whole robot, but arms and held objects are
    checked only by their own motions.
    """

    errors = ""

    def __init__(self, limits: Limits, *, collisions: bool = False) -> None:
        self._limits = limits
        self._collisions = collisions

    async def navigate(self, motion: MoveMotion) -> None:
        robot = objects.require_robot()
        if robot.description.drive is Drive.FIXED:
            raise robot.absence("drive: its base is fixed")
        if self._collisions:
            _check_base_clear(robot, motion.target)
        robot.body.set_pose(motion.target)

    async def move_tcp(self, motion: MoveTCPMotion) -> None:
        robot = objects.require_robot()
        answers = self._postures(robot, motion.arm, motion.target)
        robot.body.set_joint_positions(self._clear(robot, motion, answers) if self._collisions else next(answers))

    async def looking(self, motion: LookingMotion) -> None:
        robot = objects.require_robot()
        objects.check_in_map(motion.target)
        robot.body.set_joint_positions(head_joints(robot, motion.target))

    async def move_gripper(self, motion: MoveGripperMotion) -> None:
        robot = objects.require_robot()
        joints: dict[str, float] = {}
        for arm in robot.each_arm(motion.gripper):
            joints |= robot.gripper_joints(arm, motion.motion)
        robot.body.set_joint_positions(joints)

    async def move_arm_joints(self, motion: MoveArmJointsMotion) -> None:
        robot = objects.require_robot()
        targets: dict[str, float] = {}
        for arm, positions in ((poses.Arms.LEFT, motion.left_arm_poses), (poses.Arms.RIGHT, motion.right_arm_poses)):
            for joint in positions or {}:
                if joint not in (joints := robot.one_arm(arm).joints):
                    raise poses.UnknownJoint(f"{robot.body.name}, {arm.name} arm", joint, joints)
            targets |= positions or {}
        _set_joints(robot, targets)

    async def move_joints(self, motion: MoveJointsMotion) -> None:
        _set_joints(objects.require_robot(), dict(zip(motion.names, motion.positions, strict=True)))

    async def detecting(self, motion: DetectingMotion) -> Sequence[Seen]:
        return seen_by_camera(objects.require_robot(), motion.object_type)

    async def world_state_detecting(self, motion: WorldStateDetectingMotion) -> Sequence[Seen]:
        return objects_in_world(motion.object_type)

    async def open(self, motion: OpeningMotion) -> None:
        handle = geometry.handle_of(motion.object_part)
        self._move_handle(objects.require_robot(), motion.arm, handle, geometry.opened_position(handle))

    async def close(self, motion: ClosingMotion) -> None:
        handle = geometry.handle_of(motion.object_part)
        self._move_handle(objects.require_robot(), motion.arm, handle, geometry.closed_position(handle))

    async def accessing(self, motion: AccessingMotion) -> None:
        robot = objects.require_robot()
        tool_frame = robot.one_arm(motion.arm).tool_frame
        if motion.gripper != tool_frame:
            message = f"the gripper of the {motion.arm.name} arm is {tool_frame}, not {motion.gripper}"
            raise failures.IllPosedGoalFailure(message, motion.gripper)
        handle = geometry.handle_of(objects.ObjectPart(motion.drawer_handle, motion.part_of), motion.drawer_joint)
        self._move_handle(robot, motion.arm, handle, geometry.moved_position(handle, motion.distance))

    def _move_handle(self, robot: objects.CurrentRobot, arm: poses.Arms, handle: geometry.Handle, goal: float) -> None:
        """Move the handle's joint to `goal` together with the hand, which keeps its pose relative to the handle."""
        geometry.check_same_world(robot, handle.whole)
        tool_frame = robot.one_arm(arm).tool_frame
        tool = robot.tool_pose(arm)
        distance = geometry.distance_to_box(tool, handle.whole.bounding_box(handle.link))
        if distance > geometry.HOLD_DISTANCE_M_MAX:
            message = f"{tool_frame} is not on {handle.link} but {distance:.3f} m away: grasp it first"
            raise failures.EnvironmentManipulationImpossible(message, handle.link, distance)
        grip = tool.relative_to(handle.whole.link_pose(handle.link))
        path = [next(self._postures(robot, arm, each @ grip)) for each in geometry.handle_poses(handle, goal)]
        robot.body.set_joint_positions(path[-1])
        handle.whole.set_joint_position(handle.joint, goal)

    def _postures(self, robot: objects.CurrentRobot, arm: poses.Arms, target: poses.Pose) -> Iterator[dict[str, float]]:
        """Yield the arm's joint angles for a tool frame at the target. Raises `IKError` if there are none."""
        tool_frame = robot.one_arm(arm).tool_frame
        try:
            yield from postures(robot.body, arm, target, limits=self._limits)
        except Unreachable as unreachable:
            raise failures.IKError(target, arm, tool_frame, unreachable.reason) from unreachable

    def _clear(
        self, robot: objects.CurrentRobot, motion: MoveTCPMotion, answers: Iterator[dict[str, float]]
    ) -> dict[str, float]:
        """Return the first posture at which neither the arm nor the held object collides.

        Raises `ManipulationGoalInCollision`.
        """
        held = [obj for obj, link in robot.body.attachments.items() if link == robot.one_arm(motion.arm).tool_frame]
        may_touch = bool(motion.allow_gripper_collision)
        clear = clear_posture(robot, motion.arm, answers, gripper_may_touch=may_touch, held=held)
        if isinstance(clear, dict):
            return clear
        part, obj = clear
        message = f"at its goal the {motion.arm.name} arm would be in {obj.name} with {part}"
        raise failures.ManipulationGoalInCollision(message, part, obj.name)


def clear_posture(
    robot: objects.CurrentRobot,
    arm: poses.Arms,
    answers: Iterable[dict[str, float]],
    *,
    gripper_may_touch: bool,
    held: Sequence[Object] = (),
    base: poses.Pose | None = None,
) -> dict[str, float] | tuple[str, Object]:
    """Return the first of these postures at which the arm does not collide, or the first posture's collision.

    There is at least one posture. A collision is returned as by `arm_collision`, if the arm collides at each of them.
    """
    first: tuple[str, Object] | None = None
    for joints in answers:
        collision = arm_collision(robot, arm, joints, gripper_may_touch=gripper_may_touch, held=held, base=base)
        if collision is None:
            return joints
        first = first or collision
    assert first is not None
    return first


def arm_collision(
    robot: objects.CurrentRobot,
    arm: poses.Arms,
    joints: Mapping[str, float],
    *,
    gripper_may_touch: bool,
    held: Sequence[Object] = (),
    base: poses.Pose | None = None,
) -> tuple[str, Object] | None:
    """Return the first link of an arm, or held object, that would be in another object, and that object.

    The robot is taken at its pose unless `base` is passed. Nothing is moved.
    """
    body, described = robot.body, robot.one_arm(arm)
    last = described.joints[-1] if gripper_may_touch else None
    above = {link: body.joints_above(link) for link in body.links if body.body.solids[link]}
    links = [link for link, joints in above.items() if described.joints[0] in joints and last not in joints]
    return next(iter(collisions_at(body, joints, links=links, carried=held, base=base)), None)


def _check_base_clear(robot: objects.CurrentRobot, goal: poses.Pose) -> None:
    """Raise `NavigationGoalInCollision` if the base, the torso or the head collides at this pose of the base."""
    objects.check_in_map(goal)
    links = robot.base_links()
    carried = [obj for obj, link in robot.body.attachments.items() if (link or robot.body.body.base) in links]
    collisions = collisions_at(robot.body, {}, links=links, carried=carried, base=goal)
    if collisions:
        part, obj = collisions[0]
        message = f"at its goal the base would be in {obj.name} with {part}"
        raise failures.NavigationGoalInCollision(message, part, obj.name)


def _set_joints(robot: objects.CurrentRobot, positions: Mapping[str, float]) -> None:
    body, description = robot
    try:
        body.set_joint_positions(positions)
    except (poses.JointLimitExceeded, poses.JointFollows) as exceeded:
        if description.torso_joint is not None and [*positions] == [description.torso_joint]:
            raise failures.TorsoGoalUnreachable(str(exceeded), positions[description.torso_joint]) from exceeded
        raise failures.ConfigurationNotReached(str(exceeded), dict(positions)) from exceeded


# === process modules ==========================================================================================
#
# Choose the robot whose process modules execute the motions of the current context: `with simulated_robot:`.
#
# Choices nest, end with their block, and are inherited by tasks that start inside. A user's own robot is a class with
# these methods: `with ChosenRobot("mine", MyModules()):`; a motion without a method fails with
# `CapabilityAbsenceFailure`. Arms keep to their soft limits; in `with simulated_robot_within(Limits.HARD):` they move
# up to the mechanical stops.


class MovingModules(Protocol):
    """The motions of the robot itself, the minimum that a user's own robot implements.

    One method per motion; it returns when the motion has ended and raises a `PlanFailure` if it failed.
    """

    async def navigate(self, motion: MoveMotion) -> None: ...

    async def move_tcp(self, motion: MoveTCPMotion) -> None: ...

    async def looking(self, motion: LookingMotion) -> None: ...

    async def move_gripper(self, motion: MoveGripperMotion) -> None: ...

    async def move_arm_joints(self, motion: MoveArmJointsMotion) -> None: ...

    async def move_joints(self, motion: MoveJointsMotion) -> None: ...


class ProcessModules(MovingModules, Protocol):
    """All motions, including the optional ones: perceiving, opening and closing.

    Perceiving returns the percepts, the best first, or raises `PerceptionObjectNotFound` with the reason. All are
    recorded, and the motion returns the first. A percept that matches no object of the world is a `Seen` of a
    `BelieveObject`.
    """

    async def detecting(self, motion: DetectingMotion) -> Sequence[Seen]: ...

    async def world_state_detecting(self, motion: WorldStateDetectingMotion) -> Sequence[Seen]: ...

    async def open(self, motion: OpeningMotion) -> None: ...

    async def close(self, motion: ClosingMotion) -> None: ...

    async def accessing(self, motion: AccessingMotion) -> None: ...


class ChosenRobot:
    """A choice of process modules; inside its `with` block they execute the motions of the context.

    Args:
        name: used in messages.
        modules: the robot's modules; a method of `ProcessModules` that they lack is a motion the robot cannot execute.
        limits: joint limits of its arms, used by searches that check reachability (`CostmapLocation`).
        collisions: whether searches refuse places where its base would collide, and grippers refuse objects that do
            not fit them (`geometry.check_fits`).
    """

    def __init__(
        self, name: str, modules: MovingModules, *, limits: Limits = Limits.SOFT, collisions: bool = False
    ) -> None:
        self.name = name
        self.modules = modules
        self.limits = limits
        self.collisions = collisions

    def __enter__(self) -> Self:
        _chosen.set((*_chosen.get(), self))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        _chosen.set(_chosen.get()[:-1])

    def __repr__(self) -> str:
        return f"<{self.name} robot>"


def simulated_robot_within(limits: Limits, *, collisions: bool = False) -> ChosenRobot:
    """Return the simulated robot with these limits of the arms' joints.

    Soft limits are those of the thesis' experiments. Within hard limits an arm reaches about twice as many poses, also
    from above with the torso down.

    Args:
        limits: limits of the arms' joints.
        collisions: whether a goal at which the arm or the held object collides raises `ManipulationGoalInCollision`,
            and one at which the base collides `NavigationGoalInCollision`. A motion may allow collisions of the
            gripper. Paths are not checked. Location designators then offer only places where the base, with its
            heading, is clear, and a gripper refuses an object that does not fit it (`geometry.check_fits`).

    >>> with simulated_robot_within(Limits.HARD):
    ...     await MoveTCPMotion(Pose([0.9495, 0.188, 0.790675]), Arms.LEFT).perform()
    """
    name = f"simulated ({limits.name.lower()} limits{', minding collisions' if collisions else ''})"
    return ChosenRobot(name, SimulatedModules(limits, collisions=collisions), limits=limits, collisions=collisions)


simulated_robot = simulated_robot_within(Limits.SOFT)
"""The robot of the current world, moved kinematically: instantly, exactly, without physics."""
