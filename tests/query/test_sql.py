"""Queries in SQL cannot change anything or exceed their bounds, and name the mistakes in their text."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import psutil
import pytest

from pycrorm_async.errors import DatabaseUnavailable, QueryRefused
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.sql import SqlLimits, SqlResult, json_rows, query
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import OWNER_GRANTS
from tests.databases import Server, change_each, open_connection
from tests.full_disk import files_of_at_most
from tests.projections.event_script import append_and_fold
from tests.query.read_only_queries import ENDLESS, RECORDS, SqlReader, is_sqlite, login, opened_reader

pytestmark = pytest.mark.slow


# === read only ================================================================================================
#
# Queries in SQL cannot change anything or exceed their bounds: the database itself refuses attacks.

ON_BOTH = {
    "an insertion that returns": "INSERT INTO episode (number) VALUES (77) RETURNING number",
    "a deletion": "DELETE FROM event",
    "a change in WITH": "WITH gone AS (DELETE FROM event RETURNING *) SELECT * FROM gone",
    "a new table from a query": "CREATE TABLE planted AS SELECT 1",
    "a temporary table": "CREATE TEMP TABLE planted (x integer)",
    "a dropped table": "DROP TABLE event",
    "two statements behind a comment": "SELECT 1 /* ; */ ; DROP TABLE event --",
    "a parenthesis that closes early": "SELECT 1) AS q (c0)) AS sized; DELETE FROM event; --",
    "the end of the transaction": "COMMIT",
    "a transaction that writes": "BEGIN IMMEDIATE",
    "ANALYZE": "ANALYZE",
}
ON_SQLITE = {
    "ATTACH": "ATTACH '{folder}/planted' AS planted",
    "VACUUM INTO": "VACUUM INTO '{folder}/planted'",
    "a pragma that writes": "PRAGMA user_version = 7",
    "a pragma as a table": "SELECT * FROM pragma_journal_mode('delete')",
    "load_extension": "SELECT load_extension('{folder}/planted.so')",
    "a pointer": "SELECT fts3_tokenizer('simple')",
    "a virtual table": "CREATE VIRTUAL TABLE temp.planted USING fts4(x)",
}
ON_POSTGRESQL = {
    "a file of the server": "SELECT pg_read_file('/etc/hostname')",
    "a program": "COPY (SELECT 1) TO PROGRAM 'touch {folder}/planted'",
    "the end of another session": "SELECT pg_terminate_backend(pid) FROM pg_stat_activity",
    "the end, with its schema": 'SELECT "pg_catalog" . "pg_terminate_backend" /**/ (pid) FROM pg_stat_activity',
    "the end, in escaped letters": 'SELECT U&"pg\\005fterminate\\005fbackend"(pid) FROM pg_stat_activity',
    "the end, as a text that is run": "SELECT query_to_xml('SELECT pg_' || 'terminate_backend(1)', true, true, '')",
    "RESET ROLE": "RESET ROLE",
    "RESET ROLE behind a query": "SELECT 1; RESET ROLE",
    "SET SESSION AUTHORIZATION": "SET SESSION AUTHORIZATION postgres",
    "another role by a function": """SELECT "set_config"('role', 'none', false)""",
    "no time limit by a function": "SELECT set_config('statement_timeout', '0', false)",
    "a text that a function runs": "SELECT public.run_text('SELECT set_' || 'config(''role'', ''none'', true)')",
    "setval": "SELECT setval('pycrorm.episode_number', 4000000)",
    "a lock": "SELECT pg_advisory_lock(7266203370152417862)",
    "rows that are locked": "SELECT * FROM pycrorm.event FOR UPDATE",
    "SELECT INTO": "SELECT 1 INTO planted",
    "DO": "DO $$ BEGIN PERFORM pg_sleep(0); END $$",
    "a cursor": "DECLARE planted CURSOR WITH HOLD FOR SELECT 1",
    "a password": "SELECT rolpassword FROM pg_authid",
    "a table that the reader may not read": "SELECT * FROM public.diary",
}


async def test_every_attack_is_refused_and_changes_nothing(owner_url: str, reader_url: str, tmp_path: Path) -> None:
    if not is_sqlite(owner_url):  # a superuser's own code that runs any text, and a table of another purpose
        body = "LANGUAGE plpgsql AS $$ BEGIN EXECUTE command; RETURN command; END $$"
        change_each(
            owner_url,
            [
                "CREATE TABLE IF NOT EXISTS public.diary (x text)",
                f"CREATE OR REPLACE FUNCTION public.run_text(command text) RETURNS text STABLE {body}",
            ],
        )
    attacks = {**ON_BOTH, **(ON_SQLITE if is_sqlite(owner_url) else ON_POSTGRESQL)}
    async with open_connection(owner_url) as query:
        before = [await query(each) for each in _state_of(owner_url)]
        for url in {reader_url, owner_url}:  # on PostgreSQL the owner is a superuser
            async with opened_reader(url) as sql:
                for attack, text in attacks.items():
                    if attack == "a text that a function runs" and url == reader_url:
                        continue  # runs with the rights of a reader
                    with pytest.raises(QueryRefused):
                        pytest.fail(f"{attack} was answered with {await sql.query(text.format(folder=tmp_path))}")
                    assert list(tmp_path.iterdir()) == [], attack
                    assert [await query(each) for each in _state_of(owner_url)] == before, attack


def _state_of(url: str) -> list[str]:
    """Return queries of the schema, the log and a sequence, which a transaction that is rolled back would change."""
    if is_sqlite(url):
        statements = ["SELECT name, sql FROM sqlite_master", "PRAGMA user_version", "PRAGMA journal_mode"]
    else:
        statements = [
            "SELECT relname::text FROM pg_class WHERE relnamespace >= 16384 AND relkind <> 't' ORDER BY 1",
            "SELECT last_value, is_called FROM pycrorm.episode_number",
            "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory'",
        ]
    return [*statements, "SELECT episode, sequence, type, payload FROM event ORDER BY 1, 2"]


async def test_an_endless_query_is_stopped_or_cancelled(sql: SqlReader) -> None:
    started_s = time.monotonic()
    for endless in (ENDLESS + "count(*) FROM n", ENDLESS + "x FROM n WHERE x < 0"):
        with pytest.raises(QueryRefused, match=r"was stopped after 0[.]3 s: select less, or allow it more time"):
            await sql.query(endless, SqlLimits(seconds=0.3))
    await _cancelled(sql, f"{ENDLESS} count(*) FROM n")
    assert time.monotonic() - started_s < 40


async def _cancelled(sql: SqlReader, text: str) -> None:
    task = asyncio.create_task(sql.query(text, SqlLimits(seconds=60)))
    await asyncio.sleep(0.3)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


ONE_LONG_STEP = "SELECT instr(zeroblob(15000000), zeroblob(7000000) || x'01')"
"""Computes for minutes in one step of SQLite, between two of its checks for an interruption."""


@pytest.fixture
async def file_sql(tmp_path: Path) -> AsyncIterator[SqlReader]:
    """A SQLite memory without tables."""
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    await (await EventLog.open(DatabaseAddress.parse(url), create=True)).close()
    async with opened_reader(url) as opened:
        yield opened


async def test_a_single_step_of_sqlite_is_stopped_and_cancelled(file_sql: SqlReader) -> None:
    started_s = time.monotonic()
    with pytest.raises(QueryRefused, match=r"was stopped after 0[.]3 s"):
        await file_sql.query(ONE_LONG_STEP, SqlLimits(seconds=0.3))
    await _cancelled(file_sql, ONE_LONG_STEP)
    assert time.monotonic() - started_s < 20


async def test_a_query_on_a_file_fills_neither_the_memory_nor_the_disk(file_sql: SqlReader) -> None:
    with pytest.raises(QueryRefused, match="needs more memory than it may use"):
        await file_sql.query(f"SELECT {', '.join(['zeroblob(16000000)'] * 60)}")
    numbers = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n LIMIT 20) "
    with (
        files_of_at_most(10_000_000),
        pytest.raises(QueryRefused, match="needs more space for temporary files than it may use"),
    ):
        await file_sql.query(f"{numbers} SELECT x, zeroblob(1000000) AS zeros FROM n ORDER BY zeros, -x")
    _, rows, _ = await file_sql.query(f"{numbers} SELECT x, randomblob(700000) FROM n ORDER BY -x")
    assert [each[0] for each in rows] == [*range(20, 0, -1)]


async def test_a_process_of_a_query_that_dies_is_named(file_sql: SqlReader) -> None:
    task = asyncio.create_task(file_sql.query(ONE_LONG_STEP, SqlLimits(seconds=60)))
    process = await asyncio.to_thread(_process_of_a_query)
    process.kill()
    with pytest.raises(QueryRefused, match="the process of the query ended with the code -9"):
        await task
    assert not process.is_running()


def _process_of_a_query() -> psutil.Process:
    while True:
        for each in psutil.Process().children():
            if "sqlite_process" in str(each.cmdline()):
                return each
        time.sleep(0.02)


async def test_time_at_which_the_rows_are_not_read_does_not_count(sql: SqlReader) -> None:
    async with sql.stream(ENDLESS + "x FROM n", SqlLimits(rows=1_500, seconds=1)) as rows:
        count = 0
        async for _ in rows:
            count += 1
            if count == 1:
                await asyncio.sleep(1.1)
    assert (count, rows.more) == (1_500, True)


async def test_a_query_runs_as_the_reader_and_a_login_that_may_not_take_this_role_is_refused(server: Server) -> None:
    url = server.new_database()
    await append_and_fold(url, RECORDS)
    who = "SELECT current_user::text, count(*) FROM process_metadata"
    stranger = login(url, "SUPERUSER")
    async with opened_reader(stranger) as sql:
        with pytest.raises(QueryRefused, match=r"as the role pycrorm_reader: run `pycrorm roles --create` once$"):
            await sql.query(who)
        change_each(url, OWNER_GRANTS)
        assert (await sql.query(who))[1] == [("pycrorm_reader", 2)]
    async with opened_reader(login(url, "IN ROLE pycrorm_recorder, pycrorm_reader")) as sql:
        assert (await sql.query(who))[1] == [("pycrorm_reader", 2)]
    async with opened_reader(login(url, "IN ROLE pycrorm_recorder")) as sql:
        with pytest.raises(QueryRefused, match=r'which "login-.*" may not take: GRANT pycrorm_reader TO "login-.*"$'):
            await sql.query(who)
    member = login(url, "IN ROLE pycrorm_recorder", "GRANT pycrorm_reader TO {name} WITH SET FALSE")
    async with opened_reader(member) as sql:
        with pytest.raises(QueryRefused, match=r'GRANT pycrorm_reader TO "login-.*" WITH SET TRUE$'):
            await sql.query(who)
    body = "$$ BEGIN PERFORM set_config('role', 'none', true); RETURN current_user; END $$"
    leave = f"CREATE FUNCTION public.leave() RETURNS text IMMUTABLE LANGUAGE plpgsql AS {body}"
    owner = login(url, "IN ROLE pycrorm_reader", "ALTER SCHEMA pycrorm OWNER TO {name}", leave)
    async with opened_reader(owner) as sql:
        assert (await sql.query(who))[1] == [("pycrorm_reader", 2)]
        with pytest.raises(QueryRefused, match="the function leave can do more and is not allowed"):
            await sql.query("SELECT public.leave()")


async def test_a_volatile_function_is_refused_however_its_name_is_written_and_behind_an_operator(
    owner_url: str, sql: SqlReader
) -> None:
    if sql.is_sqlite:
        return
    effect = "SELECT pg_catalog.pg_logical_emit_message(false, 'planted', '') IS NULL; SELECT 1"
    names = ("public.effect", 'public."my func"', 'public."ÄNDERN"', 'public."a""b"', "public.Ünder", '"Lab X".plain')
    change_each(
        owner_url,
        [
            'CREATE SCHEMA "Lab X"',
            'GRANT USAGE ON SCHEMA "Lab X" TO PUBLIC',
            *(
                f"CREATE FUNCTION {each}() RETURNS integer LANGUAGE sql SECURITY DEFINER AS $$ {effect} $$"
                for each in names
            ),
            "CREATE FUNCTION public.two(a integer, b integer) RETURNS integer LANGUAGE sql AS $$ SELECT a + b $$",
            "CREATE OPERATOR public.@+@ (FUNCTION = public.two, LEFTARG = integer, RIGHTARG = integer)",
            "CREATE AGGREGATE public.folded (integer) (SFUNC = public.two, STYPE = integer)",
        ],
    )
    calls = [f"{name}()" for name in names]
    calls += [f"'\"' || {each} || '\"'" for each in calls]
    for call in (*calls, "1 OPERATOR(public.@+@) 2", "public.folded(1)"):
        with pytest.raises(QueryRefused, match=r"the (function|operator) .* can do more and is not allowed"):
            pytest.fail(f"{call} was answered with {await sql.query(f'SELECT {call}')}")
    names_alone = """SELECT 1 AS "my func", '{"a": [1]}'::jsonb @> '{"a": []}' AS held"""
    assert (await sql.query(names_alone))[1] == [(1, True)]


async def test_a_date_that_python_lacks_is_refused_with_the_way_to_read_it(sql: SqlReader) -> None:
    if sql.is_sqlite:
        return
    for value in ("'200000-01-01'::timestamp", "'4000-01-01 BC'::timestamptz", "'24:00'::time"):
        with pytest.raises(QueryRefused, match=r"Python has no such date or time .*: cast the column to text"):
            await sql.query(f"SELECT {value}")
        assert (await sql.query(f"SELECT ({value})::text"))[1][0][0][:4] in value


# === results ==================================================================================================
#
# Queries in SQL return their columns and rows within bounds, and name the mistakes in their text.


async def test_a_query_returns_its_columns_and_rows(sql: SqlReader, reader_url: str) -> None:
    text = "SELECT id, status, status FROM process_metadata ORDER BY id DESC; "
    columns, rows, more = await sql.query(text)
    assert columns == ("id", "status", "status")
    assert rows == [(2, "SUCCEEDED", "SUCCEEDED"), (1, "RUNNING", "RUNNING")]
    assert not more
    assert await sql.query("WITH one AS (SELECT 1 AS x) SELECT x FROM one -- the end") == (("x",), [(1,)], False)
    assert (await sql.query("SELECT sequence FROM event WHERE episode = -1"))[1] == []
    assert (await sql.query("VALUES ('é; --🤖;'), ('a'';');;\n"))[1] == [("é; --🤖;",), ("a';",)]
    text = "SELECT count(*) FROM event, json_each(payload) AS member"
    if not sql.is_sqlite:
        text = "SELECT count(*) FROM event, jsonb_each(payload::jsonb) AS member"
    assert (await sql.query(text))[1][0] > (20,)
    async with Reading.open(reader_url) as reading:
        frame = (await reading.query("SELECT id AS n, status, id AS n FROM process_metadata ORDER BY id")).frame()
    assert [*frame.columns] == ["n", "status", "n_1"]
    assert frame.n.tolist() == [1, 2]


async def test_a_frame_of_sql_keeps_each_column_and_each_digit(sql: SqlReader) -> None:
    text = f"SELECT 1 AS x, 2 AS x, 3 AS x_1, {2**53 + 1} AS big UNION SELECT 4, 5, 6, NULL"
    result = SqlResult(*await sql.query(text))
    frame = result.frame().sort_values("x")
    assert [*frame.columns] == ["x", "x_2", "x_1", "big"]
    assert frame.iloc[0].tolist() == [1, 2, 3, 2**53 + 1]
    assert str(frame.big.dtype) == "Int64"


async def test_rows_are_the_same_json_on_both_databases(sql: SqlReader) -> None:
    written = (
        "x'00ff', 1e999, -1e999" if sql.is_sqlite else r"'\x00ff'::bytea, 'Infinity'::float8, '-Infinity'::numeric"
    )
    rows = (await sql.query(f"SELECT sum(id), avg(id), NULL, {written} FROM process_metadata"))[1]
    encoded = msgspec.json.Encoder(decimal_format="number").encode(json_rows(rows))
    assert json.loads(encoded) == [[3, 1.5, None, "00ff", "Infinity", "-Infinity"]]


async def test_a_query_ends_at_its_limits_on_rows_and_bytes(sql: SqlReader) -> None:
    text = "SELECT sequence FROM event WHERE episode = 2 ORDER BY sequence"
    assert await sql.query(text, SqlLimits(rows=3)) == (("sequence",), [(1,), (2,), (3,)], True)
    assert (await sql.query(text, SqlLimits(rows=11)))[1:] == ([(each,) for each in range(1, 12)], False)
    assert (await sql.query(text, SqlLimits(rows=10)))[2] is True
    long = "SELECT a.sequence FROM event a, event b, event c ORDER BY 1"
    _, rows, more = await sql.query(long, SqlLimits(rows=None))
    assert (len(rows), more) == ((len(RECORDS) - 3) ** 3, False)
    ones = "'" + "1" * 1_000 + "'"
    _, rows, more = await sql.query(f"{ENDLESS} {ones} FROM n", SqlLimits(rows=None, bytes=50_000))
    assert 40 <= len(rows) <= 50
    assert more
    huge = "SELECT zeroblob(900000000)" if sql.is_sqlite else "SELECT repeat('x', 20000000)"
    refusal = "value of more than 16 MiB: select" if sql.is_sqlite else "has 200000\\d+ bytes, and the limit is"
    with pytest.raises(QueryRefused, match=refusal):
        await sql.query(huge)


REFUSED = {
    "SELECT 1; SELECT 2 -- the end": "a query is one statement: this text has several",
    "SELECT 1;; SELECT 2;;": "a query is one statement: this text has several",
    "SELECT $1": r"a query has no parameters such as \?, :name or \$1: write the values themselves$",
    "VACUUM": "a query may only read: it is one SELECT, or WITH … SELECT",
    "UPDATE pose SET x = 1": "a query may only read: it is one SELECT, or WITH … SELECT",
    "SELECT * FROM root_failures": r"there is no table or view root_failures; did you mean root_failure\?",
    "SELECT * FROM task_tree_nodes": r"there is no table or view task_tree_nodes; did you mean task_tree_node\?$",
    "SELECT * FROM weather": "there is no table or view weather; `pycrorm schema` lists them$",
    "SELECT statu FROM process_metadata": "the query is refused: .*statu",
    **dict.fromkeys(("", ";", "-- nothing", "SELEC 1", "SELECT", "SELECT 'a", "SELECT \0", "SELECT '\ud800'"), ""),
}
REFUSED_BY_SQLITE = {
    **dict.fromkeys(("SELECT ?", "SELECT ?, ?2", "SELECT :a, @b"), "a query has no parameters"),
    "ATTACH ':memory:' AS a": ".*; ATTACH or VACUUM is not allowed$",
    "SELECT CAST(x'66ff' AS TEXT)": "the query is refused: Could not decode to UTF-8",
    "SELECT 1 LIMIT 'x'": "the query is refused: datatype mismatch$",
}
REFUSED_BY_POSTGRESQL = {
    "SELECT 1; -- the end": "a query is one statement: .*, or more behind its semicolon$",
    "SELECT 1 LIMIT 'x'": 'the query is refused: .*type bigint: "x"',
    "SELECT dtyp FROM action": 'the query is refused: column "dtyp" does not exist'
    r' \(Perhaps you meant to reference the column "action.dtype".\)$',
    "SELECT b.dtype FROM action AS a": 'the query is refused: missing FROM-clause entry for table "b"$',
}


async def test_a_mistake_is_refused_with_its_reason(sql: SqlReader) -> None:
    for text, refusal in {**REFUSED, **(REFUSED_BY_SQLITE if sql.is_sqlite else REFUSED_BY_POSTGRESQL)}.items():
        with pytest.raises(QueryRefused, match=f"^{refusal}"):
            pytest.fail(f"{text!r} was answered with {await sql.query(text)}")


async def test_a_query_on_a_file_that_is_gone_is_unavailable(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    await append_and_fold(url, RECORDS)
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    for each in tmp_path.glob("memory.db*"):
        each.unlink()
    with pytest.raises(DatabaseUnavailable):
        await query(log, "SELECT 1")
    await log.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("limits", [{"rows": 0}, {"bytes": -1}, {"seconds": math.nan}, {"seconds": math.inf}])
def test_a_limit_of_nothing_or_of_no_number_is_refused(limits: dict[str, Any]) -> None:
    with pytest.raises(QueryRefused, match="must be > 0 and finite"):
        SqlLimits(**limits)
    with pytest.raises(QueryRefused, match="is at most 86400"):
        SqlLimits(seconds=1e9)
