"""Fail over to a replica under an open memory: all that was flushed is there afterwards, under the same numbers.

An asynchronous replica has lost the last commits, which the memory stores again; a synchronous one has lost none.
Events are recorded before, through and after the failover.
"""

from __future__ import annotations

import asyncio
import random
import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.backups import PATRONI_PACKAGES, PatroniCluster, Replicas, has_patroni, replicas_in
from tests.databases import ask, server_in
from tests.memory.note_actions import NoteActionPerformable

pytestmark = pytest.mark.soak

SETTINGS = Settings(sync_interval_ms=5, flush_timeout_s=120)
QUESTIONS = (
    "SELECT id, sequence, payload FROM event JOIN episode ON number = event.episode",
    "SELECT id, number FROM episode",
    "SELECT id, dtype FROM task_tree_node",
    "SELECT id, text FROM note_action",
)


@pytest.fixture(params=["asynchronous", "synchronous", "patroni"])
def replicas(request: pytest.FixtureRequest) -> Iterator[Replicas | PatroniCluster]:
    with tempfile.TemporaryDirectory(prefix="pg") as place:
        if request.param != "patroni":
            with replicas_in(Path(place), synchronous=request.param == "synchronous") as pair:
                yield pair
            return
        if not has_patroni():
            pytest.skip(f"{PATRONI_PACKAGES} are not installed")
        with (
            server_in(Path(place), syncs=False) as programs,
            tempfile.TemporaryDirectory(prefix="pat") as name,
            PatroniCluster(Path(name), programs) as cluster,
        ):
            yield cluster


async def note(rng: random.Random) -> None:
    for _ in range(rng.randrange(1, 6)):
        await NoteActionPerformable(f"{rng.random()}").perform()


async def record(memory: Memory, rng: random.Random) -> None:
    for _ in range(rng.randrange(1, 4)):
        async with memory.episode(description="an episode"):
            await note(rng)


def contents(url: str) -> list[set[Any]]:
    return [set(ask(url, question)) for question in QUESTIONS]


async def verify_shows_no_fault(url: str) -> None:
    async with await EventLog.open(DatabaseAddress.parse(url), create=False) as log:
        result = await verify(log)
    assert (result.damage, result.drift, result.behind, result.outdated) == (0, 0, 0, None)
    assert not result.stopped
    assert not result.unmade


async def test_a_failover_takes_nothing_that_was_flushed(
    replicas: Replicas | PatroniCluster, tmp_path: Path, in_turn: bool, rng: random.Random
) -> None:
    rounds = 2 if isinstance(replicas, PatroniCluster) else 9 if in_turn else 100
    ask(replicas.url(), "CREATE DATABASE memory")
    url = replicas.url("memory")
    async with Memory.open(url, spool=tmp_path / "spool", settings=SETTINGS) as memory:
        for number in range(rounds):
            await record(memory, rng)
            await memory.flush()
            if isinstance(replicas, Replicas) and not replicas.synchronous:
                await asyncio.to_thread(replicas.lag)
            way = number % 3
            async with memory.episode(description="through it all") if way == 0 else nullcontext():
                await (note(rng) if way == 0 else record(memory, rng))
                await memory.flush()
                before = await asyncio.to_thread(contents, url)
                await asyncio.to_thread(replicas.fail_over)
                if way < 2:
                    await (note(rng) if way == 0 else record(memory, rng))
                await memory.flush()
                after = await asyncio.to_thread(contents, url)
                assert all(kept <= now for kept, now in zip(before, after, strict=True))
                await verify_shows_no_fault(url)
            await asyncio.to_thread(replicas.follow)
