"""The view of failures: where each began, with its path, its object, its arm and its message."""

from __future__ import annotations

import pytest
from sqlalchemy import select

from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectMoved,
    ObjectReference,
    ObjectValue,
)
from pycrorm_async.orm import RootFailure
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms
from tests.orm.recorded_breakfast import OPEN, every, moment
from tests.projections.event_script import (
    MOVE,
    NAVIGATE,
    PICK_UP,
    Script,
    declarations,
    declared,
    field,
    name_of,
    pose,
    row,
)
from tests.projections.sql_queries import ask, stored_and_folded

pytestmark = pytest.mark.slow
RETRY = declared("Retry", "retry", field("times", "integer", 2), kind="language")


def failing() -> Script:
    """A transport fails in a motion of its second attempt, and the plan continues; then the plan itself raises."""
    script = Script()
    put = script.put
    put(EpisodeStarted("Breakfast", "me", "host", "1.0", "3.11"))  # 1
    root = put(NodeStarted("root"))  # 2
    milk = put(ObjectAdded("milk", "MILK", pose(1, 2, 3)))  # 3
    retry = put(NodeStarted("language", root, name_of(RETRY), {"times": 2}))  # 4
    for arm in ("LEFT", "RIGHT"):  # 5 to 9, 10 to 14
        seen = {"object_designator": ObjectReference(milk, milk), "arm": arm, "grasp": "TOP"}
        pick = put(NodeStarted("action", retry, name_of(PICK_UP), seen))
        move = put(NodeStarted("motion", pick, name_of(MOVE), {"target": pose(7, 8)}))
        put(ObjectMoved(milk, "milk", "MILK", pose(9, 9, 9), move))
        fault = FailureValue("plan.failures.IKError", f"{arm} is too short", [])
        put(NodeEnded(move, "FAILED", fault))
        put(NodeEnded(pick, "FAILED", fault))
    put(NodeEnded(retry, "SUCCEEDED"))  # 15
    handle = ObjectValue("ObjectPart", "handle", "GENERIC_OBJECT", pose(1))
    opening = put(NodeStarted("action", root, name_of(OPEN), {"object_designator": handle, "arm": "LEFT"}))  # 16
    put(NodeEnded(opening, "CANCELLED"))  # 17
    drive = put(NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(7)}))  # 18
    put(NodeEnded(drive, "SUCCEEDED"))  # 19
    opening = put(NodeStarted("action", root, name_of(OPEN), {"object_designator": handle, "arm": "LEFT"}))  # 20
    put(NodeEnded(opening, "ERROR", FailureValue("builtins.KeyError", "door")))  # 21
    put(NodeEnded(root, "ERROR", FailureValue("builtins.KeyError", "door")))  # 22
    put(EpisodeEnded("ERROR"))  # 23
    put = (second := Script(2)).put
    put(EpisodeStarted("Lunch", "me", "host", "1.0", "3.11"))  # 1
    root = put(NodeStarted("root"))  # 2
    put(NodeEnded(root, "ERROR", FailureValue("builtins.ValueError", "no table")))  # 3
    script.records += second.records
    return script


async def test_a_failure_is_listed_where_it_began_with_path_object_arm_and_message(log: EventLog) -> None:
    await stored_and_folded(log, [*declarations(PICK_UP, MOVE, OPEN, NAVIGATE, RETRY), *failing().records])
    first, second, opening, plan = await every(log, select(RootFailure).order_by(RootFailure.id))
    path = "root > Retry > PickUpAction > MoveMotion"
    assert (first.id, first.dtype, first.status) == (row(6), "MoveMotion", TaskStatus.FAILED)
    assert (first.path, first.object, first.arm) == (path, "milk", Arms.LEFT)
    assert (first.reason, first.message, first.recovered) == ("IKError", "LEFT is too short", True)
    assert (first.start_time, first.end_time, first.episode.description) == (moment(6), moment(8), "Breakfast")
    assert (second.id, second.path, second.arm, second.message) == (row(11), path, Arms.RIGHT, "RIGHT is too short")
    assert (opening.id, opening.path, opening.status) == (row(20), "root > OpenAction", TaskStatus.ERROR)
    assert (opening.object, opening.arm, opening.reason) == ("handle", Arms.LEFT, "KeyError")
    assert (opening.message, opening.recovered) == ("door", False)
    assert (plan.id, plan.dtype, plan.path, plan.object) == (row(2, number=2), None, "root", None)
    assert (plan.arm, plan.message, plan.recovered) == (None, "no table", False)
    lost = select(RootFailure.path).where(~RootFailure.recovered, RootFailure.object == "handle")
    assert await every(log, lost) == ["root > OpenAction"]


async def test_object_and_arm_of_a_failure_are_those_of_the_nearest_node(log: EventLog) -> None:
    script = Script()
    put = script.put
    milk = put(ObjectAdded("milk", "MILK", pose(1, 2, 3)))
    seen = {"object_designator": ObjectReference(milk, milk), "arm": "RIGHT", "grasp": "TOP"}
    pick = put(NodeStarted("action", None, name_of(PICK_UP), seen))
    handle = {"object_designator": ObjectValue("ObjectPart", "handle"), "arm": "LEFT"}
    opening = put(NodeStarted("action", pick, name_of(OPEN), handle))
    for node in (opening, pick):
        put(NodeEnded(node, "FAILED", FailureValue("plan.failures.PlanFailure", "")))
    await stored_and_folded(log, [*declarations(PICK_UP, OPEN), *script.records])
    (failure,) = await every(log, select(RootFailure))
    assert (failure.path, failure.object, failure.arm) == ("PickUpAction > OpenAction", "handle", Arms.LEFT)


async def test_a_dict_field_is_no_object_of_a_failure(log: EventLog) -> None:
    note = declared("NoteAction", "note_action", field("lines", "dict", 2, item="text"))
    script = Script()
    lines = {"object": "milk", "row": "first"}
    node = script.put(NodeStarted("action", None, name_of(note), {"lines": lines}))
    script.put(NodeEnded(node, "FAILED", FailureValue("plan.failures.PlanFailure", "")))
    await stored_and_folded(log, [*declarations(note), *script.records])
    (failure,) = await every(log, select(RootFailure))
    assert (failure.path, failure.object, failure.recovered) == ("NoteAction", None, False)


async def test_simulations_are_left_out_of_failures_unless_asked_for(log: EventLog) -> None:
    script = failing()
    for place, each in enumerate(script.records[:-3]):  # the second episode has none
        if each.type in ("EpisodeStarted", "NodeStarted"):
            simulated = each.payload.replace(b"{", b'{"simulated":true,', 1)
            script.records[place] = each._replace(payload=simulated)
    await stored_and_folded(log, [*declarations(PICK_UP, MOVE, OPEN, NAVIGATE, RETRY), *script.records])
    reading = Reading(log)
    counts = []
    for also in (False, True):
        async with reading.session(simulated=also) as session:
            counts.append(len((await session.scalars(select(RootFailure))).all()))
    assert counts == [1, 4]


async def test_plain_sql_counts_where_failures_began(log: EventLog) -> None:
    await stored_and_folded(log, [*declarations(PICK_UP, MOVE, OPEN, NAVIGATE, RETRY), *failing().records])
    question = "SELECT path, object, count(*) FROM root_failure GROUP BY path, object ORDER BY path"
    assert await ask(log, question) == [
        ("root", None, 1),
        ("root > OpenAction", "handle", 1),
        ("root > Retry > PickUpAction > MoveMotion", "milk", 2),
    ]
