"""Queries in SQL cannot change anything or exceed their bounds, and name the mistakes in their text."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import psutil
import pytest

from pycrorm_async.errors import DatabaseUnavailable, QueryRefused
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.sql import ReadOnlySql, SqlLimits, json_rows
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import GRANTS
from tests.databases import Server, change_each, open_connection
from tests.full_disk import files_of_at_most
from tests.projections.event_script import append_and_fold
from tests.query.read_only_queries import ENDLESS, RECORDS, SqlReader, is_sqlite, login, opened_reader

pytestmark = pytest.mark.slow


# === read only sql ============================================================================================
#
# Queries in SQL cannot change anything or exceed their bounds: the database itself refuses attacks.

QUICK = SqlLimits(seconds=0.3)


# --- attacks --------------------------------------------------------------------------------------------------

ON_BOTH = {
    "an insertion": "INSERT INTO event SELECT * FROM event",
    "an insertion that returns": "INSERT INTO episode (number) VALUES (77) RETURNING number",
    "an update": "UPDATE event SET payload = NULL",
    "a deletion": "DELETE FROM event",
    "a deletion that returns": "DELETE FROM event RETURNING sequence",
    "a change in WITH": "WITH gone AS (DELETE FROM event RETURNING *) SELECT * FROM gone",
    "a new table": "CREATE TABLE planted (x integer)",
    "a new table from a query": "CREATE TABLE planted AS SELECT 1",
    "a temporary table": "CREATE TEMP TABLE planted (x integer)",
    "a new view": "CREATE VIEW planted AS SELECT 1",
    "an index": "CREATE INDEX planted ON event (type)",
    "a dropped table": "DROP TABLE event",
    "a changed table": "ALTER TABLE event RENAME TO planted",
    "two statements": "SELECT 1; DELETE FROM event",
    "two statements behind a comment": "SELECT 1 /* ; */ ; DROP TABLE event --",
    "a parenthesis that closes early": "SELECT 1) AS q (c0)) AS sized; DELETE FROM event; --",
    "the end of the transaction": "COMMIT",
    "a transaction that writes": "BEGIN IMMEDIATE",
    "VACUUM": "VACUUM",
    "ANALYZE": "ANALYZE",
    "REINDEX": "REINDEX event",
}
ON_SQLITE = {
    "ATTACH": "ATTACH '{folder}/planted' AS planted",
    "VACUUM INTO": "VACUUM INTO '{folder}/planted'",
    "DETACH": "DETACH main",
    "a pragma that writes": "PRAGMA user_version = 7",
    "a pragma that makes the schema writable": "PRAGMA writable_schema = on",
    "a pragma that allows writing": "PRAGMA query_only = off",
    "a pragma as a table": "SELECT * FROM pragma_journal_mode('delete')",
    "load_extension": "SELECT load_extension('{folder}/planted.so')",
    "a pointer": "SELECT fts3_tokenizer('simple')",
    "a virtual table": "CREATE VIRTUAL TABLE temp.planted USING fts4(x)",
    "a savepoint": "SAVEPOINT planted",
    "REPLACE": "REPLACE INTO pycrorm_log VALUES (1, 2, 3)",
}
ON_POSTGRESQL = {
    "a file of the server": "SELECT pg_read_file('/etc/hostname')",
    "a folder of the server": "SELECT pg_ls_dir('/')",
    "a program": "COPY (SELECT 1) TO PROGRAM 'touch {folder}/planted'",
    "a file that is written": "COPY (SELECT 1) TO '{folder}/planted'",
    "a file that is read": "COPY event FROM '/etc/passwd'",
    "the end of another session": "SELECT pg_terminate_backend(pid) FROM pg_stat_activity",
    "the end, with its schema": 'SELECT "pg_catalog" . "pg_terminate_backend" /**/ (pid) FROM pg_stat_activity',
    "the end, in escaped letters": 'SELECT U&"pg\\005fterminate\\005fbackend"(pid) FROM pg_stat_activity',
    "the end, as a text that is run": "SELECT query_to_xml('SELECT pg_' || 'terminate_backend(1)', true, true, '')",
    "a cancelled statement": "SELECT pg_cancel_backend(pid) FROM pg_stat_activity",
    "SET ROLE": "SET ROLE pycrorm_folder",
    "RESET ROLE": "RESET ROLE",
    "SET SESSION AUTHORIZATION": "SET SESSION AUTHORIZATION postgres",
    "a transaction that may write": "SET TRANSACTION READ WRITE",
    "a setting": "SELECT set_config('transaction_read_only', 'off', false)",
    "no time limit": "SET statement_timeout = 0",
    "no time limit by a function": "SELECT set_config('statement_timeout', '0', false)",
    "nextval": "SELECT nextval('pycrorm.episode_number')",
    "setval": "SELECT setval('pycrorm.episode_number', 4000000)",
    "lo_import": "SELECT lo_import('/etc/passwd')",
    "lo_create": "SELECT lo_create(0)",
    "a lock": "SELECT pg_advisory_lock(7266203370152417862)",
    "rows that are locked": "SELECT * FROM pycrorm.event FOR UPDATE",
    "LOCK TABLE": "LOCK TABLE pycrorm.event",
    "NOTIFY": "NOTIFY planted",
    "pg_notify": "SELECT pg_notify('planted', '')",
    "SELECT INTO": "SELECT 1 INTO planted",
    "DO": "DO $$ BEGIN PERFORM pg_sleep(0); END $$",
    "CALL": "CALL planted()",
    "PREPARE": "PREPARE planted AS SELECT 1",
    "a cursor": "DECLARE planted CURSOR WITH HOLD FOR SELECT 1",
    "a password": "SELECT rolpassword FROM pg_authid",
    "a server setting": "SELECT pg_reload_conf()",
    "a function with the rights of its owner": "SELECT public.planted_by_the_owner()",
    "a connection by dblink": "SELECT public.dblink_exec('dbname=postgres', 'DROP TABLE event')",
}


async def test_every_attack_is_refused_and_changes_nothing(owner_url: str, sql: SqlReader, tmp_path: Path) -> None:
    async with open_connection(owner_url) as query:
        before = [await query(each) for each in _state_of(owner_url)]
        for attack, text in {**ON_BOTH, **(ON_SQLITE if sql.is_sqlite else ON_POSTGRESQL)}.items():
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
            "SELECT count(*) FROM pg_largeobject_metadata",
            "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory'",
        ]
    return [*statements, "SELECT episode, sequence, type, payload FROM event ORDER BY 1, 2"]


@pytest.mark.parametrize(
    "endless",
    [
        ENDLESS + "count(*) FROM n",
        ENDLESS + "x FROM n WHERE x < 0",
        "SELECT count(*) FROM event a, event b, event c, event d, event e, event f, event g, event h",
    ],
)
async def test_an_endless_query_is_stopped(endless: str, sql: SqlReader) -> None:
    started_s = time.monotonic()
    with pytest.raises(QueryRefused, match=r"was stopped after 0[.]3 s: select less, or allow it more time"):
        await sql.query(endless, QUICK)
    assert time.monotonic() - started_s < 15


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
        await file_sql.query(ONE_LONG_STEP, QUICK)
    task = asyncio.create_task(file_sql.query(ONE_LONG_STEP, SqlLimits(seconds=60)))
    await asyncio.sleep(0.3)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
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


# --- logins ---------------------------------------------------------------------------------------------------

MORE_RIGHTS = {
    "is a superuser": ("SUPERUSER",),
    "may create roles or databases": ("CREATEDB IN ROLE pycrorm_reader",),
    "is a member of pycrorm_folder": ("IN ROLE pycrorm_folder",),
    "is a member of pycrorm_recorder": ("IN ROLE pycrorm_recorder, pycrorm_reader",),
    "is a member of pg_read_server_files": ("IN ROLE pycrorm_reader, pg_read_server_files",),
    "is a member of pg_execute_server_program": ("IN ROLE pycrorm_reader, pg_execute_server_program",),
    "is a member of pg_signal_backend": ("IN ROLE pg_signal_backend, pycrorm_reader",),
    "owns the database": ("IN ROLE pycrorm_reader", "ALTER DATABASE {database} OWNER TO {name}"),
    "may create schemas": ("IN ROLE pycrorm_reader", "GRANT CREATE ON DATABASE {database} TO {name}"),
    "may create tables": ("IN ROLE pycrorm_reader", "GRANT CREATE ON SCHEMA memory_tables TO {name}"),
    "may change the memory": ("IN ROLE pycrorm_reader", "GRANT UPDATE (head) ON pycrorm.episode TO {name}"),
    "may create tables in the schema lab": ("IN ROLE pycrorm_reader", "GRANT CREATE ON SCHEMA lab TO {name}"),
    "may change the table lab.notes": ("IN ROLE pycrorm_reader", "GRANT DELETE ON lab.notes TO {name}"),
    "may change the table lab.drafts": ("IN ROLE pycrorm_reader", "GRANT UPDATE (x) ON lab.drafts TO {name}"),
    "may change the sequence lab.numbers": ("IN ROLE pycrorm_reader", "GRANT USAGE ON SEQUENCE lab.numbers TO {name}"),
    "may run lab.effect with the rights of its owner": (
        "IN ROLE pycrorm_reader",
        "GRANT EXECUTE ON FUNCTION lab.effect TO {name}",
    ),
}


async def test_a_login_with_more_rights_than_a_reader_is_refused(server: Server) -> None:
    owner_url = await _with_roles(server)
    database = urlsplit(owner_url).path.removeprefix("/")
    change_each(
        owner_url,
        [
            "CREATE SCHEMA lab",
            *(f"CREATE TABLE lab.{name} (x text)" for name in ("notes", "drafts")),
            "CREATE SEQUENCE lab.numbers",
            "CREATE FUNCTION lab.effect() RETURNS integer LANGUAGE sql SECURITY DEFINER AS 'SELECT 1'",
            "REVOKE ALL ON FUNCTION lab.effect FROM PUBLIC",
            "CREATE TABLE public.board (x text)",
            "GRANT ALL ON public.board TO PUBLIC",
        ],
    )
    reader = login(
        owner_url,
        "IN ROLE pycrorm_reader",
        "GRANT USAGE ON SCHEMA lab TO {name}",
        "GRANT SELECT ON lab.notes TO {name}",
    )
    async with opened_reader(reader) as sql:  # reading more is no excess, nor is what every login may
        assert (await sql.query("SELECT count(*) FROM lab.notes"))[1] == [(0,)]
    login(owner_url, "IN ROLE pycrorm_folder")  # could have planted code in the views, which an owner's query would run
    for right, (attributes, *after) in MORE_RIGHTS.items():
        url = login(owner_url, attributes, *(each.format(database=database, name="{name}") for each in after))
        async with opened_reader(url) as sql:
            with pytest.raises(QueryRefused) as refused:
                await sql.query("SELECT 1")
        assert right in str(refused.value)
        assert "CREATE ROLE pycrorm_query LOGIN PASSWORD '…' IN ROLE pycrorm_reader" in str(refused.value)


async def test_a_function_with_effects_is_refused_although_every_login_may_call_it(server: Server) -> None:
    owner_url = await _with_roles(server)
    effect = "SELECT pg_catalog.pg_logical_emit_message(false, 'planted', '') IS NULL; SELECT 1"
    change_each(
        owner_url,
        [f"CREATE FUNCTION public.effect() RETURNS integer LANGUAGE sql SECURITY DEFINER AS $$ {effect} $$"],
    )
    async with opened_reader(login(owner_url, "IN ROLE pycrorm_reader")) as sql:
        with pytest.raises(QueryRefused, match="the function effect can do more and is not allowed"):
            await sql.query("SELECT public.effect()")
        assert (await sql.query("SELECT 1 AS effect"))[0] == ("effect",)  # a name alone calls nothing


async def test_a_volatile_function_is_refused_however_its_name_is_written_and_behind_an_operator(
    server: Server,
) -> None:
    owner_url = await _with_roles(server)
    names = ('"my func"', '"ÄNDERN"', '"Än"', '"a""b"', "Ünder", '"Lab X".plain')
    change_each(
        owner_url,
        [
            'CREATE SCHEMA "Lab X"',
            'GRANT USAGE ON SCHEMA "Lab X" TO PUBLIC',
            *(
                f"CREATE FUNCTION {name if '.' in name else f'public.{name}'}() RETURNS integer LANGUAGE sql"
                " SECURITY DEFINER AS $$ SELECT 1 $$"
                for name in names
            ),
            "CREATE FUNCTION public.two(a integer, b integer) RETURNS integer LANGUAGE sql AS $$ SELECT a + b $$",
            "CREATE OPERATOR public.@+@ (FUNCTION = public.two, LEFTARG = integer, RIGHTARG = integer)",
            "CREATE AGGREGATE public.folded (integer) (SFUNC = public.two, STYPE = integer)",
        ],
    )
    calls = [f"{name if '.' in name else f'public.{name}'}()" for name in names]
    calls += [f"'\"' || {each} || '\"'" for each in calls]
    async with opened_reader(login(owner_url, "IN ROLE pycrorm_reader")) as sql:
        for call in (*calls, "1 OPERATOR(public.@+@) 2", "public.folded(1)"):
            with pytest.raises(QueryRefused, match=r"the (function|operator) .* can do more and is not allowed"):
                pytest.fail(f"{call} was answered with {await sql.query(f'SELECT {call}')}")
        assert (await sql.query("""SELECT 1 AS "my func", '{"a": [1]}'::jsonb @> '{"a": []}' AS held"""))[1] == [
            (1, True)
        ]


async def test_a_date_that_python_lacks_is_refused_with_the_way_to_read_it(server: Server) -> None:
    async with opened_reader(login(await _with_roles(server), "IN ROLE pycrorm_reader")) as sql:
        for value in ("'200000-01-01'::timestamp", "'4000-01-01 BC'::timestamptz", "'24:00'::time"):
            with pytest.raises(QueryRefused, match=r"Python has no such date or time .*: cast the column to text"):
                await sql.query(f"SELECT {value}")
            assert (await sql.query(f"SELECT ({value})::text"))[1][0][0][:4] in value


async def _with_roles(server: Server) -> str:
    url = server.new_database()
    await append_and_fold(url, RECORDS)
    change_each(url, GRANTS)
    return url


# === sql results ==============================================================================================
#
# Queries in SQL return their columns and rows within bounds, and name the mistakes in their text.


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
