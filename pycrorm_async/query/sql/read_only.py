"""Run one SQL query that can only read, with bounds on its time, rows and bytes.

sql = ReadOnlySql(log)
result = await sql.query("SELECT dtype, count(*) AS nodes FROM task_tree_node GROUP BY dtype")
async with sql.stream("SELECT * FROM event", SqlLimits(rows=None)) as rows:
    async for row in rows: ...

**Theory of operation.** The text of a query is untrusted: a user or a language model wrote it. Each query
has a connection of its own, which is closed after it, so that no setting, lock or temporary table outlives a query.
The database refuses everything but reading: SQLite through an authorizer, in a process with limits (`sqlite_reader`),
PostgreSQL through a login without other rights, a read-only transaction and a cursor (`postgresql_reader`). Parsing the
text here would not do, because a parser that differs from the database's in one detail would let a statement through.

A query that reaches a bound on time is stopped: SQLite's process is killed, a server cancels it. One that reaches a
bound on rows or bytes ends early, and `more` is True.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from pycrorm_async.errors import QueryRefused
from pycrorm_async.query.value_html import NotebookValue
from pycrorm_async.store.log import EventLog

if TYPE_CHECKING:
    import pandas as pd

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
        times: dict[str, int] = {}
        names = []
        for name in self.columns:
            times[name] = times.get(name, -1) + 1
            names.append(f"{name}_{times[name]}" if times[name] else name)
        return names

    def frame(self) -> pd.DataFrame:
        """Return the rows as a frame of pandas, which derives the types from the values. Raises `MissingExtra`."""
        from pycrorm_async.query.frames.dataframe import imported

        frame: pd.DataFrame = imported("pandas").DataFrame(self.rows, columns=self.names)
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


class ReadOnlySql:
    """Runs queries in SQL on the database of a log. Needs no closing: each query has its own connection."""

    def __init__(self, log: EventLog) -> None:
        self._log = log

    async def query(self, sql: str, limits: SqlLimits = DEFAULT_LIMITS) -> SqlResult:
        """Return the rows of one query. Raises as `stream` does."""
        async with self.stream(sql, limits) as rows:
            collected = [row async for row in rows]
            return SqlResult(rows.columns, collected, rows.more)

    @asynccontextmanager
    async def stream(self, sql: str, limits: SqlLimits = DEFAULT_LIMITS) -> AsyncIterator[SqlRows]:
        """Run one query and read its rows while it runs.

        Raises `QueryRefused` for a text that is not one query, would do more than read, is wrong, or takes longer than
        it may; and on PostgreSQL for a login with more rights than `pycrorm_reader`. Raises `DatabaseUnavailable`.
        """
        with self._log.translated():
            async with self._cursor(sql, limits) as cursor:
                yield SqlRows(cursor, limits)

    def _cursor(self, sql: str, limits: SqlLimits) -> AbstractAsyncContextManager[Cursor]:
        if not _CHARACTERS.fullmatch(sql):
            raise QueryRefused("a query in SQL has no character U+0000 and no half of a surrogate pair")
        if self._log.address.is_sqlite:
            from pycrorm_async.query.sql.sqlite_reader import sqlite_cursor

            return sqlite_cursor(self._log.address.path, sql, bytes_max=limits.bytes, seconds=limits.seconds)
        # Loading the driver of a server takes a tenth of a second.
        from pycrorm_async.query.sql.postgresql_reader import postgresql_cursor

        return postgresql_cursor(self._log.engine, sql, bytes_max=limits.bytes, seconds=limits.seconds)
