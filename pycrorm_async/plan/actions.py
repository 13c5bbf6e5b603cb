"""Built-in actions of a mobile manipulator, and descriptions that resolve to them.

**Basic.** Basic actions: posture, driving, looking, picking up and placing.

Actions with handles and grippers are in `actions`, detection and transport in `actions`. Each
action is recorded with its fields; concepts are those of SOMA. Positions are in metres in the map, angles in rad.
Descriptions with alternatives are in `actions`.

>>> await PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT).perform()

**Manipulation.** Actions of one gripper: hold and release objects, grasp handles, open and close drawers and doors.

>>> handle = ObjectPart("sink_area_drawer_handle", kitchen)
>>> await OpenActionPerformable(handle, Arms.LEFT).perform()

**Transport.** Actions that detect an object, and that transport one to a target pose.

>>> milk = await DetectActionPerformable(BelieveObject("milk", ObjectType.MILK, Pose([1.3, 1, 0.9]))).perform()
>>> await TransportActionPerformable(milk, Arms.LEFT, Pose([1.3, 0.6, 0.95])).perform()
"""

import asyncio
import itertools
import math
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterable, Iterator, Sequence
from contextlib import aclosing
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, Protocol, TypeAlias, TypeVar

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import failures, geometry, objects
from pycrorm_async.plan import motions as robot_motions
from pycrorm_async.plan.failures import arms
from pycrorm_async.plan.field_types import check_properties
from pycrorm_async.plan.language import ActionAbstract, ActionDescription
from pycrorm_async.plan.locations import CostmapLocation, Location, LocationDesignator
from pycrorm_async.world.bullet import Object
from pycrorm_async.world.pose import Arms, Grasp, GripperState, Pose, dot, yaw_quaternion
from pycrorm_async.world.urdf import Drive

# === basic ====================================================================================================


class CheckedAction(ActionAbstract):
    """An action whose fields are checked when it is built. Raises `ResolutionError`."""

    def __post_init__(self) -> None:
        check_properties(self)


@dataclass
class MoveTorsoActionPerformable(CheckedAction):
    """Lift or lower the torso to `position` (m). Raises `TorsoGoalUnreachable`, `CapabilityAbsenceFailure`."""

    concept: ClassVar[str | None] = "MoveTorso"

    position: float

    def resources(self) -> frozenset[failures.Resource]:
        return frozenset({failures.Resource.TORSO})

    async def perform(self) -> None:
        await robot_motions.MoveJointsMotion([objects.require_robot().torso_joint()], [self.position]).perform()


@dataclass
class SetGripperActionPerformable(CheckedAction):
    """Open or close a gripper."""

    concept: ClassVar[str | None] = "SettingGripper"

    gripper: Arms
    motion: GripperState

    def resources(self) -> frozenset[failures.Resource]:
        return arms(self.gripper)

    async def perform(self) -> None:
        await robot_motions.MoveGripperMotion(self.motion, self.gripper).perform()


@dataclass
class ParkArmsActionPerformable(CheckedAction):
    """Move an arm, or both, to the folded park posture. Raises `CapabilityAbsenceFailure` for an arm without one."""

    concept: ClassVar[str | None] = "ParkingArms"

    arm: Arms

    def resources(self) -> frozenset[failures.Resource]:
        return arms(self.arm)

    async def perform(self) -> None:
        robot = objects.require_robot()
        parked = {arm: robot.parked(arm) for arm in robot.each_arm(self.arm)}
        if self.arm not in (Arms.LEFT, Arms.RIGHT, Arms.BOTH):
            joints = parked[self.arm]
            await robot_motions.MoveJointsMotion([*joints], [*joints.values()]).perform()
            return
        await robot_motions.MoveArmJointsMotion(parked.get(Arms.LEFT), parked.get(Arms.RIGHT)).perform()


@dataclass
class NavigateActionPerformable(CheckedAction):
    """Drive to a place."""

    concept: ClassVar[str | None] = "Navigating"

    target_location: Pose

    def resources(self) -> frozenset[failures.Resource]:
        return frozenset({failures.Resource.BASE})

    async def perform(self) -> None:
        await robot_motions.MoveMotion(self.target_location).perform()


@dataclass
class LookAtActionPerformable(CheckedAction):
    """Turn the head to a point."""

    concept: ClassVar[str | None] = "LookingAt"

    target: Pose

    def resources(self) -> frozenset[failures.Resource]:
        return frozenset({failures.Resource.HEAD})

    async def perform(self) -> None:
        await robot_motions.LookingMotion(self.target).perform()


@dataclass
class PickUpActionPerformable(CheckedAction):
    """Grasp an object with one arm and lift it by 3 cm; afterwards it is attached to the gripper.

    `grasp` sets the gripper's orientation in the object's own axes. The gripper opens 0.1 m before the object, measured
    along its fingers; those of a PR2 in the direction in which they point when the action begins.

    Raises:
        IKError: one of the three goals of the arm is out of reach.
        EndEffectorFailure: the gripper holds another object.
        PerceptionObjectNotInWorld: the object is not in the robot's world.
        IllPosedGoalFailure: `arm` is not a single arm, or the object is furniture or a robot.
        CapabilityAbsenceFailure: the robot has no such arm; or the object is heavier than the arm's payload; or
            collisions count, and the object does not fit the gripper (`geometry.check_fits`).
    """

    concept: ClassVar[str | None] = "PickingUp"

    object_designator: objects.ObjectDesignator | Object
    arm: Arms
    grasp: Grasp

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm)

    async def perform(self) -> None:
        robot = objects.require_robot()
        target = objects.in_world(self.object_designator)
        geometry.check_takable(robot, self.arm, target)
        if robot_motions.collisions_count():
            geometry.check_fits(robot, self.arm, target, geometry.grasping_pose(target.pose, self.grasp))
        arm, tool = self.arm, robot.tool_pose(self.arm)
        before, at, above = geometry.pick_up_poses(robot.description, target.pose, self.grasp, tool)
        reach = partial(robot_motions.MoveTCPMotion, arm=arm, allow_gripper_collision=True, _object_name=target.name)
        await reach(before).perform()
        await robot_motions.MoveGripperMotion(GripperState.OPEN, self.arm).perform()
        await reach(at).perform()
        await robot_motions.MoveGripperMotion(GripperState.CLOSE, self.arm).perform()
        geometry.take(robot, self.arm, target)
        await reach(above).perform()


@dataclass
class PlaceActionPerformable(CheckedAction):
    """Place the held object at `target_location`; the gripper ends 7 cm behind it.

    Raises:
        IKError: the target or the retracted pose is out of reach; only in the latter case the object is placed.
        ObjectLost: the gripper does not hold the object.
        PerceptionObjectNotInWorld: the object is not in the robot's world.
    """

    concept: ClassVar[str | None] = "Placing"

    object_designator: objects.ObjectDesignator | Object
    arm: Arms
    target_location: Pose

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm)

    async def perform(self) -> None:
        robot = objects.require_robot()
        body, held = robot.body, objects.in_world(self.object_designator)
        tool_frame = robot.one_arm(self.arm).tool_frame
        if body.attachments.get(held) != tool_frame:
            raise failures.ObjectLost(f"the {self.arm.name} gripper does not hold {held.name}", held.name)
        goal = geometry.place_pose(self.target_location, held.pose, robot.tool_pose(self.arm))
        await robot_motions.MoveTCPMotion(goal, self.arm, _object_name=held.name).perform()
        await robot_motions.MoveGripperMotion(GripperState.OPEN, self.arm).perform()
        body.detach(held)
        await robot_motions.MoveTCPMotion(geometry.retract(goal), self.arm, _object_name=held.name).perform()


@dataclass
class FaceAtPerformable(CheckedAction):
    """Rotate the base on the spot to face a point, and look at it."""

    concept: ClassVar[str | None] = "LookingAt"

    pose: Pose

    def resources(self) -> frozenset[failures.Resource]:
        return frozenset({failures.Resource.BASE, failures.Resource.HEAD})

    async def perform(self) -> None:
        base = objects.require_robot().body.pose
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
    object_designator: objects.ObjectDesignator | Object
    arm: Arms
    grasp: Grasp
    policy: str | None = field(default=None, kw_only=True)

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm) | {failures.Resource.HEAD}

    async def perform(self) -> None:
        await NavigateActionPerformable(self.standing_position).perform()
        await FaceAtPerformable(objects.designator_of(self.object_designator).pose).perform()
        await PickUpActionPerformable(self.object_designator, self.arm, self.grasp).perform()


# === manipulation =============================================================================================


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
            collisions count, and the object does not fit the gripper (`geometry.check_fits`).
    """

    concept: ClassVar[str | None] = "Holding"

    gripper: Arms
    object_designator: objects.ObjectDesignator | Object
    effort: float

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.gripper)

    async def perform(self) -> None:
        robot = objects.require_robot()
        target = objects.in_world(self.object_designator)
        if not self.effort >= 0:
            raise failures.IllPosedGoalFailure(f"effort must be >= 0 N, got {self.effort} N", self.effort)
        geometry.check_takable(robot, self.gripper, target)
        tool = robot.tool_pose(self.gripper)
        distance = min(geometry.distance_to_box(tool, target.bounding_box(link)) for link in target.links)
        if distance > geometry.HOLD_DISTANCE_M_MAX:
            message = (
                f"the {self.gripper.name} gripper would close on nothing: {target.name} is {distance:.3f} m from it"
            )
            raise failures.GripperClosedCompletely(message, target.name, distance)
        if robot_motions.collisions_count():
            geometry.check_fits(robot, self.gripper, target, tool)
        await robot_motions.MoveGripperMotion(GripperState.CLOSE, self.gripper).perform()
        geometry.take(robot, self.gripper, target)


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
    object_designator: objects.ObjectDesignator | Object

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.gripper)

    async def perform(self) -> None:
        robot = objects.require_robot()
        tool_frame = robot.one_arm(self.gripper).tool_frame
        held = objects.in_world(self.object_designator)
        if robot.body.attachments.get(held) != tool_frame:
            raise failures.ObjectLost(f"the {self.gripper.name} gripper does not hold {held.name}", held.name)
        await robot_motions.MoveGripperMotion(GripperState.OPEN, self.gripper).perform()
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
    object_desig: objects.ObjectDesignator | Object

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm)

    async def perform(self) -> None:
        robot = objects.require_robot()
        goal, name = geometry.grasp_pose(self.object_desig), self.object_desig.name
        geometry.check_free(robot, self.arm)
        await robot_motions.MoveTCPMotion(geometry.approach(goal), self.arm, _object_name=name).perform()
        await robot_motions.MoveGripperMotion(GripperState.OPEN, self.arm).perform()
        await robot_motions.MoveTCPMotion(goal, self.arm, allow_gripper_collision=True, _object_name=name).perform()
        await robot_motions.MoveGripperMotion(GripperState.CLOSE, self.arm, allow_gripper_collision=True).perform()


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

    object_designator: objects.ObjectPart
    arm: Arms

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm)

    async def perform(self) -> None:
        geometry.handle_of(self.object_designator)
        await GraspingActionPerformable(self.arm, self.object_designator).perform()
        await robot_motions.OpeningMotion(self.object_designator, self.arm).perform()
        await robot_motions.MoveGripperMotion(GripperState.OPEN, self.arm, allow_gripper_collision=True).perform()


@dataclass
class CloseActionPerformable(CheckedAction):
    """Close a drawer or a door by its handle; the open hand stays at the handle. Raises what `OpenAction` raises."""

    concept: ClassVar[str | None] = "Closing"

    object_designator: objects.ObjectPart
    arm: Arms

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(self.arm)

    async def perform(self) -> None:
        geometry.handle_of(self.object_designator)
        await GraspingActionPerformable(self.arm, self.object_designator).perform()
        await robot_motions.ClosingMotion(self.object_designator, self.arm).perform()
        await robot_motions.MoveGripperMotion(GripperState.OPEN, self.arm, allow_gripper_collision=True).perform()


# === transport ================================================================================================


@dataclass
class DetectActionPerformable(CheckedAction):
    """Detect objects of the same type as the designated one and return the most visible one.

    The designated object may be a `BelieveObject`. The head does not move. Raises `PerceptionObjectNotFound`, which
    names the reason for each object.
    """

    concept: ClassVar[str | None] = "LookingFor"

    object_designator: objects.ObjectDesignator | Object

    def resources(self) -> frozenset[failures.Resource]:
        return frozenset({failures.Resource.HEAD})

    async def perform(self) -> objects.ObjectDesignator:
        return await robot_motions.DetectingMotion(self.object_designator.object_type).perform()


class TransportWays(Protocol):
    """A source of ways to fetch an object and to place it; `learning.TransportPolicy` takes them from experience."""

    def fetching(
        self, target: objects.ObjectDesignator | Object, arms: Sequence[Arms], goal: Pose
    ) -> AsyncIterator[MoveAndPickUpPerformable]:
        """Iterate over ways to pick up the object so that it can be placed at the goal, the likeliest first."""
        ...

    def placing(self, held: objects.ObjectDesignator | Object, arm: Arms, goal: Pose) -> LocationDesignator:
        """Return the places, with heights of the torso, from which the arm places the held object, likeliest first."""
        ...


@dataclass
class _Way:
    """The way that a `TransportWays` has chosen: the pick-up, and the next place for placing that was not tried yet."""

    fetch: MoveAndPickUpPerformable | None
    next_place: Callable[[], Awaitable[Location | None]]


@dataclass
class TransportActionPerformable(CheckedAction):
    """Pick up an object with one arm and place it at `target_location`; arms are parked while driving.

    The action searches its base poses itself (`CostmapLocation`), with the torso as it is, and picks up from the front.
    One of a `TransportAction` with a policy picks up and places in the ways that the policy chose. An object that the
    arm already holds is only delivered.

    Raises:
        ObjectUnfetchable: no base pose allows the pick-up.
        ReachabilityFailure: no base pose allows the placing; the arm keeps holding the object.
        EndEffectorFailure: the arm holds another object.
        PerceptionObjectNotInWorld: the object is not in the robot's world.
        IllPosedGoalFailure, CapabilityAbsenceFailure: `arm` is not a single arm, or a gripper cannot hold the object;
            the robot has no such arm, or collisions count and the object does not fit the gripper.
    """

    concept: ClassVar[str | None] = "Transporting"

    object_designator: objects.ObjectDesignator | Object
    arm: Arms
    target_location: Pose
    _way: _Way | None = field(default=None, repr=False, compare=False)

    def resources(self) -> frozenset[failures.Resource]:
        return failures.reaching(Arms.BOTH)

    async def perform(self) -> None:
        robot = objects.require_robot()
        tool_frame = robot.one_arm(self.arm).tool_frame
        target = objects.in_world(self.object_designator)
        geometry.check_takable(robot, self.arm, target)
        is_held = robot.body.attachments.get(target) == tool_frame
        fetch = self._way.fetch if self._way is not None else None
        if robot_motions.collisions_count() and not is_held and fetch is None:
            geometry.check_fits(robot, self.arm, target, geometry.grasping_pose(target.pose, Grasp.FRONT))
        await self._park_arms()
        if not is_held:
            if fetch is not None:
                await fetch.perform()
            else:
                await self._drive(self._fetching_pose(robot.body))
                await PickUpActionPerformable(self.object_designator, self.arm, Grasp.FRONT).perform()
            await self._park_arms()
        place = await self._placing_place(robot.body)
        if place.torso_height is not None:
            await MoveTorsoActionPerformable(place.torso_height).perform()
        await self._drive(place.pose)
        await PlaceActionPerformable(self.object_designator, self.arm, self.target_location).perform()
        await self._park_arms()

    async def _placing_place(self, body: Object) -> Location:
        if self._way is None:
            return CostmapLocation(self.target_location, reachable_for=body, reachable_arm=self.arm).resolve()
        place = await self._way.next_place()
        if place is None:
            message = f"there is no other place to stand and reach {self.target_location}"
            raise failures.ReachabilityFailure(message, self.target_location)
        return place

    async def _park_arms(self) -> None:
        """Park every arm that has a park posture."""
        foldable = [arm for arm, each in objects.require_robot().description.arms.items() if each.park]
        both = {Arms.LEFT, Arms.RIGHT}
        if both <= {*foldable}:
            foldable = [Arms.BOTH, *(arm for arm in foldable if arm not in both)]
        for arm in foldable:
            await ParkArmsActionPerformable(arm).perform()

    async def _drive(self, place: Pose) -> None:
        """Drive to a place; a robot with a fixed base is offered no other place than its own."""
        if objects.require_robot().description.drive is not Drive.FIXED:
            await NavigateActionPerformable(place).perform()

    def _fetching_pose(self, body: Object) -> Pose:
        try:
            return CostmapLocation(self.object_designator, reachable_for=body, reachable_arm=self.arm).resolve().pose
        except failures.ObjectUnreachable as unreachable:
            raise failures.ObjectUnfetchable(unreachable.message, *unreachable.data) from unreachable


# === descriptions =============================================================================================
#
# Define the descriptions of the built-in actions; `language` defines what they have in common.

T = TypeVar("T")

OneOrMore: TypeAlias = T | Iterable[T]
Objects: TypeAlias = objects.ObjectDesignatorDescription | OneOrMore[objects.ObjectLike]


class MoveTorsoAction(ActionDescription[MoveTorsoActionPerformable]):
    """Lift or lower the torso to one of these positions (m)."""

    def __init__(self, positions: OneOrMore[float]) -> None:
        super().__init__(MoveTorsoActionPerformable, position=positions)


class SetGripperAction(ActionDescription[SetGripperActionPerformable]):
    """Open or close a gripper."""

    def __init__(self, grippers: OneOrMore[Arms], motions: OneOrMore[GripperState]) -> None:
        super().__init__(SetGripperActionPerformable, gripper=grippers, motion=motions)


class ParkArmsAction(ActionDescription[ParkArmsActionPerformable]):
    """Move one of these arms, or both, to the folded park posture."""

    def __init__(self, arms: OneOrMore[Arms]) -> None:
        super().__init__(ParkArmsActionPerformable, arm=arms)


class NavigateAction(ActionDescription[NavigateActionPerformable]):
    """Drive to one of these places."""

    def __init__(self, target_locations: OneOrMore[Pose]) -> None:
        super().__init__(NavigateActionPerformable, target_location=target_locations)


class LookAtAction(ActionDescription[LookAtActionPerformable]):
    """Turn the head to one of these points."""

    def __init__(self, targets: OneOrMore[Pose]) -> None:
        super().__init__(LookAtActionPerformable, target=targets)


class PickUpAction(ActionDescription[PickUpActionPerformable]):
    """Pick up an object: a given one, one of several, or one that matches a description."""

    _lifting = "arm", "object_designator"

    def __init__(self, object_designator_description: Objects, arms: OneOrMore[Arms], grasps: OneOrMore[Grasp]) -> None:
        super().__init__(
            PickUpActionPerformable,
            object_designator=object_designator_description,
            arm=arms,
            grasp=grasps,
        )


class PlaceAction(ActionDescription[PlaceActionPerformable]):
    """Place the held object at one of these poses."""

    def __init__(
        self, object_designator_description: Objects, target_locations: OneOrMore[Pose], arms: OneOrMore[Arms]
    ) -> None:
        super().__init__(
            PlaceActionPerformable,
            object_designator=object_designator_description,
            arm=arms,
            target_location=target_locations,
        )


class GripAction(ActionDescription[GripActionPerformable]):
    """Close a gripper on an object between its fingers, with one of these efforts (N)."""

    _lifting = "gripper", "object_designator"

    def __init__(
        self, grippers: OneOrMore[Arms], object_designator_description: Objects, efforts: OneOrMore[float]
    ) -> None:
        super().__init__(
            GripActionPerformable,
            gripper=grippers,
            object_designator=object_designator_description,
            effort=efforts,
        )


class ReleaseAction(ActionDescription[ReleaseActionPerformable]):
    """Release a held object."""

    def __init__(self, grippers: OneOrMore[Arms], object_designator_description: Objects) -> None:
        super().__init__(ReleaseActionPerformable, gripper=grippers, object_designator=object_designator_description)


class GraspingAction(ActionDescription[GraspingActionPerformable]):
    """Close a gripper around an object or a handle."""

    def __init__(self, arms: OneOrMore[Arms], object_description: Objects) -> None:
        super().__init__(GraspingActionPerformable, arm=arms, object_desig=object_description)


class OpenAction(ActionDescription[OpenActionPerformable]):
    """Open a drawer or a door by one of these handles."""

    def __init__(self, object_designator_description: OneOrMore[objects.ObjectPart], arms: OneOrMore[Arms]) -> None:
        super().__init__(OpenActionPerformable, object_designator=object_designator_description, arm=arms)


class CloseAction(ActionDescription[CloseActionPerformable]):
    """Close a drawer or a door by one of these handles."""

    def __init__(self, object_designator_description: OneOrMore[objects.ObjectPart], arms: OneOrMore[Arms]) -> None:
        super().__init__(CloseActionPerformable, object_designator=object_designator_description, arm=arms)


class DetectAction(ActionDescription[DetectActionPerformable]):
    """Detect an object of the type of one of these."""

    def __init__(self, object_designator_description: Objects) -> None:
        super().__init__(DetectActionPerformable, object_designator=object_designator_description)


class TransportAction(ActionDescription[TransportActionPerformable]):
    """Fetch an object and place it at one of these poses.

    With a `policy`, `async for` and `Retry` get its ways to fetch the object with one of the arms, the likeliest first;
    each alternative is another way, from where the object is by then, and delivers an object that an earlier one has
    picked up. There are no more of them once the object is at its place.

    >>> ways = TransportPolicy(model)  # of pycrorm_async.learning
    >>> await Retry(TransportAction(milk, [Arms.LEFT, Arms.RIGHT], [place], policy=ways), max_tries=5).perform()
    """

    _lifting = "arm", "object_designator"

    def __init__(
        self,
        object_designator_description: Objects,
        arms: OneOrMore[Arms],
        target_locations: OneOrMore[Pose],
        policy: TransportWays | None = None,
    ) -> None:
        super().__init__(
            TransportActionPerformable,
            object_designator=object_designator_description,
            arm=arms,
            target_location=target_locations,
        )
        self._policy = policy

    def resolve(self) -> TransportActionPerformable:
        """Return the first alternative; with a policy a coroutine of it. Raises what the iteration raises."""
        return self._first() if self._policy is not None else super().resolve()  # type: ignore[return-value]

    async def _first(self) -> TransportActionPerformable:
        async with aclosing(self.__aiter__()) as alternatives:
            return await anext(alternatives)

    def __iter__(self) -> Iterator[TransportActionPerformable]:
        """Yield every combination. Raises `CallerError` with a policy, which may query the memory in between."""
        if self._policy is not None:
            raise CallerError("a transport with a policy may query a memory: iterate with `async for`")
        return super().__iter__()

    async def __aiter__(self) -> AsyncGenerator[TransportActionPerformable, None]:
        """Yield what the policy chooses for each object and place; without one, every combination.

        Raises `ObjectUnfetchable` if the policy has no way.
        """
        if self._policy is None:
            for each in super().__iter__():
                yield each
            return
        among, arms, goals = (self._choices(name, each) for name, each in self._alternatives.items())
        offers = False
        for target, goal in itertools.product(among, goals):
            async for each in self._chosen(self._policy, target, arms, goal):
                offers = True
                yield each
                if _is_at(target, goal):
                    return
        if not offers:
            names = ", ".join(each.name for each in among)
            message = f"there is no way to fetch {names} with which it can be placed at its goal"
            raise failures.ObjectUnfetchable(message, names)

    async def _chosen(
        self, policy: TransportWays, target: objects.ObjectDesignator | Object, arms: Sequence[Arms], goal: Pose
    ) -> AsyncGenerator[TransportActionPerformable, None]:
        """Yield the ways to fetch one object for one place, and while it is held, to place it."""
        places: dict[tuple[Arms, Grasp | None], Iterator[Location | None]] = {}
        exhausted: set[tuple[Arms | None, Grasp | None]] = set()

        async def next_place(arm: Arms, grasp: Grasp | None) -> Location | None:
            if (hold := (arm, grasp)) not in places:
                places[hold] = policy.placing(target, arm, goal).steps()
            for place in places[hold]:
                if place is not None:
                    return place
                await asyncio.sleep(0)  # a search may take seconds
            exhausted.add(hold)
            return None

        grasp: Grasp | None = None  # of an object that is held from the start the policy finds the grasp
        ways = policy.fetching(target, arms, goal)
        while ((arm := _holding(target)), grasp) not in exhausted:
            way = await anext(ways, None) if arm is None else None
            if way is not None:
                arm, grasp = way.arm, way.grasp
            if arm is None:
                return
            yield TransportActionPerformable(target, arm, goal, _Way(way, partial(next_place, arm, grasp)))


def _holding(target: objects.ObjectDesignator | Object) -> Arms | None:
    """Return the arm that holds the object; None if none does."""
    body, description = objects.require_robot()
    link = body.attachments.get(objects.in_world(target))
    return next((arm for arm, each in description.arms.items() if each.tool_frame == link), None)


def _is_at(target: objects.ObjectDesignator | Object, goal: Pose) -> bool:
    """Return whether no arm holds the object, and it is at the goal to 1 cm and 5°."""
    pose = objects.in_world(target).pose
    is_there = math.dist(pose.position, goal.position) < 0.01 and abs(dot(pose.orientation, goal.orientation)) > 0.999
    return is_there and _holding(target) is None
