"""Types of users: mapped classes that authors declare, and classes that are made where none is imported."""

from __future__ import annotations

import gc
import subprocess
import sys
import weakref
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import ForeignKey, select
from sqlalchemy.orm import Mapped, load_only, mapped_column

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DesignatorTypeDeclared, NodeStarted, ObjectAdded, ObjectReference, RobotValue
from pycrorm_async.orm import Action, Designator, Motion, PickUpAction, TaskTreeNode
from pycrorm_async.orm.dynamic import DynamicClasses
from pycrorm_async.projections.columns import Layout, unite
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms
from tests.commands import environment
from tests.memory.note_actions import NoteActionPerformable, url_of
from tests.orm.recorded_breakfast import session_on
from tests.projections.event_script import PICK_UP, SAYING, Script, declarations, declared, field, name_of, pose, row
from tests.projections.sql_queries import stored_and_folded

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]


# === dynamic classes ==========================================================================================
#
# Types without a class in this process, the classes made for them, and classes that authors declared.

CAREFUL = declared(
    "CarefulPickUpAction",
    "careful_pick_up_action",
    *PICK_UP.fields,
    field("speed", "real", 5),
    field("via", "pose", 6),
    bases=("PickUpAction",),
)
DANCE = declared("DanceMotion", "dance_motion", field("beats", "integer", 2), kind="motion")
LOOP = declared("Loop", "loop", field("times", "integer", 2), kind="language")
STATE = RobotValue(pose(0.5), "ROBOT", 0.25)


class ORMRemark(Action):
    """A class as an author declares it in the thesis, including `init=False`."""

    id: Mapped[int] = mapped_column(ForeignKey(f"{Action.__tablename__}.id"), primary_key=True, init=False)
    text: Mapped[str]


def all_kinds() -> Script:
    script = Script()
    milk = script.put(ObjectAdded("milk", "MILK", pose(1, 2, 3)))  # 1
    grasp = {"object_designator": ObjectReference(milk, milk), "arm": "LEFT", "grasp": "TOP"}
    script.put(NodeStarted("action", None, name_of(CAREFUL), grasp | {"speed": 0.5, "via": pose(7)}, STATE))  # 2
    script.put(NodeStarted("action", None, name_of(SAYING), {"text": "hi"}, STATE))  # 3
    script.put(NodeStarted("motion", None, name_of(DANCE), {"beats": 4}, STATE))  # 4
    script.put(NodeStarted("language", None, name_of(LOOP), {"times": 3}, STATE))  # 5
    return script


KINDS = declarations(CAREFUL, SAYING, DANCE, LOOP)


async def every(log: EventLog, question: Any) -> list[Any]:
    async with session_on(log) as session:
        return list((await session.scalars(question)).all())


def names(only_row: list[Any]) -> list[str]:
    return [type(each).__name__ for each in only_row]


async def accepted(log: EventLog) -> list[DesignatorTypeDeclared]:
    return list(unite(Layout(), await log.declarations()).accepted.values())


@asynccontextmanager
async def classes_of(log: EventLog) -> AsyncIterator[DynamicClasses]:
    classes = DynamicClasses()
    classes.learn(await accepted(log))
    classes.map()
    classes.use_in(log.engine)
    try:
        yield classes
    finally:
        classes.dispose()


async def test_a_type_without_a_class_is_read_as_its_nearest_class(log: EventLog) -> None:
    await stored_and_folded(log, [*KINDS, *all_kinds().records])
    assert names(await every(log, select(Action).order_by(Action.id))) == ["PickUpAction", "Action"]
    assert names(await every(log, select(PickUpAction))) == ["PickUpAction"]
    assert names(await every(log, select(Motion))) == ["Motion"]
    everything = await every(log, select(Designator).order_by(Designator.id))
    assert names(everything) == ["PickUpAction", "Action", "Motion", "Language"]
    assert [each.dtype for each in everything] == ["CarefulPickUpAction", "SayingAction", "DanceMotion", "Loop"]
    assert everything[0].arm is Arms.LEFT
    assert everything[0].object.pose.position.z == 3.0
    assert everything[1].robot_state.pose.position.x == 0.5
    nodes = await every(log, select(TaskTreeNode).order_by(TaskTreeNode.id))
    assert [each.action for each in nodes] != []
    assert names([each.action for each in nodes]) == ["PickUpAction", "Action", "Motion", "Language"]


async def test_a_class_is_made_for_it_with_its_fields(log: EventLog) -> None:
    await stored_and_folded(log, [*KINDS, *all_kinds().records])
    async with classes_of(log) as classes:
        actions = await every(log, select(Action).order_by(Action.id))
        assert names(actions) == ["CarefulPickUpAction", "SayingAction"]
        careful, saying = actions
        assert issubclass(type(careful), PickUpAction)
        assert (careful.speed, careful.via.position.x, careful.pose.position.x) == (0.5, 7.0, 7.0)
        assert (careful.arm, careful.object.pose.position.y) == (Arms.LEFT, 2.0)
        assert saying.text == "hi"
        mapped: Any = classes.of("SayingAction")
        assert [each.id for each in await every(log, select(mapped).where(mapped.text == "hi"))] == [row(3)]
        assert names(await every(log, select(Designator).order_by(Designator.id))) == [
            "CarefulPickUpAction", "SayingAction", "DanceMotion", "Loop",
        ]  # fmt: skip
        nodes = await every(log, select(TaskTreeNode).order_by(TaskTreeNode.id))
        assert nodes[0].action.via.position.x == 7.0


async def test_lists_dicts_and_poses_are_attributes_of_a_made_class_whatever_their_names(log: EventLog) -> None:
    trip = declared(
        "TripAction",
        "trip_action",
        field("stops", "list", 2, item="pose"),
        field("loads", "dict", 3, item="integer"),
        field("entries", "text", 4),
        field("start", "pose", 5),
        field("end", "pose", 6),
        field("duration", "real", 7),  # as an attribute that every action has
    )
    script = Script()
    stops, loads = [pose(1), pose(2)], {"milk": 2, "cup": 1}
    parameters = {"stops": stops, "loads": loads, "entries": "x", "start": pose(3), "end": pose(4), "duration": 60.0}
    script.put(NodeStarted("action", None, name_of(trip), parameters))
    await stored_and_folded(log, [*declarations(trip), *script.records])
    async with classes_of(log) as classes:
        (only_row,) = await every(log, select(Action))
        assert (only_row.start.position.x, only_row.end.position.x) == (3.0, 4.0)
        assert (only_row.pose is only_row.start, only_row.pose_id, only_row.end_id) == (True, row(1, 5), row(1, 6))
        assert only_row.entries == "x"
        assert [(each.x, each.frame) for each in only_row.stops] == [(1.0, "map"), (2.0, "map")]
        assert only_row.loads == {"milk": 2, "cup": 1}
        assert (only_row.duration, only_row.status) == (60.0, TaskStatus.RUNNING)
        made: Any = classes.of("TripAction")
        assert await every(log, select(made.duration).where(made.duration > 50)) == [60.0]


async def test_a_class_can_be_requested_by_type_table_or_designator(log: EventLog) -> None:
    class SayingActionPerformable:
        dtype = "SayingAction"

    await stored_and_folded(log, [*KINDS, *all_kinds().records])
    async with classes_of(log) as classes:
        saying = classes.of("SayingAction")
        assert classes.of("saying_action") is saying
        assert classes.of(SayingActionPerformable) is saying
        assert classes.of("PickUpAction") is PickUpAction
        assert classes.of("pick_up_action") is PickUpAction
        with pytest.raises(CallerError, match="this memory has no type 'Waving'"):
            classes.of("Waving")


async def test_a_type_that_appears_after_the_first_query_is_in_the_answer(log: EventLog) -> None:
    projector = Projector(log)
    await projector.open()
    async with classes_of(log) as classes:
        for question in (select(Action), select(Designator), select(PickUpAction)):
            assert await every(log, question) == []
        await log.append([*KINDS, *all_kinds().records])
        await projector.catch_up()
        assert names(await every(log, select(Action).order_by(Action.id))) == ["PickUpAction", "Action"]
        classes.learn(await accepted(log))
        classes.map()
        assert names(await every(log, select(Action).order_by(Action.id))) == ["CarefulPickUpAction", "SayingAction"]
        assert names(await every(log, select(PickUpAction))) == ["CarefulPickUpAction"]


async def test_a_field_that_appears_later_is_an_attribute_of_the_existing_class(log: EventLog) -> None:
    louder = declared("SayingAction", "saying_action", field("text", "text", 2), field("volume", "real", 3))
    script = all_kinds()
    projector = await stored_and_folded(log, [*KINDS, *script.records])
    async with classes_of(log) as classes:
        saying: Any = classes.of("SayingAction")
        assert [each.text for each in await every(log, select(saying))] == ["hi"]
        script.put(NodeStarted("action", None, name_of(louder), {"text": "HI", "volume": 0.5}))
        await log.append([*declarations(louder), *script.records])
        await projector.catch_up()
        classes.learn(await accepted(log))
        classes.map()
        grown: Any = classes.of("SayingAction")
        assert grown is saying
        rows = await every(log, select(grown).order_by(grown.id))
        assert [(each.text, each.volume) for each in rows] == [("hi", None), ("HI", 0.5)]
        assert [each.text for each in await every(log, select(grown).where(grown.volume > 0.1))] == ["HI"]


async def test_two_memories_with_types_of_one_name_do_not_share_classes(log: EventLog, tmp_path: Path) -> None:
    other_saying = declared("SayingAction", "saying_action", field("words", "integer", 2))
    other = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{tmp_path}/other.db"), create=True)
    try:
        script = Script()
        script.put(NodeStarted("action", None, name_of(other_saying), {"words": 3}))
        await stored_and_folded(log, [*KINDS, *all_kinds().records])
        await stored_and_folded(other, [*declarations(other_saying), *script.records])
        async with classes_of(log) as first, classes_of(other) as second:
            assert first.of("SayingAction") is not second.of("SayingAction")
            for _ in range(2):
                assert (await every(log, select(Action).order_by(Action.id)))[1].text == "hi"
                assert (await every(other, select(Action)))[0].words == 3
            assert not hasattr(first.of("SayingAction"), "words")
        async with classes_of(other):
            assert names(await every(log, select(Action).order_by(Action.id))) == ["PickUpAction", "Action"]
            assert names(await every(other, select(Action))) == ["SayingAction"]
    finally:
        await other.close()


async def test_disposed_classes_leave_no_references(log: EventLog) -> None:
    await stored_and_folded(log, [*KINDS, *all_kinds().records])
    identities = dict(Designator.__mapper__.polymorphic_map)
    mapped_class: list[weakref.ref[type]] = []
    kept = load_only(Action.id)  # a program may keep an option for its queries
    async with classes_of(log) as classes:
        await every(log, select(Action).options(kept))
        await every(log, select(Action))
        await every(log, select(TaskTreeNode))
        await every(log, select(classes.of("SayingAction")))
        mapped_class += [weakref.ref(classes.of(name)) for name in ("SayingAction", "CarefulPickUpAction", "Loop")]
    assert dict(Designator.__mapper__.polymorphic_map) == identities
    del classes
    gc.unfreeze()  # tests/conftest.py froze all objects, also the loading paths that `dispose` replaced
    gc.collect()
    gc.freeze()
    assert [each() for each in mapped_class] == [None, None, None]
    assert names(await every(log, select(Action).order_by(Action.id))) == ["PickUpAction", "Action"]


async def test_an_authors_class_is_that_of_its_rows_and_of_those_from_before_it_was_declared(log: EventLog) -> None:
    before = declared("RemarkAction", "remark_action", field("text", "text", 2))
    after = declared("RemarkAction", "ORMRemark", field("text", "text", 2))
    script = Script()
    script.put(NodeStarted("action", None, name_of(before), {"text": "old"}))
    script.put(NodeStarted("action", None, name_of(after), {"text": "new"}, STATE))
    projector = Projector(log)
    await projector.open()
    assert await every(log, select(ORMRemark)) == []  # its table is there before its first row
    await log.append([*declarations(before, after), *script.records])
    await projector.catch_up()
    for class_ in (ORMRemark, Action):
        rows = await every(log, select(class_).order_by(class_.id))
        assert [(type(each), each.dtype, each.text) for each in rows] == [
            (ORMRemark, "RemarkAction", "old"),
            (ORMRemark, "RemarkAction", "new"),
        ]
    assert rows[1].robot_state.pose.position.x == 0.5
    assert names([each.action for each in await every(log, select(TaskTreeNode))]) == ["ORMRemark"] * 2
    async with classes_of(log) as classes:
        assert classes.of("RemarkAction") is ORMRemark


@pytest.mark.parametrize("declaration", [SAYING, CAREFUL], ids=lambda each: each.dtype)
async def test_a_type_can_be_queried_while_its_base_is_unknown(
    log: EventLog, declaration: DesignatorTypeDeclared
) -> None:
    bases = ("NobodyAction", declaration.dtype)
    orphan = declared("OrphanAction", "orphan_action", field("n", "integer", 2), bases=bases)
    script = Script()
    script.put(NodeStarted("action", None, name_of(orphan), {"n": 1}))
    await stored_and_folded(log, [*declarations(orphan), *script.records])
    expected = {"SayingAction": "Action", "CarefulPickUpAction": "Action"}[declaration.dtype]
    assert names(await every(log, select(Action))) == [expected]
    async with classes_of(log):
        (only_row,) = await every(log, select(Action))
        assert (type(only_row).__name__, only_row.n) == ("OrphanAction", 1)


IN_A_NEW_PROCESS = """
import gc
from sqlalchemy.orm import configure_mappers
from pycrorm_async.orm.dynamic import DynamicClasses
from tests.projections.event_script import SAYING

gc.disable()
for _ in range(2):
    classes = DynamicClasses()
    classes.learn([SAYING])
    classes.map()
    classes.dispose()
configure_mappers()
"""


def test_a_class_that_is_deleted_before_any_query_affects_none() -> None:
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", IN_A_NEW_PROCESS]
    done = subprocess.run(command, cwd=root, env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# === types ====================================================================================================
#
# User types in a memory: subclasses, mapped classes, views, data frames, and processes that lack the class.


async def test_a_memory_that_only_records_generates_no_class(tmp_path: Path) -> None:
    identities = Designator.__mapper__.polymorphic_map
    before = set(identities)
    async with Memory.open(url_of(tmp_path)) as memory:
        await NoteActionPerformable("a").perform()
        await memory.flush()
        assert set(identities) == before
        mapped = memory.mapped(NoteActionPerformable)
        assert set(identities) - before == {mapped.__mapper__.polymorphic_identity}
