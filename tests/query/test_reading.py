"""A memory opened for reading: sessions, named queries, and frames of pandas, polars and Arrow."""

from __future__ import annotations

import contextlib
import sqlite3
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
from sqlalchemy import Engine, Text, create_engine, func, literal_column, null, select, text, type_coerce, union_all
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session, aliased

from pycrorm_async.errors import (
    CallerError,
    DatabaseUnavailable,
    InternalError,
    MissingExtra,
    QueryRefused,
    UnknownEpisode,
)
from pycrorm_async.events import types as events
from pycrorm_async.orm import Action, NavigateAction, Object, PickUpAction, PickUpWithContextView, Pose, TaskTreeNode
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType
from tests.databases import ask, run_in_own_loop
from tests.projections.event_script import (
    NAVIGATE,
    PICK_UP,
    SAYING,
    Script,
    append_and_fold,
    declarations,
    name_of,
    pose,
    row,
)

pytestmark = pytest.mark.soak_on("postgresql")
"""Both databases run the same selects: those of tests/orm, of moments and of schemas run on both at each commit."""

# === reading ==================================================================================================
#
# A memory opened for reading: sessions, named queries, data frames.


def moment(sequence: int) -> datetime:
    return datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC) + timedelta(seconds=sequence)


def episode(number: int) -> Script:
    script = Script(number)
    put = script.put
    put(events.EpisodeStarted(f"episode {number}", "me", "host", "1.0", "3.11"))  # 1
    root = put(events.NodeStarted("root"))  # 2
    milk = put(events.ObjectAdded("milk", "MILK", pose(1, 2, 3)))  # 3
    robot = events.RobotValue(pose(0.5), "ROBOT", 0.25)
    outer = put(events.NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(7)}, robot))  # 4
    other = put(events.NodeStarted("action", root, name_of(SAYING), {"text": "hi"}))  # 5
    grasp = {"object_designator": events.ObjectReference(milk, milk), "arm": "LEFT", "grasp": "TOP"}
    inner = put(events.NodeStarted("action", outer, name_of(PICK_UP), grasp, robot))  # 6
    put(events.NodeEnded(inner, "FAILED", events.FailureValue("a.IKError", "too far")))  # 7
    put(events.NodeEnded(outer, "SUCCEEDED"))  # 8
    if number == 2:
        put(events.NodeEnded(other, "SUCCEEDED"))  # 9
        put(events.NodeEnded(root, "SUCCEEDED"))  # 10
        put(events.EpisodeEnded("SUCCEEDED"))  # 11
    return script


@pytest.fixture(scope="module")
def filled_url(module_database_url: str) -> str:
    """The URL of a memory in which episode 1 still runs and episode 2 has ended."""
    types = declarations(NAVIGATE, PICK_UP, SAYING)
    run_in_own_loop(append_and_fold(module_database_url, [*types, *episode(1).records, *episode(2).records]))
    return module_database_url


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
    assert [await reading.episode(name) for name in ("1", "2")] == summaries


@pytest.mark.slow
async def test_an_episode_is_found_by_its_number_its_id_or_as_the_last_and_no_other_is(reading: Reading) -> None:
    identity = "00000000-0000-7000-8000-00000000000{}"
    for name, number in (("1", 1), ("last", 2), (identity.format(1), 1)):
        assert (await reading.episode(name)).number == number
    assert await reading.number_of(identity.format(2)) == 2
    for name, message in (
        ("3", "there is no episode '3' (`pycrorm episodes` lists all 2)"),
        ("first", "there is no episode 'first' (`pycrorm episodes` lists all 2)"),
        ("00000000-0000", "2 episodes have an id that begins with '00000000-0000': use more of its digits"),
    ):
        with pytest.raises(UnknownEpisode) as raised:
            await reading.episode(name)
        assert str(raised.value) == message
    with pytest.raises(UnknownEpisode):
        await reading.number_of(identity.format(9))


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


async def test_a_frame_of_a_mapped_class_has_its_attributes_once(reading: Reading) -> None:
    frame = await reading.dataframe(select(NavigateAction))
    assert list(frame.columns) == [
        "id", "process_metadata_id", "dtype", "kind", "robot_state_id", "pose_id",
        "status", "start_time", "end_time", "duration_s", "duration", "reason", "end_sequence", "robot", "sequence",
    ]  # fmt: skip
    assert [*frame.sequence, *frame.end_sequence] == [4, 4, 8, 8]
    assert [*frame.status, *frame.duration, *frame.reason.isna()] == ["SUCCEEDED"] * 2 + [4.0] * 2 + [True] * 2
    assert list(frame.start_time) == [pd.Timestamp(moment(4))] * 2
    frame = await reading.dataframe(select(Pose.id, Object.id).join(Object.pose).order_by(Pose.id))
    assert list(frame.columns) == ["id", "id_1"]
    assert frame.id.tolist() == frame.id_1.tolist() == [row(3), row(3, number=2)]


async def test_enums_are_the_same_text_in_a_frame_and_in_plain_sql(reading: Reading, filled_url: str) -> None:
    columns = PickUpAction.arm, PickUpAction.grasp, Object.obj_type, PickUpAction.status
    question = select(*columns).join(PickUpAction.object).order_by(PickUpAction.id)
    frame = await reading.dataframe(question)
    assert frame.values.tolist() == [["LEFT", "TOP", "MILK", "FAILED"]] * 2
    by_hand = (
        "SELECT arm, grasp, obj_type, status FROM pick_up_action JOIN designator USING (id)"
        " JOIN object ON object.id = object_designator_id ORDER BY pick_up_action.id"
    )
    assert ask(filled_url, by_hand) == [tuple(each) for each in frame.values]
    if filled_url.startswith("sqlite"):  # the only database with a driver that pandas can use here
        with contextlib.closing(sqlite3.connect(filled_url.removeprefix("sqlite:///"))) as plain:
            assert pd.read_sql(by_hand, plain).equals(frame)
        with synchronous(filled_url) as engine:
            assert pd.read_sql(question, engine).equals(frame)
            left = question.where(PickUpAction.arm == Arms.LEFT, PickUpAction.status == TaskStatus.FAILED)
            assert pd.read_sql(left, engine).equals(frame)
            assert len(pd.read_sql(question.where(PickUpAction.arm == Arms.RIGHT), engine)) == 0


@contextlib.contextmanager
def synchronous(url: str) -> Iterator[Engine]:
    engine = create_engine(url)
    try:
        yield engine
    finally:
        engine.dispose()


@pytest.mark.parametrize("module_database_url", ["sqlite"], indirect=True)  # PostgreSQL's drivers here are async
async def test_objects_have_members_also_in_a_synchronous_session(filled_url: str) -> None:
    with synchronous(filled_url) as engine, Session(engine) as session:
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


# === frames ===================================================================================================
#
# Frames of pandas, polars and Arrow, and streams of Arrow batches, typed as the columns are declared.

ENUM, TIME = pa.dictionary(pa.int32(), pa.string()), pa.timestamp("us", tz="UTC")
NODE = TaskTreeNode
COLUMNS = NODE.id, NODE.status, NODE.start_time, NODE.end_time, NODE.reason, NODE.torso_height, NODE.simulated
OF_EACH_KIND = select(*COLUMNS, NODE.parent_id, NODE.result).order_by(NODE.id)
SCHEMA = pa.schema(
    {
        "id": pa.int64(), "status": ENUM, "start_time": TIME, "end_time": TIME, "reason": pa.string(),
        "torso_height": pa.float64(), "simulated": pa.bool_(), "parent_id": pa.int64(), "result": pa.string(),
    }
)  # fmt: skip


async def test_columns_have_their_declared_types_with_all_some_and_no_values(reading: Reading) -> None:
    whole = await reading.dataframe(OF_EACH_KIND, to="arrow")
    assert (whole.schema, whole.num_rows) == (SCHEMA, 8)
    assert whole.column("status").to_pylist()[:3] == ["RUNNING", "SUCCEEDED", "RUNNING"]
    assert whole.column("start_time").to_pylist()[0] == moment(2)
    for condition in (NODE.kind == "root", NODE.id < 0):  # without a reason, without a row
        part = await reading.dataframe(OF_EACH_KIND.where(condition), to="arrow")
        assert part.schema == SCHEMA
        assert set(part.column("reason").to_pylist()) <= {None}


async def test_a_frame_of_pandas_has_these_types_also_without_a_value(reading: Reading) -> None:
    texts = pd.Series(["text"]).dtype
    frame = await reading.dataframe(OF_EACH_KIND.where(NODE.kind == "root", NODE.process_metadata_id == 1))
    times = ["datetime64[us, UTC]"] * 2
    assert [*map(str, frame.dtypes)] == ["int64", str(texts), *times, str(texts), "float64", "bool", "Int64", "object"]
    empty = await reading.dataframe(OF_EACH_KIND.where(NODE.id < 0))
    assert [*map(str, empty.dtypes)] == [
        "Int64",
        str(texts),
        *times,
        str(texts),
        "float64",
        "boolean",
        "Int64",
        "object",
    ]


async def test_a_frame_of_polars_has_these_types_and_values(reading: Reading) -> None:
    frame = await reading.dataframe(OF_EACH_KIND, to="polars")
    assert isinstance(frame, pl.DataFrame)
    assert frame.schema["end_time"] == pl.Datetime("us", "UTC")
    assert frame.schema["parent_id"] == pl.Int64
    assert frame["status"].cast(pl.String).to_list()[:2] == ["RUNNING", "SUCCEEDED"]
    empty = await reading.dataframe(OF_EACH_KIND.where(NODE.id < 0), to="polars")
    assert empty.schema["reason"] == pl.String


async def test_json_is_a_value_in_pandas_and_text_elsewhere(reading: Reading) -> None:
    question = select(Action.parameters).where(Action.dtype == "SayingAction").limit(1)
    assert (await reading.dataframe(question)).parameters.tolist() == [{"text": "hi"}]
    assert (await reading.dataframe(question, to="arrow")).to_pylist() == [{"parameters": '{"text":"hi"}'}]
    await reading.refresh()
    frame = await reading.dataframe(select(reading.mapped("SayingAction")).limit(1), deferred=True)
    assert frame.parameters.tolist() == [{"text": "hi"}]


async def test_a_class_a_question_and_a_union_have_frames(reading: Reading) -> None:
    whole = await reading.dataframe(PickUpAction)
    pd.testing.assert_frame_equal(whole, await reading.dataframe(select(PickUpAction)))
    asked = reading.ask.durations(episode=2)
    pd.testing.assert_frame_equal(await reading.dataframe(asked), await asked)
    with pytest.raises(UnknownEpisode):
        await reading.dataframe(reading.ask.durations(episode=99))
    parts = [select(NODE.id, NODE.start_time, NODE.status).where(NODE.process_metadata_id == each) for each in (1, 2)]
    union = await reading.dataframe(union_all(*parts), to="arrow")
    assert (union.schema.types, union.num_rows) == ([pa.int64(), TIME, ENUM], 8)
    (batch,) = [each async for each in reading.batches(PickUpAction)]
    assert batch.num_rows == 2


async def test_what_declares_no_rows_is_refused(reading: Reading) -> None:
    as_text = r"SQL as text declares none: `\(await memory.query\(sql\)\).frame\(\)`"
    wrong: list[tuple[Any, str]] = [(each, as_text) for each in ("SELECT 1", text("SELECT 1 AS x").columns())]
    wrong += [(each, "a frame can be of a select, a mapped class or a question, not of ") for each in (7, int, Pose.x)]
    for query, refusal in wrong:
        with pytest.raises(CallerError, match=refusal):
            await reading.dataframe(query)
    with pytest.raises(CallerError, match="of pandas, polars, arrow, not of 'spark'"):
        await reading.dataframe(select(Pose), to="spark")  # type: ignore[call-overload]


async def test_a_select_that_the_database_refuses_is_the_callers_fault_and_a_question_is_ours(
    reading: Reading, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = select(literal_column("statu", Text).label("status")).select_from(NODE)
    for to in ("pandas", "arrow"):
        with pytest.raises(
            QueryRefused, match=r'^the query is refused: (no such column: statu|column "statu" does not)'
        ):
            await reading.dataframe(wrong, to=to)
    with pytest.raises(QueryRefused, match=r"^the query is refused: "):
        [batch async for batch in reading.batches(wrong)]
    question = reading.ask.durations()
    monkeypatch.setattr(question, "_plan", replace(question._plan, select_of=lambda episode: wrong))
    with pytest.raises(InternalError, match="statu"):
        await reading.dataframe(question)


async def test_batches_have_one_schema_and_the_rows_of_the_frame_in_order(reading: Reading) -> None:
    batches = [each async for each in reading.batches(OF_EACH_KIND, rows=3)]
    assert [each.num_rows for each in batches] == [3, 3, 2]
    assert {each.schema for each in batches} == {SCHEMA}
    frame = await reading.dataframe(OF_EACH_KIND, to="arrow")
    assert pa.Table.from_batches(batches).to_pylist() == frame.to_pylist()
    (empty,) = [each async for each in reading.batches(OF_EACH_KIND.where(NODE.id < 0))]
    assert (empty.num_rows, empty.schema) == (0, SCHEMA)
    for rows in (0, "x", None, 1.5):
        with pytest.raises(CallerError, match=rf"^rows must be a whole number from 1 to 2147483648, got {rows!r}$"):
            await anext(reading.batches(OF_EACH_KIND, rows=rows))  # type: ignore[arg-type]


async def test_a_stream_that_is_left_early_returns_its_connection(reading: Reading) -> None:
    for _ in range(20):  # more often than the pool has connections
        batches = reading.batches(OF_EACH_KIND, rows=1)
        assert (await anext(batches)).num_rows == 1
        await batches.aclose()
    assert len(await reading.dataframe(OF_EACH_KIND)) == 8


async def test_columns_on_request_are_in_a_frame_that_asks_for_them(reading: Reading) -> None:
    view = PickUpWithContextView
    columns = [*(await reading.dataframe(select(view))).columns]
    whole = await reading.dataframe(select(view).order_by(view.id), deferred=True)
    more = ["object_z", "object_qx", "object_qy", "object_qz", "object_qw", "height_over_torso", "robot"]
    more += [f"robot_in_{each}" for each in more[:5]]
    assert sorted(whole.columns) == sorted([*columns, *more, "description", "scene", "policy"])
    assert whole.description.tolist() == ["episode 1", "episode 2"]
    action = await reading.dataframe(select(NavigateAction), deferred=True)
    assert "parameters" in action.columns
    assert not [each for each in action.columns if each.startswith("_")]


async def test_an_expression_without_a_type_has_that_of_its_first_values(reading: Reading) -> None:
    question = select(func.round(Pose.x).label("near"), func.avg(Pose.y).over().label("mean"), null().label("missing"))
    frame = await reading.dataframe(question.limit(2), to="arrow")
    assert frame.schema.types == [pa.float64(), pa.float64(), pa.null()]
    without_rows = select(func.avg(Pose.y).label("mean")).where(Pose.id < 0)
    assert (await reading.dataframe(without_rows, to="arrow")).schema.types == [pa.float64()]
    declared = select(type_coerce(null(), Text()).label("missing"))
    assert (await reading.dataframe(declared, to="arrow")).schema.types == [pa.string()]


async def test_a_value_that_its_column_cannot_hold_is_named(reading: Reading) -> None:
    question = select(type_coerce(NODE.kind, NODE.id.type).label("number"))
    with pytest.raises(CallerError, match=r"the column 'number' is int64, but has another value: .*type_coerce"):
        await reading.dataframe(question)


@pytest.mark.parametrize(
    ("library", "absent", "extra"),
    [("pandas", "pandas", "frames"), ("polars", "polars", "polars"), ("arrow", "pyarrow", "frames")],
)
async def test_without_its_library_the_error_names_the_extra(
    reading: Reading, monkeypatch: pytest.MonkeyPatch, library: str, absent: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, absent, None)
    with pytest.raises(MissingExtra, match=rf"pip install 'pycrorm-async\[{extra}\]'"):
        await reading.dataframe(select(PickUpAction), to=library)  # type: ignore[call-overload]
