"""A plan with memory against the same plan without: navigate, face, look and try to pick up, as fast as it goes.

Prints one JSON line: rollouts a second without, with a memory that writes by a thread, and with one whose events a
daemon writes meanwhile, paired in turns within one run; and what either costs.
Run it with `python -m bench.plan`.
"""

import asyncio
import json
import statistics
import tempfile
import time
from contextlib import AsyncExitStack, suppress
from pathlib import Path

import numpy as np

from bench.daemon import start_daemon, stop
from pycrorm_async import Memory
from pycrorm_async.config import Writer
from pycrorm_async.plan import MoveAndPickUpPerformable, PlanFailure, simulated_robot
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose

ROLLOUTS = 300
TURNS = 10


async def rollouts(world: BulletWorld, milk: Object, generator: np.random.Generator) -> float:
    """Seconds for one turn."""
    target = designator_of(milk)
    began = time.perf_counter()
    for _ in range(ROLLOUTS):
        x, y = generator.uniform(-0.9, 0.9, 2)
        arm = (Arms.LEFT, Arms.RIGHT)[generator.integers(2)]
        grasp = tuple(Grasp)[generator.integers(4)]
        with simulated_robot, suppress(PlanFailure):
            await MoveAndPickUpPerformable(Pose([1.3 + x, 1.0 + y, 0.0]), target, arm, grasp).perform()
        world.reset()
    return time.perf_counter() - began


async def turn(url: str | None, seed: int, *, writer: Writer = "thread") -> float:
    """Seconds of one turn in a world of its own, while the memory is written beside it.

    A thread folds afterwards, a daemon meanwhile, on another core where there is one.
    """
    async with AsyncExitStack() as stack:
        if url is not None:
            memory = await stack.enter_async_context(Memory.open(url, writer=writer))
            await stack.enter_async_context(memory.episode(description="bench"))
        world = stack.enter_context(BulletWorld())
        Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
        return await rollouts(world, milk, np.random.default_rng(seed))


async def measured() -> dict[str, object]:
    with_memory, by_daemon, without = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{folder}/daemon.db"
        daemon = start_daemon(url, Path(f"{folder}/daemon.db.spool"))
        for seed in range(TURNS):
            without.append(await turn(None, seed))
            with_memory.append(await turn(f"sqlite:///{folder}/bench.db", seed))
            by_daemon.append(await turn(url, seed, writer="daemon"))
        stop(daemon)
    shares = [one / other - 1 for one, other in zip(with_memory, without, strict=True)]
    shares_by_daemon = [one / other - 1 for one, other in zip(by_daemon, without, strict=True)]
    return {
        "bench": "plan",
        "rollouts_a_turn": ROLLOUTS,
        "turns": TURNS,
        "rollouts_per_s_without": round(ROLLOUTS / statistics.median(without)),
        "rollouts_per_s_with": round(ROLLOUTS / statistics.median(with_memory)),
        "slower_by_median": round(statistics.median(shares), 3),
        "slower_by_each": [round(each, 3) for each in shares],
        "rollouts_per_s_by_daemon": round(ROLLOUTS / statistics.median(by_daemon)),
        "slower_by_daemon_median": round(statistics.median(shares_by_daemon), 3),
        "slower_by_daemon_each": [round(each, 3) for each in shares_by_daemon],
    }


if __name__ == "__main__":
    print(json.dumps(asyncio.run(measured())))
