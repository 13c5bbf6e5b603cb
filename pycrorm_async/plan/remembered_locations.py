"""Locations from experience: find places to pick an object up from past successes in the memory, not by search.

>>> stand = await DatabaseCostmapLocation(target=milk, reachable_for=robot).resolve()
>>> if stand is not None:
...     await NavigateActionPerformable(stand.pose).perform()
...     await MoveTorsoActionPerformable(stand.torso_height).perform()
...     await PickUpActionPerformable(milk, stand.reachable_arms[0], stand.grasp).perform()
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator, Sequence
from dataclasses import dataclass, field

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import failures, geometry, locations, objects
from pycrorm_async.plan.execution import Refusal
from pycrorm_async.plan.field_types import check_properties
from pycrorm_async.plan.task import Experience, PastSuccess, experience
from pycrorm_async.world import queries
from pycrorm_async.world.bullet import Object
from pycrorm_async.world.pose import Arms, Pose, rotated, yaw_quaternion

POLICY_CLEARANCE_M = 0.3
"""Minimum distance between the middle of the robot's base and any obstacle, the thesis' value."""
_POLICY_CELLS = 300  # 6 m across: the range of the policies' base poses, with a margin
_UPRIGHT_MIN = 0.99  # the cosine of 8 degrees: a base that leans more is not on the floor


@dataclass(frozen=True)
class DatabaseCostmapLocation:
    """Base poses of past successful pick-ups of the target's type, transferred to the target's current pose.

    Args:
        target: the object to pick up.
        reachable_for: the robot. Restricts the result to places from which it reaches all three goals of the pick-up
            with the arm, grasp and torso height of the past success, with its arms as they are now, within the limits
            of the chosen robot.
        reachable_arm: use only successes with this arm, LEFT or RIGHT; None means any arm that lifts the object, if one
            does.
        experience: the source of past successes; None means the open memory.

    Each place has the arm, the grasp and the torso height of the past success, and is 0.3 m clear of obstacles; where
    collisions count, the base with its heading is clear of them instead. The best place is the one with the highest
    share of successes among the tries like it, for the target's height; failures count. A pick-up of this process
    counts as soon as it has ended, one of another process once it is visible in the memory's tables.

    Raises `CallerError` without a memory or for `Arms.BOTH`; `NoWorld`, `NoRobotHere` and
    `PerceptionObjectNotInWorld`.
    """

    target: objects.ObjectLike
    reachable_for: objects.ObjectLike | None = None
    reachable_arm: Arms | None = None
    experience: Experience | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.target, Object | objects.ObjectDesignator):
            raise CallerError("experience is recorded by the type of an object: pass an object as target, not a place")
        check_properties(self)
        if self.reachable_arm is Arms.BOTH:
            raise CallerError("a pick-up uses one arm: reachable_arm must be LEFT, RIGHT, or None for either of them")

    async def resolve(self) -> locations.Location | None:
        """Return the place with the best experience; None if no past success is usable in the current scene."""
        places = iter(await self.remembered())
        try:
            return next(places, None)
        finally:
            places.close()

    def __aiter__(self) -> AsyncIterator[locations.Location]:
        """Iterate over the places, best first; the last one yielded counts as taken, or none if all were yielded."""
        return _PlaceIterator(self)

    async def remembered(self) -> locations.LocationDesignator:
        """Query the experience once, and return its places as an ordinary location designator."""
        source = self.experience if self.experience is not None else experience.get()
        if source is None:
            raise CallerError(
                "past successes are queried from a memory, and none is open: resolve inside"
                " `async with Memory.open(url)`, or pass one as `experience`"
            )
        robot = locations.resolve_robot(self.reachable_for) if self.reachable_for is not None else None
        height = objects.pose_of(self.target).position.z - locations.base_height_m(robot)
        past = await source.successes(
            objects.designator_of(self.target).object_type, arm=self.reachable_arm, height=height
        )
        return _ExperienceLocation(self.target, self.reachable_for, self.reachable_arm, past)


class _PlaceIterator:
    """An asynchronous iterator; a dropped one is closed at once, an async generator only later by the event loop."""

    def __init__(self, designator: DatabaseCostmapLocation) -> None:
        self._designator = designator
        self._places: Iterator[locations.Location] | None = None

    def __aiter__(self) -> _PlaceIterator:
        return self

    async def __anext__(self) -> locations.Location:
        if self._places is None:
            self._places = iter(await self._designator.remembered())
        for place in self._places:
            return place
        raise StopAsyncIteration


@dataclass(frozen=True)
class _ExperienceLocation(locations.LocationDesignator):
    """The places of a `DatabaseCostmapLocation` after its experience has been queried."""

    target: objects.ObjectLike
    reachable_for: objects.ObjectLike | None
    reachable_arm: Arms | None
    past: Sequence[PastSuccess]

    def _name(self) -> str:
        return DatabaseCostmapLocation.__name__

    def _candidates(self) -> Iterator[locations.Location | Refusal]:
        target_pose = objects.pose_of(self.target)
        robot = locations.resolve_robot(self.reachable_for) if self.reachable_for is not None else None
        origin = Pose((target_pose.position.x, target_pose.position.y, 0.0))
        ignored = robot.with_load() if robot is not None else None
        clearance = locations.base_clearance([robot] if robot is not None else [])
        free = queries.OccupancyCostmap(
            objects.require_world(),
            origin,
            distance_to_obstacle_m=POLICY_CLEARANCE_M,
            size_cells=_POLICY_CELLS,
            ignore=ignored,
        )
        height_m, lifting = locations.base_height_m(robot), self._lifting(robot)
        for each in self.past:
            pose = target_pose @ each.stand
            base_pose = _upright_pose(pose, height_m)
            if base_pose is None:
                yield Refusal(pose, "the base would lean")
                continue
            if clearance is not None:
                refusal = clearance.refusal(base_pose)
            else:
                is_free = free.value_at(*base_pose.position[:2])
                refusal = None if is_free else f"an obstacle is nearer than {POLICY_CLEARANCE_M} m"
            if refusal is None and each.arm not in lifting:
                refusal = f"the {each.arm.name} arm does not lift the object, another one does"
            if refusal is None and robot is not None:
                refusal = _reach(robot, base_pose, target_pose, each).refusal
            if refusal is not None:
                yield Refusal(base_pose, refusal)
            else:
                yield locations.Location(base_pose, (each.arm,), each.grasp, each.torso_height)

    def _lifting(self, robot: objects.CurrentRobot | None) -> tuple[Arms, ...]:
        """Return the arms of past successes to repeat: where the arm is open, those that lift the target."""
        used = dict.fromkeys(each.arm for each in self.past)
        if robot is None or self.reachable_arm is not None:
            return tuple(used)
        return geometry.lifting_arms(robot, [*robot.description.arms, *used], self.target)

    def _no_place_failure(self) -> failures.PlanFailure:
        name = self.target.name
        return failures.ObjectUnreachable(f"no past success is usable for {name} in this scene", name)


def _upright_pose(base: Pose, height_m: float) -> Pose | None:
    """Move the base pose to this height; None if it leans, because the object lies and recorded ones were upright."""
    if rotated(base.orientation, (0.0, 0.0, 1.0)).z < _UPRIGHT_MIN:
        return None
    return Pose((base.position.x, base.position.y, height_m), yaw_quaternion(base.yaw), base.frame)


def _reach(robot: objects.CurrentRobot, base_pose: Pose, target_pose: Pose, past: PastSuccess) -> locations.PlaceReach:
    """Return the arm if it reaches all three goals of the grasp from the base pose at the past torso height."""
    body, description = robot
    if past.arm not in description.arms:
        return locations.PlaceReach(refusal=f"the robot has no {past.arm.name} arm")
    if past.torso_height is not None:
        if description.torso_joint is None:
            return locations.PlaceReach(refusal="the robot has no torso to lift")
        lower, upper = body.joint_limits(description.torso_joint)
        if not lower <= past.torso_height <= upper:
            return locations.PlaceReach(refusal=f"the torso cannot be lifted to {past.torso_height:g} m")

    def goals(arm: Arms) -> tuple[Pose, ...]:
        tool = robot.tool_pose(arm)
        return geometry.pick_up_poses(description, target_pose, past.grasp, base_pose @ tool.relative_to(body.pose))

    return locations.reaching_arms(robot, past.arm, base_pose, goals, torso_height=past.torso_height, grasps=True)
