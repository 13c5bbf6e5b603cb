"""Delete or replace a database under a plan, or set it back: by a failover or by restoring a backup."""

from __future__ import annotations

import asyncio
import json
import os
import random
import shutil
import sqlite3
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bench.breaking.outcome import Event, Outcome, Step
from bench.breaking.processes import ChildProcess, RecordedSteps, walk
from pycrorm_async import Memory, Settings
from pycrorm_async.operations.recovery import rebind, recover
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.backups import PATRONI_PACKAGES, Backup, PatroniCluster, Replicas, has_patroni, replicas_in
from tests.databases import Server, ask, server_in

# === restores =================================================================================================
#
# Set a database back to an earlier state: by a failover with or without losses, or by restoring a backup.
#
# Everything that a flush acknowledged before must exist afterwards, with the same numbers and row ids, and `verify`
# must report nothing. Each round is compared and verified directly after the flush that follows the fault, before
# anything else is recorded: events recorded after a flush may be in the log before they are in the tables, and verify
# reports those as behind.

_SETTINGS: Final = Settings(sync_interval_ms=5, flush_timeout_s=120)
_EVENTS: Final = (
    "SELECT id, sequence, payload FROM event JOIN episode ON number = event.episode ORDER BY episode.number, sequence"
)
_ROWS: Final = (
    "SELECT id, number FROM episode",
    "SELECT id, dtype FROM task_tree_node",
    "SELECT id, text FROM note_action",
)
_VERIFY_EVERY: Final = 20


@dataclass
class NoteAction(ActionAbstract):
    """An action that does nothing and is recorded."""

    text: str

    async def perform(self) -> None:
        """Do nothing."""


async def _record(memory: Memory, rng: random.Random) -> None:
    for _ in range(rng.randrange(1, 4)):
        async with memory.episode(description="an episode"):
            await _note(rng)


async def _note(rng: random.Random) -> None:
    for _ in range(rng.randrange(1, 6)):
        await NoteAction(f"{rng.random()}").perform()


class _StateBefore:
    """The events and rows that the database contained after a flush."""

    def __init__(self, url: str) -> None:
        self._url = url
        self.events: list[Event] = ask(url, _EVENTS)
        self._rows = [set(ask(url, question)) for question in _ROWS]

    def compare(self, outcome: Outcome) -> None:
        """Count one round: the same events must exist, and the same rows under the same ids."""
        keys = {event[:2] for event in self.events}
        events: list[Event] = ask(self._url, _EVENTS)
        outcome.compare(self.events, events, put=[event for event in events if event[:2] not in keys])
        missing = sum(
            len(before - set(ask(self._url, question))) for before, question in zip(self._rows, _ROWS, strict=True)
        )
        outcome.add_corrupted(missing)


async def _check(outcome: Outcome, state: _StateBefore, url: str, *, rounds: int) -> None:
    """Count one round, and verify the first, the last and every twentieth. The tables must show all of the log."""
    state.compare(outcome)
    if (outcome.rounds - 1) % _VERIFY_EVERY and outcome.rounds != rounds:
        return
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        verified = await verify(log)
    finally:
        await log.close()
    faults = {
        "damage": verified.damage,
        "drift": verified.drift,
        "behind": verified.behind,
        "stopped": len(verified.stopped),
        "not compared": len(verified.unmade) + (verified.outdated is not None),
    }
    outcome.add_corrupted(sum(faults.values()))
    if any(faults.values()):
        counts = ", ".join(f"{name} {count}" for name, count in faults.items() if count)
        print(f"round {outcome.rounds}: verify reports {counts}", file=sys.stderr)


@asynccontextmanager
async def _set_back(
    memory: Memory, rng: random.Random, set_back: Callable[[], Any], url: str
) -> AsyncIterator[_StateBefore]:
    """Set the database back under a memory, then continue in one of three ways; yield the state from before.

    When the body runs, everything recorded is flushed. In one of the ways an episode is still open and ends after it.
    """
    way = rng.randrange(3)
    async with memory.episode(description="through it all") if way == 0 else nullcontext():
        await (_note(rng) if way == 0 else _record(memory, rng))
        await memory.flush()
        state = _StateBefore(url)
        await asyncio.to_thread(set_back)
        if way == 0:
            await _note(rng)
        elif way == 1:
            await _record(memory, rng)
        await memory.flush()
        yield state


def failovers(*, synchronous: bool) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Kill a primary and promote its standby, which confirmed every COMMIT, or had stopped receiving before."""

    async def run_all(outcome: Outcome, rounds: int, rng: random.Random, step: Step, place: Path, spool: Path) -> None:
        with replicas_in(place, synchronous=synchronous) as replicas:
            before = None if synchronous else replicas.lag
            await _failing_over(replicas, outcome, rounds, rng, step, spool, before=before)

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        standby = "confirms every COMMIT" if synchronous else "no longer receives changes"
        outcome = Outcome(
            note=f"PostgreSQL: SIGQUIT of the primary while its standby {standby}; the standby is promoted"
        )
        with tempfile.TemporaryDirectory(prefix="pair") as place:
            asyncio.run(run_all(outcome, rounds, rng, step, Path(place), folder / "spool"))
        return outcome

    return run


async def _failing_over(
    replicas: Replicas | PatroniCluster,
    outcome: Outcome,
    rounds: int,
    rng: random.Random,
    step: Step,
    spool: Path,
    *,
    before: Callable[[], None] | None = None,
) -> None:
    """Fail over under an open memory in each round, after calling `before`."""
    ask(replicas.url(), "CREATE DATABASE memory")
    url = replicas.url("memory")
    async with Memory.open(url, spool=spool, settings=_SETTINGS) as memory:
        for _ in range(rounds):
            await _record(memory, rng)
            await memory.flush()
            if before is not None:
                await asyncio.to_thread(before)
            async with _set_back(memory, rng, replicas.fail_over, url) as state:
                await _check(outcome, state, url, rounds=rounds)
            await asyncio.to_thread(replicas.follow)
            step()


def failovers_by_patroni(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Kill a node of two with all its processes; Patroni promotes the other, which the URL names too."""
    outcome = Outcome(note="PostgreSQL: SIGKILL of Patroni and the primary; Patroni promotes the replica after 20 s")
    if not has_patroni():
        outcome.note = f"skipped: {PATRONI_PACKAGES} are not installed"
        return outcome
    with (
        tempfile.TemporaryDirectory(prefix="pg") as place,
        server_in(Path(place), syncs=False) as programs,
        tempfile.TemporaryDirectory(prefix="pat") as name,
        PatroniCluster(Path(name), programs) as cluster,
    ):
        asyncio.run(_failing_over(cluster, outcome, rounds, rng, step, folder / "spool"))
    return outcome


def restored_servers(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Replace a database on a server by an earlier copy while a memory is open."""

    outcome = Outcome(note="PostgreSQL: DROP DATABASE, then CREATE DATABASE from a copy")

    async def run_all(server: Server, url: str) -> None:
        async with Memory.open(url, spool=folder / "spool", settings=_SETTINGS) as memory:
            for _ in range(rounds):
                await _record(memory, rng)
                await memory.flush()
                backup = await asyncio.to_thread(Backup, url, server)
                async with _set_back(memory, rng, backup.restore, url) as state:
                    await _check(outcome, state, url, rounds=rounds)
                await asyncio.to_thread(backup.drop)
                step()

    with (
        tempfile.TemporaryDirectory(prefix="pg") as place,
        server_in(Path(place), syncs=False) as server,  # DROP DATABASE waits for a checkpoint of all databases
    ):
        asyncio.run(run_all(server, server.new_database()))
    return outcome


def restored_files(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Replace a SQLite file by an earlier copy, while a memory has it open or between two memories."""
    outcome = Outcome(note="SQLite: the file is replaced while no memory is open, or in place under an open one")
    url = f"sqlite:///{folder}/memory.db"

    async def run_all() -> None:
        for _ in range(rounds):
            async with Memory.open(url, settings=_SETTINGS) as memory:
                await _record(memory, rng)
                await memory.flush()
                if rng.random() < 0.5:
                    async with _set_back(memory, rng, Backup(url, None).restore, url) as state:
                        await _check(outcome, state, url, rounds=rounds)
                else:
                    _copy(folder / "memory.db", folder / "copy.db")
                    await _record(memory, rng)
                    await memory.flush()
                    state = _StateBefore(url)
            if _replace_by_copy(folder):
                async with Memory.open(url, settings=_SETTINGS) as memory:
                    await _record(memory, rng)
                    await memory.flush()
                    await _check(outcome, state, url, rounds=rounds)
            step()

    asyncio.run(run_all())
    return outcome


def _copy(source: Path, target: Path) -> None:
    with closing(sqlite3.connect(source)) as read, closing(sqlite3.connect(target)) as written:
        read.backup(written)


def _replace_by_copy(folder: Path) -> bool:
    """Replace the memory by its copy; return False if there is no copy."""
    if not (folder / "copy.db").exists():
        return False
    for each in ("memory.db-wal", "memory.db-shm"):
        (folder / each).unlink(missing_ok=True)
    (folder / "copy.db").replace(folder / "memory.db")
    return True


# === deletions ================================================================================================
#
# Delete or replace a SQLite database at a random moment under a plan and its writer.
#
# `rebind` and `recover` store the remaining events in the new database. Events that only the deleted file contained are
# not counted as lost, because they had been stored. If only the deleted file contained the beginning of an episode, its
# later events become dead letters, which count as reported.

_LONGEST_LIFE_S: Final = 0.3
_EVENTS_BY_ID = (
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
        steps.add(plan.kill_and_read())
    finally:
        plan.stop_and_read()
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
    for episode, sequence, kind, payload in ask(file, _EVENTS_BY_ID):
        event = json.loads(payload)
        if kind == "NodeStarted" and event.get("parameters"):
            begun[episode, sequence] = event["parameters"]["place"], event["parameters"]["step"]
        elif kind == "NodeEnded":
            ended[episode, event["node"]] = event["status"]
    return [((*step, ended.get(node, "LOST")), node[0]) for node, step in begun.items()]
