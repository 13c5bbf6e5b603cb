"""Every row of what happened has its event: as an attribute of the mapped classes, and in plain SQL."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import func, select

from pycrorm_async.events.ids import row_key
from pycrorm_async.events.types import (
    CandidateValue,
    EpisodeStarted,
    FailureValue,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectReference,
    RefusalValue,
    RobotValue,
)
from pycrorm_async.orm import (
    Base,
    EpisodeTag,
    LocationCandidate,
    LocationRefusal,
    ParameterItem,
    PickUpAction,
    PickUpWithContextView,
    RootFailure,
    SpatialRelation,
)
from pycrorm_async.projections.generations import current_generation
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import PICK_UP, Script, declarations, declared, field, name_of, pose
from tests.projections.sql_queries import stored_and_folded
from tests.sessions import session_on

PLACE = declared("PlaceAction", "place_action", field("object_designator", "object", 2), field("arm", "enum", 3))
SETS = declared("SetAction", "set_action", field("things", "list", 2, item="object"), field("sequence", "integer", 3))
WITHOUT_EVENT = {"process_metadata", "position", "quaternion"}
"""The views of episodes, and of the parts of a pose."""
EVENTS: dict[Any, int] = {
    EpisodeTag: 1,
    LocationCandidate: 5,
    LocationRefusal: 5,
    ParameterItem: 6,
    PickUpAction: 7,
    PickUpWithContextView: 7,
    RootFailure: 7,
    SpatialRelation: 7,
}


@pytest.fixture
async def filled(log: EventLog) -> EventLog:
    """The log of an episode with a tag and a failed pick-up of milk beside a bowl."""
    script = Script()
    put = script.put
    put(EpisodeStarted("Tutorial", "me", "host", "1.0", "3.11", tags=("kitchen",)))
    root = put(NodeStarted("root"))
    milk = put(ObjectAdded("milk", "MILK", pose(1, 2, 1)))
    put(ObjectAdded("bowl", "BOWL", pose(1.15, 2, 1)))
    offered, refused = (CandidateValue(pose(7, 8), ("LEFT",)),), (RefusalValue(pose(8, 8), "too far"),)
    put(LocationResolved("CostmapLocation", offered, 0, 9, root, refused))
    seen, state = ObjectReference(milk, milk), RobotValue(pose(0.5), "ROBOT", 0.25)
    put(NodeStarted("action", root, name_of(SETS), {"things": [seen], "sequence": 70}, state))
    parameters = {"object_designator": seen, "arm": "LEFT", "grasp": "TOP"}
    pick = put(NodeStarted("action", root, name_of(PICK_UP), parameters, state))
    put(NodeEnded(pick, "FAILED", FailureValue("plan.failures.IKError", "too far")))
    await stored_and_folded(log, [*declarations(PICK_UP, PLACE, SETS), *script.records])
    return log


async def test_a_mapped_row_has_its_event_and_queries_order_by_it(filled: EventLog) -> None:
    async with session_on(filled) as session:
        for class_, event in EVENTS.items():
            assert list(await session.scalars(select(func.max(class_.sequence)))) == [event], class_
            loaded = (await session.scalars(select(class_).order_by(class_.sequence))).all()
            assert {each.sequence for each in loaded} == {event}, class_


async def test_every_view_of_what_happened_has_the_event_of_its_rows(filled: EventLog) -> None:
    tables = {mapper.class_.__tablename__: mapper.class_ for mapper in Base.registry.mappers}
    async with filled.engine.connect() as connection:
        generation = await current_generation(connection)
        assert generation is not None
        for view in generation.views:
            answer = await connection.exec_driver_sql(f'SELECT * FROM "{view}"')
            columns = list(answer.keys())
            if "process_metadata_id" not in columns or view in WITHOUT_EVENT:
                continue
            assert columns.count("sequence") == 1, view
            key = getattr(tables.get(view), "_row", "id")
            for row in answer.mappings():
                # A field of a type that has this name takes precedence.
                assert row["sequence"] == (70 if view == "set_action" else row_key(row[key]).sequence), view
        for class_, event in EVENTS.items():
            table = class_.__tablename__
            sequences = await connection.exec_driver_sql(f'SELECT DISTINCT sequence FROM "{table}"')
            assert sequences.scalars().all() == [event], table
