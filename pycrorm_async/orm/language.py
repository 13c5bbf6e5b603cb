"""Map the expressions of the plan language.

Each expression is a node of the task tree, and the nodes of its operands are its children (`TaskTreeNode.parent_id`).
`select(Language)` returns all expressions; `select(Action)` and `select(Motion)` return none.

>>> interrupted = select(Monitor).join(Monitor.node).where(TaskTreeNode.status == TaskStatus.INTERRUPTED)
"""

from __future__ import annotations

from sqlalchemy.orm import Mapped

from pycrorm_async.orm.designators import Language

__all__ = ["Sequential", "TryInOrder", "Parallel", "TryAll", "Repeat", "Monitor", "Code", "Retry"]


class Sequential(Language):
    """Performs its operands in order, up to the first that fails."""

    __tablename__ = "sequential"


class TryInOrder(Language):
    """Performs its operands in order, up to the first that succeeds."""

    __tablename__ = "try_in_order"


class Parallel(Language):
    """Performs its operands concurrently; succeeds if all do."""

    __tablename__ = "parallel"


class TryAll(Language):
    """Performs its operands concurrently; succeeds if one does."""

    __tablename__ = "try_all"


class Repeat(Language):
    """Performs its operand `times` times."""

    __tablename__ = "repeat"

    times: Mapped[int]


class Monitor(Language):
    """Performs its operand until that ends or a condition holds; in the latter case its node becomes INTERRUPTED.

    Attributes:
        condition: the qualified name of the condition.
        interval_s: the time between two evaluations of it.
    """

    __tablename__ = "monitor"

    condition: Mapped[str]
    interval_s: Mapped[float]


class Code(Language):
    """Calls a function.

    Attributes:
        function: its qualified name.
    """

    __tablename__ = "code"

    function: Mapped[str]

    @property
    def arguments(self) -> dict[str, str]:
        """The call's arguments by name, each as a short text."""
        return self.mapping("arguments")


class Retry(Language):
    """Repeats its operand, or its next alternative, until one succeeds, at most `max_tries` times."""

    __tablename__ = "retry"

    max_tries: Mapped[int]
