"""Nodes of the task tree: one node for each `perform`, from its start to its end.

A node refers to its parent and not to its children, so that a plan of any length keeps only its current path in memory.
The parent of a new node is the current node of the same context; asyncio tasks inherit it, so that concurrent plans do
not mix. To keep a whole tree without a memory, collect it: `with collected_tree() as tree: await plan(); print(tree)`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

import msgspec

from pycrorm_async import connected_var
from pycrorm_async.connected_var import ConnectedVar
from pycrorm_async.plan.failures import Resource
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType, Pose

NodeKind = Literal["root", "action", "motion", "language"]


class TaskTreeNode(msgspec.Struct, eq=False):
    """One execution of a `perform`.

    Attributes:
        designator: the performed designator; None for the root of an episode.
        kind: root, action, motion or language.
        parent: the node it runs inside, in the same context; None for a top-level node.
        started_ns, ended_ns: monotonic time, ns; `ended_ns` is None while it runs.
        status: see `TaskStatus`.
        failure: the exception it ended with, if any.
        result: the value that `perform` returned.
        record: reserved for the observer that records the plan.
    """

    designator: Performable | None
    kind: NodeKind
    parent: TaskTreeNode | None
    started_ns: int
    status: TaskStatus = TaskStatus.RUNNING
    failure: BaseException | None = None
    result: Any = None
    ended_ns: int | None = None
    record: Any = None

    def __repr__(self) -> str:
        name = type(self.designator).__name__ if self.designator is not None else "root"
        return f"<{name} {self.status.name}>"


current_node: ContextVar[TaskTreeNode | None] = ContextVar("current_node", default=None)


class CollectedTree:
    """The nodes that started while the tree was collecting, in order; `print(tree)` draws them.

    Attributes:
        roots: the nodes whose parent is not in the tree.
    """

    def __init__(self) -> None:
        self.roots: list[TaskTreeNode] = []
        self._children: dict[TaskTreeNode, list[TaskTreeNode]] = {}

    def add(self, node: TaskTreeNode) -> None:
        """Add a node that has started."""
        siblings = self.roots if node.parent is None else self._children.get(node.parent, self.roots)
        siblings.append(node)
        self._children[node] = []

    def children(self, node: TaskTreeNode) -> tuple[TaskTreeNode, ...]:
        """Return the nodes that started inside this one, in order."""
        return tuple(self._children[node])

    def depth(self, node: TaskTreeNode) -> int:
        """Return the number of the node's ancestors in the tree."""
        above = 0
        while node.parent in self._children:
            node = node.parent
            above += 1
        return above

    def __len__(self) -> int:
        return len(self._children)

    def __iter__(self) -> Iterator[TaskTreeNode]:
        """Iterate over all nodes, parents before their children, siblings in the order of their start."""
        ahead = self.roots[::-1]
        while ahead:
            node = ahead.pop()
            yield node
            ahead.extend(reversed(self._children[node]))

    def __str__(self) -> str:
        lines = []
        ahead = [(node, "", "", "") for node in reversed(self.roots)]
        while ahead:
            node, indent, branch, below = ahead.pop()
            lines.append(f"{indent}{branch}{_line(node)}")
            children = self._children[node]
            forks = [("├── ", "│   ")] * (len(children) - 1) + [("└── ", "    ")]
            inner = [(child, indent + below, *fork) for child, fork in zip(children, forks, strict=False)]
            ahead.extend(reversed(inner))
        return "\n".join(lines)


def _line(node: TaskTreeNode) -> str:
    name = type(node.designator).__name__ if node.designator is not None else "root"
    if node.ended_ns is None:
        return f"{name} {node.status.name}"
    failure = f" ({type(node.failure).__name__})" if node.failure is not None else ""
    return f"{name} {node.status.name}{failure} {(node.ended_ns - node.started_ns) / 1e6:.1f} ms"


collecting: ContextVar[tuple[CollectedTree, ...]] = ContextVar("collecting", default=())
"""The trees that collect the nodes of this context."""


@contextmanager
def collected_tree() -> Iterator[CollectedTree]:
    """Collect the nodes of this context, and of the tasks it starts, into a tree; with or without a memory.

    The tree keeps every node in memory, with its designator, failure and result.
    """
    tree = CollectedTree()
    token = collecting.set((*collecting.get(), tree))
    try:
        yield tree
    finally:
        collecting.reset(token)


# === performable ==============================================================================================
#
# Designators import the execution, which creates their nodes; with a protocol the execution need not import them.


class Performable(Protocol):
    """A designator, as its node sees it."""

    __kind__: ClassVar[NodeKind]
    __dtype__: ClassVar[str]
    __aliases__: ClassVar[Any]
    __concept__: ClassVar[str | None]
    __orm_class__: ClassVar[type | None]

    def perform(self) -> Coroutine[Any, Any, Any]:
        """Perform it and return when it has ended."""
        ...

    def resources(self) -> frozenset[Resource]:
        """Return the parts of the robot it uses exclusively from start to end."""
        ...


# === experience ===============================================================================================
#
# Port through which plans query a memory for past successful pick-ups.
#
# `experience` is the experience of the current context: that of the open memory, or None. The plan layer does not
# depend on its implementation.


@dataclass(frozen=True, slots=True)
class PastSuccess:
    """One way in which an object was picked up successfully.

    Attributes:
        torso_height: m; None for a robot without a torso.
        stand: pose of the robot's base in the object's own frame.
        score: the share of successes that is expected of this way, between 0 and 1; failures count.
        times: number of successes with exactly these values.
        evidence: number of tries that the score is based on, each counted by its likeness to this way.
        prior: the score of a way of which nothing is known.
    """

    arm: Arms
    grasp: Grasp
    torso_height: float | None
    stand: Pose
    score: float
    times: int = 1
    evidence: float = 1.0
    prior: float = 0.0


class Experience(Protocol):
    """A source of past successes."""

    async def successes(
        self, object_type: ObjectType, *, arm: Arms | None, height: float | None = None, torso: float | None = None
    ) -> Sequence[PastSuccess]:
        """Return ways in which objects of that type were picked up, each once, that with the highest score first.

        Args:
            arm: of the ways; None means any.
            height: of the object over the robot's base, m, for which the ways are scored; None means for each way the
                height at which it succeeded.
            torso: height of the torso for which they are scored, m; None means for each way its own.
        """
        ...


experience: ConnectedVar[Experience] = connected_var.experience


# === task branches ============================================================================================
#
# Wait for parallel tasks, so that none of them outlives its caller.
#
# An `asyncio.TaskGroup` is not suitable: it treats a cancelled branch as one that ended normally, and it cancels its
# own caller to wake it up, whereas the plan language must distinguish cancellations from outside and from inside.


async def join_tasks(tasks: Sequence[asyncio.Task[Any]]) -> asyncio.CancelledError | None:
    """Wait until all tasks have ended; cancel the others as soon as one was cancelled or raised.

    The tasks are cancelled once for each cancellation of the caller, and at least once if one of them broke. A branch
    is not cancelled again while it cleans up, unless the caller is.

    Returns:
        The last cancellation of the caller, which was passed on to the tasks; the caller must raise it again.
    """
    outside: asyncio.CancelledError | None = None
    cancellations_due = cancellations_sent = 0
    pending = set(tasks)
    while pending:
        try:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError as cancelled:
            outside = cancelled
            cancellations_due += 1
        except BaseException:  # the coroutine of a dropped plan is closed and cannot await any more
            _cancel(pending)
            raise
        else:
            if any(each.cancelled() or each.exception() is not None for each in done):
                cancellations_due = max(cancellations_due, 1)
        if cancellations_due > cancellations_sent:
            cancellations_sent = cancellations_due
            _cancel(pending)
    try:
        return outside
    finally:
        del outside


def raise_errors(tasks: Sequence[asyncio.Task[Any]], outside: asyncio.CancelledError | None) -> None:
    """Raise the exceptions of the tasks, several as a group; without one, raise the cancellation, if there was one.

    An exception takes precedence over a cancellation, like one that is raised while a plan cleans up.
    """
    raised = [each.exception() for each in tasks if not each.cancelled()]
    errors = [each for each in raised if each is not None]
    cancelled = outside or (asyncio.CancelledError() if any(each.cancelled() for each in tasks) else None)
    error = BaseExceptionGroup("several branches raised", errors) if len(errors) > 1 else next(iter(errors), cancelled)
    try:
        if error is not None:
            raise error
    finally:
        # The traceback of a raised exception holds this frame: break the reference cycle.
        del error, errors, raised, cancelled, outside, tasks


def _cancel(tasks: set[asyncio.Task[Any]]) -> None:
    for task in tasks:
        task.cancel()
