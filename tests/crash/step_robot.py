"""Run a plan that records through a daemon, in a process that the tests kill, and report each step on the output.

Every line is written at once, so that the pipe keeps it when the process dies: `did EPISODE STEP` when `perform` of a
step has returned, and `ended EPISODE` when the episode has ended. The plan runs until its input is closed.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import random
import select
from dataclasses import dataclass
from pathlib import Path

from pycrorm_async import Memory, Settings
from pycrorm_async.plan import ActionAbstract

SETTINGS = Settings(
    sync_interval_ms=5,
    segment_bytes=2**16,
    record_bytes_max=2**14,
    spool_bytes_max=2**24,
    spool_reserve_bytes=2**18,
    flush_timeout_s=60,
)


@dataclass
class StepActionPerformable(ActionAbstract):
    place: str
    step: int

    async def perform(self) -> None:
        """Succeed without doing anything."""


def report(*words: object) -> None:
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def stop_requested() -> bool:
    return bool(select.select([0], [], [], 0)[0])


async def perform_steps(url: str, spool: Path, name: str, rng: random.Random, pause_s_max: float) -> None:
    async with Memory.open(url, spool=spool, writer="daemon", settings=SETTINGS) as memory:
        report("opened")
        for number in itertools.count():
            episode = f"{name}.{number}"
            async with memory.episode(description=episode):
                for step in range(rng.randrange(1, 60)):
                    await StepActionPerformable(episode, step).perform()
                    report("did", episode, step)
                    if rng.random() < 0.1:
                        await asyncio.sleep(rng.random() * pause_s_max)
            report("ended", episode)
            if stop_requested():
                return
            if rng.random() < 0.05:
                await memory.synced()


def run_step_robot(url: str, spool: str, name: str, seed: int, pause_s_max: float) -> None:
    """Perform steps until the input is closed, with a pause of at most `pause_s_max` after every tenth on average."""
    asyncio.run(perform_steps(url, Path(spool), name, random.Random(seed), pause_s_max))
