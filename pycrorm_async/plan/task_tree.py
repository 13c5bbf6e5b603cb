"""Nodes of the task tree: one node for each `perform`, from its start to its end.

A node refers to its parent and not to its children, so that a plan of any length keeps only its current path in memory.
The parent of a new node is the current node of the same context; asyncio tasks inherit it, so that concurrent plans do
not mix. To keep a whole tree without a memory, collect it: `with collected_tree() as tree: await plan(); print(tree)`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from pycrorm_async.plan.protocols import NodeKind, Performable
from pycrorm_async.task_status import TaskStatus


class TaskTreeNode:
    """One execution of a `perform`.

    Attributes:
        designator: the performed designator; None for the root of an episode.
        kind: root, action, motion or language.
        parent: the node it runs inside, in the same context; None for a top-level node.
        status: see `TaskStatus`.
        failure: the exception it ended with, if any.
        result: the value that `perform` returned.
        started_ns, ended_ns: monotonic time, ns; `ended_ns` is None while it runs.
        record: reserved for the observer that records the plan.
    """

    __slots__ = (
        "designator",
        "ended_ns",
        "failure",
        "kind",
        "parent",
        "record",
        "result",
        "started_ns",
        "status",
    )

    def __init__(
        self,
        designator: Performable | None,
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
