"""Where it went well before: places to pick an object up from that come from experience instead of from a search.

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
from pycrorm_async.plan.current_robot import CurrentRobot, require_world
from pycrorm_async.plan.experience import Experience, PastSuccess, experience
from pycrorm_async.plan.failures import ObjectUnreachable, PlanFailure
from pycrorm_async.plan.field_types import check_properties
from pycrorm_async.plan.geometry.grasp_poses import pick_up_poses
from pycrorm_async.plan.locations.base_poses import reaching_arms, resolve_robot
from pycrorm_async.plan.locations.designators import Location, LocationDesignator
from pycrorm_async.plan.object_designators import ObjectDesignator, ObjectLike, designator_of, pose_of
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, rotated, yaw_quaternion
from pycrorm_async.world.queries.costmaps import OccupancyCostmap

__all__ = ["DatabaseCostmapLocation"]

CLEARANCE_M = 0.3
_CELLS = 300  # 6 m across: the floor from which people and policies have tried
_UPRIGHT_MIN = 0.99  # the cosine of 8 degrees: a robot that leans more does not stand on its wheels


@dataclass(frozen=True)
class DatabaseCostmapLocation:
    """Where a robot stood when it picked up objects of the target's type, carried over to where the target is now.

    Args:
        target: the object to be picked up.
        reachable_for: the robot that is to do it. Only places from which it reaches all three goals of the
            pick-up with the arm, the grasp and the torso height that went well, with its arms as they are now,
            within the limits of the chosen robot.
        reachable_arm: only what went well with this arm, LEFT or RIGHT.
        experience: who knows what went well; the open memory, if left out.

    Each place has the one arm that did it, the grasp and the torso height, and is 0.3 m clear of what is around.
    Experience is what is in the memory's tables: `await memory.flush()` makes that all that was performed so far.

    Raises `CallerError` when there is no memory to be asked, or not one arm is named; `NoWorld`, `NoRobotHere` and
    `PerceptionObjectNotInWorld`.
    """

    target: ObjectLike
    reachable_for: ObjectLike | None = None
    reachable_arm: Arms | None = None
    experience: Experience | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.target, Object | ObjectDesignator):
            raise CallerError("experience is remembered by the type of an object: give one as target, not a place")
        check_properties(self)
        if self.reachable_arm is Arms.BOTH:
            raise CallerError("a pick-up is done with one arm: ask for LEFT, for RIGHT, or for None, either of them")

    async def resolve(self) -> Location | None:
        """The place where it went best; None if nothing that is remembered fits here."""
        places = iter(await self.remembered())
        try:
            return next(places, None)
        finally:
            places.close()

    def __aiter__(self) -> AsyncIterator[Location]:
        """One place after another, the best first; the last one asked for counts as taken, none if all were."""
        return _PlaceIterator(self)

    async def remembered(self) -> LocationDesignator:
        """The same places as an ordinary location designator, with what is known at this moment."""
        known = self.experience if self.experience is not None else experience.get()
        if known is None:
            raise CallerError(
                "what went well before is asked of a memory: do it inside `async with Memory.open(url)`,"
                " or give it as `experience`"
            )
        past = await known.successes(designator_of(self.target).object_type, arm=self.reachable_arm)
        return _ExperienceLocation(self.target, self.reachable_for, past)


class _PlaceIterator:
    """No async generator: left in the middle, it is over at once, and not when the loop gets round to it."""

    def __init__(self, asked: DatabaseCostmapLocation) -> None:
        self._asked = asked
        self._places: Iterator[Location] | None = None

    def __aiter__(self) -> _PlaceIterator:
        return self

    async def __anext__(self) -> Location:
        if self._places is None:
            self._places = iter(await self._asked.remembered())
        for place in self._places:
            return place
        raise StopAsyncIteration


@dataclass(frozen=True)
class _ExperienceLocation(LocationDesignator):
    """The same question, once the experience is known."""

    target: ObjectLike
    reachable_for: ObjectLike | None
    past: Sequence[PastSuccess]

    def _name(self) -> str:
        return DatabaseCostmapLocation.__name__

    def _candidates(self) -> Iterator[Location | None]:
        there = pose_of(self.target)
        robot = resolve_robot(self.reachable_for) if self.reachable_for is not None else None
        origin = Pose((there.position.x, there.position.y, 0.0))
        ignored = robot.with_load() if robot is not None else None
        free = OccupancyCostmap(
            require_world(), origin, distance_to_obstacle_m=CLEARANCE_M, size_cells=_CELLS, ignore=ignored
        )
        for each in self.past:
            stand = _stand(there @ each.stand)
            if stand is None or not free.value_at(*stand.position[:2]):
                yield None
                continue
            reaches = robot is None or _reaches(robot, stand, there, each)
            yield Location(stand, (each.arm,), each.grasp, each.torso_height) if reaches else None

    def _no_place_failure(self) -> PlanFailure:
        name = self.target.name
        return ObjectUnreachable(f"nothing that is remembered fits for {name}", name)


def _stand(base: Pose) -> Pose | None:
    """The base on the floor; None if it would lean, as it does for an object that lies where others stood."""
    if rotated(base.orientation, (0.0, 0.0, 1.0)).z < _UPRIGHT_MIN:
        return None
    return Pose((base.position.x, base.position.y, 0.0), yaw_quaternion(base.yaw), base.frame)


def _reaches(robot: CurrentRobot, stand: Pose, there: Pose, past: PastSuccess) -> bool:
    """Whether that arm reaches all three goals of that grasp from there, with the torso at that height."""
    body, description = robot
    if past.arm not in description.arms:
        return False
    if past.torso_height is not None:
        lower, upper = body.joint_limits(description.torso_joint)
        if not lower <= past.torso_height <= upper:
            return False

    def goals(arm: Arms) -> tuple[Pose, ...]:
        tool = body.link_pose(description.arms[arm].tool_frame)
        return pick_up_poses(there, past.grasp, stand @ tool.relative_to(body.pose))

    return reaching_arms(robot, past.arm, stand, goals, torso_height=past.torso_height) is not None
