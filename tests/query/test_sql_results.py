"""Queries in SQL return their columns and rows within bounds, and name the mistakes in their text."""

from __future__ import annotations

import asyncio
import json
import math
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pycrorm_async.errors import DatabaseUnavailable, QueryRefused
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.sql import ReadOnlySql, SqlLimits, json_rows
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.projections.factories import append_and_fold
from tests.query.read_only_queries import ENDLESS, RECORDS, SqlReader

pytestmark = pytest.mark.slow


async def test_a_query_returns_its_columns_and_rows(sql: SqlReader) -> None:
    text = "SELECT id, status, status FROM process_metadata ORDER BY id DESC; "
    columns, rows, more = await sql.query(text)
    assert columns == ("id", "status", "status")
    assert rows == [(2, "SUCCEEDED", "SUCCEEDED"), (1, "RUNNING", "RUNNING")]
    assert not more
    assert await sql.query("WITH one AS (SELECT 1 AS x) SELECT x FROM one -- the end") == (("x",), [(1,)], False)
    assert (await sql.query("SELECT sequence FROM event WHERE episode = -1"))[1] == []
    assert (await sql.query("VALUES (1), (2)"))[1] == [(1,), (2,)]
    text = "SELECT count(*) FROM event, json_each(payload) AS member"
    if not sql.is_sqlite:
        text = "SELECT count(*) FROM event, jsonb_each(payload::jsonb) AS member"
    assert (await sql.query(text))[1][0] > (20,)


async def test_rows_are_the_same_json_on_both_databases(sql: SqlReader) -> None:
    written = (
        "x'00ff', 1e999, -1e999" if sql.is_sqlite else r"'\x00ff'::bytea, 'Infinity'::float8, '-Infinity'::numeric"
    )
    rows = (await sql.query(f"SELECT sum(id), avg(id), NULL, {written} FROM process_metadata"))[1]
    encoded = msgspec.json.Encoder(decimal_format="number").encode(json_rows(rows))
    assert json.loads(encoded) == [[3, 1.5, None, "00ff", "Infinity", "-Infinity"]]


async def test_an_answer_is_a_frame_of_pandas(reader_url: str) -> None:
    async with Reading.open(reader_url) as reading:
        frame = (await reading.query("SELECT id AS n, status, id AS n FROM process_metadata ORDER BY id")).frame()
    assert [*frame.columns] == ["n", "status", "n_1"]
    assert frame.n.tolist() == [1, 2]


async def test_more_rows_than_the_limit_are_reported(sql: SqlReader) -> None:
    text = "SELECT sequence FROM event WHERE episode = 2 ORDER BY sequence"
    assert await sql.query(text, SqlLimits(rows=3)) == (("sequence",), [(1,), (2,), (3,)], True)
    assert (await sql.query(text, SqlLimits(rows=11)))[1:] == ([(each,) for each in range(1, 12)], False)
    assert (await sql.query(text, SqlLimits(rows=10)))[2] is True
    long = "SELECT a.sequence FROM event a, event b, event c ORDER BY 1"
    _, rows, more = await sql.query(long, SqlLimits(rows=None))
    assert len(rows) == (len(RECORDS) - 3) ** 3
    assert not more


async def test_a_query_ends_at_its_limit_on_bytes(sql: SqlReader) -> None:
    ones = "'" + "1" * 1_000 + "'"
    text = f"{ENDLESS} {ones} FROM n"
    _, rows, more = await sql.query(text, SqlLimits(rows=None, bytes=50_000))
    assert 40 <= len(rows) <= 50
    assert more


async def test_a_huge_value_does_not_reach_this_process(sql: SqlReader) -> None:
    huge = "SELECT zeroblob(900000000)" if sql.is_sqlite else "SELECT repeat('x', 20000000)"
    with pytest.raises(
        QueryRefused,
        match="value of more than 16 MiB: select" if sql.is_sqlite else "has 200000\\d+ bytes, and the limit is",
    ):
        await sql.query(huge)


async def test_a_text_that_is_no_query_is_refused(sql: SqlReader) -> None:
    for text in ("", ";", "-- nothing", "SELEC 1", "SELECT", "SELECT $1", "SELECT 'a", "SELECT \0", "SELECT '\ud800'"):
        with pytest.raises(QueryRefused):
            pytest.fail(f"{text!r} was answered with {await sql.query(text)}")


async def test_comments_and_empty_statements_may_follow_the_semicolon_of_a_query(sql: SqlReader) -> None:
    texts = {
        "SELECT 1; -- the end": 1,
        "SELECT 1 /* ; */ ;\n/* the; end */ -- ; (": 1,
        "SELECT 'é; --🤖;' -- it; is\n; -- that;": "é; --🤖;",
        "SELECT 'a''; -- b'": "a'; -- b",
        "VALUES (';') -- no; semicolon": ";",
        "SELECT 1;;": 1,
        "SELECT 1; ;\n-- the; end\n; /* ' */ ;": 1,
        "SELECT ';\"' AS \"a;'b\";;": ';"',
    }
    for text, value in texts.items():
        assert (await sql.query(text))[1] == [(value,)], text
    for text in ("SELECT 1; SELECT 2 -- the end", "SELECT 1; -- one\nSELECT 2", "SELECT 1;; SELECT 2;;"):
        with pytest.raises(QueryRefused, match="a query is one statement: this text has several"):
            await sql.query(text)
    for text in ("DELETE FROM process_metadata; -- all", "SELECT 1) AS a; -- ("):
        with pytest.raises(QueryRefused):
            await sql.query(text)


async def test_a_text_that_is_not_utf_8_is_refused_with_the_way_to_read_it(sql: SqlReader) -> None:
    if not sql.is_sqlite:
        return
    with pytest.raises(QueryRefused, match=r"^the query has a text that is not UTF-8: select it as bytes, with CAST"):
        await sql.query("SELECT CAST(x'66ff' AS TEXT)")
    assert (await sql.query("SELECT CAST(CAST(x'66ff' AS TEXT) AS BLOB)"))[1] == [(b"f\xff",)]


async def test_a_limit_that_is_no_integer_is_named(sql: SqlReader) -> None:
    refusal = "LIMIT and OFFSET must be integers$" if sql.is_sqlite else 'type bigint: "x"'
    for clause in ("LIMIT 'x'", "LIMIT 1 OFFSET 'x'"):
        with pytest.raises(QueryRefused, match=f"^the query is refused: .*{refusal}"):
            await sql.query(f"SELECT id FROM process_metadata {clause}")


async def test_vacuum_is_refused_by_its_name(sql: SqlReader) -> None:
    with pytest.raises(QueryRefused, match=r"^a query may only read: it is one SELECT, or WITH … SELECT") as refused:
        await sql.query("VACUUM")
    assert not sql.is_sqlite or str(refused.value).endswith("; ATTACH or VACUUM is not allowed")


async def test_a_statement_that_changes_a_view_may_only_read(sql: SqlReader) -> None:
    for text in ("UPDATE pose SET x = 1", "DELETE FROM pose", "INSERT INTO action (id) VALUES (1)"):
        with pytest.raises(QueryRefused, match=r"^a query may only read: it is one SELECT, or WITH … SELECT"):
            await sql.query(text)


async def test_a_query_with_a_parameter_is_refused_with_the_way_to_write_it(sql: SqlReader) -> None:
    for text in ("SELECT $1", *(("SELECT ?", "SELECT ?, ?2", "SELECT :a, @b") if sql.is_sqlite else ())):
        with pytest.raises(QueryRefused, match=r"^a query has no parameters such as \?, :name or \$1: write the value"):
            await sql.query(text)


async def test_an_open_memory_for_reading_takes_queries(reader_url: str) -> None:
    async with Reading.open(reader_url) as reading:
        assert (await reading.query("SELECT count(*) AS episodes FROM process_metadata")).rows == [(2,)]
        with pytest.raises(QueryRefused):
            await reading.query("DELETE FROM event", SqlLimits(rows=1))


async def test_a_wrong_name_is_answered_with_the_nearest_one(sql: SqlReader) -> None:
    with pytest.raises(QueryRefused, match=r"no table or view root_failures; did you mean root_failure\?"):
        await sql.query("SELECT * FROM root_failures")
    with pytest.raises(QueryRefused, match=r"no table or view task_tree_nodes; did you mean task_tree_node\?$"):
        await sql.query("SELECT * FROM task_tree_nodes")
    with pytest.raises(QueryRefused, match="no table or view weather; `pycrorm schema` lists them"):
        await sql.query("SELECT * FROM weather")
    with pytest.raises(QueryRefused, match="statu"):
        await sql.query("SELECT statu FROM process_metadata")


async def test_a_server_names_a_mistake_with_its_hint_once(sql: SqlReader) -> None:
    if sql.is_sqlite:
        return
    refusals = {
        "SELECT dtyp FROM action": 'column "dtyp" does not exist'
        ' (Perhaps you meant to reference the column "action.dtype".)',
        "SELECT action.dtype FROM action AS a": 'invalid reference to FROM-clause entry for table "action"'
        ' (Perhaps you meant to reference the table alias "a".)',
        "SELECT b.dtype FROM action AS a": 'missing FROM-clause entry for table "b"',
        "SELECT dtype, count(*) FROM action": 'column "action.dtype" must appear in the GROUP BY clause'
        " or be used in an aggregate function",
    }
    for text, refusal in refusals.items():
        with pytest.raises(QueryRefused) as refused:
            await sql.query(text)
        assert str(refused.value) == f"the query is refused: {refusal}"


async def test_a_cancelled_query_stops_in_the_database(sql: SqlReader) -> None:
    task = asyncio.create_task(sql.query(f"{ENDLESS} count(*) FROM n", SqlLimits(seconds=60)))
    await asyncio.sleep(0.3)
    task.cancel()
    started_s = time.monotonic()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert time.monotonic() - started_s < 20


async def test_a_query_on_a_file_that_is_gone_is_unavailable(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    await append_and_fold(url, RECORDS)
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    for each in tmp_path.glob("memory.db*"):
        each.unlink()
    with pytest.raises(DatabaseUnavailable):
        await ReadOnlySql(log).query("SELECT 1")
    await log.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "limits",
    [{"rows": 0}, {"bytes": -1}, {"seconds": 0.0}, {"seconds": math.nan}, {"seconds": math.inf}, {"bytes": math.nan}],
)
def test_a_limit_of_nothing_or_of_no_number_is_refused(limits: dict[str, Any]) -> None:
    with pytest.raises(QueryRefused, match="must be > 0 and finite"):
        SqlLimits(**limits)
    with pytest.raises(QueryRefused, match="is at most 86400"):
        SqlLimits(seconds=1e9)
