"""A plan in a process to be killed: remembers steps through a daemon, and says on its output what it did.

Every line is written at once, so the pipe holds it when the process dies: `did EPISODE STEP` when `perform` of a step
has returned, `ended EPISODE` when the episode has. It goes on until its input is closed.
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
        """Done."""


def say(*words: object) -> None:
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def told_to_stop() -> bool:
    return bool(select.select([0], [], [], 0)[0])


async def walk(url: str, spool: Path, name: str, rng: random.Random) -> None:
    async with Memory.open(url, spool=spool, writer="daemon", settings=SETTINGS) as memory:
        say("opened")
        for number in itertools.count():
            episode = f"{name}.{number}"
            async with memory.episode(description=episode):
                for step in range(rng.randrange(1, 60)):
                    await StepActionPerformable(episode, step).perform()
                    say("did", episode, step)
                    if rng.random() < 0.1:
                        await asyncio.sleep(rng.random() * 0.02)
            say("ended", episode)
            if told_to_stop():
                return
            if rng.random() < 0.05:
                await memory.synced()


def take_a_walk(url: str, spool: str, name: str, seed: int) -> None:
    asyncio.run(walk(url, Path(spool), name, random.Random(seed)))
