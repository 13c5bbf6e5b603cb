"""Compare a plan with a memory and the same plan without: navigate, face, look and try to pick up, without pauses.

    python -m bench.plan               ten turns of 300 rollouts
    python -m bench.plan --turns 3     fewer of them
    python -m bench.plan --quick       two short turns

The script prints one JSON line: rollouts a second without a memory, with a writer thread, with a writer process, and
with a daemon; what each writer costs, as a share of the rollout and in µs of the plan's thread; and the number of
events in a rollout. The variants take turns, and a turn begins when its writer is ready.
"""

import asyncio
import json
import sqlite3
import statistics
import sys
import tempfile
import time
from contextlib import AsyncExitStack, closing, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.daemon import start_daemon, stop
from pycrorm_async import Memory
from pycrorm_async.plan import MoveAndPickUpPerformable, PlanFailure, simulated_robot
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.settings import Writer
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose

QUICK = "--quick" in sys.argv
ROLLOUTS = 10 if QUICK else 300
TURNS = 2 if QUICK else int(sys.argv[2]) if sys.argv[1:2] == ["--turns"] else 10


class Duration(NamedTuple):
    """Duration of one turn in seconds: wall time, and CPU time of the plan's thread."""

    wall: float
    thread: float


async def rollouts(world: BulletWorld, milk: Object, generator: np.random.Generator) -> Duration:
    target = designator_of(milk)
    began, began_thread = time.perf_counter(), time.thread_time()
    for _ in range(ROLLOUTS):
        x, y = generator.uniform(-0.9, 0.9, 2)
        arm = (Arms.LEFT, Arms.RIGHT)[generator.integers(2)]
        grasp = tuple(Grasp)[generator.integers(4)]
        with simulated_robot, suppress(PlanFailure):
            await MoveAndPickUpPerformable(Pose([1.3 + x, 1.0 + y, 0.0]), target, arm, grasp).perform()
        world.reset()
    return Duration(time.perf_counter() - began, time.thread_time() - began_thread)


async def turn(url: str | None, seed: int, *, writer: Writer = "thread") -> Duration:
    """Run one turn in a new world, with a memory at `url`.

    A writer thread folds after the turn; a daemon folds during it, on another core if there is one.
    """
    async with AsyncExitStack() as stack:
        if url is not None:
            memory = await stack.enter_async_context(Memory.open(url, writer=writer))
            await stack.enter_async_context(memory.episode(description="bench"))
            await memory.flush()  # from now on the writer is ready
        world = stack.enter_context(BulletWorld())
        Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
        return await rollouts(world, milk, np.random.default_rng(seed))


async def measure() -> dict[str, object]:
    without: list[Duration] = []
    by_writer: dict[Writer, list[Duration]] = {"thread": [], "process": [], "daemon": []}
    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{folder}/daemon.db"
        daemon = start_daemon(url, Path(f"{folder}/daemon.db.spool"))
        for seed in range(TURNS):
            without.append(await turn(None, seed))
            for writer, turns in by_writer.items():
                turns.append(await turn(f"sqlite:///{folder}/{writer}.db", seed, writer=writer))
        stop(daemon)
        with closing(sqlite3.connect(f"{folder}/daemon.db")) as file:
            [(events,)] = file.execute("SELECT count(*) FROM event")
    return {
        "bench": "plan",
        "rollouts_a_turn": ROLLOUTS,
        "turns": TURNS,
        "rollouts_per_s_without": rate(without),
        "events_a_rollout": round(events / TURNS / ROLLOUTS, 1),
        **{f"with_{writer}": cost(turns, without) for writer, turns in by_writer.items()},
    }


def rate(turns: list[Duration]) -> int:
    return round(ROLLOUTS / statistics.median(each.wall for each in turns))


def cost(turns: list[Duration], without: list[Duration]) -> dict[str, object]:
    """Return the additional time as a share of the turn without memory; other processes hardly affect CPU shares."""
    wall = [one.wall / other.wall - 1 for one, other in zip(turns, without, strict=True)]
    thread = [one.thread / other.thread - 1 for one, other in zip(turns, without, strict=True)]
    more_s = min(each.thread for each in turns) - min(each.thread for each in without)
    return {
        "rollouts_per_s": rate(turns),
        "slower_by_median": round(statistics.median(wall), 3),
        "slower_by_each": [round(each, 3) for each in wall],
        "plan_thread_busier_by_median": round(statistics.median(thread), 3),
        "us_a_rollout": round(more_s / ROLLOUTS * 1e6),
    }


if __name__ == "__main__":
    print(json.dumps(asyncio.run(measure())))
