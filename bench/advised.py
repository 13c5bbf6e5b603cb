"""Measure what advice is worth in a kitchen: failed attempts and objects placed, with `memory.advising` and without.

    python -m bench.advised                40 tasks for each of three seeds, some minutes
    python -m bench.advised --quick        one seed, a few tasks

A memory remembers 300 tries of the default policy: milk at a random place on one of the three worktops, turned at
random, collisions of the base and the arm count. In each task the milk is at another such place, and the robot picks it
up with `Retry(MoveAndPickUp(milk), max_tries=5)` and brings it to a further place with `TransportAction`. All ways get
the same tasks, and `MoveAndPickUp` draws the same 100 alternatives for all; the advised plan tries those first that the
memory expects to succeed, and leaves out those below a chance of 30 %; with `explore=False` also those of which too
little is known. Each way has a memory of its own, to which its tasks are added. The robot is kinematic, and a failed
attempt is a `MoveAndPickUpAction` that failed.

The script prints one JSON line; the table is on stderr. Intervals are Wilson's, 95 %; that of failed attempts for 100
tasks is of the mean over the tasks.
"""

from __future__ import annotations

import asyncio
import json
import math
import shutil
import tempfile
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track
from rich.table import Table

from bench.first_tries import fill, in_kitchen
from bench.material.runs import options
from bench.reporting.figures import console
from pycrorm_async import Memory
from pycrorm_async.learning import MoveAndPickUp
from pycrorm_async.learning.experiment import KITCHEN
from pycrorm_async.learning.scenes import Stage
from pycrorm_async.plan import PlanFailure, Retry
from pycrorm_async.plan.actions import MoveAndPickUpPerformable, TransportActionPerformable
from pycrorm_async.plan.task import collected_tree
from pycrorm_async.query.frames import NORMAL_95
from pycrorm_async.query.success import interval_95
from pycrorm_async.world import Pose

REMEMBERED, TASKS, SEEDS, TRIES_MAX, SAMPLES, MINIMUM = 300, 40, 3, 5, 100, 0.3

WAYS: dict[str, Callable[[Memory], AbstractContextManager[None]]] = {
    "on its own": lambda _: nullcontext(),
    "advised": lambda memory: memory.advising(MINIMUM),
    "advised, not exploring": lambda memory: memory.advising(MINIMUM, explore=False),
}


@dataclass
class Outcome:
    """The outcomes of the tasks of one way: failed attempts of each, and the numbers of those picked up and placed."""

    failed: list[int] = field(default_factory=list)
    first: int = 0
    picked: int = 0
    placed: int = 0

    def figures(self) -> dict[str, Any]:
        tasks, failed = len(self.failed), np.array(self.failed)
        off = NORMAL_95 * failed.std(ddof=1) / math.sqrt(tasks) if tasks > 1 else math.inf
        counts = {"first_try": self.first, "picked": self.picked, "placed": self.placed}
        shares = {name: [count, *_rounded(interval_95(count, tasks))] for name, count in counts.items()}
        return {
            "tasks": tasks,
            "failed_per_100": round(100 * failed.mean(), 1),
            "failed_interval": [round(100 * (failed.mean() + sign * off), 1) for sign in (-1, 1)],
            **shares,
        }


def _rounded(numbers: Iterable[float]) -> list[float]:
    return [round(each, 3) for each in numbers]


async def perform(stage: Stage, goal: Pose, rng: np.random.Generator, outcome: Outcome) -> None:
    """Pick the milk up, with `TRIES_MAX` attempts at most, and bring it to the goal."""
    with collected_tree() as tree:
        try:
            await Retry(MoveAndPickUp(stage.target, samples=SAMPLES, rng=rng), max_tries=TRIES_MAX).perform()
            picked = True
        except PlanFailure:
            picked = False
    attempts = [each for each in tree if isinstance(each.designator, MoveAndPickUpPerformable)]
    failed = sum(each.failure is not None for each in attempts)
    outcome.failed.append(failed)
    outcome.picked += picked
    outcome.first += picked and not failed
    if picked:
        done = attempts[-1].designator
        assert isinstance(done, MoveAndPickUpPerformable)
        try:
            await TransportActionPerformable(stage.target, done.arm, goal).perform()
            outcome.placed += 1
        except PlanFailure:
            pass


async def remember(url: str, seed: int, tries: int) -> None:
    """Record tries of the default policy in the kitchen."""
    async with Memory.open(url) as memory:
        await fill(memory, in_kitchen(), tries, np.random.default_rng((seed, 0)), 0.0)


async def tasks(url: str, way: str, seed: int, count: int, outcome: Outcome) -> None:
    """Perform the tasks of this seed in a memory that remembers tries."""
    kitchen = in_kitchen()
    async with Memory.open(url) as memory:
        with KITCHEN.entered() as stage, WAYS[way](memory):
            for number in track(range(count), way, console=console()):
                rng = np.random.default_rng((seed, 1, number))
                kitchen.prepare(stage, rng, number)
                goal = stage.target.pose
                kitchen.prepare(stage, rng, number)
                async with memory.episode(description=f"task {number} of seed {seed}", seed=seed):
                    await perform(stage, goal, rng, outcome)


async def measure(folder: Path, seeds: int, count: int, remembered: int) -> dict[str, Outcome]:
    """Return the outcomes by way."""
    outcomes = {way: Outcome() for way in WAYS}
    for seed in range(seeds):
        filled = folder / f"{seed}.db"
        await remember(f"sqlite:///{filled}", seed, remembered)
        for number, (way, outcome) in enumerate(outcomes.items()):
            file = shutil.copy(filled, folder / f"{seed}_{number}.db")
            await tasks(f"sqlite:///{file}", way, seed, count, outcome)
    return outcomes


def show(figures: dict[str, dict[str, Any]]) -> None:
    table = Table("", "failed per 100 tasks", "first try", "picked up", "placed")
    for name, each in figures.items():
        counts = [each[key] for key in ("first_try", "picked", "placed")]
        shares = [f"{count / each['tasks']:.1%} ({least:.0%}-{most:.0%})" for count, least, most in counts]
        low, high = each["failed_interval"]
        table.add_row(name, f"{each['failed_per_100']:.0f} ({low:.0f}-{high:.0f})", *shares)
    console().print(table)


def main() -> None:
    parser = options(__doc__, quick="one seed, a few tasks")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--tasks", type=int, default=TASKS)
    parser.add_argument("--remembered", type=int, default=REMEMBERED, help="tries remembered before the tasks")
    arguments = parser.parse_args()
    seeds, count = (1, 10) if arguments.quick else (arguments.seeds, arguments.tasks)
    with tempfile.TemporaryDirectory(prefix="advised_") as folder:
        outcomes = asyncio.run(measure(Path(folder), seeds, count, arguments.remembered))
    figures = {name: each.figures() for name, each in outcomes.items()}
    show(figures)
    print(json.dumps({"bench": "advised", **figures}))


if __name__ == "__main__":
    main()
