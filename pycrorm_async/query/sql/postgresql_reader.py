"""Run one query on a PostgreSQL server, on a connection that can only read.

**Theory of operation.** A read-only transaction is not enough: as a superuser, `pg_read_file` reads files of the server
and COPY … TO PROGRAM runs programs on it. Four independent checks apply:

1. The login has no more rights than `pycrorm_reader` (`_RIGHTS`). SET ROLE then leads nowhere.
2. The text is prepared, so it is one statement, and becomes the query of a cursor: PostgreSQL takes nothing but SELECT,
   VALUES and TABLE there, no SET, COPY, DO, CALL or SELECT INTO.
3. The transaction is READ ONLY and always rolled back, and the connection is closed after it.
4. A function that PostgreSQL declares VOLATILE may have effects that no rollback undoes: it ends other sessions, takes
   locks, changes settings, runs a text as SQL. A text with the name of one, or of an operator or aggregate over one, is
   refused. Strings and comments count too, because leaving them out would need PostgreSQL's own lexer. A view, a cast
   or a type calls functions that the text does not name. One outside the memory, which every login may use, over a
   volatile function with the rights of its owner, gives these rights to each query.

The cursor returns with each row the sum of the bytes up to it, and empty values from the bound on, because one value
can have a gigabyte.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import asyncpg
from sqlalchemy.ext.asyncio import AsyncEngine

from pycrorm_async.errors import QueryRefused
from pycrorm_async.query.sql.refusals import NO_PARAMETERS, NOT_ONE, ONLY_READS, missing_relation, stopped
from pycrorm_async.store.postgresql.search_path import LOG_SCHEMA, TABLES_SCHEMA, VIEWS_SCHEMA

READER = "pycrorm_reader"

_BEGIN = (
    "BEGIN TRANSACTION READ ONLY",
    "SET LOCAL standard_conforming_strings = on",
    "SET LOCAL idle_in_transaction_session_timeout = '10min'",  # a pager stops reading for minutes
)
_SCHEMAS = f"'{LOG_SCHEMA}', '{TABLES_SCHEMA}', '{VIEWS_SCHEMA}'"
_MORE = (
    "(nspname !~ '^pg_' AND has_{privilege}_privilege(session_user, {object}, '{rights}')"
    f" AND NOT COALESCE(has_{{privilege}}_privilege(to_regrole('{READER}'), {{object}}, '{{rights}}'), false))"
)
"""The condition that the login has one of these rights outside the system's schemas, and the reader has none."""
_RIGHTS = f"""
SELECT session_user::text AS login, to_regrole('{READER}') IS NOT NULL AS has_roles, CASE
    WHEN login.rolsuper THEN 'is a superuser'
    WHEN pg_has_role(session_user, datdba, 'MEMBER') THEN 'owns the database'
    WHEN login.rolcreaterole OR login.rolcreatedb OR login.rolreplication OR login.rolbypassrls
        THEN 'may create roles or databases, replicate, or read what is hidden from its role'
    WHEN other.name IS NOT NULL THEN 'is a member of ' || other.name
    WHEN has_database_privilege(session_user, pg_database.oid, 'CREATE') THEN 'may create schemas in the database'
    WHEN EXISTS (
        SELECT FROM pg_namespace WHERE nspname IN ({_SCHEMAS}) AND has_schema_privilege(session_user, oid, 'CREATE')
    ) THEN 'may create tables in the memory'
    WHEN EXISTS (
        SELECT FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
        WHERE nspname IN ({_SCHEMAS}) AND relkind IN ('r', 'v', 'm', 'p') AND (
            has_any_column_privilege(session_user, pg_class.oid, 'INSERT, UPDATE')
            OR has_table_privilege(session_user, pg_class.oid, 'DELETE, TRUNCATE, TRIGGER')
        )
    ) THEN 'may change the memory'
    WHEN elsewhere.excess IS NOT NULL THEN elsewhere.excess
END AS excess
FROM pg_roles AS login CROSS JOIN pg_database LEFT JOIN LATERAL (
    SELECT min(rolname::text) AS name FROM pg_roles
    WHERE rolname NOT IN (session_user, '{READER}') AND pg_has_role(session_user, oid, 'MEMBER')
) AS other ON true LEFT JOIN LATERAL (
    SELECT min(excess) AS excess FROM (
        SELECT 'may create tables in the schema ' || nspname FROM pg_namespace
        WHERE {_MORE.format(privilege="schema", object="oid", rights="CREATE")}
        UNION ALL
        SELECT 'may change the table ' || nspname || '.' || relname
        FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
        WHERE relkind IN ('r', 'v', 'm', 'p', 'f') AND (
            {_MORE.format(privilege="table", object="pg_class.oid", rights="INSERT, UPDATE, DELETE, TRUNCATE, TRIGGER")}
            OR {_MORE.format(privilege="any_column", object="pg_class.oid", rights="INSERT, UPDATE")}
        )
        UNION ALL
        SELECT 'may change the sequence ' || nspname || '.' || relname
        FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
        WHERE relkind = 'S' AND {_MORE.format(privilege="sequence", object="pg_class.oid", rights="USAGE, UPDATE")}
        UNION ALL
        SELECT 'may run ' || nspname || '.' || proname || ' with the rights of its owner'
        FROM pg_proc JOIN pg_namespace ON pg_namespace.oid = pronamespace
        WHERE prosecdef AND {_MORE.format(privilege="function", object="pg_proc.oid", rights="EXECUTE")}
    ) AS rights (excess)
) AS elsewhere ON true
WHERE login.rolname = session_user AND datname = current_database()"""  # noqa: S608  our own names only
"""Selects the rights of the login that `pycrorm_reader` has not; null if there are none. Any table may be read."""

_VOLATILE = """
SELECT 'function ' || f.proname FROM pg_proc AS f JOIN pg_namespace ON pg_namespace.oid = f.pronamespace
LEFT JOIN pg_aggregate ON aggfnoid = f.oid LEFT JOIN pg_proc AS transition ON transition.oid = aggtransfn
WHERE 'v' IN (f.provolatile, transition.provolatile) AND f.proname = ANY($1::text[]) AND f.proname <> ALL($2)
AND (nspname = ANY(current_schemas(true)) OR nspname = ANY($1::text[]))
UNION ALL
SELECT 'operator ' || oprname FROM pg_operator JOIN pg_proc ON pg_proc.oid = oprcode
JOIN pg_namespace ON pg_namespace.oid = oprnamespace
WHERE provolatile = 'v' AND strpos($3, oprname) > 0
AND (nspname = ANY(current_schemas(true)) OR nspname = ANY($1::text[]))
LIMIT 1"""
"""Selects a function or an operator of the text that may have effects. One of another schema is called with its schema
only."""
_HARMLESS = (
    "random", "random_normal", "gen_random_uuid", "clock_timestamp", "timeofday", "pg_sleep", "pg_relation_size",
    "pg_table_size", "pg_indexes_size", "pg_total_relation_size", "pg_database_size",
)  # fmt: skip
"""Volatile functions without effects."""
_RELATIONS = f"""
SELECT relname::text FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
WHERE nspname IN ('{LOG_SCHEMA}', '{VIEWS_SCHEMA}') AND relkind IN ('r', 'v')"""  # noqa: S608  our own names only
_DATABASE_FAULTS = ("08", "40", "53", "55", "57", "58", "XX")
"""Classes of errors that are the database's; all others are the query's own."""
_CANCELLED = "57014"
_UNDEFINED_TABLE = "42P01"
_MISSING_FROM = "errorMissingRTE"
"""The server's function that reports a table that exists, but not in this FROM, with the same code. Its message has the
language of the server."""


class _Cursor:
    def __init__(self, connection: asyncpg.Connection[Any], bytes_max: int) -> None:
        self.columns: tuple[str, ...] = ()
        self._connection = connection
        self._bytes_max = bytes_max
        self._is_first = True

    async def start(self, sql: str, seconds: float) -> None:
        for statement in (*_BEGIN, f"SET LOCAL statement_timeout = {max(int(seconds * 1000), 1)}"):
            await self._connection.execute(statement)
        await self._check_login()
        await self._check_functions(sql)
        query = sql.rstrip().rstrip(";")
        async with self._bounded(seconds):
            # `execute` would send several statements as they are; preparing refuses them.
            prepared = await self._connection.prepare(query)
            if prepared.get_parameters():
                raise QueryRefused(NO_PARAMETERS)
            attributes = prepared.get_attributes()
            if not attributes:
                raise QueryRefused(ONLY_READS)
            query = await self._without_end(query)
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

    async def _without_end(self, query: str) -> str:
        """Return one statement without its semicolon and the comments behind it.

        PostgreSQL's own parser finds the semicolon, outside of strings and comments: it is the first token of the
        statement that may not be in parentheses.
        """
        if ";" not in query:
            return query
        text = f"({query}\n)"
        await self._connection.execute("SAVEPOINT pycrorm_end")  # an error would end the transaction
        try:
            await self._connection.prepare(text)
        except asyncpg.PostgresSyntaxError as error:
            await self._connection.execute("ROLLBACK TO SAVEPOINT pycrorm_end")
            end = int(error.position or 0) - 1
            return text[1:end] if text[end : end + 1] == ";" else query
        return query

    async def _check_login(self) -> None:
        rights = await self._connection.fetchrow(_RIGHTS)
        if rights is None or rights["excess"] is None:
            return
        first = "" if rights["has_roles"] else " (first make the roles: operations/README.md, PostgreSQL)"
        raise QueryRefused(
            f"a query in SQL needs a login that can only read, and {rights['login']} {rights['excess']}; make one:"
            f" CREATE ROLE pycrorm_query LOGIN PASSWORD '…' IN ROLE {READER}{first}, and use it in the URL"
        )

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
            if "multiple commands" in text:
                raise QueryRefused(NOT_ONE) from None
            notes = " ".join(each for each in (error.detail, error.hint) if each)
            raise QueryRefused(f"the query is refused: {text}{f' ({notes})' if notes else ''}") from None
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
async def postgresql_cursor(engine: AsyncEngine, sql: str, *, bytes_max: int, seconds: float) -> AsyncIterator[_Cursor]:
    """Run one query on a connection of its own, which is closed at the end."""
    async with engine.connect() as connection:
        try:
            driver = (await connection.get_raw_connection()).driver_connection
            assert isinstance(driver, asyncpg.Connection)
            cursor = _Cursor(driver, bytes_max)
            await cursor.start(sql, seconds)
            yield cursor
        finally:
            await connection.invalidate()  # ends the transaction too: nothing was committed
