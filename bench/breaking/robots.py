"""Whole memories: plans that remember by a thread or through the daemon, and die; or the daemon does, or its server.

What a plan said before it died is the truth. It is compared with the rows of its steps, so everything between
`perform` and the tables is in it.
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

from bench.breaking.databases import start_again
from bench.breaking.outcome import Event, Outcome, Step
from bench.breaking.speaking import Speaker
from pycrorm_async import Memory
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.recovery import recover
from pycrorm_async.settings import Writer
from tests.crash.step_robot import SETTINGS, StepActionPerformable, say
from tests.databases import Server, ask

__all__ = ["killed_plans", "killed_daemons", "walk", "Walked", "compare_steps"]

_LONGEST_LIFE_S = 0.2
_SETTINGS = replace(SETTINGS, connect_timeout_s=3600.0, flush_timeout_s=3600.0)
"""Nothing here is about being slow: on a busy machine only opening a database may take a minute."""
_STEPS = (
    "SELECT place, step, status FROM step_action JOIN task_tree_node ON step_action.id = task_tree_node.id"
    " ORDER BY step_action.id"
)
_INCOMPLETE = (
    "SELECT count(*) FROM episode WHERE refused IS NOT NULL OR parked IS NOT NULL OR head <> folded OR head <>"
    " (SELECT count(*) FROM event WHERE event.episode = episode.number)"
)


def walk(url: str, spool: str, writer: Writer, name: str, seed: int) -> None:
    """A plan without end: `did PLACE STEP` when a step's `perform` returned, `synced` when all so far is."""
    asyncio.run(_walk(url, Path(spool), writer, name, random.Random(seed)))


async def _walk(url: str, spool: Path, writer: Writer, name: str, rng: random.Random) -> None:
    async with Memory.open(url, spool=spool, writer=writer, settings=_SETTINGS) as memory:
        for number in itertools.count():
            place = f"{name}.{number}"
            async with memory.episode(description=place):
                for step in range(1, rng.randrange(2, 60)):
                    await StepActionPerformable(place, step).perform()
                    say("did", place, step)
                    chance = rng.random()
                    if chance < 0.5:
                        await asyncio.sleep(rng.random() * 0.005)
                    elif chance < 0.55:
                        await memory.synced()
                        say("synced")


class Walked:
    """What plans said that are dead: the steps that are sure, and those that may be there or not."""

    def __init__(self) -> None:
        self.sure: list[Event] = []
        self.perhaps: list[Event] = []

    def add(self, said: list[list[str]], *, when_synced: bool = False) -> None:
        """With `when_synced` only what was done before the last `synced` is sure."""
        did = [(index, line[1], int(line[2])) for index, line in enumerate(said) if line[0] == "did"]
        end = max([-1, *(index for index, line in enumerate(said) if line[0] == "synced")])
        done = [(index, (place, step, "SUCCEEDED")) for index, place, step in did]
        self.sure += [each for index, each in done if index < end or not when_synced]
        unsure = [each for index, each in done if index > end and when_synced]
        # The step that was at work, of the same episode or the next one; whichever was last is LOST if it is there.
        last, at = (did[-1][1], did[-1][2]) if did else ("", 0)
        name, _, number = last.rpartition(".")
        following = [(last, at + 1), (f"{name}.{int(number) + 1}", 1)] if did else []
        self.perhaps += unsure + [(place, step, "LOST") for place, step, _ in unsure]
        self.perhaps += [(place, step, status) for place, step in following for status in ("SUCCEEDED", "LOST")]


def compare_steps(outcome: Outcome, walked: Walked, url: str) -> None:
    """When nobody writes any more."""
    found = [(place, step, status) for place, step, status in ask(url, _STEPS)]
    outcome.compare(walked.sure, found, put=walked.perhaps)
    outcome.changed += ask(url, _INCOMPLETE)[0][0]


def killed_plans(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """A plan with its writer's thread is killed; the next one adopts what it left, and is killed too."""
    outcome = Outcome(note="SQLite; the next plan adopts what the killed one left; the tables are compared")
    url, spool, walked = f"sqlite:///{folder}/memory.db", folder / "spool", Walked()
    for number in range(rounds):
        plan = Speaker(walk, url, str(spool), "thread", f"plan{number}", rng.randrange(2**31))
        plan.wait_for("did")
        time.sleep(rng.random() * _LONGEST_LIFE_S)
        walked.add(plan.kill())
        step()
    asyncio.run(recover(url, spool=spool))
    compare_steps(outcome, walked, url)
    outcome.rounds = rounds
    return outcome


def _serve(url: str, spool: str) -> None:
    asyncio.run(serve(url, spool=Path(spool), leave=asyncio.Event(), say=say))


def killed_daemons(server: Server | None) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """The daemon is killed while three plans record; now and then a plan too; and the server, if there is one."""

    def killed(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome = Outcome(note="SQLite; plans are killed too" if server is None else "so are plans and the server")
        place = Path(tempfile.mkdtemp(dir=folder))
        url = f"sqlite:///{place}/memory.db" if server is None else server.new_database()
        spool, walked, names = place / "spool", Walked(), itertools.count()

        def start() -> Speaker:
            return Speaker(walk, url, str(spool), "daemon", f"plan{next(names)}", rng.randrange(2**31))

        plans = [start() for _ in range(3)]
        for _ in range(rounds):
            daemon = Speaker(_serve, url, str(spool))
            daemon.wait_for("draining")
            time.sleep(rng.random() ** 2 * 0.5)
            if rng.random() < 0.3:
                walked.add(plans.pop(rng.randrange(len(plans))).kill())
                plans.append(start())
            if server is not None and rng.random() < 0.1:
                server.kill()
                time.sleep(rng.random() * 0.1)
                start_again(server)
            daemon.kill()
            step()
        for each in plans:
            each.wait_for("did")
            walked.add(each.kill())
        asyncio.run(recover(url, spool=spool))
        compare_steps(outcome, walked, url)
        outcome.rounds = rounds
        return outcome

    return killed
