"""Delete or replace a SQLite database at a random moment under a plan and its writer.

`rebind` and `recover` store the remaining events in the new database. Events that only the deleted file contained are
not counted as lost, because they had been stored. If only the deleted file contained the beginning of an episode, its
later events become dead letters, which count as reported.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import shutil
import tempfile
import time
from pathlib import Path
from typing import Final

from bench.breaking.child_process import ChildProcess
from bench.breaking.outcome import Event, Outcome, Step
from bench.breaking.robots import RecordedSteps, walk
from pycrorm_async.operations.recovery import rebind, recover
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import ask

__all__ = ["deleted_databases"]

_LONGEST_LIFE_S: Final = 0.3
_EVENTS = (
    "SELECT episode.id, sequence, type, payload FROM event JOIN episode ON episode.number = event.episode"
    " ORDER BY episode.number, sequence"
)


def deleted_databases(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Delete the file or replace it by another memory's file; then kill the plan, at once or later."""
    outcome = Outcome(
        note="deleted or replaced under a plan that is killed; then rebind; reported events are dead letters"
    )
    for number in range(rounds):
        place = Path(tempfile.mkdtemp(dir=folder))
        _round(outcome, place, rng, f"plan{number}")
        shutil.rmtree(place)
        step()
    return outcome


def _round(outcome: Outcome, place: Path, rng: random.Random, name: str) -> None:
    file, old = place / "memory.db", place / "old.db"
    url, spool, steps = f"sqlite:///{file}", place / "spool", RecordedSteps()
    replaced = rng.random() < 0.5
    if replaced:
        asyncio.run(_create(f"sqlite:///{place}/other.db"))
    plan = ChildProcess(walk, url, str(spool), "thread", name, rng.randrange(2**31))
    try:
        plan.wait_for("did")
        time.sleep(rng.random() * _LONGEST_LIFE_S)
        for suffix in ("", "-wal"):
            os.link(f"{file}{suffix}", f"{old}{suffix}")
        if replaced:
            (place / "other.db").replace(file)
        else:
            file.unlink()
        stored = {each for each, _ in _steps(old)}
        time.sleep(rng.random() ** 2 * _LONGEST_LIFE_S)
        steps.add(plan.kill())
    finally:
        plan.stop()
    asyncio.run(rebind(url, spool=spool, on_rebinding=lambda _: None))
    report = asyncio.run(recover(url, spool=spool))
    if report.failed:
        outcome.error = str(next(iter(report.failed.values())))
    places_of_dead_letters = {place for (place, _, _), episode in _steps(old) if episode in report.dead_letters}
    existing = [each for each, _ in _steps(file)]
    # Insert the events of the deleted file at their places, so that the order of the others can be compared.
    everything = sorted([*existing, *(stored - set(existing))])
    reported = [each for each in steps.certain if each[0] in places_of_dead_letters]
    outcome.compare(steps.certain, everything, put=[*steps.possible, *stored], reported=reported)


async def _create(url: str) -> None:
    await (await EventLog.open(DatabaseAddress.parse(url), create=True)).close()


def _steps(file: Path) -> list[tuple[Event, str]]:
    """Read the steps in the log of this file, with their status and the id of their episode."""
    begun: dict[tuple[str, int], tuple[str, int]] = {}
    ended: dict[tuple[str, int], str] = {}
    for episode, sequence, kind, payload in ask(file, _EVENTS):
        event = json.loads(payload)
        if kind == "NodeStarted" and event.get("parameters"):
            begun[episode, sequence] = event["parameters"]["place"], event["parameters"]["step"]
        elif kind == "NodeEnded":
            ended[episode, event["node"]] = event["status"]
    return [((*step, ended.get(node, "LOST")), node[0]) for node, step in begun.items()]
