"""Run the path from the queue to the log with all faults combined, drawn from one seed.

Files, queue, writer and SQLite log are real. The seed decides when the sync thread runs, when the power fails on a disk
that loses unsynced data, when the database is unavailable or loses its reply, and when the drain is cancelled. After
the death of each recorder the next one starts, and the dead folder is drained under the same faults. At the end
everything that was synced before a power cut must be in the log once, and nothing that was never put.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.codec import LOST, Heading, Record
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import Backoff, Drain
from tests.crash.disk_machine import Machine, machine_on
from tests.crash.step_robot import Event, verify_kept
from tests.databases import ask
from tests.queue.factories import opened_dead
from tests.writer.fakes import CountingFold, ForwardingDestination

pytestmark = pytest.mark.slow

_NO_BACKOFF = Backoff(first_s=1e-6, longest_s=1e-6)
_STORED = "SELECT id, sequence, payload FROM event JOIN episode ON number = event.episode ORDER BY number, sequence"


class _FaultyLog(ForwardingDestination):
    """A log that at random is unavailable, or commits and loses the reply."""

    def __init__(self, log: EventLog, rng: random.Random) -> None:
        super().__init__(CountingFold(log))
        self._rng = rng

    async def append(self, *batch: Any, **options: Any) -> Mapping[EpisodeId, str]:
        chance = self._rng.random()
        if chance < 0.2:
            raise DatabaseUnavailable("unavailable before the append")
        refused = await super().append(*batch, **options)
        if chance < 0.4:
            raise DatabaseUnavailable("the reply to the COMMIT was lost")
        return refused


class _Life:
    """One recorder from its start to its death."""

    def __init__(self, machine: Machine, rng: random.Random, number: int) -> None:
        self.machine = machine
        self._rng = rng
        self._number = number
        self._episodes = 0
        self._open: list[EpisodeId] = []
        self._count = 0
        self.taken = 0
        machine.meanwhile = self._node

    def act(self) -> None:
        """Put a few events."""
        for _ in range(self._rng.randrange(1, 6)):
            if not self._open or (len(self._open) < 9 and self._rng.random() < 0.2):
                self._episodes += 1
                randomness = self._number.to_bytes(4) + self._episodes.to_bytes(6)
                self._open.append(episode_id(1_700_000_000_000_000_000, randomness))
                self._put(Heading(self._open[-1], "EpisodeStarted", 1))
                continue
            episode = self._rng.choice(self._open)
            ends = len(self._open) > 1 and self._rng.random() < 0.15
            self._put(Heading(episode, "EpisodeEnded" if ends else "NodeStarted", 1))
            if ends:
                self._open.remove(episode)

    def _node(self) -> Heading:
        return Heading(self._rng.choice(self._open), "NodeStarted", 1)

    def _put(self, heading: Heading) -> None:
        self._count += 1
        self.machine.put(heading, b'{"n":%d,"x":"%s"}' % (self._count, b"x" * self._rng.randrange(900)))


class _PowerFails(BaseException):
    """The power of the simulated machine has failed."""


def _fail_power_at(machine: Machine, moment: int) -> None:
    """Let the power fail at the `moment`-th call of `machine.cut`."""
    original_cut, calls_left = machine.cut, moment

    def cut_or_fail() -> None:
        nonlocal calls_left
        calls_left -= 1
        if calls_left == 0:
            original_cut()
            raise _PowerFails

    machine.cut = cut_or_fail  # type: ignore[method-assign]


async def _record_until_cut(
    machine: Machine, life: _Life, log: EventLog, rng: random.Random
) -> tuple[Path, list[Event]]:
    """Record, sync and drain until the power fails; return the folder after the cut, and the synced events."""
    destination = _FaultyLog(log, rng)
    _fail_power_at(machine, rng.randrange(1, 150))
    with contextlib.suppress(_PowerFails):
        while True:
            await _step(machine, life, destination, rng)
    [(folder, synced, _, _)] = machine.cuts
    return folder, events_of(machine.put_so_far[:synced])


async def _step(machine: Machine, life: _Life, destination: _FaultyLog, rng: random.Random) -> None:
    queue = machine.queue
    life.act()
    machine.cut()
    if rng.random() < 0.7:
        machine.turn()
    if queue.synced > life.taken and rng.random() < 0.6:
        batch = await queue.get_batch(events_max=rng.choice((1, 3, 50)), bytes_max=2**20, age_s_max=0.0)
        life.taken = batch[-1].position
        stored = False
        while not stored:
            machine.cut()
            with contextlib.suppress(DatabaseUnavailable):
                await destination.append(batch)
                stored = True
        machine.cut()
        await queue.acknowledge(life.taken)
        machine.turn()


async def _drain(folder: Path, log: EventLog, rng: random.Random) -> None:
    """Drain the dead folder as the next process would; cancel the drain and restart it at random."""
    for attempt in range(30):
        recovered = opened_dead(folder, check=rng.random() < 0.5)
        settings = Settings(batch_events_max=rng.choice((1, 5, 100)))
        drain = Drain(recovered, _FaultyLog(log, rng).append, settings=settings, backoff=_NO_BACKOFF)
        running = asyncio.create_task(drain.run())
        if attempt < 29 and rng.random() < 0.5:
            for _ in range(rng.randrange(40)):
                await asyncio.sleep(0)
            running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
        if recovered.release() is not None:
            return


def events_of(records: Iterable[Record]) -> list[Event]:
    """Return the events of the records, without the ends that recovery computes."""
    return [
        (episode_text(each.episode), each.sequence, each.payload.decode())
        for each in records
        if each.episode is not None and each.payload != LOST
    ]


@pytest.mark.parametrize("memories", [4, pytest.param(1_000, marks=pytest.mark.soak)])
async def test_all_faults_at_random_lose_nothing_that_was_synced_and_double_nothing(
    tmp_path: Path, memories: int, in_turn: bool, rng: random.Random
) -> None:
    for memory in range(min(memories, 100) if in_turn else memories):
        url = f"sqlite:///{tmp_path}/{memory}.db"
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        synced: list[Event] = []
        put: list[Event] = []
        for number in range(1, rng.randrange(2, 4)):
            with machine_on(tmp_path / str(memory) / str(number), rng) as machine:
                folder, synced_here = await _record_until_cut(machine, _Life(machine, rng, number), log, rng)
                synced += synced_here
                put += events_of(machine.put_so_far)
                await _drain(folder, log, rng)
        await log.close()
        verify_kept(synced, [each for each in ask(url, _STORED) if each[2] != LOST.decode()], possible=put)
