"""A fake observer of plans that refuses an impossible order, and actions that log their runs."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

from pycrorm_async.plan import ActionAbstract, CollectedTree, PlanFailure, Resource
from pycrorm_async.plan.execution import (
    Candidate,
    Cells,
    Refusal,
    Search,
    Seen,
    Simulation,
    current_simulation,
    recorder,
)
from pycrorm_async.plan.task import TaskTreeNode, current_node
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import ObjectType

# === fake observer ============================================================================================
#
# A fake observer of plans that keeps every notification and refuses an impossible order.


class OrderBroken(AssertionError):
    """The plan layer notified the observer in an impossible order."""


class Recording:
    """Implements `PlanObserver`. `notes` has "start X", "end X STATUS" and "place X" in order."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.refused: list[tuple[Refusal, ...]] = []
        self.offered_beyond: list[int] = []
        self.cells: list[Cells | None] = []
        self.places: list[tuple[str, tuple[Candidate, ...], int | None, int, TaskTreeNode | None]] = []
        self.open: list[TaskTreeNode] = []
        self.ended: list[TaskTreeNode] = []
        self.thoughts: list[Simulation] = []

    async def wait_for_notes(self, count: int) -> None:
        """Wait until it has this many notes."""
        async with asyncio.timeout(10):
            while len(self.notes) < count:  # noqa: ASYNC110  the plan layer sets no event of the test
                await asyncio.sleep(0)

    def admit(self) -> Awaitable[None] | None:
        return None

    def node_started(self, node: TaskTreeNode) -> None:
        if node.status is not TaskStatus.RUNNING or node.ended_ns is not None or node.record is not None:
            raise OrderBroken(f"{node} starts, and is not new")
        if current_node.get() is not node.parent:
            raise OrderBroken(f"{node} starts outside its parent")
        if node.parent is not None and node.parent.record is self and node.parent not in self.open:
            raise OrderBroken(f"{node} starts inside {node.parent}, which is over")
        node.record = self
        self.open.append(node)
        self.notes.append(f"start {type(node.designator).__name__}")

    def node_ended(self, node: TaskTreeNode) -> None:
        if node not in self.open:
            raise OrderBroken(f"{node} ends, and is not open")
        if node.status is TaskStatus.RUNNING or node.ended_ns is None or node.ended_ns < node.started_ns:
            raise OrderBroken(f"{node} ends without an end")
        if any(each.parent is node for each in self.open):
            raise OrderBroken(f"{node} ends before its children")
        self.open.remove(node)
        self.ended.append(node)
        self.notes.append(f"end {type(node.designator).__name__} {node.status.name}")

    def location_resolved(self, search: Search) -> None:
        self.refused.append(tuple(search.refused))
        self.offered_beyond.append(search.offered_beyond)
        self.cells.append(search.cells)
        self.places.append((search.location, tuple(search.offered), search.taken, search.considered, search.node))
        self.notes.append(f"place {search.location}")

    def object_detected(
        self,
        *,
        source: Literal["camera", "world_state"],
        object_type: ObjectType | None,
        seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> None:
        self.notes.append(f"saw {' '.join(each.thing.name for each in seen)}".strip())

    def simulation_started(self, simulation: Simulation) -> None:
        if (
            simulation.record is not None
            or current_simulation.get() is not simulation
            or current_node.get() is not None
        ):
            raise OrderBroken(f"{simulation} begins, and is not what is thought")
        simulation.record = self
        self.thoughts.append(simulation)
        self.notes.append(f"think {simulation.description}")

    def simulation_ended(self, simulation: Simulation, failure: BaseException | None) -> None:
        if not self.thoughts or self.thoughts.pop() is not simulation:
            raise OrderBroken(f"{simulation} ends, and is not the innermost")
        if simulation.world is not None and not simulation.world.entered:
            raise OrderBroken("the copy is closed before the thought is over")
        self.notes.append(f"thought {type(failure).__name__ if failure is not None else 'through'}")

    @contextmanager
    def listening(self) -> Iterator[Recording]:
        token = recorder.set(self)
        try:
            yield self
        finally:
            recorder.reset(token)


# === step actions =============================================================================================
#
# Actions that log their runs, for tests of the plan language.


@dataclass
class Step(ActionAbstract):
    """Returns its name, after some turns of the loop.

    Attributes:
        log: gets "name" when it starts and "name." when it is done.
        fails: what it raises then.
    """

    name: str
    log: list[str] = field(default_factory=list)
    turns: int = 0
    fails: BaseException | None = None
    needs: Iterable[Resource] = ()

    def resources(self) -> frozenset[Resource]:
        return frozenset(self.needs)

    async def perform(self) -> str:
        self.log.append(self.name)
        for _ in range(self.turns):
            await asyncio.sleep(0)
        if self.fails is not None:
            raise self.fails
        self.log.append(f"{self.name}.")
        return self.name


@dataclass
class Around(ActionAbstract):
    """Perform one action inside itself, and hold the resources meanwhile."""

    inner: ActionAbstract
    needs: Iterable[Resource] = ()
    before: int = 0

    def resources(self) -> frozenset[Resource]:
        return frozenset(self.needs)

    async def perform(self) -> object:
        for _ in range(self.before):
            await asyncio.sleep(0)
        return await self.inner.perform()


def failing(name: str, message: str = "", turns: int = 0) -> Step:
    return Step(name, fails=PlanFailure(message or f"{name} failed"), turns=turns)


def drawn(tree: CollectedTree) -> list[str]:
    """Return the drawing of the tree without durations."""
    return re.sub(r" \d+\.\d ms", "", str(tree)).splitlines()
