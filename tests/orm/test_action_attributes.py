"""Actions have their node, their times and their outcome, also in filters and in plain SQL."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Mapped, selectinload

from pycrorm_async.events.types import NodeEnded, NodeStarted
from pycrorm_async.orm import Action, MoveMotion, PickUpAction, ProcessMetaData
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from tests.orm.recorded_breakfast import every, moment
from tests.projections.event_script import Script, declarations, declared, field, name_of, row, time_us
from tests.projections.sql_queries import ask, stored_and_folded
from tests.sessions import session_on

pytestmark = pytest.mark.slow
WAIT = declared("WaitAction", "orm_wait", field("duration", "real", 2), field("status", "text", 3))


class ORMWait(Action):
    """A class whose fields have the names of attributes that every action has."""

    __tablename__ = "orm_wait"

    duration: Mapped[float]
    status: Mapped[str]  # type: ignore[assignment]


async def test_an_action_loads_its_node_on_request(breakfast: EventLog) -> None:
    async with session_on(breakfast) as session:
        pick = (await session.scalars(select(PickUpAction))).one()
        assert (await pick.awaitable_attrs.node).status == TaskStatus.FAILED
    (pick,) = await every(breakfast, select(PickUpAction).options(selectinload(PickUpAction.node)))
    assert (pick.node.status, pick.node.reason) == (TaskStatus.FAILED, "IKError")


async def test_an_action_has_its_times_and_its_outcome(breakfast: EventLog) -> None:
    drive, pick, opening = await every(breakfast, select(Action).order_by(Action.start_time))
    assert (drive.status, drive.reason, drive.duration) == (TaskStatus.SUCCEEDED, None, 4.0)
    assert (pick.status, pick.reason, pick.duration) == (TaskStatus.FAILED, "IKError", 3.0)
    assert (pick.start_time, pick.end_time) == (moment(11), moment(14))
    assert (opening.status, opening.end_time, opening.duration) == (TaskStatus.LOST, None, None)
    assert pick.episode is pick.process_metadata
    (move,) = await every(breakfast, select(MoveMotion))
    assert (move.status, move.duration) == (TaskStatus.SUCCEEDED, 1.0)


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        (Action.status == TaskStatus.FAILED, [11]),
        (Action.duration >= 3, [6, 11]),
        (Action.end_time.is_(None), [15]),
        (Action.start_time > moment(6), [11, 15]),
        (Action.reason == "IKError", [11]),
        (Action.episode.has(description="Tutorial"), [6, 11, 15]),
    ],
)
async def test_actions_are_filtered_and_ordered_by_times_and_outcome(
    breakfast: EventLog, condition: Any, expected: list[int]
) -> None:
    slowest_last = select(Action.id).where(condition).order_by(Action.duration.is_(None), Action.start_time)
    assert await every(breakfast, slowest_last) == [row(each) for each in expected]


async def test_an_action_joins_its_episode(breakfast: EventLog) -> None:
    question = select(ProcessMetaData.description, PickUpAction.duration).join(PickUpAction.episode)
    async with session_on(breakfast) as session:
        assert (await session.execute(question)).all() == [("Tutorial", 3.0)]


@pytest.mark.parametrize("view", ["action", "motion", "designator", "task_tree_node"])
async def test_plain_sql_reads_times_and_outcome_of_an_action_from_one_view(breakfast: EventLog, view: str) -> None:
    columns = "process_metadata_id, dtype, status, start_time, end_time, duration, reason"
    course = await ask(
        breakfast, f"SELECT {columns} FROM {view} WHERE dtype IN ('PickUpAction', 'MoveMotion') ORDER BY id"
    )
    move = (1, "MoveMotion", "SUCCEEDED", time_us(8), time_us(9), 1.0, None)
    pick = (1, "PickUpAction", "FAILED", time_us(11), time_us(14), 3.0, "IKError")
    assert course == {"action": [pick], "motion": [move]}.get(view, [move, pick])


async def test_a_field_with_the_name_of_an_action_attribute_hides_it(log: EventLog) -> None:
    script = Script()
    node = script.put(NodeStarted("action", None, name_of(WAIT), {"duration": 60.0, "status": "patient"}))
    script.put(NodeEnded(node, "SUCCEEDED"))
    await stored_and_folded(log, [*declarations(WAIT), *script.records])
    (wait,) = await every(log, select(ORMWait).where(ORMWait.duration > 50, Action.duration < 50))
    assert (wait.duration, wait.status, wait.reason) == (60.0, "patient", None)
    assert await every(log, select(Action.duration)) == [1.0]
