"""A thousand random plans: the memory of each agrees with what its parts report."""

from __future__ import annotations

import asyncio
import contextvars
import random
import sqlite3
from collections import Counter, defaultdict
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract
from tests.promises.random_plans import AT_ONCE, Generator, Journal, JournalEntry, PlanPart, built

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


# --- concurrency ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plans", [45, pytest.param(90, marks=pytest.mark.soak)])
async def test_concurrent_plans_in_tasks_never_share_a_parent(tmp_path: Path, plans: int) -> None:
    journals: dict[int, Journal] = {}

    async def some(first: int) -> None:
        for seed in range(first, plans, 3):
            journals[seed] = await play(seed, memory)

    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with asyncio.TaskGroup() as group:
            for first in range(3):
                group.create_task(some(first))
        await memory.flush()
    trees = recorded(tmp_path / "memory.db")
    for seed, journal in journals.items():
        assert trees.get(seed, []) == expected_rows(journal), f"seed {seed}: {plan_of(seed)}"


class Threads(ActionAbstract):
    """Perform three plans, each in a thread of its own with a copy of the context."""

    def __init__(self, journals: list[Journal]) -> None:
        self.journals = journals

    async def perform(self) -> None:
        await asyncio.gather(*(asyncio.to_thread(self._run, journal) for journal in self.journals))

    def _run(self, journal: Journal) -> None:
        contextvars.copy_context().run(asyncio.run, self._plan(journal))

    async def _plan(self, journal: Journal) -> None:
        task = asyncio.create_task(built(journal.plan, journal).perform())
        await asyncio.wait([task, *journal.tasks])
        if not task.cancelled():
            task.exception()


async def test_concurrent_plans_in_threads_never_share_a_parent(tmp_path: Path) -> None:
    seeds = [seed for seed in range(60) if seed % 5 < 2]
    rounds = [[Journal(plan_of(seed)) for seed in seeds[number : number + 3]] for number in range(0, len(seeds), 3)]
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        for number, journals in enumerate(rounds):
            async with memory.episode(description=str(number)):
                await Threads(journals).perform()
        await memory.flush()
    trees = recorded(tmp_path / "memory.db")
    for number, journals in enumerate(rounds):
        assert sorted(shapes(trees[number])) == sorted(
            shape for each in journals for shape in shapes(expected_rows(each))
        )


def shapes(rows: list[Row]) -> list[str]:
    """Return the trees below each root (or below `Threads`), as text, in order."""
    texts = [f"{dtype} {status} {reason} {message}" for dtype, _, status, reason, message in rows]
    children: dict[int | None, list[int]] = defaultdict(list)
    for number, (_, parent, *_) in enumerate(rows):
        children[parent].append(number)

    def shape(number: int) -> str:
        return f"{texts[number]} [{', '.join(map(shape, children[number]))}]"

    top = children[0] if rows[0][0] == "ThreadsAction" else children[None]
    return [shape(each) for each in top]
