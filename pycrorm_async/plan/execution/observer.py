"""What the plan layer asks of a memory: to be told what happens. Without one a plan runs the same.

`recorder` is the memory of this context. It is told in the caller's task, synchronously, and must be quick;
what it raises from `node_started` refuses the perform before it runs, everything else it must keep to
itself.
"""

from __future__ import annotations

from collections.abc import Awaitable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

from pycrorm_async.connected_var import ConnectedVar
from pycrorm_async.world.enums import Arms, Grasp, ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose

if TYPE_CHECKING:
    from pycrorm_async.plan.task_tree import TaskTreeNode
    from pycrorm_async.world.bullet import BulletWorld

__all__ = ["PlanObserver", "Candidate", "Seen", "Thought", "recorder", "thinking"]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place a location designator offers: a pose, and the arms that reach from there.

    A place that comes from experience also says with which grasp and torso height (m) it went well.
    """

    pose: Pose
    arms: tuple[Arms, ...] = ()
    grasp: Grasp | None = None
    torso_height: float | None = None


@dataclass(frozen=True, slots=True)
class Seen:
    """An object that was perceived, and the share of it that was seen, 0 to 1 (None: nobody looked)."""

    thing: Object
    visible: float | None = None


class Thought:
    """Something that is thought through in a copy of the world, and does not happen (`plan.thinking`).

    Attributes:
        description: in words; None: nobody said.
        world: the copy; None if there was no world to copy.
        by: the node in which it is thought; None outside any.
        record: belongs to whoever records the plan.
    """

    __slots__ = ("by", "description", "record", "world")

    def __init__(self, description: str | None, world: BulletWorld | None, by: TaskTreeNode | None) -> None:
        self.description = description
        self.world = world
        self.by = by
        self.record: Any = None


class PlanObserver(Protocol):
    """Told of every node, resolved location, perception and thought of the plans in its context."""

    def admit(self) -> Awaitable[None] | None:
        """None if a node may start at once; otherwise what must be awaited first (it may raise)."""
        ...

    def node_started(self, node: TaskTreeNode) -> None:
        """Status RUNNING; `perform` has not run yet. May raise to refuse it. May set `node.record`."""
        ...

    def node_ended(self, node: TaskTreeNode) -> None:
        """Status, failure and result are set. Called exactly once for every node that started."""
        ...

    def location_resolved(
        self,
        *,
        location: str,
        offered: tuple[Candidate, ...],
        taken: int | None,
        considered: int,
        node: TaskTreeNode | None,
    ) -> None:
        """A location designator was asked: what it offered, which was taken, how many places it looked at.

        Called once for each time it is asked, perhaps in another context (a loop over places that is
        dropped).
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
        """Perception answered: what was looked for, and what was found, best seen first."""
        ...

    def thought_began(self, thought: Thought) -> None:
        """From now on what happens in this context is only thought. May set `thought.record`."""
        ...

    def thought_ended(self, thought: Thought, failure: BaseException | None) -> None:
        """It is over; `failure` left it. Called exactly once for every thought that began, its world still open."""
        ...


recorder: ConnectedVar[PlanObserver] = ConnectedVar("recorder")

thinking: ContextVar[Thought | None] = ContextVar("thinking", default=None)
"""The innermost thought of this context; None where things really happen."""
