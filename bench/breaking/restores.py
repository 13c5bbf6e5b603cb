"""Set a database back to an earlier state: by a failover with or without losses, or by restoring a backup.

Everything that a flush acknowledged before must exist afterwards, with the same numbers and row ids, and `verify` must
report nothing.
Each round is compared and verified directly after the flush that follows the fault, before anything else is recorded:
events recorded after a flush may be in the log before they are in the tables, and verify reports those as behind.
"""

from __future__ import annotations

import asyncio
import random
import sqlite3
import sys
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async import Memory, Settings
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.backups import Backup
from tests.databases import Server, ask, server_in
from tests.replicas import replicas_in

__all__ = ["failovers", "restored_files", "restored_servers"]

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
            ask(replicas.url(), "CREATE DATABASE memory")
            url = replicas.url("memory")
            async with Memory.open(url, spool=spool, settings=_SETTINGS) as memory:
                for _ in range(rounds):
                    await _record(memory, rng)
                    await memory.flush()
                    if not synchronous:
                        await asyncio.to_thread(replicas.lag)
                    async with _set_back(memory, rng, replicas.fail_over, url) as state:
                        await _check(outcome, state, url, rounds=rounds)
                    await asyncio.to_thread(replicas.follow)
                    step()

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        standby = "confirms every COMMIT" if synchronous else "no longer receives changes"
        outcome = Outcome(
            note=f"PostgreSQL: SIGQUIT of the primary while its standby {standby}; the standby is promoted"
        )
        with tempfile.TemporaryDirectory(prefix="pair") as place:
            asyncio.run(run_all(outcome, rounds, rng, step, Path(place), folder / "spool"))
        return outcome

    return run


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
