"""The expressions of the plan language: each is a node of the task tree, with those of its operands below it.

`select(Language)` gives all of them; what they performed is found by `TaskTreeNode.parent_id`. There are none among
actions and motions.

>>> interrupted = select(Monitor).join(Monitor.node).where(TaskTreeNode.status == TaskStatus.INTERRUPTED)
"""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from pycrorm_async.orm.designators import Language

__all__ = ["Sequential", "TryInOrder", "Parallel", "TryAll", "Repeat", "Monitor", "Code", "Retry"]


class Sequential(Language):
    """One after the other, up to the first that failed."""

    __tablename__ = "sequential"

    id: Mapped[int] = mapped_column(ForeignKey("language.id"), primary_key=True)


class TryInOrder(Language):
    """One after the other, up to the first that succeeded."""

    __tablename__ = "try_in_order"

    id: Mapped[int] = mapped_column(ForeignKey("language.id"), primary_key=True)


class Parallel(Language):
    """All at once; all had to succeed."""

    __tablename__ = "parallel"

    id: Mapped[int] = mapped_column(ForeignKey("language.id"), primary_key=True)


class TryAll(Language):
    """All at once; one had to succeed."""

    __tablename__ = "try_all"

    id: Mapped[int] = mapped_column(ForeignKey("language.id"), primary_key=True)


class Repeat(Language):
    """Again and again, so many times."""

    __tablename__ = "repeat"

    id: Mapped[int] = mapped_column(ForeignKey("language.id"), primary_key=True)
    times: Mapped[int]


class Monitor(Language):
    """Until it was done, or until a condition held; then the status of its node is INTERRUPTED.

    Attributes:
        condition: the qualified name of what was asked.
        interval_s: how often it was asked.
    """

    __tablename__ = "monitor"

    id: Mapped[int] = mapped_column(ForeignKey("language.id"), primary_key=True)
    condition: Mapped[str]
    interval_s: Mapped[float]


class Code(Language):
    """A function was called.

    Attributes:
        function: its qualified name.
    """

    __tablename__ = "code"

    id: Mapped[int] = mapped_column(ForeignKey("language.id"), primary_key=True)
    function: Mapped[str]

    @property
    def arguments(self) -> dict[str, str]:
        """By name, each as a short text."""
        return self.mapping("arguments")


class Retry(Language):
    """Again, with the next alternative if there was one, until it succeeded; at most so many times."""

    __tablename__ = "retry"

    id: Mapped[int] = mapped_column(ForeignKey("language.id"), primary_key=True)
    max_tries: Mapped[int]
