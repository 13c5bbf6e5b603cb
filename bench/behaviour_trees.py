"""Measure the cost of a tick of a behaviour tree of py_trees that is remembered.

    python -m bench.behaviour_trees            200 pairs of turns of 50 ticks for each of three trees, about two minutes
    python -m bench.behaviour_trees --quick    4 pairs of short turns

Each tree has 100 behaviours: 11 sequences below a parallel, each with eight leaves. In the *quiet* tree seven
conditions of each sequence hold and an action runs, so nothing changes. In the *idle* tree the last leaf fails, so the
whole tree ends in each tick with the same outcome. In the *busy* tree one behaviour alternates between RUNNING and
SUCCEEDED, and with it the rest of its sequence. Two copies of a tree, one remembered, take turns in random order in one
thread, whose CPU time counts. The script prints one JSON line: the CPU time of a tick in µs, plain and remembered, the
median of the ratios within the pairs, and the events that a tick writes.
"""

from __future__ import annotations

import json
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from py_trees.behaviour import Behaviour
from py_trees.common import ParallelPolicy, Status
from py_trees.composites import Parallel, Sequence
from py_trees.trees import BehaviourTree

from pycrorm_async import Memory, Settings
from pycrorm_async.integrations.py_trees import RememberedTree

PAIRS, TICKS = (4, 10) if "--quick" in sys.argv else (200, 50)


class Leaf(Behaviour):
    """A behaviour whose outcome a function chooses."""

    def __init__(self, name: str, outcome: Callable[[], Status]) -> None:
        super().__init__(name)
        self._outcome = outcome

    def update(self) -> Status:
        return self._outcome()


def tree_of(first: Callable[[], Status], last: Status) -> BehaviourTree:
    """Return a tree of 100 behaviours; `last` is the outcome of the last leaf of each sequence."""
    root = Parallel("robot", ParallelPolicy.SuccessOnAll(synchronise=False))
    for number in range(11):
        leaves = [Leaf(f"condition {each}", lambda: Status.SUCCESS) for each in range(7)]
        if number == 0:
            leaves[0] = Leaf("first", first)
        root.add_child(Sequence(f"task {number}", memory=False, children=[*leaves, Leaf("action", lambda: last)]))
    return BehaviourTree(root)


def alternating() -> Callable[[], Status]:
    state = {"holds": False}

    def outcome() -> Status:
        state["holds"] = not state["holds"]
        return Status.SUCCESS if state["holds"] else Status.RUNNING

    return outcome


def quiet() -> BehaviourTree:
    return tree_of(lambda: Status.SUCCESS, Status.RUNNING)


def idle() -> BehaviourTree:
    return tree_of(lambda: Status.SUCCESS, Status.FAILURE)


def busy() -> BehaviourTree:
    return tree_of(alternating(), Status.RUNNING)


def turn_us(tree: BehaviourTree) -> float:
    began_ns = time.thread_time_ns()
    for _ in range(TICKS):
        tree.tick()
    return (time.thread_time_ns() - began_ns) / TICKS / 1_000


def measure(make: Callable[[], BehaviourTree], folder: Path, order: random.Random) -> dict[str, Any]:
    """Return the CPU time of a tick of a plain and of a remembered tree."""
    trees = {"plain": make(), "remembered": make()}
    took: dict[str, list[float]] = {name: [] for name in trees}
    with Memory.sync(f"sqlite:///{folder / make.__name__}.db", settings=Settings(fold="at_end")) as memory:
        with RememberedTree(trees["remembered"], memory.recording, instant_s=10.0):
            for tree in trees.values():  # the first tick writes every node
                tree.tick()
            before = memory.status.written
            for _ in range(PAIRS):
                for name in order.sample(list(trees), 2):
                    took[name].append(turn_us(trees[name]))
            events = memory.status.written - before
        assert memory.status.faults.total == 0
    ratios = [later / first for first, later in zip(took["plain"], took["remembered"], strict=True)]
    return {
        "plain_us": round(median(took["plain"]), 1),
        "remembered_us": round(median(took["remembered"]), 1),
        "ratio": round(median(ratios), 3),
        "events_a_tick": round(events / PAIRS / TICKS, 2),
    }


def main() -> None:
    order = random.Random(7)
    with tempfile.TemporaryDirectory() as folder:
        results = {make.__name__: measure(make, Path(folder), order) for make in (quiet, idle, busy)}
    print(json.dumps({"bench": "behaviour_trees", "behaviours": 100, "pairs": PAIRS, **results}))


if __name__ == "__main__":
    main()
