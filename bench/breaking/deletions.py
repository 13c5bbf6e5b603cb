"""A SQLite database that is deleted or replaced under a plan and its writer, at a random moment.

What was performed comes into the new database by `rebind` and `recover`. What only the deleted file held is no loss:
it was stored there when it was deleted. An episode whose beginning was there alone is counted as told: its events are
kept as dead letters.
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

from bench.breaking.outcome import Event, Outcome, Step
from bench.breaking.robots import Walked, walk
from bench.breaking.speaking import Speaker
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
    """The file goes, or another memory's takes its place; then the plan is killed, at once or later."""
    outcome = Outcome(note="deleted or replaced under a plan that is killed; then rebind; told: kept as dead letters")
    for number in range(rounds):
        place = Path(tempfile.mkdtemp(dir=folder))
        _round(outcome, place, rng, f"plan{number}")
        shutil.rmtree(place)
        step()
    return outcome


def _round(outcome: Outcome, place: Path, rng: random.Random, name: str) -> None:
    file, old = place / "memory.db", place / "old.db"
    url, spool, walked = f"sqlite:///{file}", place / "spool", Walked()
    replaced = rng.random() < 0.5
    if replaced:
        asyncio.run(_made(f"sqlite:///{place}/other.db"))
    plan = Speaker(walk, url, str(spool), "thread", name, rng.randrange(2**31))
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
        walked.add(plan.kill())
    finally:
        plan.stop()
    asyncio.run(rebind(url, spool=spool, say=lambda _: None))
    report = asyncio.run(recover(url, spool=spool))
    if report.failed:
        outcome.broke = str(next(iter(report.failed.values())))
    kept = {place for (place, _, _), episode in _steps(old) if episode in report.dead_letters}
    found = [each for each, _ in _steps(file)]
    # What only the deleted file held stands in its place, so that the order of the others is compared all the same.
    everything = sorted([*found, *(stored - set(found))])
    told = [each for each in walked.sure if each[0] in kept]
    outcome.compare(walked.sure, everything, put=[*walked.perhaps, *stored], told=told)


async def _made(url: str) -> None:
    await (await EventLog.open(DatabaseAddress.parse(url), create=True)).close()


def _steps(file: Path) -> list[tuple[Event, str]]:
    """The steps that ended well, or were lost with their process, in the log of this file; each with its episode."""
    begun: dict[tuple[str, int], tuple[str, int]] = {}
    ended: dict[tuple[str, int], str] = {}
    for episode, sequence, kind, payload in ask(file, _EVENTS):
        said = json.loads(payload)
        if kind == "NodeStarted" and said.get("parameters"):
            begun[episode, sequence] = said["parameters"]["place"], said["parameters"]["step"]
        elif kind == "NodeEnded":
            ended[episode, said["node"]] = said["status"]
    return [((*what, ended.get(node, "LOST")), node[0]) for node, what in begun.items()]
