"""A memory opened for reading: sessions, named queries, data frames."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pandas as pd
import pytest
from sqlalchemy import Engine, create_engine, func, select
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session, aliased

from pycrorm_async.errors import CallerError, DatabaseUnavailable, UnknownEpisode
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectReference,
    RobotValue,
)
from pycrorm_async.orm import Action, NavigateAction, Object, PickUpAction, PickUpWithContextView, Pose, TaskTreeNode
from pycrorm_async.projections.projector import Projector
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType
from tests.databases import ask, run_in_own_loop
from tests.projections.event_script import NAVIGATE, PICK_UP, SAYING, Script, declarations, name_of, pose, row
from tests.projections.factories import append_and_fold


def moment(sequence: int) -> datetime:
    return datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC) + timedelta(seconds=sequence)


def episode(number: int) -> Script:
    script = Script(number)
    put = script.put
    put(EpisodeStarted(f"episode {number}", "me", "host", "1.0", "3.11"))  # 1
    root = put(NodeStarted("root"))  # 2
    milk = put(ObjectAdded("milk", "MILK", pose(1, 2, 3)))  # 3
    robot = RobotValue(pose(0.5), "ROBOT", 0.25)
    outer = put(NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(7)}, robot))  # 4
    other = put(NodeStarted("action", root, name_of(SAYING), {"text": "hi"}))  # 5
    grasp = {"object_designator": ObjectReference(milk, milk), "arm": "LEFT", "grasp": "TOP"}
    inner = put(NodeStarted("action", outer, name_of(PICK_UP), grasp, robot))  # 6
    put(NodeEnded(inner, "FAILED", FailureValue("a.IKError", "too far")))  # 7
    put(NodeEnded(outer, "SUCCEEDED"))  # 8
    if number == 2:
        put(NodeEnded(other, "SUCCEEDED"))  # 9
        put(NodeEnded(root, "SUCCEEDED"))  # 10
        put(EpisodeEnded("SUCCEEDED"))  # 11
    return script


@pytest.fixture(scope="module")
def recorded(module_database_url: str) -> DatabaseAddress:
    """A log in which episode 1 still runs and episode 2 has ended."""
    address = DatabaseAddress.parse(module_database_url)

    types = declarations(NAVIGATE, PICK_UP, SAYING)
    run_in_own_loop(append_and_fold(module_database_url, [*types, *episode(1).records, *episode(2).records]))
    return address


@pytest.fixture
async def reading(recorded: DatabaseAddress) -> AsyncIterator[Reading]:
    async with Reading.open_address(recorded) as opened:
        yield opened


async def test_the_overview_has_a_line_for_every_episode(reading: Reading) -> None:
    first = EpisodeSummary(
        number=1, id="00000000-0000-7000-8000-000000000001", started_at=moment(1), ended_at=None, duration_ns=None,
        status="RUNNING", description="episode 1", created_by="me", nodes=4, failed=1,
        world="milk (MILK)",
    )  # fmt: skip
    second = EpisodeSummary(
        number=2, id="00000000-0000-7000-8000-000000000002", started_at=moment(1), ended_at=moment(11),
        duration_ns=10_000_000_000, status="SUCCEEDED", description="episode 2", created_by="me", nodes=4, failed=1,
        world="milk (MILK)",
        end_sequence=11,
    )  # fmt: skip
    summaries = await reading.episodes()
    assert [replace(each, digest_sequence=None, digest=None) for each in summaries] == [first, second]
    assert [(each.digest_sequence, each.digest is None) for each in summaries] == [(None, True), (11, False)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number"),
    [("1", 1), ("2", 2), ("last", 2), ("00000000-0000-7000-8000-000000000001", 1)],
)
async def test_an_episode_is_found_by_number_by_id_or_as_the_last(reading: Reading, name: str, number: int) -> None:
    assert (await reading.episode(name)).number == number


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("3", "there is no episode '3' (`pycrorm episodes` lists all 2)"),
        ("first", "there is no episode 'first' (`pycrorm episodes` lists all 2)"),
        ("00000000-0000", "2 episodes have an id that begins with '00000000-0000': use more of its digits"),
    ],
)
@pytest.mark.soak_on("postgresql")
async def test_an_unknown_or_ambiguous_episode_is_refused(reading: Reading, name: str, message: str) -> None:
    with pytest.raises(UnknownEpisode) as raised:
        await reading.episode(name)
    assert str(raised.value) == message


async def test_the_number_of_an_episode_is_known_by_its_id(reading: Reading) -> None:
    assert await reading.number_of("00000000-0000-7000-8000-000000000002") == 2
    with pytest.raises(UnknownEpisode):
        await reading.number_of("00000000-0000-7000-8000-000000000009")


@pytest.mark.slow
async def test_a_task_tree_lists_parents_first_with_depths_and_durations(reading: Reading) -> None:
    tree = await reading.tree(1)
    assert [(each.depth, each.id, each.parent_id, each.dtype, each.status, each.duration_ns) for each in tree] == [
        (0, row(2), None, None, "RUNNING", None),
        (1, row(4), row(2), "NavigateAction", "SUCCEEDED", 4_000_000_000),
        (2, row(6), row(4), "PickUpAction", "FAILED", 1_000_000_000),
        (1, row(5), row(2), "SayingAction", "RUNNING", None),
    ]
    assert tree[2] == NodeSummary(
        id=row(6), parent_id=row(4), depth=2, dtype="PickUpAction", kind="action", status="FAILED",
        parameters={"object_designator": {"object": 3, "row": 3, "name": "milk"}, "arm": "LEFT", "grasp": "TOP"},
        started_at=moment(6), duration_ns=1_000_000_000, reason="IKError", failure_message="too far", simulated=False,
        sequence=6, end_sequence=7,
    )  # fmt: skip
    assert await reading.tree(9) == []


@pytest.mark.slow
async def test_a_session_has_classes_for_every_type_in_the_memory(reading: Reading) -> None:
    async with reading.session() as session:
        actions = (
            await session.scalars(select(Action).where(Action.process_metadata_id == 1).order_by(Action.id))
        ).all()
    assert [type(each).__name__ for each in actions] == ["NavigateAction", "SayingAction", "PickUpAction"]
    saying: Any = reading.mapped("SayingAction")
    async with reading.session() as session:
        assert [each.text for each in await session.scalars(select(saying))] == ["hi", "hi"]
    with pytest.raises(CallerError):
        reading.mapped("WavingAction")


async def test_a_session_cannot_write(reading: Reading) -> None:
    async with reading.session() as session:
        connection = await session.connection()
        with pytest.raises(DBAPIError, match=r"read-?only"):
            await connection.exec_driver_sql("DELETE FROM zz_pose__1001")


@pytest.mark.empty_database
async def test_a_memory_that_is_missing_or_has_no_tables_is_unavailable(log: EventLog, tmp_path: object) -> None:
    with pytest.raises(DatabaseUnavailable):
        async with Reading.open(f"sqlite:///{tmp_path}/nothing.db"):
            pass
    with pytest.raises(DatabaseUnavailable, match="has a log but no tables yet: run `pycrorm writer --once --url "):
        async with Reading.open_address(log.address):
            pass


# --- frames -------------------------------------------------------------------------------------------------------


async def test_a_frame_of_the_view_has_its_columns_and_names_of_enum_members(reading: Reading) -> None:
    frame = await reading.dataframe(select(PickUpWithContextView).order_by(PickUpWithContextView.id))
    assert list(frame.columns) == [
        "id", "arm", "grasp", "torso_height", "relative_x", "relative_y", "quaternion_x", "quaternion_y",
        "quaternion_z", "quaternion_w", "obj_type", "status", "process_metadata_id", "node_id",
        "object_x", "object_y", "sequence",
    ]  # fmt: skip
    assert frame.to_dict("records")[0] == {
        "id": row(6), "arm": "LEFT", "grasp": "TOP", "torso_height": 0.25, "relative_x": -0.5, "relative_y": -2.0,
        "quaternion_x": 0.0, "quaternion_y": 0.0, "quaternion_z": 0.0, "quaternion_w": 1.0, "obj_type": "MILK",
        "status": "FAILED", "process_metadata_id": 1, "node_id": row(6),
        "object_x": -0.5, "object_y": -2.0, "sequence": 6,
    }  # fmt: skip
    assert len(frame) == 2


async def test_a_frame_accepts_conditions_with_enum_members_and_joins(reading: Reading) -> None:
    question = (
        select(PickUpAction.arm, Object.name, Pose.x, TaskTreeNode.status)
        .join(PickUpAction.object)
        .join(Object.pose)
        .join(PickUpAction.node)
        .where(PickUpAction.arm == Arms.LEFT, PickUpAction.process_metadata_id.in_([1, 7]))
    )
    frame = await reading.dataframe(question)
    assert frame.to_dict("records") == [{"arm": "LEFT", "name": "milk", "x": 1.0, "status": "FAILED"}]


async def test_a_frame_has_times_in_utc(reading: Reading) -> None:
    question = select(TaskTreeNode.start_time, TaskTreeNode.end_time).where(
        TaskTreeNode.process_metadata_id == 1, TaskTreeNode.kind == "action"
    )
    frame = await reading.dataframe(question.order_by(TaskTreeNode.id))
    assert [str(each) for each in frame.dtypes] == ["datetime64[us, UTC]"] * 2
    assert list(frame.start_time) == [pd.Timestamp(moment(each)) for each in (4, 5, 6)]
    assert frame.end_time.isna().tolist() == [False, True, False]


async def test_a_frame_of_a_mapped_class_has_its_attributes_once(reading: Reading) -> None:
    frame = await reading.dataframe(select(NavigateAction))
    assert list(frame.columns) == [
        "id", "process_metadata_id", "dtype", "kind", "robot_state_id", "pose_id",
        "status", "start_time", "end_time", "duration", "reason", "end_sequence", "robot", "sequence",
    ]  # fmt: skip
    assert [*frame.sequence, *frame.end_sequence] == [4, 4, 8, 8]
    assert [*frame.status, *frame.duration, *frame.reason.isna()] == ["SUCCEEDED"] * 2 + [4.0] * 2 + [True] * 2
    assert list(frame.start_time) == [pd.Timestamp(moment(4))] * 2
    frame = await reading.dataframe(select(Pose.id, Object.id).join(Object.pose).order_by(Pose.id))
    assert list(frame.columns) == ["id", "id_1"]
    assert frame.id.tolist() == frame.id_1.tolist() == [row(3), row(3, number=2)]


async def test_enums_are_the_same_text_in_a_frame_and_in_plain_sql(reading: Reading, recorded: DatabaseAddress) -> None:
    columns = PickUpAction.arm, PickUpAction.grasp, Object.obj_type, PickUpAction.status
    question = select(*columns).join(PickUpAction.object).order_by(PickUpAction.id)
    frame = await reading.dataframe(question)
    assert frame.values.tolist() == [["LEFT", "TOP", "MILK", "FAILED"]] * 2
    by_hand = (
        "SELECT arm, grasp, obj_type, status FROM pick_up_action JOIN designator USING (id)"
        " JOIN object ON object.id = object_designator_id ORDER BY pick_up_action.id"
    )
    assert ask(str(recorded), by_hand) == [tuple(each) for each in frame.values]
    if str(recorded).startswith("sqlite"):  # the only database with a driver that pandas can use here
        with contextlib.closing(sqlite3.connect(str(recorded).removeprefix("sqlite:///"))) as plain:
            assert pd.read_sql(by_hand, plain).equals(frame)
        with synchronous(recorded) as engine:
            assert pd.read_sql(question, engine).equals(frame)
            left = question.where(PickUpAction.arm == Arms.LEFT, PickUpAction.status == TaskStatus.FAILED)
            assert pd.read_sql(left, engine).equals(frame)
            assert len(pd.read_sql(question.where(PickUpAction.arm == Arms.RIGHT), engine)) == 0


@contextlib.contextmanager
def synchronous(address: DatabaseAddress) -> Iterator[Engine]:
    engine = create_engine(str(address))
    try:
        yield engine
    finally:
        engine.dispose()


@pytest.mark.parametrize("module_database_url", ["sqlite"], indirect=True)  # PostgreSQL's drivers here are async
async def test_objects_have_members_also_in_a_synchronous_session(recorded: DatabaseAddress) -> None:
    with synchronous(recorded) as engine, Session(engine) as session:
        (picked, _) = session.scalars(select(PickUpAction).order_by(PickUpAction.id))
        assert (picked.arm, picked.grasp, picked.status) == (Arms.LEFT, Grasp.TOP, TaskStatus.FAILED)
        assert picked.robot_state is not None
        assert (picked.object.obj_type, picked.robot_state.type) == (ObjectType.MILK, ObjectType.ROBOT)
        session.expire(picked)
        assert (picked.arm, picked.status) == (Arms.LEFT, TaskStatus.FAILED)
        session.expunge_all()
        arms = {each.id: each.arm for each in session.scalars(select(Action)) if isinstance(each, PickUpAction)}
        assert [*arms.values()] == [Arms.LEFT] * 2
        assert {type(each.status) for each in session.scalars(select(TaskTreeNode))} == {TaskStatus}


async def test_a_frame_counts_groups_and_accepts_aliases(reading: Reading) -> None:
    counted = select(TaskTreeNode.status, func.count().label("times")).group_by(TaskTreeNode.status)
    frame = await reading.dataframe(counted.order_by(TaskTreeNode.status))
    assert frame.to_dict("list") == {"status": ["FAILED", "RUNNING", "SUCCEEDED"], "times": [2, 2, 4]}
    there = aliased(Pose, name="there")
    frame = await reading.dataframe(select(there.x.label("far")).where(there.x > 6).order_by(there.id))
    assert frame.to_dict("list") == {"far": [7.0, 7.0]}


async def test_an_empty_answer_is_a_frame_with_columns(reading: Reading) -> None:
    frame = await reading.dataframe(select(Pose.x, Pose.time).where(Pose.id < 0))
    assert list(frame.columns) == ["x", "time"]
    assert len(frame) == 0
    assert str(frame.dtypes["time"]) == "datetime64[us, UTC]"


@pytest.mark.slow
async def test_a_fresh_memory_has_no_episodes(log: EventLog) -> None:
    await Projector(log).open()
    async with Reading.open_address(log.address) as opened:
        assert await opened.episodes() == []
        with pytest.raises(UnknownEpisode):
            await opened.episode("last")
