"""Where to stand and where to put things: location designators that look for places and tell what they offered.

`resolve()` gives the best place, iterating gives one after another, both at the moment they are asked. Each
time a recorder is told once: what was offered, which was taken, how many places were looked at.

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
from pycrorm_async.plan.execution.observer import Candidate, recorder
from pycrorm_async.plan.failures import (
    EnvironmentUnreachable,
    LookingHighLevelFailure,
    ObjectUnavailable,
    ObjectUnreachable,
    PlanFailure,
    ReachabilityFailure,
)
from pycrorm_async.plan.field_types import check_properties
from pycrorm_async.plan.locations.base_poses import base_poses
from pycrorm_async.plan.locations.opening_poses import opening_poses
from pycrorm_async.plan.locations.surfaces import surface_poses
from pycrorm_async.plan.object_designators import ObjectLike, ObjectPart, pose_of
from pycrorm_async.plan.task_tree import current_node
from pycrorm_async.world.enums import Arms, Grasp
from pycrorm_async.world.pose import Pose

__all__ = [
    "AccessingLocation",
    "CostmapLocation",
    "Location",
    "LocationDesignator",
    "ObjectRelativeLocation",
    "SemanticCostmapLocation",
]


class LocationDesignator(ABC):
    """What every location designator does. A subclass says which places it looks at.

    Its fields are checked when it is built, as an action's are: `ResolutionError` names what does not fit.
    """

    def __post_init__(self) -> None:
        check_properties(self)

    if not TYPE_CHECKING:  # a type checker finds the fault by itself

        def __getattr__(self, name: str) -> NoReturn:
            if name in ("pose", "reachable_arms"):
                raise NotResolved(type(self).__name__, name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @abstractmethod
    def _candidates(self) -> Iterator[Location | None]:
        """Every place it looks at, in order; None for one that will not do."""

    @abstractmethod
    def _no_place_failure(self) -> PlanFailure:
        """What it means for a plan that there is no place."""

    def _name(self) -> str:
        """What a recorder is told."""
        return type(self).__name__

    def resolve(self) -> Location:
        """The first place that will do. Raises a plan failure, which each designator names, if there is none."""
        places = iter(self)
        try:
            place = next(places, None)
        finally:
            places.close()
        if place is None:
            raise self._no_place_failure()
        return place

    def __iter__(self) -> Generator[Location, None, None]:
        """One place after another that will do; the last one asked for counts as taken, none if all were."""
        observer, node = recorder.get(), current_node.get()
        offered: list[Candidate] = []
        taken: int | None = None
        considered = 0
        try:
            for place in self._candidates():
                considered += 1
                if place is not None:
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
                    node=node,
                )


@dataclass(frozen=True)
class Location(LocationDesignator):
    """A place: a pose in the map, and the arms that reach what it was looked for. Resolves to itself.

    A place that comes from experience also says with which grasp and torso height (m) it went well.
    """

    pose: Pose
    reachable_arms: tuple[Arms, ...] = ()
    grasp: Grasp | None = None
    torso_height: float | None = None

    def _candidates(self) -> Iterator[Location | None]:
        yield self

    def _no_place_failure(self) -> PlanFailure:
        raise AssertionError("a place is somewhere")


@dataclass(frozen=True)
class ObjectRelativeLocation(LocationDesignator):
    """The place that is at `relative_pose` as seen from an object. Raises `PerceptionObjectNotInWorld`."""

    relative_pose: Pose
    reference_object: ObjectLike

    def _candidates(self) -> Iterator[Location | None]:
        yield Location(pose_of(self.reference_object) @ self.relative_pose)

    def _no_place_failure(self) -> PlanFailure:
        raise AssertionError("beside a thing is somewhere")


@dataclass(frozen=True)
class CostmapLocation(LocationDesignator):
    """Where a robot can stand, facing the target, to reach or to see it: near it, and clear of what is around.

    Args:
        target: an object, to be picked up, or a pose, to bring the tool frame to or to put a held object
            down at.
        reachable_for: the robot that is to reach it. For an object that means all three goals of a pick-up
            from the front (`Grasp.FRONT`), for a pose those of placing what the arm holds, with the torso
            and the arms as they are now, within the limits of the chosen robot (`simulated_robot_within`).
        visible_for: the robot that is to see it.
        reachable_arm: only places where this arm reaches; for BOTH, each of the two.

    Up to 600 places are looked at, best first. Resolving raises `ObjectUnreachable` (an object),
    `ReachabilityFailure` (a pose), `LookingHighLevelFailure` (only to be seen) or
    `PerceptionObjectNotInWorld`.
    """

    target: Pose | ObjectLike
    reachable_for: ObjectLike | None = None
    visible_for: ObjectLike | None = None
    reachable_arm: Arms | None = None

    def _candidates(self) -> Iterator[Location | None]:
        for pose, arms in base_poses(
            self.target,
            reachable_for=self.reachable_for,
            visible_for=self.visible_for,
            reachable_arm=self.reachable_arm,
        ):
            yield Location(pose, arms) if arms is not None else None

    def _no_place_failure(self) -> PlanFailure:
        if self.reachable_for is None:
            return LookingHighLevelFailure("there is no place to see it from")
        if isinstance(self.target, Pose):
            return ReachabilityFailure(f"there is no place to stand and reach {self.target}", self.target)
        name = self.target.name
        return ObjectUnreachable(f"there is no place to stand and pick up {name}", name)


@dataclass(frozen=True)
class AccessingLocation(LocationDesignator):
    """Where a robot can stand to open a drawer or a door by its handle, and to close it again.

    >>> handle = ObjectPart("sink_area_drawer_handle", kitchen)
    >>> stand = AccessingLocation(handle, robot).resolve()
    >>> await NavigateActionPerformable(stand.pose).perform()
    >>> await OpenActionPerformable(handle, stand.reachable_arms[0]).perform()

    Args:
        handle: the part that the hand takes.
        robot: who is to do it: with its torso as it is now, within the limits of the chosen robot
            (`simulated_robot_within`).
        arm: only places where this arm can do it; for BOTH, each of the two.

    Places are 0.4 m clear of what is around. Those that drawer or door will sweep come last. Resolving raises
    `EnvironmentUnreachable`, `EnvironmentManipulationImpossible` (nothing moves the handle),
    `PerceptionObjectNotInWorld`, `CapabilityAbsenceFailure` and `UnknownLink`.
    """

    handle: ObjectPart
    robot: ObjectLike
    arm: Arms | None = None

    def _candidates(self) -> Iterator[Location | None]:
        for pose, arms in opening_poses(self.handle, self.robot, self.arm):
            yield Location(pose, arms) if arms is not None else None

    def _no_place_failure(self) -> PlanFailure:
        name = self.handle.name
        return EnvironmentUnreachable(f"there is no place to stand and open and close {name}", name)


@dataclass(frozen=True)
class SemanticCostmapLocation(LocationDesignator):
    """Where something can be put on a link of an object, for example on the surface of a table.

    Args:
        urdf_link_name: the link; the top of its bounding box is the surface.
        part_of: the object that has the link.
        for_object: what is to be put there: its bottom will be on the surface, and it has room there.
            Without it, the poses are on the surface itself.

    The middle comes first, then places all over the surface in a fixed order. Resolving raises
    `ObjectUnavailable` if there is no room, `PerceptionObjectNotInWorld` and `UnknownLink`.
    """

    urdf_link_name: str
    part_of: ObjectLike
    for_object: ObjectLike | None = None

    def _candidates(self) -> Iterator[Location | None]:
        for pose in surface_poses(self.urdf_link_name, self.part_of, self.for_object):
            yield Location(pose) if pose is not None else None

    def _no_place_failure(self) -> PlanFailure:
        what = self.for_object.name if self.for_object is not None else "anything"
        return ObjectUnavailable(f"there is no room for {what} on {self.urdf_link_name}", self.urdf_link_name, what)
