"""Port through which the plan layer reports its execution to an observer, usually a memory; plans run without one too.

`recorder` is the observer of the current context. It is called synchronously in the plan's task, so it must be quick.
An exception of `node_started` refuses the perform before it runs; its other methods must not raise.
"""

from __future__ import annotations

from collections.abc import Awaitable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

from pycrorm_async.connected_var import ConnectedVar
from pycrorm_async.world.enums import Arms, Grasp, ObjectType
from pycrorm_async.world.pose import Pose

if TYPE_CHECKING:
    from pycrorm_async.plan.object_designators import ObjectLike
    from pycrorm_async.plan.task_tree import TaskTreeNode
    from pycrorm_async.world.bullet import BulletWorld


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place that a location designator offers: a pose, and the arms that reach the target from there.

    A place from experience also has the grasp and the torso height (m) of the past success.
    """

    pose: Pose
    arms: tuple[Arms, ...] = ()
    grasp: Grasp | None = None
    torso_height: float | None = None


@dataclass(frozen=True, slots=True)
class Refusal:
    """A place that a location designator tried and does not offer, and the reason."""

    pose: Pose
    reason: str


@dataclass(frozen=True, slots=True)
class Cells:
    """The numbers of places in the costmaps of a search.

    Attributes:
        occupied: places with an obstacle too near for any heading.
        hidden: further places from which the target is not visible.
        free: all others, the best of which the search tries.
    """

    occupied: int
    hidden: int
    free: int


@dataclass(frozen=True, slots=True)
class Seen:
    """A percept: an object that perception reports, whether or not the world has it.

    >>> Seen(milk, pose=Pose([1.31, 1, 0.9]), confidence=0.92, source="stereo")
    >>> Seen(BelieveObject("cup?", ObjectType.JEROEN_CUP, Pose([1.2, 0.4, 0.9])), confidence=0.31, source="stereo")

    Attributes:
        thing: the object of the world that the percept matches; a `BelieveObject` if it matches none, which may be a
            hypothesis or a false positive.
        visible: the visible share of the object, 0 to 1; None if it was not computed.
        pose: the perceived pose; None means the pose of `thing`.
        confidence: the confidence as the robot's perception computed it; None if it computed none.
        source: name of the sensor or method; None means the source of the whole detection.
    """

    thing: ObjectLike
    visible: float | None = None
    pose: Pose | None = None
    confidence: float | None = None
    source: str | None = None


class Simulation:
    """A running simulation: plans performed in a copy of the world (see `execution.simulation`).

    Attributes:
        description: in words; None if the caller passed none.
        world: the copy; None if there was no world to copy.
        by: the node that runs the simulation; None outside any node.
        record: reserved for the observer that records the plan.
    """

    __slots__ = ("by", "description", "record", "world")

    def __init__(self, description: str | None, world: BulletWorld | None, by: TaskTreeNode | None) -> None:
        self.description = description
        self.world = world
        self.by = by
        self.record: Any = None


class PlanObserver(Protocol):
    """Receives every node, resolved location, perception and simulation of the plans in its context."""

    def admit(self) -> Awaitable[None] | None:
        """Return None if a node may start at once, otherwise an awaitable to await before (it may raise)."""
        ...

    def node_started(self, node: TaskTreeNode) -> None:
        """Called before `perform` runs, with status RUNNING. May raise to refuse it. May set `node.record`."""
        ...

    def node_ended(self, node: TaskTreeNode) -> None:
        """Called exactly once for every started node, after its status, failure and result are set."""
        ...

    def location_resolved(
        self,
        *,
        location: str,
        offered: tuple[Candidate, ...],
        taken: int | None,
        considered: int,
        refused: tuple[Refusal, ...],
        offered_beyond: int,
        cells: Cells | None,
        node: TaskTreeNode | None,
    ) -> None:
        """Called after a location designator was resolved or iterated.

        Args:
            location: the designator's class name.
            offered: the first places it offered, and the last one.
            taken: index of the offered place that was taken; None if none was.
            considered: number of places it tried.
            refused: the first places that it tried in vain, in the order of the search.
            offered_beyond: number of further places that it offered.
            cells: the places in its costmaps; None if it has none, or ended before they were made.

        Called once per resolution, in another context if a loop over places was dropped.
        """
        ...

    def object_detected(
        self,
        *,
        source: Literal["camera", "world_state"],
        object_type: ObjectType | None,
        seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> None:
        """Called after a perception, with the perceived objects, the best visible first."""
        ...

    def simulation_started(self, simulation: Simulation) -> None:
        """Called when a simulation starts in this context. May set `simulation.record`."""
        ...

    def simulation_ended(self, simulation: Simulation, failure: BaseException | None) -> None:
        """Called exactly once at the end of every started simulation, before its world closes.

        `failure` is the exception that left the simulation, if any.
        """
        ...


recorder: ConnectedVar[PlanObserver] = ConnectedVar("recorder")

current_simulation: ContextVar[Simulation | None] = ContextVar("current_simulation", default=None)
"""The innermost simulation of this context; None outside a simulation."""
