"""The mark of a custom projection: how much of the log it has, so that only what is newer has to be checked."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.ext.asyncio import AsyncConnection

from bench.one_episode import Steps
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, EpisodeTagged, NodeStarted
from pycrorm_async.operations.removal import remove
from pycrorm_async.projections import pipeline
from pycrorm_async.projections.custom import Changes, Event, Projection
from pycrorm_async.projections.custom_tables import states
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow
from tests.projections.event_script import Script
from tests.projections.sql_queries import ask
from tests.projections.verify_cases import rebuilt

pytestmark = pytest.mark.slow


class Nodes(Projection):
    """Has a row for each node, and cannot fold a motion."""

    name, version = "nodes", 1
    tables = {"own_node": {"kind": "text"}}  # noqa: RUF012 - a common form in user code

    def fold(self, event: Event, rows: Changes) -> None:
        if isinstance(event.happening, NodeStarted):
            if event.happening.kind == "motion":
                raise ValueError("a motion")
            rows.insert("own_node", event.id, kind=event.happening.kind)


@pytest.fixture
async def log(tmp_path: Path) -> AsyncIterator[EventLog]:
    async with await EventLog.open(DatabaseAddress.parse(f"sqlite:///{tmp_path}/memory.db"), create=True) as opened:
        yield opened


@pytest.fixture
def moved_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Move the mark at each new event, and use it however small the memory is."""
    monkeypatch.setattr(pipeline, "_UNMARKED_EVENTS_MIN", 1)
    monkeypatch.setattr(pipeline, "_CHECKED_EVENTS_MAX", 10**6)


async def folding(log: EventLog, *projections: Projection) -> Projector:
    """Return an open projector, as each process has one."""
    projector = Projector(log, projections=projections)
    await projector.open()
    return projector


def begun(episode: int) -> Script:
    script = Script(episode)
    script.put(EpisodeStarted("", "me", "host", "", "3.11"))
    script.put(NodeStarted("root"))
    return script


async def behind(log: EventLog) -> int:
    """Return the number of events that the projection lacks, of all episodes but those parked."""
    [state] = await states(log, [Nodes()])
    assert state.fault is None
    return state.behind


async def mark_of(log: EventLog) -> list[tuple[int, ...]]:
    """Return episode and sequence of the mark."""
    [[name]] = await ask(log, "SELECT name FROM sqlite_master WHERE name GLOB '*progress_nodes__*'")
    return await ask(log, f"SELECT folded >> 31, (folded >> 5) & 67108863 FROM {name} WHERE id <= 0")


async def test_a_complete_fold_takes_as_many_steps_in_a_memory_of_ten_times_as_many_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "_UNMARKED_EVENTS_MIN", 10)
    counts = []
    with Steps() as steps:
        for episodes in (200, 2_000):
            address = DatabaseAddress.parse(f"sqlite:///{tmp_path}/{episodes}.db")
            async with await EventLog.open(address, create=True) as log:
                projector = await folding(log, Nodes())
                for first, last in ((1, episodes), (episodes + 1, episodes + 5)):
                    records = [each for number in range(first, last + 1) for each in begun(number).records]
                    steps.hundreds = 0
                    await log.append(records)
                    await projector.catch_up()
                counts.append(steps.hundreds)
                assert await behind(log) == 0
    few, many = counts
    assert many <= few + 2


class Walk:
    """Changes one memory in random order, as recorders, folding processes and operators do."""

    def __init__(self, log: EventLog, seed: int) -> None:
        self.log = log
        self.random = random.Random(seed)
        self.open: dict[int, Script] = {}
        self.ended: dict[int, Script] = {}
        self.archived: dict[int, Script] = {}
        self.number = 0

    async def append(self, script: Script, *events: Any) -> None:
        before = len(script.records)
        for each in events:
            script.put(each)
        await self.log.append(script.records[before:])

    async def begin(self) -> None:
        self.number += 1
        script = self.open[self.number] = Script(self.number)
        nodes = [NodeStarted("root" if not each else "action", each and 2) for each in range(self.random.randrange(3))]
        await self.append(script, EpisodeStarted("", "me", "host", "", "3.11"), *nodes)

    async def grow(self) -> None:
        if self.open:
            script = self.random.choice([*self.open.values()])
            await self.append(script, NodeStarted("motion" if self.random.random() < 0.1 else "action"))

    async def end(self) -> None:
        if self.open:
            number = self.random.choice([*self.open])
            script = self.ended[number] = self.open.pop(number)
            await self.append(script, EpisodeEnded("SUCCEEDED"))

    async def tag(self) -> None:
        if self.ended:
            await self.append(self.random.choice([*self.ended.values()]), EpisodeTagged(("kept",)))

    async def archive(self) -> None:
        rows = [each for each in await self.log.episodes() if each.ended_wall_ns and each.folded == each.head]
        if rows:
            row = rows[-1] if self.random.random() < 0.5 else self.random.choice(rows)
            await remove(self.log, [row], reason="old", archived_in="lake")
            number = int(row.id.replace("-", "")[-6:], 16)
            self.archived[number] = self.ended.pop(number)

    async def restore(self) -> None:
        if self.archived:
            number = self.random.choice([*self.archived])
            script = self.ended[number] = self.archived.pop(number)
            self.log.blobs.restores = True
            await self.log.append(script.records)
            self.log.blobs.restores = False

    async def write_file_anew(self) -> None:
        await dialect_of(self.log.engine).purge(self.log.engine, [])

    async def fold_tables_alone(self) -> None:
        await (await folding(self.log)).catch_up()

    async def fold_beside_new_events(self) -> None:
        projector = await folding(self.log, Nodes())
        await projector.fold_next_batch()
        await self.begin()
        projector._custom._due_s = 0
        await projector.fold_rest()

    async def rebuild(self) -> None:
        await rebuilt(self.log, Nodes())


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.usefixtures("moved_at_once")
async def test_a_complete_fold_leaves_nothing_behind_the_mark_whatever_happened_before(
    log: EventLog, seed: int
) -> None:
    walk = Walk(log, seed)
    steps = [walk.begin, walk.grow, walk.grow, walk.end, walk.tag, walk.archive, walk.restore, walk.write_file_anew]
    steps += [walk.fold_tables_alone, walk.fold_tables_alone, walk.fold_beside_new_events, walk.rebuild]
    projector = await folding(log, Nodes())
    marks = set()
    for _ in range(20):
        for step in walk.random.choices(steps, k=4):
            await step()
        await projector.catch_up()
        assert await behind(log) == 0
        marks.update(await mark_of(log))
    assert len(marks) > 10


@pytest.mark.usefixtures("moved_at_once")
async def test_events_that_are_stored_while_the_mark_is_moved_are_behind_it(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    projector, script = await folding(log, Nodes()), begun(1)
    episodes_behind = pipeline.episodes_behind

    async def stored_after(connection: AsyncConnection, place: str, **options: Any) -> list[EpisodeRow]:
        result = await episodes_behind(connection, place, **options)
        if "after_tables" not in options and len(script.records) == 2:  # asked for the mark
            script.put(NodeStarted("action", 2))
            await log.append(script.records[2:])
        return result

    monkeypatch.setattr(pipeline, "episodes_behind", stored_after)
    await log.append(script.records)
    await projector.catch_up()
    assert await mark_of(log) == [(1, 2)]
    await projector.catch_up()
    assert await behind(log) == 0
