"""Frames of pandas, polars and Arrow, and streams of Arrow batches, typed as the columns are declared."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any

import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
from sqlalchemy import Text, func, literal_column, null, select, text, type_coerce, union_all

from pycrorm_async.errors import CallerError, InternalError, MissingExtra, QueryRefused, UnknownEpisode
from pycrorm_async.orm import Action, NavigateAction, PickUpAction, PickUpWithContextView, Pose, TaskTreeNode
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import DatabaseAddress
from tests.databases import run_in_own_loop
from tests.projections.event_script import NAVIGATE, PICK_UP, SAYING, declarations, row
from tests.projections.factories import append_and_fold
from tests.query.test_reading import episode, moment

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


@pytest.fixture(scope="module")
def recorded(module_database_url: str) -> DatabaseAddress:
    """Return the address of a log in which episode 1 still runs and episode 2 has ended."""
    records = [*declarations(NAVIGATE, PICK_UP, SAYING), *episode(1).records, *episode(2).records]
    run_in_own_loop(append_and_fold(module_database_url, records))
    return DatabaseAddress.parse(module_database_url)


@pytest.fixture
async def reading(recorded: DatabaseAddress) -> AsyncIterator[Reading]:
    async with Reading.open_address(recorded) as opened:
        yield opened


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


async def test_json_that_a_class_loads_on_request_is_a_value_in_pandas(reading: Reading) -> None:
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


@pytest.mark.parametrize("query", ["SELECT 1", text("SELECT 1"), text("SELECT 1 AS x").columns()])
async def test_sql_as_text_is_refused_with_the_call_that_runs_it(reading: Reading, query: Any) -> None:
    with pytest.raises(CallerError, match=r"SQL as text declares none: `\(await memory.query\(sql\)\).frame\(\)`"):
        await reading.dataframe(query)


@pytest.mark.parametrize("query", [7, int, Pose.x])
async def test_what_has_no_rows_is_refused(reading: Reading, query: Any) -> None:
    with pytest.raises(CallerError, match="a frame can be of a select, a mapped class or a question, not of "):
        await reading.dataframe(query)


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


async def test_a_frame_of_another_library_is_refused(reading: Reading) -> None:
    with pytest.raises(CallerError, match="of pandas, polars, arrow, not of 'spark'"):
        await reading.dataframe(select(Pose), to="spark")  # type: ignore[call-overload]


async def test_ids_in_frames_are_exact(reading: Reading) -> None:
    frame = await reading.dataframe(select(PickUpAction.id).order_by(PickUpAction.id))
    assert frame.id.tolist() == [row(6), row(6, number=2)]
