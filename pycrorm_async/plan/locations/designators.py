"""Location designators search places for the robot's base or for objects, and report the search to the observer.

`resolve()` returns the best place; iterating yields one after another. Both search in the current state of the world.
Each resolution or iteration is reported once: the first places offered and the number of further ones, the one taken,
the number considered, the first refused ones with the reason for each, and how many a costmap excludes.

>>> stand = CostmapLocation(target=cereal, reachable_for=robot).resolve()
>>> stand.reachable_arms
(<Arms.LEFT: 1>,)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

from pycrorm_async.plan.errors import NotResolved
from pycrorm_async.plan.execution.observer import Candidate, Cells, Refusal, recorder
from pycrorm_async.plan.failures import (
    EnvironmentUnreachable,
    LookingHighLevelFailure,
    ObjectUnavailable,
    ObjectUnreachable,
    PlanFailure,
    ReachabilityFailure,
)
from pycrorm_async.plan.field_types import check_properties
from pycrorm_async.plan.locations.base_poses import Reach, base_poses
from pycrorm_async.plan.locations.opening_poses import opening_poses
from pycrorm_async.plan.locations.surfaces import surface_poses
from pycrorm_async.plan.object_designators import ObjectLike, ObjectPart, pose_of
from pycrorm_async.plan.task_tree import current_node
from pycrorm_async.world.enums import Arms, Grasp
from pycrorm_async.world.pose import Pose

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
                raise NotResolved(type(self).__name__, name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @abstractmethod
    def _candidates(self) -> Iterator[Location | Refusal | Cells | None]:
        """Yield every candidate in order; a refusal, or None, for one that is unsuitable; once `Cells` of costmaps."""

    @abstractmethod
    def _no_place_failure(self) -> PlanFailure:
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
        observer, node = recorder.get(), current_node.get()
        offered: list[Candidate] = []
        offered_beyond = 0
        refused: list[Refusal] = []
        cells: Cells | None = None
        taken: int | None = None
        considered = 0
        try:
            for place in self._candidates():
                if isinstance(place, Cells):
                    cells = place
                    continue
                considered += 1
                if isinstance(place, Refusal):
                    if len(refused) < REFUSALS_MAX:
                        refused.append(place)
                elif place is not None:
                    if len(offered) == CANDIDATES_MAX:
                        offered.pop()
                        offered_beyond += 1
                    taken = len(offered)
                    offered.append(Candidate(place.pose, place.reachable_arms, place.grasp, place.torso_height))
                    yield place
                    taken = None
        finally:
            if observer is not None:
                observer.location_resolved(
                    location=self._name(),
                    offered=tuple(offered),
                    taken=taken,
                    considered=considered,
                    refused=tuple(refused),
                    offered_beyond=offered_beyond,
                    cells=cells,
                    node=node,
                )


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

    def _no_place_failure(self) -> PlanFailure:
        raise AssertionError("a location always yields itself")


@dataclass(frozen=True)
class ObjectRelativeLocation(LocationDesignator):
    """The place at `relative_pose` relative to an object. Raises `PerceptionObjectNotInWorld`."""

    relative_pose: Pose
    reference_object: ObjectLike

    def _candidates(self) -> Iterator[Location | Refusal]:
        yield Location(pose_of(self.reference_object) @ self.relative_pose)

    def _no_place_failure(self) -> PlanFailure:
        raise AssertionError("a relative location always yields one place")


@dataclass(frozen=True)
class CostmapLocation(LocationDesignator):
    """Base poses near the target and clear of obstacles from which a robot, facing the target, reaches or sees it.

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

    target: Pose | ObjectLike
    reachable_for: ObjectLike | None = None
    visible_for: ObjectLike | None = None
    reachable_arm: Arms | None = None

    def _candidates(self) -> Iterator[Location | Refusal | Cells]:
        return map(
            _candidate,
            base_poses(
                self.target,
                reachable_for=self.reachable_for,
                visible_for=self.visible_for,
                reachable_arm=self.reachable_arm,
            ),
        )

    def _no_place_failure(self) -> PlanFailure:
        if self.reachable_for is None:
            return LookingHighLevelFailure("there is no place to stand from which the target is visible")
        if isinstance(self.target, Pose):
            return ReachabilityFailure(f"there is no place to stand and reach {self.target}", self.target)
        name = self.target.name
        return ObjectUnreachable(f"there is no place to stand and pick up {name}", name)


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

    handle: ObjectPart
    robot: ObjectLike
    arm: Arms | None = None

    def _candidates(self) -> Iterator[Location | Refusal | Cells]:
        return map(_candidate, opening_poses(self.handle, self.robot, self.arm))

    def _no_place_failure(self) -> PlanFailure:
        name = self.handle.name
        return EnvironmentUnreachable(f"there is no place to stand and open and close {name}", name)


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
    part_of: ObjectLike
    for_object: ObjectLike | None = None

    def _candidates(self) -> Iterator[Location | Refusal]:
        for place in surface_poses(self.urdf_link_name, self.part_of, self.for_object):
            yield place if isinstance(place, Refusal) else Location(place)

    def _no_place_failure(self) -> PlanFailure:
        name = self.for_object.name if self.for_object is not None else "anything"
        return ObjectUnavailable(f"there is no room for {name} on {self.urdf_link_name}", self.urdf_link_name, name)


def _candidate(searched: tuple[Pose, Reach] | Cells) -> Location | Refusal | Cells:
    if isinstance(searched, Cells):
        return searched
    pose, reach = searched
    return Location(pose, reach.arms) if reach.refusal is None else Refusal(pose, reach.refusal)
