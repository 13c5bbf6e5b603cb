"""A thousand random plans: the memory of each agrees with what its parts report."""

from __future__ import annotations

import asyncio
import functools
import random
import sqlite3
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, Iterable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import pytest

from pycrorm_async import Memory
from pycrorm_async.plan import (
    ActionAbstract,
    ActionDescription,
    Designator,
    Monitor,
    Parallel,
    PlanFailure,
    Repeat,
    Resource,
    Retry,
    Sequential,
    TryAll,
    TryInOrder,
)
from pycrorm_async.plan.failures import IKError, ObjectLost, Timeout
from pycrorm_async.world import Arms, Pose

pytestmark = pytest.mark.slow


PLANS = 1_000
PARTS = 8
"""A part has plans of every kind, so that one part runs by default and the others in turns."""

Row = tuple[str, int | None, str, str | None, str | None]
"""Dtype, the index of the parent's row, status, and class and message of the failure."""

SQL = """
SELECT description, node.id, parent_id, dtype, node.status, reason, node.failure_message
FROM task_tree_node AS node JOIN process_metadata AS episode ON episode.id = node.process_metadata_id
ORDER BY node.id
"""


def plan_of(seed: int) -> PlanPart:
    return Generator(seed, wild=seed % 5 > 2, greedy=seed % 5 == 2).plan()


async def play(seed: int, memory: Memory) -> Journal:
    """Perform the plan of this seed in an episode of its own; every second wild one is cancelled from outside."""
    part = plan_of(seed)
    journal = Journal(part)
    async with memory.episode(description=str(seed)):
        plan = asyncio.create_task(built(part, journal).perform())
        if seed % 5 == 4:
            for _ in range(random.Random(-seed).randrange(60)):
                await asyncio.sleep(0)
            plan.cancel("from outside")
        await asyncio.wait([plan])
        if journal.tasks:
            await asyncio.wait(journal.tasks)
    for task in (plan, *journal.tasks):
        if not task.cancelled():
            task.exception()
    return journal


def recorded(file: Path) -> dict[int, list[Row]]:
    """Return the trees in the database, by seed, in the order their nodes started, without the roots of the
    episodes.
    """
    with closing(sqlite3.connect(file)) as database:
        rows = database.execute(SQL).fetchall()
    places: dict[int, int] = {}
    trees: dict[int, list[Row]] = defaultdict(list)
    for description, node, parent, dtype, status, reason, message in rows:
        if dtype is not None:
            tree = trees[int(description)]
            places[node] = len(tree)
            tree.append((dtype, places.get(parent), status, reason, message))
    return trees


def expected_rows(journal: Journal) -> list[Row]:
    return [(each.dtype, each.parent, each.status, each.reason, each.message) for each in journal.entries]


@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.soak) for part in range(1, PARTS))])
async def test_the_memory_of_a_random_plan_agrees_with_the_reports_of_its_parts(tmp_path: Path, part: int) -> None:
    journals: dict[int, Journal] = {}
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        for seed in range(part, PLANS, PARTS):
            async with asyncio.timeout(60):
                journals[seed] = await play(seed, memory)
        await memory.flush()
        assert memory.status.faults.total == 0
    assert_various(journals.values())
    trees = recorded(tmp_path / "memory.db")
    assert set(trees) == {seed for seed, journal in journals.items() if journal.entries}
    for seed, journal in journals.items():
        assert trees.get(seed, []) == expected_rows(journal), f"seed {seed}: {plan_of(seed)}"
        assert journal.collisions == [], f"seed {seed}: two branches held the same part of the robot"
        assert all(each.status != "RUNNING" for each in journal.entries), f"seed {seed}"


def assert_various(journals: Iterable[Journal]) -> None:
    """Check that the plans include each status and depth; otherwise their agreement would prove little."""
    seen: Counter[str] = Counter()
    for each in (entry for journal in journals for entry in journal.entries):
        seen.update((each.status, each.dtype, f"reason {each.reason}"))
    for status in ("SUCCEEDED", "FAILED", "ERROR", "CANCELLED", "INTERRUPTED"):
        assert seen[status] > 5, (status, seen)
    for name in "Sequential TryInOrder Parallel TryAll Repeat Retry Monitor Action".split():
        assert seen[f"Journaled{name}"] > 25, (name, seen)
    for name in "PlanFailures ExceptionGroup ResourceDeadlock ValueError Timeout".split():
        assert seen[f"reason {name}"] > 0, (name, seen)


# --- a second implementation of the plan language ---------------------------------------------------------------------

Tree = tuple[tuple[int, ...], bool, list["Tree"]]
"""Path, whether it succeeded, and the results of its children."""


class Interpreter:
    """Interpret a plan without bugs, cancellations, monitors and resources by the rules of the language."""

    def __init__(self) -> None:
        self.runs: dict[tuple[int, ...], int] = defaultdict(int)

    def of(self, part: PlanPart) -> Tree:
        if part.kind == "leaf":
            run = self.runs[part.path]
            self.runs[part.path] += 1
            return part.path, part.does[run % len(part.does)] == "ok", []
        done: list[Tree] = []
        for each in self.turns(part):
            done.append(self.of(each))
            if self.is_over(part.kind, succeeded=done[-1][1]):
                break
        return part.path, self.succeeded(part.kind, [success for _, success, _ in done]), done

    def turns(self, part: PlanPart) -> list[PlanPart]:
        if part.kind in ("repeat", "retry"):
            return part.children * part.times
        return part.children[: part.times] if part.kind == "alternatives" else part.children

    def is_over(self, kind: str, *, succeeded: bool) -> bool:
        if kind in ("in_order", "retry", "alternatives"):
            return succeeded
        return kind in ("sequential", "then") and not succeeded

    def succeeded(self, kind: str, successes: list[bool]) -> bool:
        if kind == "anyway":
            return True
        return any(successes) if kind in ("in_order", "retry", "alternatives", "all") else all(successes)


def tree_of(entries: list[JournalEntry], root: int = 0) -> Tree:
    """Return the journal as a tree, with concurrent runs in the order in which they are written."""
    entry = entries[root]
    inside = [tree_of(entries, number) for number, each in enumerate(entries) if each.parent == root]
    if entry.part.kind in AT_ONCE:
        inside.sort(key=lambda each: each[0])
    return entry.part.path, entry.status == "SUCCEEDED", inside


@pytest.mark.parametrize("plans", [PLANS // PARTS, pytest.param(PLANS, marks=pytest.mark.soak)])
async def test_an_ordinary_random_plan_follows_the_rules_of_the_language(plans: int) -> None:
    async with Memory.open("sqlite://") as memory:
        for seed in range(0, plans, 5):
            for each in (seed, seed + 1):
                journal = await play(each, memory)
                assert tree_of(journal.entries) == Interpreter().of(plan_of(each)), f"seed {each}: {plan_of(each)}"


# === random plans =============================================================================================
#
# Plans made at random, whose parts keep a record of their own of what happened to them.
#
# A `PlanPart` is a part of a plan: it has its place (path) and what it will do. `built` makes the performable of it, of
# classes that write into a `Journal` when they start and how they end. The journal does not use the task tree: who is
# inside whom follows from the paths alone.

PartPath = tuple[int, ...]

AT_ONCE = ("parallel", "all", "gather", "group")
FLAT = ("sequential", "in_order", "parallel", "all")
ACTIONS = ("then", "anyway", "cleanup", "gather", "group", "timeout")
ORDINARY = ("sequential", "in_order", "parallel", "all", "repeat", "retry", "alternatives", "then", "anyway", "gather")
WILD = (*ORDINARY, "monitor", "monitor", "cleanup", "group", "timeout")


@dataclass
class PlanPart:
    """A part of a plan.

    Attributes:
        does: of a leaf, the outcome of each of its runs: ok, fail, bug, cancelled, cancels.
        times: rounds, attempts, or the check at which a monitor's condition holds.
    """

    kind: str
    path: PartPath
    children: list[PlanPart] = field(default_factory=list)
    does: list[str] = field(default_factory=list)
    pauses: int = 0
    times: int = 1
    wants: frozenset[Resource] = frozenset()
    nesting: int = 0

    def all(self) -> list[PlanPart]:
        return [self, *(each for child in self.children for each in child.all())]


class Generator:
    """Generate plans of nested expressions and actions.

    Args:
        wild: with bugs, cancellations, monitors, and parts of the robot that they require.
        greedy: branches that require resources at the outermost level, and often more inside.
    """

    def __init__(self, seed: int, *, wild: bool, greedy: bool) -> None:
        self._dice = random.Random(seed)
        self._kinds = WILD if wild or greedy else ORDINARY
        self._ends = ["ok"] * 12 + ["fail"] * 6 + (["bug", "cancelled", "cancels"] if wild else [])
        self._wild = wild
        self._greedy = greedy

    def plan(self) -> PlanPart:
        return self._part((), 4, "", self._dice.choice(["parallel", "all"]) if self._greedy else None)

    def _part(self, path: PartPath, depth: int, above: str, kind: str | None = None) -> PlanPart:
        dice = self._dice
        if depth == 0 or (path and dice.random() < 0.2):
            does = [dice.choice(self._ends) for _ in range(3)]
            return PlanPart("leaf", path, does=does, pauses=dice.choice([0, 0, 1, 2, 5]), wants=self._wants(0.5))
        # An expression inside one of its own kind would be merged with it: `nesting` produces that case.
        kinds = [each for each in self._kinds if each != above or each not in FLAT]
        kind = kind or dice.choice(ACTIONS if above in AT_ONCE and self._greedy else kinds)
        count = (
            1 if kind in ("repeat", "retry", "monitor", "timeout") else 2 if kind == "cleanup" else dice.randint(2, 4)
        )
        return PlanPart(
            kind,
            path,
            [self._part((*path, number), depth - 1, kind) for number in range(count)],
            times=dice.randint(1, 12) if kind == "monitor" else dice.randint(1, 3),
            pauses=dice.choice([0, 1, 3, 50]),
            wants=self._wants(0.3) if kind in ACTIONS else frozenset(),
            nesting=dice.randrange(3),
        )

    def _wants(self, chance: float) -> frozenset[Resource]:
        if not (self._wild or self._greedy) or self._dice.random() > (0.9 if self._greedy else chance):
            return frozenset()
        performables = [Resource.LEFT_ARM, Resource.RIGHT_ARM, Resource.BASE]
        return frozenset(self._dice.sample(performables, 1 if self._greedy else self._dice.randint(1, 2)))


@dataclass
class JournalEntry:
    """One run of a part."""

    part: PlanPart
    dtype: str
    parent: int | None
    status: str = "RUNNING"
    reason: str | None = None
    message: str | None = None


class Journal:
    """The runs that the parts report.

    Attributes:
        entries: in the order of their starts.
        fired: paths of the monitors whose condition held, until they run again.
        collisions: parts that held the same resource concurrently in branches of one parallel expression.
        tasks: started by actions of the plan.
    """

    def __init__(self, plan: PlanPart) -> None:
        self.entries: list[JournalEntry] = []
        self.fired: set[PartPath] = set()
        self.collisions: list[tuple[PartPath, PartPath]] = []
        self.tasks: list[asyncio.Task[Any]] = []
        self._runs: dict[PartPath, int] = {}
        self.plan = plan
        self._kinds = {part.path: part.kind for part in plan.all()}
        self.counts: dict[PartPath, int] = {}

    def started(self, part: PlanPart, dtype: str) -> JournalEntry:
        parent = self._runs[part.path[:-1]] if part.path else None
        entry = JournalEntry(part, dtype, parent)
        for other in self.entries:
            if other.status == "RUNNING" and other.part.wants & part.wants and self._in_turns(other.part, part):
                self.collisions.append((other.part.path, part.path))
        self._runs[part.path] = len(self.entries)
        self.entries.append(entry)
        return entry

    def ended(self, entry: JournalEntry, error: BaseException | None, *, interrupted: bool = False) -> None:
        if error is None:
            entry.status = "INTERRUPTED" if interrupted else "SUCCEEDED"
            return
        entry.reason = type(error).__name__
        entry.message = str(error)
        if isinstance(error, asyncio.CancelledError):
            path = entry.part.path
            inside = any(path[:length] in self.fired for length in range(len(path)))
            entry.status = "INTERRUPTED" if inside else "CANCELLED"
        else:
            entry.status = "FAILED" if all(isinstance(each, PlanFailure) for each in _leaves(error)) else "ERROR"

    def next_does(self, part: PlanPart) -> str:
        """Return the outcome of this run of a leaf."""
        run = self.counts[part.path] = self.counts.get(part.path, -1) + 1
        return part.does[run % len(part.does)]

    def _in_turns(self, one: PlanPart, other: PlanPart) -> bool:
        """Return whether neither is inside the other, and both are inside one parallel expression."""
        if one.path == other.path[: len(one.path)] or other.path == one.path[: len(other.path)]:
            return False
        shared = [a for a, b in zip(one.path, other.path, strict=False) if a == b]
        common = next(
            (number for number, (a, b) in enumerate(zip(one.path, other.path, strict=False)) if a != b), len(shared)
        )
        return any(self._kinds[one.path[:length]] in ("parallel", "all") for length in range(common + 1))


def _leaves(error: BaseException) -> list[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        return [leaf for each in error.exceptions for leaf in _leaves(each)]
    return [error]


class Journaled:
    """The common base of the classes below: a part, and a journal for its runs."""

    part: Any
    journal: Any

    async def journal_run(self, run: Callable[[], Awaitable[Any]]) -> Any:
        entry = self.journal.started(self.part, type(self).dtype)  # type: ignore[attr-defined]  # of the designator
        try:
            result = await run()
        except BaseException as error:
            self.journal.ended(entry, error)
            raise
        self.journal.ended(entry, None, interrupted=isinstance(self, Monitor) and result.interrupted)
        return result


class JournaledAction(Journaled, ActionAbstract):
    """A leaf, or an action that performs others in the way of its kind."""

    dtype: ClassVar[str] = "JournaledAction"

    def __init__(self, part: PlanPart, journal: Journal, performables: list[Designator]) -> None:
        self.part = part
        self.journal = journal
        self.parts = performables

    def resources(self) -> frozenset[Resource]:
        wants: frozenset[Resource] = self.part.wants
        return wants

    async def perform(self) -> Any:
        return await self.journal_run(getattr(self, f"_{self.part.kind}"))

    async def _leaf(self) -> str:
        does = self.journal.next_does(self.part)
        for _ in range(self.part.pauses):
            await asyncio.sleep(0)
        name = ".".join(map(str, self.part.path))
        if does == "fail":
            kinds = (PlanFailure(name), ObjectLost(name, 7), IKError(Pose([1, 2, 3]), Arms.LEFT, name))
            raise kinds[sum(self.part.path) % 3]
        if does == "bug":
            raise ValueError(name)
        if does == "cancelled":
            raise asyncio.CancelledError(name)
        if does == "cancels":
            task = asyncio.current_task()
            assert task is not None
            task.cancel(name)
            await asyncio.sleep(0)
        return name

    async def _then(self) -> None:
        for part in self.parts:
            await part.perform()

    async def _anyway(self) -> None:
        for part in self.parts:
            try:
                await part.perform()
            except PlanFailure:
                continue

    async def _cleanup(self) -> None:
        first, last = self.parts
        try:
            await first.perform()
        finally:
            await last.perform()

    async def _gather(self) -> None:
        tasks = [asyncio.create_task(part.perform()) for part in self.parts]
        self.journal.tasks += tasks
        try:
            await asyncio.gather(*tasks)
        finally:
            await asyncio.wait(tasks)

    async def _group(self) -> None:
        async with asyncio.TaskGroup() as group:
            for part in self.parts:
                self.journal.tasks.append(group.create_task(part.perform()))

    async def _timeout(self) -> None:
        (part,) = self.parts
        try:
            async with asyncio.timeout(self.part.pauses / 1e4):
                await part.perform()
        except TimeoutError:
            raise Timeout("too late") from None


class JournaledSequential(Journaled, Sequential):
    async def perform(self) -> Any:
        return await self.journal_run(super().perform)


class JournaledTryInOrder(Journaled, TryInOrder):
    async def perform(self) -> Any:
        return await self.journal_run(super().perform)


class JournaledParallel(Journaled, Parallel):
    async def perform(self) -> Any:
        return await self.journal_run(super().perform)


class JournaledTryAll(Journaled, TryAll):
    async def perform(self) -> Any:
        return await self.journal_run(super().perform)


class JournaledRepeat(Journaled, Repeat):
    async def perform(self) -> Any:
        return await self.journal_run(super().perform)


class JournaledRetry(Journaled, Retry):
    async def perform(self) -> Any:
        return await self.journal_run(super().perform)


class JournaledMonitor(Journaled, Monitor):
    async def perform(self) -> Any:
        self.journal.fired.discard(self.part.path)
        self.journal.counts[self.part.path] = 0
        return await self.journal_run(super().perform)


EXPRESSIONS: dict[str, type[JournaledSequential | JournaledTryInOrder | JournaledParallel | JournaledTryAll]] = {
    "sequential": JournaledSequential,
    "in_order": JournaledTryInOrder,
    "parallel": JournaledParallel,
    "all": JournaledTryAll,
}


def built(part: PlanPart, journal: Journal) -> Designator:
    """Return the performable of this part."""
    performables = [built(child, journal) for child in part.children]
    performable: Any
    if part.kind == "leaf" or part.kind in ACTIONS:
        return JournaledAction(part, journal, performables)
    if part.kind in FLAT:
        performable = nested(EXPRESSIONS[part.kind], performables, part.nesting)
    elif part.kind == "repeat":
        performable = JournaledRepeat(performables[0], part.times)
    elif part.kind == "monitor":
        performable = performables[0] >> JournaledMonitor(functools.partial(_holds, part, journal), interval_s=0.0005)
    else:
        performable = JournaledRetry(
            performables[0] if part.kind == "retry" else Alternatives(performables), part.times
        )
    performable.part, performable.journal = part, journal
    return performable  # type: ignore[no-any-return]  # one of those above


def nested(kind: type[Any], performables: list[Designator], nesting: int) -> Any:
    """Return the same expression, whole, or with its beginning or end in an expression of the same kind."""
    if len(performables) < 3 or nesting == 0:
        return kind(*performables)
    return (
        kind(kind(*performables[:2]), *performables[2:])
        if nesting == 1
        else kind(performables[0], kind(*performables[1:]))
    )


class Alternatives(ActionDescription[Designator]):
    """A description with these alternatives."""

    def __init__(self, performables: list[Designator]) -> None:
        super().__init__(lambda part: part, part=performables)


def _holds(part: PlanPart, journal: Journal) -> Any:
    """Return whether a monitor's condition holds; half of the conditions are async."""
    if part.times % 2:
        return _holds_later(part, journal)
    return _counted(part, journal)


async def _holds_later(part: PlanPart, journal: Journal) -> bool:
    await asyncio.sleep(0)
    return _counted(part, journal)


def _counted(part: PlanPart, journal: Journal) -> bool:
    journal.counts[part.path] += 1
    holds = journal.counts[part.path] > part.times
    if holds:
        journal.fired.add(part.path)
    return holds
