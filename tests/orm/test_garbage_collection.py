"""Queries of many rows trigger few garbage collections, and leave the collector as they found it."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import pytest
from sqlalchemy import select

from pycrorm_async.bulk_records import collecting_seldom
from pycrorm_async.events.types import NodeStarted
from pycrorm_async.orm import Action
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import NAVIGATE, Script, declarations, name_of, pose
from tests.projections.sql_queries import stored_and_folded

_USUAL = (700, 10, 10)
_ROWS = 1_500


@pytest.fixture(autouse=True)
def usual_collector() -> Iterator[None]:
    """The collector as Python starts with it."""
    before = gc.get_threshold()
    gc.set_threshold(*_USUAL)
    yield
    gc.enable()
    gc.set_threshold(*before)


@pytest.fixture
def collections() -> Iterator[list[int]]:
    """The generation of each collection."""
    generations: list[int] = []

    def note(phase: str, details: dict[str, Any]) -> None:
        if phase == "start":
            generations.append(details["generation"])

    gc.callbacks.append(note)
    yield generations
    gc.callbacks.remove(note)


@pytest.mark.soak_on("postgresql")
async def test_a_query_of_many_rows_triggers_few_collections(log: EventLog, collections: list[int]) -> None:
    script = Script()
    for number in range(_ROWS):
        script.put(NodeStarted("action", None, name_of(NAVIGATE), {"target_location": pose(number)}, None))
    await stored_and_folded(log, [*declarations(NAVIGATE), *script.records])
    reading = Reading(log)
    async with reading.session() as session:
        gc.collect()
        collections.clear()
        rows = (await session.scalars(select(Action))).all()
        count = len(collections)
    assert len(rows) == _ROWS
    assert count <= 2  # 20 at Python's own threshold
    assert gc.get_threshold() == _USUAL


@pytest.mark.parametrize("first", [0, 1])
def test_blocks_that_overlap_leave_the_threshold_as_it_was(first: int) -> None:
    blocks = [collecting_seldom(), collecting_seldom()]
    for each in blocks:
        each.__enter__()
    for each in (blocks[first], blocks[1 - first]):
        each.__exit__(None, None, None)
    assert gc.get_threshold() == _USUAL


def test_a_threshold_that_the_program_sets_remains() -> None:
    with pytest.raises(ZeroDivisionError), collecting_seldom():
        assert gc.get_threshold()[0] > _USUAL[0]
        _ = 1 / 0
    assert gc.get_threshold() == _USUAL
    with collecting_seldom():
        gc.set_threshold(1_234, 5, 6)
    assert gc.get_threshold() == (1_234, 5, 6)
    for off_or_high in (0, 1_000_000):
        gc.set_threshold(off_or_high)
        with collecting_seldom():
            assert gc.get_threshold()[0] == off_or_high
        assert gc.get_threshold()[0] == off_or_high
