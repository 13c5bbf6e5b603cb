"""Kill a rebuild anywhere, and run it beside processes that record and read: readers never see less than before."""

from __future__ import annotations

import asyncio
import os
import random
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory, Reading
from pycrorm_async.operations import rebuild as rebuilding
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import Action, PickUpWithContextView, TaskTreeNode
from pycrorm_async.projections import rebuild as steps
from pycrorm_async.settings import Settings
from tests.crash.forked_processes import ForkedProcess, die_at_statement
from tests.databases import ask
from tests.memory.note_actions import NoteActionPerformable
from tests.projections.event_script import append_and_fold
from tests.projections.rebuild_cases import TYPES, folded_elsewhere, picking, traces
from tests.table_comparison import differences, tables_of

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]


EPISODES = 30
BATCH_EVENTS = 60


async def filled(url: str, episodes: int = EPISODES) -> None:
    records = (each for number in range(1, episodes + 1) for each in picking(number).records)
    await append_and_fold(url, [*TYPES, *records])


def killed_at(url: str, last: int, *, workers: int) -> None:
    process = ForkedProcess(rebuild_until, url, last, workers, BATCH_EVENTS)
    assert process.wait() in (-9, 0), process.lines


async def kill_again_and_again(url: str, kills: int, *, workers: int) -> None:
    await filled(url)
    before = tables_of(url)
    whole = ForkedProcess(rebuild_until, url, 0, workers, BATCH_EVENTS)
    assert whole.wait() == 0
    count = int(whole.lines[-1])
    assert differences(before, tables_of(url)) == []
    seed = random.randrange(2**31)
    print("seed", seed, "statements", count)
    rng = random.Random(seed)
    for _ in range(kills):
        # Half of the kills hit the end, where the rebuild publishes the new tables and drops the old ones.
        last = rng.randint(1, count) if rng.random() < 0.5 else rng.randint(count * 2 // 3, count)
        killed_at(url, last, workers=workers)
        assert differences(before, tables_of(url)) == [], f"killed at statement {last}"
        if rng.random() < 0.5:
            assert (await rebuild_memory(url)).left == []
            assert differences(before, tables_of(url)) == [], f"after a kill at statement {last}"
            assert traces(url) == [], f"after a kill at statement {last}"
    assert (await rebuild_memory(url)).left == []
    assert differences(before, tables_of(url)) == []
    assert traces(url) == []


async def test_a_rebuild_killed_anywhere_changes_nothing_readers_see_and_the_next_one_leaves_no_trace(
    database_url: str,
) -> None:
    await kill_again_and_again(database_url, 2, workers=1)


@pytest.mark.soak
@pytest.mark.parametrize("workers", [1, 2])
async def test_a_rebuild_killed_at_fifty_points_changes_nothing_readers_see(
    database_url: str, workers: int, in_turn: bool
) -> None:
    await kill_again_and_again(database_url, 8 if in_turn else 50, workers=workers)


async def rebuild_beside_recorders(
    url: str, folder: Path, *, episodes: int, rebuilds: int, readers: int, pause_s: float = 0.0
) -> None:
    await filled(url, episodes)
    others = [
        ForkedProcess(record_until_stopped, url, folder / "spool", pause_s),
        *(ForkedProcess(read_until_stopped, url, pause_s) for _ in range(readers)),
    ]
    for each in others:
        each.wait_for_first_output()
    began = time.monotonic()
    for _ in range(rebuilds):
        assert (await rebuild_memory(url)).left == []
    took_s = time.monotonic() - began
    for each in others:
        each.request_stop()
    codes = [each.wait() for each in others]
    assert codes == [0] * len(others), [each.lines[-3:] for each in others]
    for each in others[1:]:
        *counts, waited = each.lines
        seen = [tuple(map(int, line.split()[1:])) for line in counts]
        assert seen[0][0] >= episodes
        assert seen[0][3] >= 5 * episodes
        assert all(a <= b for one, other in pairwise(seen) for a, b in zip(one, other, strict=True)), seen
        print(f"read {len(seen)} times, {waited} s at most")
    _, recorded, longest_s = others[0].lines[-1].split()
    print(f"{recorded} episodes recorded in {took_s:.1f} s, flushed in {longest_s} s at most")
    assert ask(url, "SELECT count(*) FROM episode WHERE folded < head") == [(0,)]
    assert ask(url, "SELECT count(*) FROM process_metadata") == [(episodes + int(recorded),)]
    assert differences(tables_of(url), await folded_elsewhere(url, folder)) == []
    await rebuild_memory(url)
    assert traces(url) == []


async def test_a_rebuild_changes_nothing_for_processes_that_record_and_read(database_url: str, tmp_path: Path) -> None:
    await rebuild_beside_recorders(database_url, tmp_path, episodes=30, rebuilds=2, readers=1, pause_s=0.1)


@pytest.mark.soak
async def test_a_long_rebuild_changes_nothing_for_processes_that_record_and_read(
    database_url: str, tmp_path: Path, in_turn: bool
) -> None:
    await rebuild_beside_recorders(database_url, tmp_path, episodes=1_000 if in_turn else 10_000, rebuilds=5, readers=4)


# === rebuild processes ========================================================================================
#
# Processes that compete with a rebuild: a rebuild that is killed at one statement, a recorder, and a reader.

_PATIENT = Settings(connect_timeout_s=120, flush_timeout_s=300)


def rebuild_until(url: str, last: int, workers: int, batch_events: int) -> None:
    """Rebuild, and die before statement number `last`; with 0 rebuild to the end and print the count of statements."""
    rebuilding._SHARE_EVENTS_MIN = 1
    steps._BATCH_EVENTS = batch_events
    print_count = die_at_statement(last)
    print("began", flush=True)
    asyncio.run(rebuild_memory(url, workers=workers))
    print_count()


def _input_closed() -> threading.Event:
    """Return an event that is set when the other end of the input is closed."""
    stop = threading.Event()

    def listen() -> None:
        os.read(0, 1)
        stop.set()

    threading.Thread(target=listen, daemon=True).start()
    return stop


def record_until_stopped(url: str, spool: Path, pause_s: float) -> None:
    """Record and flush episodes of notes, with a pause after each flush; print their number and the longest flush in
    seconds.
    """
    asyncio.run(_record(url, spool, pause_s, _input_closed()))


async def _record(url: str, spool: Path, pause_s: float, stop: threading.Event) -> None:
    longest_s, episodes = 0.0, 0
    async with Memory.open(url, spool=spool, settings=_PATIENT) as memory:
        print("records", flush=True)
        while not stop.is_set():
            async with memory.episode(description="beside a rebuild"):
                for turn in range(50):
                    await NoteActionPerformable(str(turn)).perform()
            began = time.monotonic()
            await memory.flush()
            longest_s, episodes = max(longest_s, time.monotonic() - began), episodes + 1
            await asyncio.sleep(pause_s)
    print("recorded", episodes, longest_s, flush=True)


def read_until_stopped(url: str, pause_s: float) -> None:
    """Print counts of episodes, nodes, actions and pick-ups, with pauses, until the input is closed, and then the
    longest query.
    """
    asyncio.run(_read(url, pause_s, _input_closed()))


async def _read(url: str, pause_s: float, stop: threading.Event) -> None:
    longest_s = 0.0
    async with Reading.open(url) as reading:
        while not stop.is_set():
            began = time.monotonic()
            episodes = len(await reading.episodes())
            async with reading.session() as session:
                nodes = (await session.scalars(select(func.count()).select_from(TaskTreeNode))).one()
                actions = len((await session.scalars(select(Action.id))).all())
                picked = (await session.scalars(select(func.count()).select_from(PickUpWithContextView))).one()
            longest_s = max(longest_s, time.monotonic() - began)
            print("counted", episodes, nodes, actions, picked, flush=True)
            await asyncio.sleep(pause_s)
    print("waited", longest_s, flush=True)
