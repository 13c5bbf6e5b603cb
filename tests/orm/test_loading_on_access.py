"""Attributes that a query does not load are loaded when they are read, for many objects at once."""

from __future__ import annotations

import asyncio
import gc
import weakref
from typing import Any

import pytest
from sqlalchemy import event, select

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.types import NodeStarted, RobotValue
from pycrorm_async.orm import Action, NavigateAction, TaskTreeNode, base
from pycrorm_async.query.reading import LoadOnAccess, Reading
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import NAVIGATE, Script, declarations, name_of, pose
from tests.projections.sql_queries import stored_and_folded

_COUNT = 5


@pytest.fixture
async def reading(log: EventLog) -> Reading:
    """A memory with a few navigations."""
    script = Script()
    for number in range(_COUNT):
        robot = RobotValue(pose(number), "ROBOT", 0.25)
        script.put(NodeStarted("action", None, name_of(NAVIGATE), {"target_location": pose(0, number)}, robot))
    await stored_and_folded(log, [*declarations(NAVIGATE), *script.records])
    return Reading(log)


@pytest.fixture
def statements(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The statements that loads on access send."""
    sent: list[str] = []
    original = LoadOnAccess.__init__

    def listening(self: LoadOnAccess, engine: Any, *arguments: Any) -> None:
        original(self, engine, *arguments)
        event.listen(engine.sync_engine, "before_cursor_execute", lambda *each: sent.append(each[2]))

    monkeypatch.setattr(LoadOnAccess, "__init__", listening)
    return sent


async def actions_of(reading: Reading) -> list[Any]:
    async with reading.session() as session:
        return list((await session.scalars(select(Action).order_by(Action.id))).all())


def selects(statements: list[str], table: str) -> int:
    return sum(f"FROM {table}" in each for each in statements)


async def test_an_attribute_is_loaded_for_all_objects_of_a_query_at_once(
    statements: list[str], reading: Reading
) -> None:
    rows = await actions_of(reading)
    assert [type(each) for each in rows] == [NavigateAction] * _COUNT
    assert not statements
    assert [each.target_location_id is not None for each in rows] == [True] * _COUNT
    assert len([each for each in statements if "navigate_action" in each]) == 1
    assert [each.target_location.position.y for each in rows] == list(range(_COUNT))
    assert [each.robot_state.pose.position.x for each in rows] == list(range(_COUNT))
    assert [selects(statements, table) for table in ("robot_state", "position")] == [3, 4]  # for any number of rows


async def test_a_batch_is_bounded(statements: list[str], reading: Reading, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "BATCH", 2)
    rows = await actions_of(reading)
    assert [each.pose_id is not None for each in rows] == [True] * _COUNT
    assert len([each for each in statements if "navigate_action" in each]) == 3


async def test_attributes_are_loaded_after_the_memory_is_closed_and_in_other_threads(reading: Reading) -> None:
    rows = await actions_of(reading)
    await reading.close()
    assert rows[1].robot_state.pose.position.x == 1
    assert await asyncio.to_thread(lambda: rows[2].pose.position.y) == 2
    assert rows[3].items == []


@pytest.mark.soak_on("postgresql")
async def test_an_object_that_was_loaded_on_access_loads_what_is_read_of_it(reading: Reading) -> None:
    robot_pose = (await actions_of(reading))[1].robot_state.pose
    gc.collect()  # the actions that the query returned, and all that only they kept
    assert robot_pose.position.x == 1


@pytest.mark.soak_on("postgresql")
async def test_a_closed_session_is_freed_with_its_last_object(reading: Reading) -> None:
    async with reading.session() as session:
        session.expunge_all()
        row = (await session.scalars(select(Action).order_by(Action.id).limit(1))).one()
        kept = weakref.ref(session.sync_session)
    del session
    gc.collect()
    assert kept() is not None
    assert row.robot_state is not None
    del row
    gc.collect()
    assert kept() is None


async def test_an_attribute_is_read_between_the_rows_of_an_open_session(reading: Reading) -> None:
    async with reading.session() as session:
        places = [
            (
                each.robot_state and each.robot_state.pose.x,
                (await session.get_one(TaskTreeNode, each.id)).action is each,
            )
            async for each in await session.stream_scalars(select(Action).order_by(Action.id))
        ]
    assert places == [(number, True) for number in range(_COUNT)]


async def test_a_database_that_is_away_is_named_when_an_attribute_is_read(
    reading: Reading, database_url: str, request: pytest.FixtureRequest
) -> None:
    rows = await actions_of(reading)
    address = reading._address
    await reading.close()
    if address.is_sqlite:
        address.path.unlink()
    else:
        request.getfixturevalue("server").drop(database_url)
    with pytest.raises(DatabaseUnavailable):
        _ = rows[0].robot_state
    assert (
        repr(rows[0]) == f"NavigateAction(id={rows[0].id}, process_metadata_id=1, dtype='NavigateAction',"
        f" kind='action', robot_state_id={rows[0].id})"
    )
