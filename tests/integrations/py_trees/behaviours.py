"""Behaviours and trees for the tests, and a visitor that counts what py_trees visits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import py_trees
from py_trees.common import Status

SUCCESS, FAILURE, RUNNING, INVALID = Status.SUCCESS, Status.FAILURE, Status.RUNNING, Status.INVALID


class Scripted(py_trees.behaviour.Behaviour):
    """Returns the given outcomes and messages, one a tick, and the last one from then on."""

    def __init__(self, name: str, outcomes: Iterable[Status], *feedback: str) -> None:
        super().__init__(name)
        self._outcomes = list(outcomes)
        self._feedback = [*feedback] or [""]

    def update(self) -> Status:
        self.feedback_message = self._feedback.pop(0) if len(self._feedback) > 1 else self._feedback[0]
        return self._outcomes.pop(0) if len(self._outcomes) > 1 else self._outcomes[0]


class Condition(Scripted):
    """A behaviour that only looks."""


class Broken(py_trees.behaviour.Behaviour):
    """Raises in its tick."""

    def __init__(self, name: str, error: BaseException) -> None:
        super().__init__(name)
        self._error = error

    def update(self) -> Status:
        raise self._error


class Visits(py_trees.visitors.VisitorBase):
    """Notes the statuses with which each behaviour was visited."""

    def __init__(self) -> None:
        super().__init__(full=False)
        self.statuses: dict[str, list[Status]] = {}

    def run(self, behaviour: Any) -> None:
        self.statuses.setdefault(behaviour.name, []).append(behaviour.status)


def tree(root: Any) -> Any:
    return py_trees.trees.BehaviourTree(root)


def sequence(name: str, *children: Any, memory: bool = False) -> Any:
    return py_trees.composites.Sequence(name, memory, list(children))


def selector(name: str, *children: Any, memory: bool = False) -> Any:
    return py_trees.composites.Selector(name, memory, list(children))


def parallel(name: str, *children: Any) -> Any:
    policy = py_trees.common.ParallelPolicy.SuccessOnAll(synchronise=False)
    return py_trees.composites.Parallel(name, policy, list(children))


def tick(ticked: Any, count: int) -> None:
    for _ in range(count):
        ticked.tick()


def named(statuses: Sequence[str]) -> list[Status]:
    """Return statuses by their initials."""
    return [{"S": SUCCESS, "F": FAILURE, "R": RUNNING}[each] for each in statuses]
