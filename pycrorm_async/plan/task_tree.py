"""A node of the task tree: one `perform`, from its start to its end, with the node it ran inside.

Nodes know their parent and not their children, so a plan of any length keeps only the path it is on in memory. The
parent of a new node is the current node of the same context: asyncio tasks inherit it, concurrent plans never mix.
To see a whole tree without a memory, collect it: `with collected_tree() as tree: await plan(); print(tree)`.
"""

from __future__ import annotations

from contextvars import ContextVar
from enum import Enum
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from pycrorm_async.plan.designator import Designator

__all__ = ["NodeKind", "TaskStatus", "TaskTreeNode", "current_node"]

NodeKind = Literal["root", "action", "motion", "language"]


class TaskStatus(Enum):
    """How far a node got. LOST is never seen by a plan: its process died while the node was running."""

    RUNNING = "RUNNING"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"
    """A plan failure: `PlanFailure` or one of its kinds was raised."""
    ERROR = "ERROR"
    """Any other exception was raised."""
    CANCELLED = "CANCELLED"
    INTERRUPTED = "INTERRUPTED"
    """By a monitor."""
    LOST = "LOST"


class TaskTreeNode:
    """One `perform`.

    Attributes:
        designator: the performable; None for the root of an episode.
        kind: root, action, motion, language.
        parent: the node it runs inside, in the same context; None outside any.
        status: see `TaskStatus`.
        failure: the exception it ended with, if any.
        result: what `perform` returned.
        started_ns, ended_ns: monotonic time, ns; `ended_ns` is None while it runs.
        record: belongs to whoever records the plan.
    """

    __slots__ = (
        "designator", "kind", "parent", "status", "failure", "result", "started_ns", "ended_ns", "record",
    )  # fmt: skip

    def __init__(
        self,
        designator: Designator | None,
        kind: NodeKind,
        parent: TaskTreeNode | None,
        started_ns: int,
    ) -> None:
        self.designator = designator
        self.kind: NodeKind = kind
        self.parent = parent
        self.status = TaskStatus.RUNNING
        self.failure: BaseException | None = None
        self.result: Any = None
        self.started_ns = started_ns
        self.ended_ns: int | None = None
        self.record: Any = None

    def __repr__(self) -> str:
        name = type(self.designator).__name__ if self.designator is not None else "root"
        return f"<{name} {self.status.name}>"


current_node: ContextVar[TaskTreeNode | None] = ContextVar("current_node", default=None)
