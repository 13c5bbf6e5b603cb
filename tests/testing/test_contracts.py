"""The shipped tools for tests accept correct classes and report each kind of defect."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Projection
from pycrorm_async.errors import CallerError, Unrecordable
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.custom import Changes, Event
from pycrorm_async.record.recording import Recording
from pycrorm_async.testing.contracts import check_designator, check_executive, check_projection
from pycrorm_async.testing.fake_clock import FakeClock
from pycrorm_async.world import Arms
from tests.databases import ask_to_change

pytest_plugins = ["pycrorm_async.testing.fixtures"]


@dataclass
class WeighActionPerformable(ActionAbstract):
    what: str
    grams: float = 1.5
    arm: Arms = Arms.LEFT
    at: datetime = field(default_factory=lambda: datetime(2026, 1, 2, 3, 4, 5, 678_901, UTC))
    note: str | None = None

    async def perform(self) -> None:
        """Succeed without doing anything."""


class Weighed(Projection):
    name = "weighed"
    tables: ClassVar = {"weighing": {"what": "text", "grams": "real"}}

    def fold(self, event: Event, rows: Changes) -> None:
        if event.dtype == "WeighAction":
            rows.insert("weighing", event.id, what=event.parameters["what"], grams=self.grams_of(event))

    def grams_of(self, event: Event) -> float:
        grams: float = event.parameters["grams"]
        return grams


class Impure(Weighed):
    def grams_of(self, event: Event) -> float:
        return random.random()


class Picky(Weighed):
    def grams_of(self, event: Event) -> float:
        raise ValueError(f"no {event.parameters['what']}")


async def plan() -> None:
    for what in ("milk", "water"):
        await WeighActionPerformable(what).perform()


async def test_a_projection_that_holds_its_contract_returns_its_rows(tmp_path: Path) -> None:
    rows = await check_projection(Weighed(), plan, tmp_path)
    assert [(row["what"], row["grams"]) for row in rows["weighing"]] == [("milk", 1.5), ("water", 1.5)]


async def test_a_projection_that_is_not_pure_is_reported(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"a second fold of weighed differs, so it is not pure: .*grams"):
        await check_projection(Impure(), plan, tmp_path)


async def test_a_projection_that_stops_is_reported_with_its_reason(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"weighed stopped: .*no milk"):
        await check_projection(Picky(), plan, tmp_path)


async def test_a_designator_returns_its_row_with_every_value(tmp_path: Path) -> None:
    row = await check_designator(WeighActionPerformable("milk", arm=Arms.RIGHT), tmp_path)
    assert (row.what, row.grams, row.note) == ("milk", 1.5, None)


async def test_a_designator_with_an_unrecordable_value_is_reported(tmp_path: Path) -> None:
    with pytest.raises(Unrecordable, match=r"grams"):
        await check_designator(WeighActionPerformable("milk", float("nan")), tmp_path)


class Bare(ActionAbstract):
    async def perform(self) -> None:
        """Succeed without doing anything."""


async def test_a_designator_that_is_no_dataclass_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match=r"Bare is not a dataclass"):
        await check_designator(Bare(), tmp_path)


def walk(recording: Recording, *, ends: Any = "SUCCEEDED", speed: object = 0.5) -> None:
    drive = recording.type("motion", "Drive", {"speed": float})
    with recording.episode(description="a walk") as episode:
        episode.start("job", recording.type("action", "Walk"))
        episode.start("go", drive, {"speed": speed}, parent="job")
        if ends:
            episode.end("go", ends)
        episode.end("job", "SUCCEEDED")


async def test_an_executive_that_holds_its_contract_returns_its_nodes(tmp_path: Path) -> None:
    async def walk_in_loop(recording: Recording) -> None:
        await asyncio.to_thread(walk, recording, ends="FAILED")

    for drive, status in (walk, "SUCCEEDED"), (walk_in_loop, "FAILED"):
        folder = tmp_path / status
        folder.mkdir()
        nodes = await check_executive(drive, folder)
        assert [(each.dtype, each.status.name) for each in nodes] == [("Walk", "SUCCEEDED"), ("Drive", status)]
        assert nodes[1].parent_id == nodes[0].id


def leave_open(recording: Recording) -> None:
    recording.episode(description="never closed").start("go", recording.type("motion", "Drive"))


def record_nothing(recording: Recording) -> None:
    recording.episode(description="empty").close()


@pytest.mark.parametrize(
    ("drive", "message"),
    [
        (partial(walk, ends=""), "1 faults were counted, the last one: .*nodes open at the end of episode"),
        (partial(walk, ends="DONE"), "1 faults were counted, the last one: .*DONE"),
        (partial(walk, speed="fast"), r"1 values are missing, the last one: Drive\.speed: "),
        (leave_open, "an episode did not end: it is RUNNING"),
        (record_nothing, "no node was recorded"),
    ],
)
async def test_an_executive_that_breaks_its_contract_is_reported(
    drive: Callable[[Recording], None], message: str, tmp_path: Path
) -> None:
    with pytest.raises(AssertionError, match=message):
        await check_executive(drive, tmp_path)


async def test_tables_that_differ_from_a_second_fold_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def falsify(memory: Memory) -> None:
        await flush(memory)
        ask_to_change(
            tmp_path / "executive.db", "UPDATE zz_task_tree_node__1001 SET status = 'FAILED' WHERE dtype = 'Drive'"
        )

    flush = Memory.flush
    monkeypatch.setattr(Memory, "flush", falsify)
    with pytest.raises(AssertionError, match=r"the log or the tables are wrong: .*FAILED"):
        await check_executive(walk, tmp_path)


async def test_the_memory_of_a_test_records_events_and_refuses_invalid_values(memory: Memory) -> None:
    await WeighActionPerformable("milk").perform()
    await memory.flush()
    assert memory.opened_count == 1
    with pytest.raises(Unrecordable, match=r"grams"):
        await WeighActionPerformable("milk", float("nan")).perform()


async def test_the_times_of_events_are_those_of_the_clock(clock: FakeClock, tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", clock=clock.clock) as memory:
        async with memory.episode(description="slow"):
            clock.advance(2.5)
            await WeighActionPerformable("milk").perform()
        await memory.flush()
        async with memory.session() as session:
            [started] = (
                await session.scalars(select(TaskTreeNode.start_time).where(TaskTreeNode.dtype.is_not(None)))
            ).all()
    assert started == datetime(2026, 1, 1, 0, 0, 2, 500_000, UTC)
