"""Location designators: search poses for the robot's base and for placing objects.

**Designators.** Location designators search places for the robot's base or for objects, and report the search to the
observer.

`resolve()` returns the best place; iterating yields one after another. Both search in the current state of the world.
Each resolution or iteration is reported once: the first places offered and the number of further ones, the one taken,
the number considered, the first refused ones with the reason for each, and how many a costmap excludes.

>>> stand = CostmapLocation(target=cereal, reachable_for=robot).resolve()
>>> stand.reachable_arms
(<Arms.LEFT: 1>,)
"""

from __future__ import annotations

import math
import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from typing import TYPE_CHECKING, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.plan import failures, geometry, objects
from pycrorm_async.plan.execution import Candidate, Cells, Refusal, Search, recorder
from pycrorm_async.plan.field_types import check_properties
from pycrorm_async.plan.motions import chosen_limits, clear_posture, collisions_count
from pycrorm_async.plan.task import current_node
from pycrorm_async.world import queries
from pycrorm_async.world.arms import STARTS_OF_SEARCH
from pycrorm_async.world.bounding_boxes import BoundingBox, box_around
from pycrorm_async.world.bullet import Object, current_world
from pycrorm_async.world.kinematics import Unreachable, headings, postures
from pycrorm_async.world.pose import Arms, Grasp, Pose, Quaternion, Vector, yaw_quaternion
from pycrorm_async.world.urdf import Drive, PR2Description
from pycrorm_async.world.world_copy import acting_robot

# === base clearance ===========================================================================================
#
# Check whether a robot's base, with its heading, is clear of obstacles at a pose.


class BaseClearance:
    """The footprints of one or more robots, and the obstacles around them as they are now."""

    def __init__(self, robots: Collection[objects.CurrentRobot]) -> None:
        self._footprints = [queries.footprint_of(each.body, each.base_links()) for each in robots]
        self._obstacles = queries.Obstacles(
            objects.require_world(), ignore={part for each in robots for part in each.with_load()}
        )

    def refusal(self, base: Pose) -> str | None:
        """Return the reason why a base cannot be at this pose; None if it is clear of obstacles there."""
        for footprint in self._footprints:
            if (obstacle := self._obstacles.overlapping(footprint, base)) is not None:
                return "base in collision with {} ({})".format(*obstacle)
        return None

    def clear(self, bases: Sequence[Pose]) -> NDArray[np.bool_]:
        """Return for each pose whether a base is clear of obstacles there, shape (bases,): faster than one by one."""
        return np.asarray(np.all([self._obstacles.clear(each, bases) for each in self._footprints], axis=0))

    def costmap(self, origin: Pose, *, size_cells: int = 200, resolution_m: float = 0.02) -> queries.Costmap:
        """Return the places that a base may have with some heading: 1 where nothing is within its inner radius."""
        distance_m = max(each.inner_radius_m for each in self._footprints)
        return self._obstacles.costmap(origin, distance_m=distance_m, size_cells=size_cells, resolution_m=resolution_m)


def base_clearance(robots: Collection[objects.CurrentRobot] = ()) -> BaseClearance | None:
    """Return the clearance of these robots, of the current one without any; None where collisions do not count.

    Raises `NoRobotHere` if collisions count and there is no robot.
    """
    return BaseClearance(robots or (objects.require_robot(),)) if collisions_count() else None


# === base poses ===============================================================================================
#
# Search base poses from which a robot reaches or sees a target: the best cells of a costmap, checked by kinematics.
#
# Each check uses the goals that the actions will use (`geometry`), with the robot's torso and arms as they are now,
# within the limits of the chosen robot. Nothing is moved.

CELLS_MAX = 600
"""Bounds the cells per search at which kinematics is checked, so that a search without a solution ends."""
VISIBLE_SHARE_MIN = 0.5
"""Minimum visible share of an object that counts as seen from a place."""


class PlaceReach(NamedTuple):
    """The arms that reach the target from a place; or, for an unsuitable place, none and the reason."""

    arms: tuple[Arms, ...] = ()
    refusal: str | None = None


def base_poses(search: CostmapLocation) -> Iterator[Location | Refusal | Cells]:
    """Yield the cells of the costmaps, then base poses that face the target, best first, suitable or not.

    For a fixed base yield only its own pose.
    """
    target = search.target
    reacher = resolve_robot(search.reachable_for) if search.reachable_for is not None else None
    viewer = resolve_robot(search.visible_for) if search.visible_for is not None else None
    goal = target if isinstance(target, Pose) else objects.pose_of(target)
    objects.check_in_map(goal)
    arms = _arms(reacher, search.reachable_arm, target) if reacher is not None else search.reachable_arm
    if reacher is not None and reacher.description.drive is Drive.FIXED:
        yield _checked(reacher.body.pose, target, goal, reacher, viewer, arms)
        return
    robots = [each for each in (reacher, viewer) if each is not None]
    clearance = base_clearance(robots)
    costmap, cells = _costmap(target, goal, robots, viewer, clearance)
    yield cells
    clear, height_m = 0, base_height_m(reacher or viewer)
    for cell in _cells(costmap, robots, every=clearance is not None):
        facing = face(cell, goal, height_m=height_m)
        place: Location | Refusal = Refusal(facing, "no heading was found at which the arm reaches the target")
        collision = None
        for base_pose in [facing] if reacher is None else _headings(reacher, arms, facing, target, goal):
            collision = None if clearance is None else clearance.refusal(base_pose)
            if collision is not None:
                place = Refusal(base_pose, collision)
            elif clear < CELLS_MAX:
                place = _checked(base_pose, target, goal, reacher, viewer, arms)
            else:
                return
            if isinstance(place, Location):
                break
        clear += collision is None
        yield place


def _arms(robot: objects.CurrentRobot, arm: Arms | None, target: Pose | objects.ObjectLike) -> Arms | tuple[Arms, ...]:
    """Return the required arm; without one those that lift the target, or reach it if it is a pose."""
    if arm is not None:
        return arm
    candidates = tuple(robot.description.arms)
    return candidates if isinstance(target, Pose) else geometry.lifting_arms(robot, candidates, target)


def _headings(
    robot: objects.CurrentRobot,
    arms: Arms | tuple[Arms, ...] | None,
    facing: Pose,
    target: Pose | objects.ObjectLike,
    goal: Pose,
) -> Iterator[Pose]:
    """Yield the poses of the base to check at a place, each once: for most arms the one that faces the target."""
    headings_yielded: set[Pose] = set()
    for arm in _each(robot, arms):
        goals = _goals(robot, facing, target, goal, arm)
        at = goals[0] if isinstance(target, Pose) else goals[1]
        for pose in headings(robot.body, arm, at, base=facing, limits=chosen_limits()):
            if pose is not facing or facing not in headings_yielded:
                yield pose
            headings_yielded.add(pose)


def _each(robot: objects.CurrentRobot, arm: Arms | tuple[Arms, ...] | None) -> tuple[Arms, ...]:
    """Return the arms of a choice: both of BOTH, these of several, all of None."""
    if isinstance(arm, tuple):
        return arm
    return tuple(robot.description.arms if arm is None else robot.each_arm(arm))


def _cells(costmap: queries.Costmap, robots: list[objects.CurrentRobot], *, every: bool) -> Iterator[Pose]:
    """Yield the middles of the cells to search: the best ones, or with `every` all of them.

    The best cells are as near to the target as is usual for a PR2. For other robots, whose arms reach from other
    distances, the cells are spread over the whole map, best first.
    """
    if all(isinstance(robot.description, PR2Description) for robot in robots):
        return islice(costmap.ranked(), None if every else CELLS_MAX)
    return costmap.ranked(every=max(1, int(np.count_nonzero(costmap.map)) // CELLS_MAX))


def _checked(
    base_pose: Pose,
    target: Pose | objects.ObjectLike,
    goal: Pose,
    reacher: objects.CurrentRobot | None,
    viewer: objects.CurrentRobot | None,
    arms: Arms | tuple[Arms, ...] | None,
) -> Location | Refusal:
    """Return the base pose with the arms that reach the target from there, or with the reason why none does."""
    if viewer is not None and not _sees(viewer, base_pose, target, goal):
        return Refusal(base_pose, "the target is not visible from here")
    if reacher is None:
        return Location(base_pose)
    goals = partial(_goals, reacher, base_pose, target, goal)
    reach = reaching_arms(reacher, arms, base_pose, goals, grasps=not isinstance(target, Pose))
    return _place(base_pose, reach)


def _place(base_pose: Pose, reach: PlaceReach) -> Location | Refusal:
    return Location(base_pose, reach.arms) if reach.refusal is None else Refusal(base_pose, reach.refusal)


def resolve_robot(meant: objects.ObjectLike) -> objects.CurrentRobot:
    """Return the robot that the argument refers to. Raises `NoRobotHere` if it has no robot description."""
    body = objects.in_world(meant)
    if body.robot_description is None:
        raise failures.NoRobotHere(f"{body.name!r} is not a robot with a robot description")
    return objects.CurrentRobot(body, body.robot_description)


def base_height_m(robot: objects.CurrentRobot | None = None) -> float:
    """Return the height of a robot's base link, which driving keeps: of this robot, else of the acting one, else 0."""
    if robot is not None:
        return robot.body.pose.position.z
    world = current_world.get()
    acting = acting_robot(world) if world is not None else None
    return acting.pose.position.z if acting is not None else 0.0


def face(place: Pose, goal: Pose, *, height_m: float, turned: float = 0.0) -> Pose:
    """Return the upright pose at the place that faces the goal, rotated by `turned` (rad) to the left."""
    x, y, _ = place.position
    heading = math.atan2(goal.position.y - y, goal.position.x - x) + turned
    return Pose((x, y, height_m), yaw_quaternion(heading))


def reaching_arms(
    robot: objects.CurrentRobot,
    arm: Arms | tuple[Arms, ...] | None,
    base_pose: Pose,
    goals: Callable[[Arms], Iterable[Pose]],
    *,
    torso_height: float | None = None,
    grasps: bool | None = None,
) -> PlaceReach:
    """Return the arms that reach all their goals from this base pose, or a refusal if the required ones do not.

    Args:
        arm: the required arm; BOTH requires both, several any of these, None any.
        torso_height: m; None means the current height.
        grasps: where collisions count, refuse an arm that would be in an object at one of the goals, and if False, also
            one whose gripper would be, or whose held objects at the first goal; None: check no collisions.

    Raises `CapabilityAbsenceFailure` for an arm that the robot lacks.
    """
    limits, collides = chosen_limits(), grasps is not None and collisions_count()
    reaching: list[Arms] = []
    refusals: list[str] = []
    for candidate in _each(robot, arm):
        answers = [
            postures(
                robot.body,
                candidate,
                each,
                base=base_pose,
                torso_height=torso_height,
                limits=limits,
                starts=STARTS_OF_SEARCH,
            )
            for each in goals(candidate)
        ]
        try:
            all_answers = [chain([next(each)], each) for each in answers]
        except Unreachable as unreachable:
            refusals.append(f"{candidate.name}: {unreachable.reason}")
            continue
        lift = robot.description.torso_joint
        torso = {} if torso_height is None or lift is None else {lift: torso_height}
        if collides and (collision := _collision(robot, candidate, all_answers, torso, base_pose, grasps=bool(grasps))):
            refusals.append(f"{candidate.name}: " + "it would be in {1.name} with {0}".format(*collision))
            continue
        reaching.append(candidate)
    enough = not refusals if arm is Arms.BOTH else bool(reaching)
    return PlaceReach(tuple(reaching)) if enough else PlaceReach(refusal="; ".join(refusals))


def _collision(
    robot: objects.CurrentRobot,
    arm: Arms,
    answers: Iterable[Iterable[dict[str, float]]],
    torso: dict[str, float],
    base: Pose,
    *,
    grasps: bool,
) -> tuple[str, Object] | None:
    """Return the collision at the first goal that the arm cannot be at without one, as its motions will find it.

    `answers` has the postures of each goal.
    """
    tool_frame = robot.description.arms[arm].tool_frame
    held = [] if grasps else [each for each, link in robot.body.attachments.items() if link == tool_frame]
    for each in answers:
        lifted = (torso | joints for joints in each)
        clear = clear_posture(robot, arm, lifted, gripper_may_touch=grasps, held=held, base=base)
        if isinstance(clear, tuple):
            return clear
        held = []  # it is released at the first goal
    return None


def _costmap(
    target: Pose | objects.ObjectLike,
    goal: Pose,
    robots: list[objects.CurrentRobot],
    viewer: objects.CurrentRobot | None,
    clearance: BaseClearance | None,
) -> tuple[queries.Costmap, Cells]:
    """Return the costmap of the search, and how many cells the maps in it exclude."""
    world = objects.require_world()
    origin = Pose((goal.position.x, goal.position.y, 0.0))
    ignored = {part for robot in robots for part in robot.with_load()}
    free = queries.OccupancyCostmap(world, origin, ignore=ignored) if clearance is None else clearance.costmap(origin)
    costmap = free * queries.GaussianCostmap(origin)
    if viewer is None:
        return costmap, cells_of(free)
    low, high = viewer.camera_heights_m()
    viewed = goal if isinstance(target, Pose) else objects.in_world(target)
    visible = queries.VisibilityCostmap(
        world, viewed, min_height_m=low, max_height_m=high, origin=origin, ignore=ignored
    )
    return costmap * visible, cells_of(free, free * visible)


def cells_of(free: queries.Costmap, seeing: queries.Costmap | None = None) -> Cells:
    """Count the cells of a map of free places; `seeing` leaves those from which the target is visible."""
    clear = int(np.count_nonzero(free.map))
    left = clear if seeing is None else int(np.count_nonzero(seeing.map))
    return Cells(free.map.size - clear, clear - left, left)


def _goals(
    robot: objects.CurrentRobot, base_pose: Pose, target: Pose | objects.ObjectLike, goal: Pose, arm: Arms
) -> tuple[Pose, ...]:
    body, description = robot
    tool_frame = description.arms[arm].tool_frame
    tool = robot.tool_pose(arm)
    if not isinstance(target, Pose):
        return geometry.pick_up_poses(description, goal, Grasp.FRONT, base_pose @ tool.relative_to(body.pose))
    held = next((each for each, link in body.attachments.items() if link == tool_frame), None)
    tool_goal = geometry.place_pose(goal, held.pose, tool) if held is not None else goal
    return tool_goal, geometry.retract(tool_goal)


def _sees(robot: objects.CurrentRobot, base_pose: Pose, target: Pose | objects.ObjectLike, goal: Pose) -> bool:
    """Return whether the target is visible from the camera's position at this base pose."""
    eye = (base_pose @ robot.camera_pose().relative_to(robot.body.pose)).position
    if isinstance(target, Pose):
        return objects.require_world().ray_test([eye], [goal.position], ignore=robot.with_load()) == [None]
    return objects.require_world().visible(objects.in_world(target), eye, ignore=robot.with_load()) >= VISIBLE_SHARE_MIN


# === designators ==============================================================================================

CANDIDATES_MAX = 1_000
"""Bounds the offered places that are reported of one search: the first ones, and the last, which may be the one taken.
A loop over the places of a large surface may ask for thousands."""
REFUSALS_MAX = 1_000
"""Bounds the refused places that are reported of one search. A search for a pick-up tries at most 600 places, one for
opening 9,600, whose record would be larger than a record may be."""


class LocationDesignator(ABC):
    """Base of location designators; a subclass defines the candidates.

    Fields are checked when it is built, as an action's are: `ResolutionError` names those that do not fit.
    """

    def __post_init__(self) -> None:
        check_properties(self)

    if not TYPE_CHECKING:  # hidden from type checkers, which report the fault themselves

        def __getattr__(self, name: str) -> NoReturn:
            if name in ("pose", "reachable_arms"):
                raise failures.NotResolved(type(self).__name__, name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @abstractmethod
    def _candidates(self) -> Iterator[Location | Refusal | Cells | None]:
        """Yield every candidate in order; a refusal, or None, for one that is unsuitable; once `Cells` of costmaps."""

    @abstractmethod
    def _no_place_failure(self) -> failures.PlanFailure:
        """Return the plan failure for a search without a suitable place."""

    def _name(self) -> str:
        """Return the name reported to the observer."""
        return type(self).__name__

    def resolve(self) -> Location:
        """Return the first suitable place. Raises a plan failure, documented by each designator, if there is none."""
        places = iter(self)
        try:
            place = next(places, None)
        finally:
            places.close()
        if place is None:
            raise self._no_place_failure()
        return place

    def __iter__(self) -> Generator[Location, None, None]:
        """Yield suitable places; the last one yielded counts as taken, or none if the iteration is exhausted."""
        for place in self.steps():
            if place is not None:
                yield place

    def steps(self) -> Generator[Location | None, None, None]:
        """Yield what the iteration yields, and None for each unsuitable place, so that other tasks can run then."""
        observer, search = recorder.get(), Search(self._name(), current_node.get())
        offered = search.offered
        try:
            for place in self._candidates():
                if isinstance(place, Cells):
                    search.cells = place
                    continue
                search.considered += 1
                if isinstance(place, Refusal) and len(search.refused) < REFUSALS_MAX:
                    search.refused.append(place)
                if not isinstance(place, Location):
                    yield None
                else:
                    if len(offered) == CANDIDATES_MAX:
                        offered.pop()
                        search.offered_beyond += 1
                    search.taken = len(offered)
                    offered.append(Candidate(place.pose, place.reachable_arms, place.grasp, place.torso_height))
                    yield place
                    search.taken = None
        finally:
            if observer is not None:
                observer.location_resolved(search)


@dataclass(frozen=True)
class Location(LocationDesignator):
    """A place: a pose in the map, and the arms that reach the target of the search. Resolves to itself.

    A place from experience also has the grasp and the torso height (m) of the past success.
    """

    pose: Pose
    reachable_arms: tuple[Arms, ...] = ()
    grasp: Grasp | None = None
    torso_height: float | None = None

    def _candidates(self) -> Iterator[Location | Refusal]:
        yield self

    def _no_place_failure(self) -> failures.PlanFailure:
        raise AssertionError("a location always yields itself")


@dataclass(frozen=True)
class ObjectRelativeLocation(LocationDesignator):
    """The place at `relative_pose` relative to an object. Raises `PerceptionObjectNotInWorld`."""

    relative_pose: Pose
    reference_object: objects.ObjectLike

    def _candidates(self) -> Iterator[Location | Refusal]:
        yield Location(objects.pose_of(self.reference_object) @ self.relative_pose)

    def _no_place_failure(self) -> failures.PlanFailure:
        raise AssertionError("a relative location always yields one place")


@dataclass(frozen=True)
class CostmapLocation(LocationDesignator):
    """Base poses near the target and clear of obstacles from which a robot, facing the target, reaches or sees it.

    A robot whose arm moves its tool in five directions or fewer is turned as that arm reaches, for example sideways.

    Args:
        target: an object to pick up, or a pose to which the tool frame or a held object is brought.
        reachable_for: the robot that must reach the target. For an object that means all three goals of a pick-up
            from the front (`Grasp.FRONT`), for a pose those of placing the held object, with the torso and the arms
            as they are now, within the limits of the chosen robot (`simulated_robot_within`).
        visible_for: the robot that must see the target.
        reachable_arm: the arm that must reach the target; BOTH requires each of the two. None means any arm that lifts
            the object (`ArmDescription.payload_kg`), if one does.

    Where collisions count, the base with its heading is clear of obstacles; elsewhere its middle is 0.32 m away from
    them. The search considers up to 600 such places, best first. Resolving raises `ObjectUnreachable` (for an object),
    `ReachabilityFailure` (for a pose), `LookingHighLevelFailure` (if only visibility is required) or
    `PerceptionObjectNotInWorld`.
    """

    target: Pose | objects.ObjectLike
    reachable_for: objects.ObjectLike | None = None
    visible_for: objects.ObjectLike | None = None
    reachable_arm: Arms | None = None

    def _candidates(self) -> Iterator[Location | Refusal | Cells]:
        return base_poses(self)

    def _no_place_failure(self) -> failures.PlanFailure:
        if self.reachable_for is None:
            return failures.LookingHighLevelFailure("there is no place to stand from which the target is visible")
        if isinstance(self.target, Pose):
            return failures.ReachabilityFailure(f"there is no place to stand and reach {self.target}", self.target)
        name = self.target.name
        return failures.ObjectUnreachable(f"there is no place to stand and pick up {name}", name)


@dataclass(frozen=True)
class AccessingLocation(LocationDesignator):
    """Base poses from which a robot can open a drawer or a door by its handle and close it again.

    >>> handle = ObjectPart("sink_area_drawer_handle", kitchen)
    >>> stand = AccessingLocation(handle, robot).resolve()
    >>> await NavigateActionPerformable(stand.pose).perform()
    >>> await OpenActionPerformable(handle, stand.reachable_arms[0]).perform()

    Args:
        handle: the part that the gripper grasps.
        robot: the robot, with its torso as it is now, within the limits of the chosen robot
            (`simulated_robot_within`).
        arm: the arm that must reach; BOTH requires each of the two.

    Places are 0.4 m clear of obstacles, and where collisions count the base with its heading is clear of them; places
    that the drawer or door sweeps come last. Resolving raises
    `EnvironmentUnreachable`, `EnvironmentManipulationImpossible` (no joint moves the handle),
    `PerceptionObjectNotInWorld`, `CapabilityAbsenceFailure` and `UnknownLink`.
    """

    handle: objects.ObjectPart
    robot: objects.ObjectLike
    arm: Arms | None = None

    def _candidates(self) -> Iterator[Location | Refusal | Cells]:
        return opening_poses(self.handle, self.robot, self.arm)

    def _no_place_failure(self) -> failures.PlanFailure:
        name = self.handle.name
        return failures.EnvironmentUnreachable(f"there is no place to stand and open and close {name}", name)


@dataclass(frozen=True)
class SemanticCostmapLocation(LocationDesignator):
    """Poses for an object on a link of another object, for example on the surface of a table.

    Args:
        urdf_link_name: the link; the top of its bounding box is the surface.
        part_of: the object that has the link.
        for_object: the object to place: at these poses its bottom is on the surface and it collides with no other
            object. Without it, the poses are on the surface itself.

    The middle comes first, then places all over the surface in a fixed order. Resolving raises `ObjectUnavailable` if
    there is no room, `PerceptionObjectNotInWorld` and `UnknownLink`.
    """

    urdf_link_name: str
    part_of: objects.ObjectLike
    for_object: objects.ObjectLike | None = None

    def _candidates(self) -> Iterator[Location | Refusal]:
        for place in surface_poses(self.urdf_link_name, self.part_of, self.for_object):
            yield place if isinstance(place, Refusal) else Location(place)

    def _no_place_failure(self) -> failures.PlanFailure:
        name = self.for_object.name if self.for_object is not None else "anything"
        return failures.ObjectUnavailable(
            f"there is no room for {name} on {self.urdf_link_name}", self.urdf_link_name, name
        )


# === opening poses ============================================================================================
#
# Search base poses from which a robot can open a drawer or a door by its handle and close it again.
#
# Each check uses the goals of `OpenAction` and `CloseAction` (`geometry`): grasping the handle in its closed, open and
# current position, and following its whole path, with the torso as it is now and within the limits of the chosen robot.
# Nothing is moved.

OPENING_CLEARANCE_M = 0.4
"""The distance in m of the base from obstacles."""
HEADINGS = 8
"""The headings that are tried at each cell, in equal steps from that which faces the handle."""
CELL_M = 0.05
"""The side of a cell in m."""
_OPENING_CELLS = 80
"""The cells along each axis of the costmap: 4 m around the handle."""
_SIGMA_CELLS = 6.0  # 0.3 m, as for picking up
_SWEEP_STEPS = 10
"""The steps of the joint at which the space that the drawer or door sweeps is computed."""


def opening_poses(
    part: objects.ObjectLike, robot: objects.ObjectLike, arm: Arms | None
) -> Iterator[Location | Refusal | Cells]:
    """Yield the cells of the costmaps, then base poses, best first, suitable or not.

    Places that the opening part does not sweep come first, facing the handle and then rotated by each multiple of 45
    degrees; the places that it sweeps follow in the same order.
    """
    handle, reacher = geometry.handle_of(part), resolve_robot(robot)
    handle_pose = handle.whole.link_pose_at(handle.link, {handle.joint: geometry.closed_position(handle)})
    goals = _handle_goals(handle)
    clearance, height_m = base_clearance([reacher]), base_height_m(reacher)
    free, *costmaps = _costmaps(handle, handle_pose, reacher)
    yield cells_of(free)
    for costmap in costmaps:
        cells = costmap.best(CELLS_MAX)
        for number in range(HEADINGS):
            for cell in cells:
                base_pose = face(cell, handle_pose, height_m=height_m, turned=number * math.tau / HEADINGS)
                collision = clearance.refusal(base_pose) if clearance is not None else None
                if collision is not None:
                    yield Refusal(base_pose, collision)
                else:
                    yield _place(base_pose, reaching_arms(reacher, arm, base_pose, lambda _: goals))


def _handle_goals(handle: geometry.Handle) -> list[Pose]:
    """Return all goals of the tool frame; the ends of the path first, because most places fail at them."""
    opened, closed, current = geometry.opened_position(handle), geometry.closed_position(handle), handle.position
    path = geometry.hand_poses(handle, opened, closed)
    between = [*path[1:-1]]
    ends = [path[0], path[-1]]
    if current not in (opened, closed):
        from_current = geometry.hand_poses(handle, opened)
        ends.append(from_current[0])
        between += [*from_current[1:], *geometry.hand_poses(handle, closed)[1:]]
    return [*ends, *(geometry.approach(each) for each in ends), *between]


def _costmaps(handle: geometry.Handle, handle_pose: Pose, robot: objects.CurrentRobot) -> tuple[queries.Costmap, ...]:
    """Return a map of free places, and two of those near the handle: the moving part does not sweep them, or does."""
    world, origin = handle.whole.world, Pose((handle_pose.position.x, handle_pose.position.y, 0.0))
    near = queries.GaussianCostmap(origin, sigma_cells=_SIGMA_CELLS, size_cells=_OPENING_CELLS, resolution_m=CELL_M)
    free, unswept = (
        queries.OccupancyCostmap(
            world,
            origin,
            distance_to_obstacle_m=OPENING_CLEARANCE_M,
            size_cells=_OPENING_CELLS,
            resolution_m=CELL_M,
            ignore=robot.with_load(),
            also=boxes,
        )
        for boxes in ((), list(_swept(handle)))
    )
    return free, unswept * near, queries.Costmap(free.map - unswept.map, origin, resolution_m=CELL_M) * near


def _swept(handle: geometry.Handle) -> Iterator[BoundingBox]:
    """Yield the boxes that the links moved by the handle's joint occupy along its path."""
    whole, opened, closed = handle.whole, geometry.opened_position(handle), geometry.closed_position(handle)
    moving = [link for link in whole.links if handle.joint in whole.joints_above(link)]
    for number in range(_SWEEP_STEPS + 1):
        at = {handle.joint: closed + (opened - closed) * number / _SWEEP_STEPS}
        for link in moving:
            frame = whole.link_pose_at(link, at)
            box = box_around([((frame.position, frame.orientation), whole.body.solids[link])])
            if box is not None:
                yield box


# === surfaces =================================================================================================
#
# Find poses for an object on a surface: the middle first, then all over the surface in a fixed random order.

STEP_M = 0.02
"""The distance in m between two candidates along each axis."""
_POINT = BoundingBox(Vector(0.0, 0.0, 0.0), Vector(0.0, 0.0, 0.0))


def surface_poses(link: str, whole: objects.ObjectLike, obj: objects.ObjectLike | None) -> Iterator[Pose | Refusal]:
    """Yield poses for `obj` on top of the link, with the link's heading, and refusals of occupied places."""
    support = objects.in_world(whole)
    heading = yaw_quaternion(support.link_pose(link).yaw)
    extent, occupied = _POINT, []
    if obj is not None:
        obj_to_put = objects.in_world(obj)
        extent = _extent(obj_to_put, heading)
        outermost = _outermost(obj_to_put)
        occupied = [
            (each.name, each.bounding_box())
            for each in support.world.objects
            if each is not support and _outermost(each) is not outermost  # what moves with the object is not in its way
        ]
        if collisions_count():
            others = (each for each in support.links if each != link and support.body.solids[each])
            occupied += [(each, support.bounding_box(each)) for each in others]
    surface = support.bounding_box(link)
    z = surface.max.z - extent.min.z
    for x, y in _grid_points(surface, extent):
        placed_box = _translate(extent, x, y, z)
        pose = Pose((x, y, z), heading)
        obstacle = next((name for name, box in occupied if _overlap(placed_box, box)), None)
        yield pose if obstacle is None else Refusal(pose, f"{obstacle} is in the way")


def _grid_points(surface: BoundingBox, extent: BoundingBox) -> Iterator[tuple[float, float]]:
    """Yield the points at which a box of that extent stays on the surface; only the middle if it is too large."""
    ranges = []
    for low, high, below, above in zip(surface.min[:2], surface.max[:2], extent.min[:2], extent.max[:2], strict=True):
        middle = (low - below + high - above) / 2
        steps = int(max(0.0, (high - above) - (low - below)) / 2 / STEP_M)
        ranges.append([middle + STEP_M * step for step in range(-steps, steps + 1)])
    middle_point = (ranges[0][len(ranges[0]) // 2], ranges[1][len(ranges[1]) // 2])
    yield middle_point
    points = [(x, y) for x in ranges[0] for y in ranges[1] if (x, y) != middle_point]
    random.Random(0).shuffle(points)  # noqa: S311  a fixed seed: the order is random but reproducible
    yield from points


def _extent(obj: Object, turn: Quaternion) -> BoundingBox:
    """Return the object's box at the origin with this rotation, independent of its current pose."""
    pose = obj.pose
    placed = []
    for link in obj.links:
        frame = Pose((0.0, 0.0, 0.0), turn) @ obj.link_pose(link).relative_to(pose)
        placed.append(((frame.position, frame.orientation), obj.body.solids[link]))
    return box_around(placed) or _POINT


def _translate(box: BoundingBox, x: float, y: float, z: float) -> BoundingBox:
    return BoundingBox(
        Vector(box.min.x + x, box.min.y + y, box.min.z + z), Vector(box.max.x + x, box.max.y + y, box.max.z + z)
    )


def _overlap(a: BoundingBox, b: BoundingBox) -> bool:
    """Return whether the boxes share more than a face."""
    return all(
        low + 1e-6 < high and other + 1e-6 < over
        for low, high, other, over in zip(a.min, b.max, b.min, a.max, strict=True)
    )


def _outermost(carried: Object) -> Object:
    """Return the object that carries this one, directly or through others, and is not carried itself."""
    while (carrier := carried.attached_to) is not None:
        carried = carrier
    return carried
