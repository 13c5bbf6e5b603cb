"""Kill plans that record with a writer thread or through the daemon, kill the daemon, and kill its server.

The lines that a plan printed before its death are compared with the rows of its steps. The comparison therefore covers
everything between `perform` and the tables.
"""

from __future__ import annotations

import asyncio
import itertools
import random
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from bench.breaking.child_process import ChildProcess
from bench.breaking.databases import start_again
from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async import Memory
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.recovery import recover
from pycrorm_async.settings import Writer
from tests.crash.step_robot import SETTINGS, StepActionPerformable, report
from tests.databases import Server, ask

__all__ = ["killed_plans", "killed_daemons", "walk", "RecordedSteps", "compare_steps"]

_LONGEST_LIFE_S = 0.2
_SETTINGS = replace(SETTINGS, connect_timeout_s=3600.0, flush_timeout_s=3600.0)
"""Timeouts that no busy machine reaches: opening a database may take a minute there."""
_STEPS = (
    "SELECT place, step, status FROM step_action JOIN task_tree_node ON step_action.id = task_tree_node.id"
    " ORDER BY step_action.id"
)
_INCOMPLETE = (
    "SELECT count(*) FROM episode WHERE refused IS NOT NULL OR parked IS NOT NULL OR head <> folded OR head <>"
    " (SELECT count(*) FROM event WHERE event.episode = episode.number)"
)


def walk(url: str, spool: str, writer: Writer, name: str, seed: int) -> None:
    """Run an endless plan; print `did PLACE STEP` after each `perform`, and `synced` after a sync of all of them."""
    asyncio.run(_walk(url, Path(spool), writer, name, random.Random(seed)))


async def _walk(url: str, spool: Path, writer: Writer, name: str, rng: random.Random) -> None:
    async with Memory.open(url, spool=spool, writer=writer, settings=_SETTINGS) as memory:
        for number in itertools.count():
            place = f"{name}.{number}"
            async with memory.episode(description=place):
                for step in range(1, rng.randrange(2, 60)):
                    await StepActionPerformable(place, step).perform()
                    report("did", place, step)
                    chance = rng.random()
                    if chance < 0.5:
                        await asyncio.sleep(rng.random() * 0.005)
                    elif chance < 0.55:
                        await memory.synced()
                        report("synced")


class RecordedSteps:
    """Collect the lines of killed plans: `certain` steps must exist, `possible` steps may exist."""

    def __init__(self) -> None:
        self.certain: list[Event] = []
        self.possible: list[Event] = []

    def add(self, lines: list[list[str]], *, when_synced: bool = False) -> None:
        """Add the lines of one plan. With `when_synced` only the steps before the last `synced` are certain."""
        returned = [(index, line[1], int(line[2])) for index, line in enumerate(lines) if line[0] == "did"]
        end = max([-1, *(index for index, line in enumerate(lines) if line[0] == "synced")])
        done = [(index, (place, step, "SUCCEEDED")) for index, place, step in returned]
        self.certain += [each for index, each in done if index < end or not when_synced]
        uncertain = [each for index, each in done if index > end and when_synced]
        # The plan died in the next step of the episode or in the first of the next one: LOST unless it had ended.
        last, sequence = (returned[-1][1], returned[-1][2]) if returned else ("", 0)
        name, _, number = last.rpartition(".")
        following = [(last, sequence + 1), (f"{name}.{int(number) + 1}", 1)] if returned else []
        self.possible += uncertain + [(place, step, "LOST") for place, step, _ in uncertain]
        self.possible += [(place, step, status) for place, step in following for status in ("SUCCEEDED", "LOST")]


def compare_steps(outcome: Outcome, steps: RecordedSteps, url: str) -> None:
    """Count one round: compare the rows of the steps, and count incomplete episodes. No process may still write."""
    rows = [(place, step, status) for place, step, status in ask(url, _STEPS)]
    outcome.compare(steps.certain, rows, put=steps.possible)
    outcome.corrupted += ask(url, _INCOMPLETE)[0][0]


def killed_plans(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Kill a plan with its writer thread; the next plan recovers its folder and is killed too."""
    outcome = Outcome(note="SQLite; each plan recovers the folder of the killed one; the tables are compared")
    url, spool, steps = f"sqlite:///{folder}/memory.db", folder / "spool", RecordedSteps()
    for number in range(rounds):
        plan = ChildProcess(walk, url, str(spool), "thread", f"plan{number}", rng.randrange(2**31))
        plan.wait_for("did")
        time.sleep(rng.random() * _LONGEST_LIFE_S)
        steps.add(plan.kill())
        step()
    asyncio.run(recover(url, spool=spool))
    compare_steps(outcome, steps, url)
    outcome.rounds = rounds
    return outcome


def _serve(url: str, spool: str) -> None:
    asyncio.run(serve(url, spool=Path(spool), stop=asyncio.Event(), report=report))


def killed_daemons(server: Server | None) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Kill the daemon while three plans record; at random also kill a plan, and the server if there is one."""

    def killed(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome = Outcome(
            note="SQLite; plans are killed too" if server is None else "PostgreSQL; plans and the server are killed too"
        )
        place = Path(tempfile.mkdtemp(dir=folder))
        url = f"sqlite:///{place}/memory.db" if server is None else server.new_database()
        spool, steps, names = place / "spool", RecordedSteps(), itertools.count()

        def start() -> ChildProcess:
            return ChildProcess(walk, url, str(spool), "daemon", f"plan{next(names)}", rng.randrange(2**31))

        plans = [start() for _ in range(3)]
        for _ in range(rounds):
            daemon = ChildProcess(_serve, url, str(spool))
            daemon.wait_for("draining")
            time.sleep(rng.random() ** 2 * 0.5)
            if rng.random() < 0.3:
                steps.add(plans.pop(rng.randrange(len(plans))).kill())
                plans.append(start())
            if server is not None and rng.random() < 0.1:
                server.kill()
                time.sleep(rng.random() * 0.1)
                start_again(server)
            daemon.kill()
            step()
        for each in plans:
            each.wait_for("did")
            steps.add(each.kill())
        asyncio.run(recover(url, spool=spool))
        compare_steps(outcome, steps, url)
        outcome.rounds = rounds
        return outcome

    return killed
