"""Measure the stages of a hook, and a `perform` in one task and in a hundred, with and without state samples.

    python -m bench.stages            20 turns of 1,000 performs each, a minute
    python -m bench.stages --quick    two short turns

The action of `bench.hook` is performed without pauses. In `bench.hook` the plan computes for a millisecond between two
performs, which evicts the code of the hook from the processor's caches; here it stays cached. The plans take turns in
random order. The hundred tasks yield to each other after each perform; their figure is the mean of each turn and
includes this switch. Each *stage* is measured in its own loop, with the same action, world and episode, to show its
share of both hooks of a perform. The script prints one JSON line, in µs: median, p99, p99.9 and maximum of a perform;
median, minimum and maximum of a stage over the turns.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import statistics
import tempfile
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

from rich.table import Table

from bench.material.turns import NothingActionPerformable, TurnTaker, nothing_action
from bench.reporting.figures import console, percentiles, spread
from pycrorm_async import Memory, Settings
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import Heading, encode
from pycrorm_async.events.ids import EpisodeId, episode_id
from pycrorm_async.events.types import EpisodeStarted, NodeEnded, NodeStarted, RobotValue
from pycrorm_async.plan import BaseMotion
from pycrorm_async.plan.execution import recorder
from pycrorm_async.plan.task import TaskTreeNode
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.record.declarations import KnownTypes
from pycrorm_async.record.plan_recorder import current_episode
from pycrorm_async.record.plan_types import Declarations
from pycrorm_async.record.values import read_parameters
from pycrorm_async.world import BulletWorld

_TASKS = 100
_UNHURRIED = Settings(connect_timeout_s=120)
"""Opening many memories at once may take long on a busy machine."""
_SAMPLED = replace(_UNHURRIED, sample_interval_ms=50)


class NothingMotion(BaseMotion):
    """A motion without parameters that does nothing; the robot's state is sampled while a motion runs."""

    async def perform(self) -> None:
        return


class Kind(NamedTuple):
    """One way to perform: with or without memory, tasks, action or motion, settings."""

    recorded: bool
    tasks: int = 1
    motion: bool = False
    settings: Settings = _UNHURRIED


KINDS = {
    "none": Kind(recorded=False),
    "memory": Kind(recorded=True),
    f"none, {_TASKS} tasks": Kind(recorded=False, tasks=_TASKS),
    f"memory, {_TASKS} tasks": Kind(recorded=True, tasks=_TASKS),
    "memory, motions": Kind(recorded=True, motion=True),
    "memory, motions sampled": Kind(recorded=True, motion=True, settings=_SAMPLED),
}


class Plan(TurnTaker):
    """A plan in its own episode; a turn ends when all its events are stored."""

    def __init__(self, kind: Kind, url: str) -> None:
        super().__init__()
        self.took_us: list[list[float]] = []
        self._kind = kind
        self._url = url

    async def begin(self, stack: AsyncExitStack) -> Callable[[int], Awaitable[None]]:
        memory = await _open_memory(stack, self._url, self._kind) if self._kind.recorded else None
        stack.enter_context(BulletWorld())
        action = NothingMotion() if self._kind.motion else nothing_action()

        async def take(performs: int) -> None:
            self.took_us.append(await self._turn(action, performs))
            if memory is not None:
                await memory.flush()

        return take

    async def _turn(self, action: NothingActionPerformable | NothingMotion, performs: int) -> list[float]:
        if self._kind.tasks > 1:
            return [await self._turn_of_many(action, performs)]
        durations_us: list[float] = []
        for _ in range(performs):
            began = time.perf_counter_ns()
            await action.perform()
            durations_us.append((time.perf_counter_ns() - began) / 1e3)
        return durations_us

    async def _turn_of_many(self, action: NothingActionPerformable | NothingMotion, performs: int) -> float:
        """Return the mean duration; single performs cannot be measured, because a perform may yield to other tasks."""

        async def perform(count: int) -> None:
            for _ in range(count):
                await action.perform()
                await asyncio.sleep(0)

        began = time.perf_counter_ns()
        await asyncio.gather(*(perform(performs // self._kind.tasks) for _ in range(self._kind.tasks)))
        return (time.perf_counter_ns() - began) / performs / 1e3


async def _open_memory(stack: AsyncExitStack, url: str, kind: Kind) -> Memory:
    memory = await stack.enter_async_context(Memory.open(url, settings=kind.settings))
    await stack.enter_async_context(memory.episode(description="bench"))
    return memory


# --- stages ---------------------------------------------------------------------------------------------------------


async def stages(folder: Path, *, turns: int, performs: int) -> dict[str, dict[str, float]]:
    """Return the spread over the turns of each stage's mean duration, in µs."""
    async with AsyncExitStack() as stack:
        memory = await _open_memory(stack, f"sqlite:///{folder}/stages.db", Kind(recorded=True))
        stack.enter_context(BulletWorld())
        queue = RecorderQueue.create(
            folder / "queue", settings=Settings(), clock=SYSTEM_CLOCK, recorder=_identity(b"recorder..")
        )
        stack.callback(queue.release)
        parts = _parts(nothing_action(), queue, memory)
        durations_us: dict[str, list[float]] = {name: [] for name in parts}
        for _ in range(turns):
            for name, part in parts.items():
                began = time.perf_counter_ns()
                for _ in range(performs):
                    part()
                durations_us[name].append((time.perf_counter_ns() - began) / performs / 1e3)
            await memory.flush()
        return {name: spread(values) for name, values in durations_us.items()}


def _parts(action: NothingActionPerformable, queue: RecorderQueue, memory: Memory) -> dict[str, Callable[[], Any]]:
    observer, episode = recorder.get(), current_episode.get()
    assert observer is not None
    assert episode is not None
    assert episode.world is not None
    world = episode.world
    declared = Declarations(KnownTypes(lambda _dtype: None)).of(type(action), lambda _: None)

    def parameters() -> dict[str, Any]:
        return read_parameters(action, declared.fields, episode, {})

    robot = world.robot()
    assert robot is not None
    start = NodeStarted("action", 2, declared.fingerprint, parameters(), cast("RobotValue", robot.written))
    payload = encode(start)
    name = _identity(b"episode...")
    queue.put_nowait(Heading(name, "EpisodeStarted", 1), encode(EpisodeStarted("bench", "", "", "", "")))

    def hooks() -> None:
        node = TaskTreeNode(action, "action", None, time.monotonic_ns())
        observer.node_started(node)
        observer.node_ended(node)

    return {
        "both hooks of a perform": hooks,
        "an observation of three numbers": lambda: memory.observe("force", {"x": 1.5, "y": -0.25, "z": 9.81}),
        "the robot's state, read": world.robot,
        "parameters, copied and checked": parameters,
        "start, encoded": lambda: encode(start),
        "end, encoded": lambda: encode(NodeEnded(3, "SUCCEEDED")),
        "put into the queue, each of the two": lambda: queue.put_nowait(
            Heading(name, "NodeStarted", 1), payload, reserved=True
        ),
    }


def _identity(randomness: bytes) -> EpisodeId:
    return episode_id(time.time_ns(), randomness)


# --- measuring ------------------------------------------------------------------------------------------------------


async def measure(folder: Path, *, turns: int, performs: int) -> dict[str, Any]:
    plans = {name: Plan(kind, f"sqlite:///{folder}/{place}.db") for place, (name, kind) in enumerate(KINDS.items())}
    async with asyncio.TaskGroup() as tasks:
        for name, plan in plans.items():
            tasks.create_task(plan.run(), name=name)
        for plan in plans.values():  # warm up: connections, tables, declarations
            await plan.take_turn(_TASKS)
            plan.took_us.clear()
        order = random.Random(1)
        for _ in range(turns):
            for plan in order.sample([*plans.values()], len(plans)):
                await plan.take_turn(performs)
        for plan in plans.values():
            await plan.take_turn(0)
    figures: dict[str, Any] = {
        name: percentiles([each for turn in plan.took_us for each in turn]) for name, plan in plans.items()
    }
    for name, without in (("memory", "none"), (f"memory, {_TASKS} tasks", f"none, {_TASKS} tasks")):
        additional = [
            statistics.median(one) - statistics.median(other)
            for one, other in zip(plans[name].took_us, plans[without].took_us, strict=True)
        ]
        figures[f"one hook, {name}"] = spread([each / 2 for each in additional])
    return figures | {"stages": await stages(folder, turns=turns, performs=performs)}


def _table(result: dict[str, Any]) -> Table:
    table = Table(title="A perform without a pause before it, and its stages, µs", title_justify="left")
    for name in ("operation", "median", "spread"):
        table.add_column(name, justify="left" if name == "operation" else "right")
    for name, figures in {**result, **result["stages"]}.items():
        if isinstance(figures, dict) and "median" in figures:
            median, *others = figures.items()
            table.add_row(name, f"{median[1]:,}", ", ".join(f"{statistic} {each:,}" for statistic, each in others))
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two short turns for each plan")
    quick = parser.parse_args().quick
    turns, performs = (2, 100) if quick else (20, 1_000)
    with tempfile.TemporaryDirectory(prefix="b") as folder:
        figures = asyncio.run(measure(Path(folder), turns=turns, performs=performs))
    result = {"bench": "stages", "turns": turns, "performs_a_turn": performs, **figures}
    print(json.dumps(result))
    console().print(_table(result))


if __name__ == "__main__":
    main()
