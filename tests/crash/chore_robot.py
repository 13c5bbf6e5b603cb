"""Run a robot in a process of its own that performs chores concurrently and reports each on its output.

Each line is a JSON object that the robot writes when it is true: `began` inside `perform`, after the hook before it has
returned; `ended` when `perform` has returned, with the outcome; `opened` and `closed` around an episode. A chore may
fail. The robot works until its input is closed.
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
"""Plans that run concurrently in one process, each in episodes of its own; two are enough to interleave."""

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
        report(began=self.number, episode=self.episode, what="step")


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
        values = {"weight": self.weight, "hand": self.hand.name, "there": self.there.position, "words": self.words}
        report(began=self.number, episode=self.episode, what="carry", values=values)
        for number in range(self.number + 1, self.number + 1 + len(self.words)):
            await StepActionPerformable(self.episode, number).perform()
            report(ended=number, episode=self.episode, how="SUCCEEDED")
            await asyncio.sleep(0)
        if self.slips:
            raise PlanFailure(f"slipped at {self.number}")


def report(**words: object) -> None:
    os.write(1, json.dumps(words).encode() + b"\n")


def stop_requested() -> bool:
    return bool(select.select([0], [], [], 0)[0])


async def chores(memory: Memory, lane: str, rng: random.Random, pause_s: float) -> None:
    for round_ in itertools.count():
        episode = f"{lane}.{round_}"
        async with memory.episode(description=episode):
            report(opened=episode)
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
                    report(ended=carry.number, episode=episode, how="FAILED")
                else:
                    report(ended=carry.number, episode=episode, how="SUCCEEDED")
                await asyncio.sleep(rng.random() * 2 * pause_s)
        report(closed=episode)
        if rng.random() < 0.1:
            await memory.synced()
        if stop_requested():
            return


async def _run_lanes(url: str, spool: Path, name: str, seed: int, pause_s: float) -> None:
    async with Memory.open(url, spool=spool, writer="daemon", settings=SETTINGS) as memory:
        async with asyncio.TaskGroup() as lanes:
            for lane in range(LANES):
                lanes.create_task(chores(memory, f"{name}.{lane}", random.Random(f"{seed} {lane}"), pause_s))
        report(faults=memory.status.faults.total)


def do_chores(url: str, spool: str, name: str, seed: int, pause_s: float) -> None:
    """Perform chores until the input is closed, with a mean pause of `pause_s` seconds between two chores."""
    asyncio.run(_run_lanes(url, Path(spool), name, seed, pause_s))
