"""Run SQL that a user or a program wrote, with bounds on its time, rows and bytes, on connections that can only read.

result = await query(log, "SELECT dtype, count(*) AS nodes FROM task_tree_node GROUP BY dtype")
async with stream(log, "SELECT * FROM event", SqlLimits(rows=None)) as rows:
    async for row in rows: ...

**Theory of operation.** The text of a query is untrusted: a user or a language model wrote it. Each query has a
connection of its own, which is closed after it, so that no setting, lock or temporary table outlives a query. The
database refuses everything but reading, each by its own means: SQLite by an authorizer, in a process with limits
(section "sqlite reader"), PostgreSQL by a role without other rights, a read-only transaction and a cursor (section
"postgresql reader"). Parsing the text here would not do, because a parser that differs from the database's in one
detail would let a statement through.

A query that reaches a bound on time is stopped: SQLite's process is killed, a server cancels it. One that reaches a
bound on rows or bytes ends early, and `more` is True.
"""

from __future__ import annotations

import asyncio
import marshal
import math
import re
import sqlite3
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from sqlalchemy.ext.asyncio import AsyncEngine

from pycrorm_async.errors import QueryRefused
from pycrorm_async.query.text import NotebookValue, distinct, nearest
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql_engine import LOG_SCHEMA, VIEWS_SCHEMA

if TYPE_CHECKING:
    import asyncpg
    import pandas as pd


# === json values ==============================================================================================
#
# Make the rows of a query in SQL values of JSON, alike for both databases and for the command and agents.
#
# Numbers are numbers with all their digits, also PostgreSQL's `numeric`, which `avg` and `sum` return, if the encoder
# has `decimal_format="number"`. JSON has no bytes and no infinity: bytes are hexadecimal digits, and NaN and infinities
# are the texts "NaN", "Infinity" and "-Infinity".


def json_rows(rows: Iterable[Iterable[Any]]) -> list[list[Any]]:
    """Return the rows with the values that JSON has."""
    return [[_value(each) for each in row] for row in rows]


def _value(value: Any) -> Any:
    match value:
        case bytes() | memoryview():
            return value.hex()
        case float() | Decimal() if not math.isfinite(value):
            return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
        case list() | tuple():
            return [_value(each) for each in value]
    return value


# === postgresql reader ========================================================================================
#
# Run one query on a PostgreSQL server, on a connection that can only read.
#
# **Theory of operation.** A read-only transaction is not enough: as a superuser, `pg_read_file` reads files of the
# server and COPY … TO PROGRAM runs programs on it. Four independent checks apply:
#
# 1. The transaction takes the role `pycrorm_reader`, whatever rights the login has. A query cannot return to these
#    rights, because the statements that would are refused by 2, and the function `set_config` by 4.
# 2. The text is prepared, so it is one statement, and becomes the query of a cursor: PostgreSQL takes nothing but
#    SELECT, VALUES and TABLE there, no SET, COPY, DO, CALL or SELECT INTO.
# 3. The transaction is READ ONLY and always rolled back, and the connection is closed after it.
# 4. A function that PostgreSQL declares VOLATILE may have effects that no rollback undoes: it ends other sessions,
#    takes locks, changes settings, runs a text as SQL. A text with the name of one, or of an operator or aggregate over
#    one, is refused. Strings and comments count too, because leaving them out would need PostgreSQL's own lexer. A
#    query of a superuser or of the log's owner calls no function but PostgreSQL's own, because others may run a text,
#    such as a call of `set_config`, without being volatile.
#    What the text does not name is not checked: a view, a cast or a type that calls such a function.
#
# The cursor returns with each row the sum of the bytes up to it, and empty values from the bound on, because one value
# can have a gigabyte.

READER = "pycrorm_reader"

_BEGIN = (
    "BEGIN TRANSACTION READ ONLY",
    "SET LOCAL standard_conforming_strings = on",
    "SET LOCAL idle_in_transaction_session_timeout = '10min'",  # a pager stops reading for minutes
)
_MAY_TAKE = f"""
SELECT quote_ident(session_user) AS login,
    has_schema_privilege(to_regrole('{READER}'), '{VIEWS_SCHEMA}', 'USAGE') AS exists,
    pg_has_role(session_user, to_regrole('{READER}'), 'MEMBER') AS is_member,
    pg_has_role(session_user, to_regrole('{READER}'),
        CASE WHEN current_setting('server_version_num')::int < 160000 THEN 'MEMBER' ELSE 'SET' END) AS may_take"""
"""Selects whether this memory has the role of readers, and whether the login may take it.

From PostgreSQL 16 on a member of a role may lack the right to take it.
"""

_VOLATILE = f"""
SELECT 'function ' || f.proname FROM pg_proc AS f JOIN pg_namespace ON pg_namespace.oid = f.pronamespace
LEFT JOIN pg_aggregate ON aggfnoid = f.oid LEFT JOIN pg_proc AS transition ON transition.oid = aggtransfn
WHERE ('v' IN (f.provolatile, transition.provolatile)
    OR nspname NOT IN ('pg_catalog', 'information_schema')
    AND pg_has_role(session_user, (SELECT nspowner FROM pg_namespace WHERE nspname = '{LOG_SCHEMA}'), 'MEMBER'))
AND f.proname = ANY($1::text[]) AND f.proname <> ALL($2)
AND (nspname = ANY(current_schemas(true)) OR nspname = ANY($1::text[]))
UNION ALL
SELECT 'operator ' || oprname FROM pg_operator JOIN pg_proc ON pg_proc.oid = oprcode
JOIN pg_namespace ON pg_namespace.oid = oprnamespace
WHERE provolatile = 'v' AND strpos($3, oprname) > 0
AND (nspname = ANY(current_schemas(true)) OR nspname = ANY($1::text[]))
LIMIT 1"""  # noqa: S608  our own names only
"""Selects a function or an operator of the text that may have effects. One of another schema is called with its schema
only."""
_HARMLESS = (
    "random", "random_normal", "gen_random_uuid", "clock_timestamp", "timeofday", "pg_sleep", "pg_relation_size",
    "pg_table_size", "pg_indexes_size", "pg_total_relation_size", "pg_database_size",
)  # fmt: skip
"""Volatile functions without effects."""
_RELATIONS = f"""
SELECT relname::text FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
WHERE nspname IN ('{LOG_SCHEMA}', '{VIEWS_SCHEMA}') AND relkind IN ('r', 'v', 'p') AND NOT relispartition"""  # noqa: S608  our own names only
_DATABASE_FAULTS = ("08", "40", "53", "55", "57", "58", "XX")
"""Classes of errors that are the database's; all others are the query's own."""
_CANCELLED = "57014"
_UNDEFINED_TABLE = "42P01"
_UNDEFINED_COLUMN = "42703"
_MISSING_FROM = "errorMissingRTE"
"""The server's function that reports a table that exists, but not in this FROM, with the same code. Its message has the
language of the server."""


class _ServerCursor:
    def __init__(self, connection: asyncpg.Connection[Any], bytes_max: int) -> None:
        self.columns: tuple[str, ...] = ()
        self._connection = connection
        self._bytes_max = bytes_max
        self._is_first = True

    async def start(self, sql: str, seconds: float) -> None:
        for statement in (*_BEGIN, f"SET LOCAL statement_timeout = {max(int(seconds * 1000), 1)}"):
            await self._connection.execute(statement)
        await self._take_role()
        await self._check_functions(sql)
        query = _without_end(sql)
        async with self._bounded(seconds):
            # `execute` would send several statements as they are; preparing refuses them.
            prepared = await self._connection.prepare(query)
            if prepared.get_parameters():
                raise QueryRefused(NO_PARAMETERS)
            attributes = prepared.get_attributes()
            if not attributes:
                raise QueryRefused(ONLY_READS)
            await (await self._connection.prepare(_declaration(query, len(attributes), self._bytes_max))).fetch()
        self.columns = tuple(each.name for each in attributes)

    async def fetch(self, rows: int, seconds: float) -> tuple[list[tuple[Any, ...]], bool]:
        async with self._bounded(seconds):
            records = await self._connection.fetch(f"FETCH {rows} FROM pycrorm_query")
        within = [each for each in records if each[-1] <= self._bytes_max]
        if self._is_first and records and not within:
            size = f"{records[0][-1]} bytes, and the limit is {self._bytes_max}"
            raise QueryRefused(f"the first row of the query has {size}: select fewer columns, or parts of them")
        self._is_first = False
        return [tuple(each)[:-1] for each in within], len(within) < len(records)

    async def _take_role(self) -> None:
        role = await self._connection.fetchrow(_MAY_TAKE)
        if not role or not role["exists"]:
            raise QueryRefused(f"a query in SQL runs as the role {READER}: run `pycrorm roles --create` once")
        if not role["may_take"]:
            login, option = role["login"], " WITH SET TRUE" if role["is_member"] else ""
            raise QueryRefused(
                f"a query in SQL runs as the role {READER}, which {login} may not take:"
                f" GRANT {READER} TO {login}{option}"
            )
        await self._connection.execute(f"SET LOCAL ROLE {READER}")

    async def _check_functions(self, sql: str) -> None:
        lowered = sql.lower()
        if 'u&"' in lowered:
            raise QueryRefused('a query writes names as they are, not as U&"…"')
        name = await self._connection.fetchval(_VOLATILE, sorted(_names(sql)), _HARMLESS, sql)
        if name is not None:
            raise QueryRefused(f"{ONLY_READS}; the {name} can do more and is not allowed")

    @asynccontextmanager
    async def _bounded(self, seconds: float) -> AsyncIterator[None]:
        """Stop the statement inside after this time, and raise its own errors as `QueryRefused`."""
        import asyncpg

        try:
            async with asyncio.timeout(seconds):  # cancels it on the server, too
                yield
        except TimeoutError:
            raise QueryRefused(stopped(seconds)) from None
        except asyncpg.PostgresError as error:
            code, text = error.sqlstate or "", " ".join((error.message or "").split())
            if code == _CANCELLED:
                raise QueryRefused(stopped(seconds)) from None
            if code.startswith(_DATABASE_FAULTS):
                raise
            if code == _UNDEFINED_TABLE and error.server_source_function != _MISSING_FROM:
                raise await self._missing(text) from None
            if "multiple commands" in text or text == 'syntax error at or near ";"':  # what is prepared ends there
                raise QueryRefused(NOT_ONE) from None
            notes = " ".join(each for each in (error.detail, error.hint) if each)
            hint = missing_column(text) if code == _UNDEFINED_COLUMN else ""
            raise QueryRefused(f"the query is refused: {text}{f' ({notes})' if notes else ''}{hint}") from None
        except (OverflowError, ValueError) as error:  # a date before year 1 or after 9999, or the time 24:00
            raise QueryRefused(f"Python has no such date or time ({error}): cast the column to text") from None

    async def _missing(self, text: str) -> QueryRefused:
        name = re.search(r'"(.+)"', text)
        await self._connection.execute("ROLLBACK")
        names = [row[0] for row in await self._connection.fetch(_RELATIONS)]
        return missing_relation(name.group(1) if name else text, names)


def _names(sql: str) -> set[str]:
    """Return every text that can be a name: each word, in its own letters and folded, and each text in quotes.

    PostgreSQL folds A to Z in a word that is not quoted, and other letters only in some encodings.
    """
    words = re.findall(r"[\w$]+", sql)
    folded = [re.sub("[A-Z]+", lambda letters: letters[0].lower(), each) for each in words]
    # A quotation mark in a string shifts the pairs, so each text from one mark to the next counts.
    quoted = re.findall(r'(?=\"((?:[^"]|""){1,63})\")', sql)
    return {*words, *folded, *(each.lower() for each in words), *(each.replace('""', '"') for each in quoted)}


def _declaration(query: str, columns: int, bytes_max: int) -> str:
    names = [f"c{number}" for number in range(columns)]
    sized = f"SELECT q.*, sum(octet_length(q::text)) OVER (ROWS UNBOUNDED PRECEDING) AS size FROM ({query}\n)"  # noqa: S608
    bounded = ", ".join(f"CASE WHEN size <= {bytes_max} THEN {name} END" for name in names)
    return (
        f"DECLARE pycrorm_query NO SCROLL CURSOR FOR SELECT {bounded}, size FROM"  # noqa: S608
        f" ({sized} AS q ({', '.join(names)})) AS sized"
    )


@asynccontextmanager
async def _server_cursor(engine: AsyncEngine, sql: str, limits: SqlLimits) -> AsyncIterator[Cursor]:
    """Run one query on a connection of its own, which is closed at the end."""
    async with engine.connect() as connection:
        try:
            driver: Any = (await connection.get_raw_connection()).driver_connection
            cursor = _ServerCursor(driver, limits.bytes)
            await cursor.start(sql, limits.seconds)
            yield cursor
        finally:
            await connection.invalidate()  # ends the transaction too: nothing was committed


# === read only ================================================================================================

_ROWS_AT_ONCE = 500
"""Bounds the rows that are fetched in one visit to the database."""
_SECONDS_MAX = 86_400
"""Bounds the limit on seconds: a day. PostgreSQL takes at most 24 of them."""
_CHARACTERS = re.compile("[^\0\ud800-\udfff]*")


@dataclass(frozen=True)
class SqlLimits:
    """Bounds of one query.

    Attributes:
        rows: the largest number of returned rows; None for any number.
        bytes: the largest size of the returned values, as text.
        seconds: the longest time that the database may spend on it, without waits for the reader of the rows.
    """

    rows: int | None = 1_000
    bytes: int = 16 << 20
    seconds: float = 10.0

    def __post_init__(self) -> None:
        for name, value in (("rows", self.rows), ("bytes", self.bytes), ("seconds", self.seconds)):
            if value is not None and not 0 < value < math.inf:
                raise QueryRefused(f"the limit on {name} of a query must be > 0 and finite, got {value}")
        if self.seconds > _SECONDS_MAX:
            raise QueryRefused(f"the limit on seconds of a query is at most {_SECONDS_MAX}, got {self.seconds:g}")


DEFAULT_LIMITS = SqlLimits()


@dataclass(frozen=True)
class SqlResult(NotebookValue):
    """The rows of a query, as the database stores them.

    Attributes:
        columns: their names, in order; two may be the same.
        more: True if the query has more rows than these, because a bound was reached.
    """

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]
    more: bool

    @property
    def names(self) -> list[str]:
        """The columns' names, the second `x` as `x_1`, as frames have them."""
        return distinct(self.columns)

    def frame(self) -> pd.DataFrame:
        """Return the rows as a frame of pandas, which derives the types from the values. Raises `MissingExtra`.

        Integers of which some are null are Int64, because pandas would make floats of them, which lose digits.
        """
        from pycrorm_async.query.frames import imported

        pandas = imported("pandas")
        frame: pd.DataFrame = pandas.DataFrame(self.rows, columns=self.names)
        for name, values in zip(self.names, zip(*self.rows, strict=True), strict=False):
            if {type(each) for each in values} == {int, NoneType}:
                frame[name] = pandas.array(values, dtype="Int64")
        return frame


class Cursor(Protocol):
    """A running query of one database."""

    columns: tuple[str, ...]

    async def fetch(self, rows: int, seconds: float) -> tuple[list[tuple[Any, ...]], bool]:
        """Return up to this many next rows, fewer at the end, and whether the bound on bytes was reached."""


class SqlRows:
    """The rows of a running query, to read with `async for`, once; `more` is valid after that."""

    def __init__(self, cursor: Cursor, limits: SqlLimits) -> None:
        self.columns = cursor.columns
        self.more = False
        self._cursor = cursor
        self._limits = limits

    async def __aiter__(self) -> AsyncIterator[tuple[Any, ...]]:
        count, rows_max, left_s = 0, self._limits.rows, self._limits.seconds
        while True:
            # One row above the bound shows whether more exist.
            wanted = _ROWS_AT_ONCE if rows_max is None else min(_ROWS_AT_ONCE, rows_max + 1 - count)
            started_s = time.monotonic()
            rows, full = await self._cursor.fetch(wanted, left_s)
            left_s = max(left_s - (time.monotonic() - started_s), 0.001)
            for row in rows:
                if count == rows_max:
                    self.more = True
                    return
                count += 1
                yield row
            if full or len(rows) < wanted:
                self.more = full
                return


async def query(log: EventLog, sql: str, limits: SqlLimits = DEFAULT_LIMITS) -> SqlResult:
    """Return the rows of one query on the database of a log. Raises what `stream` raises."""
    async with stream(log, sql, limits) as rows:
        collected = [row async for row in rows]
        return SqlResult(rows.columns, collected, rows.more)


@asynccontextmanager
async def stream(log: EventLog, sql: str, limits: SqlLimits = DEFAULT_LIMITS) -> AsyncIterator[SqlRows]:
    """Run one query, on a connection of its own, and read its rows while it runs.

    Raises `QueryRefused` for a text that is not one query, would do more than read, is wrong, or takes longer than it
    may; and on PostgreSQL for a login that may not take the role `pycrorm_reader`. Raises `DatabaseUnavailable`.
    """
    if not _CHARACTERS.fullmatch(sql):
        raise QueryRefused("a query in SQL has no character U+0000 and no half of a surrogate pair")
    with log.translated():
        is_file = log.address.is_sqlite
        cursors = _sqlite_cursor(log.address.path, sql, limits) if is_file else _server_cursor(log.engine, sql, limits)
        async with cursors as cursor:
            yield SqlRows(cursor, limits)


class ReadOnlySql:
    """`query` and `stream` on the database of one log, for programs of the previous release."""

    def __init__(self, log: EventLog) -> None:
        self.query = partial(query, log)
        self.stream = partial(stream, log)


# === refusals =================================================================================================
#
# The lines that refuse a query in SQL, alike on both databases.

ONLY_READS = "a query may only read: it is one SELECT, or WITH … SELECT"
NOT_ONE = "a query is one statement: this text has several, or more behind its semicolon"
NO_PARAMETERS = "a query has no parameters such as ?, :name or $1: write the values themselves"
_INTERNAL = re.compile(r"^zz_|__\d+$|^sqlite_|^pycrorm_")
"""Names of the tables behind the views, one for each generation, and of the bookkeeping."""


def _without_end(sql: str) -> str:
    """Return a statement without the semicolons at its end, which a cursor and the driver of SQLite would refuse."""
    return sql.rstrip(" \t\r\n;")


def stopped(seconds: float) -> str:
    return f"the query was stopped after {seconds:g} s: select less, or allow it more time"


def missing_relation(name: str, valid: Iterable[str]) -> QueryRefused:
    """Return the refusal of a query that names a table or view that does not exist."""
    public = sorted({each for each in valid if not _INTERNAL.search(each)})
    hint = nearest(name.rpartition(".")[2], public)
    return QueryRefused(f"there is no table or view {name}{hint or '; `pycrorm schema` lists them'}")


def missing_column(text: str) -> str:
    """Return the hint for an error about a column that another view has; empty for others."""
    name = re.search(r"""(?:such column: |column ["'\u201e\u00ab]?)(?:\w+\.)?(\w+)""", text)
    from pycrorm_async.orm import TaskTreeNode  # only here, because it takes longer to load than a query to run

    if name is None or name[1] not in TaskTreeNode.__table__.columns:
        return ""
    return f"; task_tree_node has {name[1]}: JOIN task_tree_node USING (id)"


# === sqlite reader ============================================================================================
#
# Run one query on a SQLite file, in a process of its own that can only read.
#
# **Theory of operation.** `mode=ro` and `PRAGMA query_only` still let ATTACH create a file. So an authorizer, which
# SQLite asks about every action when it compiles a statement, allows SELECT, READ, FUNCTION and RECURSIVE, and nothing
# else. The connection is one of the driver's own: SQLAlchemy adds REGEXP, a function in Python.
#
# SQLite checks for an interruption between the steps of its machine, and one step, such as `instr` of two large values,
# can take hours. It can bound its memory only for a whole process, the writer in it included. So each query has a
# process (`sqlite_process`). It starts in 20 ms, has limits on its memory, its temporary files and its CPU time, and is
# killed when the time is over or the query is cancelled. A killed reader leaves no lock, and its temporary files have
# no names. It has a session of its own, so that Ctrl-C interrupts only the parent. When the parent dies, the process
# ends with its stdin, or at the limit on its CPU time.

_T = TypeVar("_T")
_PROGRAM = Path(__file__).with_name("sqlite_process.py")
_START_S = 60.0
"""Bounds the start of the process, which a busy machine delays and which does not count as time of the query."""
_ACTIONS = {
    value: name.removeprefix("SQLITE_").replace("_", " ")
    for name, value in vars(sqlite3).items()
    if name.startswith(("SQLITE_CREATE_", "SQLITE_DROP_", "SQLITE_ALTER_"))
    or name
    in (
        "SQLITE_INSERT", "SQLITE_UPDATE", "SQLITE_DELETE", "SQLITE_PRAGMA", "SQLITE_ATTACH", "SQLITE_DETACH",
        "SQLITE_TRANSACTION", "SQLITE_SAVEPOINT", "SQLITE_REINDEX", "SQLITE_ANALYZE",
    )
} | {sqlite3.SQLITE_ATTACH: "ATTACH or VACUUM"}  # fmt: skip
"""The action's name by its code, which other constants share. VACUUM attaches a database itself."""
_REFUSALS = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_AUTH, sqlite3.SQLITE_TOOBIG, sqlite3.SQLITE_MISMATCH)
"""Codes of errors that are the query's own; all others are the database's."""
_NO_ROOM = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE)
"""Codes of a temporary file that cannot grow, because a reader writes no other."""
_FAULT_VALUES = 5
"""The values in a message that has the reason for which the query ended."""
_TOO_LARGE = (
    "the query has a value of more than 16 MiB: select a part of it, as substr does, or raise the limit on bytes"
)
_TOO_MUCH = "the query needs more {} than it may use: select or sort less"


class _ProcessCursor:
    def __init__(self) -> None:
        self.columns: tuple[str, ...] = ()
        self._process: subprocess.Popen[bytes] | None = None
        self._seconds = 0.0

    async def start(self, path: Path, sql: str, bytes_max: int, seconds: float) -> None:
        self._seconds = seconds
        await self._run(self._open, _START_S)
        await self._exchange((f"{path.as_uri()}?mode=ro", _without_end(sql), bytes_max, seconds), _START_S)
        self.columns = tuple(await self._exchange(None, seconds))
        if not self.columns:
            raise QueryRefused(ONLY_READS)

    async def fetch(self, rows: int, seconds: float) -> tuple[list[tuple[Any, ...]], bool]:
        clock = asyncio.get_running_loop().time
        until_s = clock() + seconds
        fetched: list[tuple[Any, ...]] = []
        state = ""
        while len(fetched) < rows and not state:
            piece, state = await self._exchange(rows - len(fetched), until_s - clock())
            fetched += piece
        return fetched, state == "full"

    def _open(self) -> None:
        try:
            self._process = subprocess.Popen(  # noqa: S603  this interpreter with our own program
                [sys.executable, "-I", "-S", str(_PROGRAM)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:
            raise QueryRefused(f"the process of the query cannot be started: {error.strerror}") from None

    async def _exchange(self, request: Any, seconds: float) -> Any:
        """Write a request, unless it is None, and return the answer."""
        process = self._process
        assert process is not None
        reader, writer = process.stdout, process.stdin
        assert reader is not None
        assert writer is not None

        def exchange() -> Any:
            if request is not None:
                marshal.dump(request, writer)
                writer.flush()
            return marshal.load(reader)  # noqa: S302  of our own program

        try:
            answer = await self._run(exchange, seconds)
        except (EOFError, OSError, ValueError, TypeError):  # of an answer that was cut
            number = await asyncio.to_thread(process.wait)
            raise QueryRefused(f"the process of the query ended with the code {number}: select less") from None
        if isinstance(answer, tuple) and len(answer) == _FAULT_VALUES:
            raise _refusal(*answer)
        return answer

    async def _run(self, work: Callable[[], _T], seconds: float) -> _T:
        """Run a call in a thread; kill the process if the time is over or this task is cancelled, and await the end."""
        thread = asyncio.ensure_future(asyncio.to_thread(work))
        try:
            done, _ = await asyncio.wait([thread], timeout=max(seconds, 0.001))
            if not done:
                raise QueryRefused(stopped(self._seconds))
            return thread.result()
        finally:
            if not thread.done():
                if self._process is not None:
                    self._process.kill()
                await asyncio.wait([thread])
                thread.exception()  # a cut answer, which otherwise would be logged as never read

    def close(self) -> None:
        if self._process is None:
            return
        self._process.kill()
        for each in (self._process.stdin, self._process.stdout):
            if each is not None:
                with suppress(OSError):  # of bytes that the process did not read
                    each.close()
        self._process.wait()


def _refusal(
    kind: str, code: int | None, text: str, denied: tuple[int, str | None] | None, names: list[str]
) -> Exception:
    """Return the error of the process, as one of the query or as one of the database."""
    if kind == "memory":
        return QueryRefused(_TOO_MUCH.format("memory"))
    if denied is not None:
        action, function = denied
        what = f"{function}()" if action == sqlite3.SQLITE_FUNCTION else _ACTIONS.get(action, f"action {action}")
        return QueryRefused(f"{ONLY_READS}; {what} is not allowed")
    if code is None and "one statement" in text:
        return QueryRefused(NOT_ONE)
    if kind == "ProgrammingError" and "binding" in text:  # "Incorrect number of bindings supplied"
        return QueryRefused(NO_PARAMETERS)
    if text.startswith("cannot modify ") or text.endswith("may not be modified"):  # a view, a table of SQLite's own
        return QueryRefused(ONLY_READS)
    if code == sqlite3.SQLITE_TOOBIG and text == "string or blob too big":
        return QueryRefused(_TOO_LARGE)
    if code in _NO_ROOM:
        return QueryRefused(_TOO_MUCH.format("space for temporary files"))
    if code is None or code & 0xFF in _REFUSALS:
        if text.startswith("no such table: "):
            return missing_relation(text.removeprefix("no such table: "), names)
        hint = missing_column(text) if text.startswith("no such column: ") else ""
        return QueryRefused(f"the query is refused: {text}{hint}")
    error = sqlite3.OperationalError(text)
    error.sqlite_errorcode = code
    return error


@asynccontextmanager
async def _sqlite_cursor(path: Path, sql: str, limits: SqlLimits) -> AsyncIterator[Cursor]:
    """Run one query on the file at this path."""
    cursor = _ProcessCursor()
    try:
        await cursor.start(path, sql, limits.bytes, limits.seconds)
        yield cursor
    finally:
        await asyncio.to_thread(cursor.close)
