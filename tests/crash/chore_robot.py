"""A robot in a process of its own that does chores, several at once, and says on its output what it has performed.

Each line is a JSON object and is written when it is true: `began` inside of `perform`, so the hook before it has
returned; `ended` when `perform` has come back, with how it ended; `opened` and `closed` around an episode. A chore may
fail. It goes on until its input is closed.
"""

from __future__ import annotations

import asyncio
import enum
import itertools
import json
import os
import random
import select
from dataclasses import dataclass
from pathlib import Path

from pycrorm_async import Memory, Settings
from pycrorm_async.plan import ActionAbstract, PlanFailure
from pycrorm_async.world import Pose

__all__ = ["do_chores"]

LANES = 2
"""Plans that run at once in one process, each in episodes of its own."""

SETTINGS = Settings(
    sync_interval_ms=10,
    segment_bytes=2**15,
    record_bytes_max=2**12,
    spool_bytes_max=2**26,
    spool_reserve_bytes=2**18,
    flush_timeout_s=90,
)


class Hand(enum.Enum):
    LEFT = 1
    RIGHT = 2


@dataclass
class StepActionPerformable(ActionAbstract):
    episode: str
    number: int

    async def perform(self) -> None:
        say(began=self.number, episode=self.episode, what="step")


@dataclass
class CarryActionPerformable(ActionAbstract):
    episode: str
    number: int
    weight: float
    hand: Hand
    there: Pose
    words: list[str]
    slips: bool

    async def perform(self) -> None:
        told = {"weight": self.weight, "hand": self.hand.name, "there": self.there.position, "words": self.words}
        say(began=self.number, episode=self.episode, what="carry", told=told)
        for number in range(self.number + 1, self.number + 1 + len(self.words)):
            await StepActionPerformable(self.episode, number).perform()
            say(ended=number, episode=self.episode, how="SUCCEEDED")
            await asyncio.sleep(0)
        if self.slips:
            raise PlanFailure(f"slipped at {self.number}")


def say(**words: object) -> None:
    os.write(1, json.dumps(words).encode() + b"\n")


def told_to_stop() -> bool:
    return bool(select.select([0], [], [], 0)[0])


async def chores(memory: Memory, lane: str, rng: random.Random, pause_s: float) -> None:
    for round_ in itertools.count():
        episode = f"{lane}.{round_}"
        async with memory.episode(description=episode):
            say(opened=episode)
            numbers = itertools.count(1)
            for _ in range(rng.randrange(1, 12)):
                words = ["".join(rng.choices("aé\n'\\\"\t☃ ", k=3)) for _ in range(rng.randrange(4))]
                there = Pose([rng.gauss(0, 9), rng.gauss(0, 1e-9), rng.gauss(0, 1)])
                slips = rng.random() < 0.2
                carry = CarryActionPerformable(
                    episode, next(numbers), rng.random() / 3, rng.choice(list(Hand)), there, words, slips
                )
                for _ in words:
                    next(numbers)
                try:
                    await carry.perform()
                except PlanFailure:
                    say(ended=carry.number, episode=episode, how="FAILED")
                else:
                    say(ended=carry.number, episode=episode, how="SUCCEEDED")
                await asyncio.sleep(rng.random() * 2 * pause_s)
        say(closed=episode)
        if rng.random() < 0.1:
            await memory.synced()
        if told_to_stop():
            return


async def _live(url: str, spool: Path, name: str, seed: int, pause_s: float) -> None:
    async with Memory.open(url, spool=spool, writer="daemon", settings=SETTINGS) as memory:
        async with asyncio.TaskGroup() as lanes:
            for lane in range(LANES):
                lanes.create_task(chores(memory, f"{name}.{lane}", random.Random(f"{seed} {lane}"), pause_s))
        say(faults=memory.status.faults.total)


def do_chores(url: str, spool: str, name: str, seed: int, pause_s: float) -> None:
    """Until its input is closed; `pause_s` is how long it rests between two chores on average."""
    asyncio.run(_live(url, Path(spool), name, seed, pause_s))
