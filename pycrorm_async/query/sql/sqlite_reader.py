"""Run one query on a SQLite file, in a thread, on a connection that can only read.

`mode=ro` and `PRAGMA query_only` still let ATTACH create a file. So an authorizer, which SQLite asks about every action
when it compiles a statement, allows SELECT, READ, FUNCTION and RECURSIVE, and nothing else. The connection is one of
the driver's own, without functions in Python: SQLAlchemy adds REGEXP, which no time limit can stop.
"""

from __future__ import annotations

import asyncio
import sqlite3
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeVar

from pycrorm_async.errors import QueryRefused
from pycrorm_async.query.sql.refusals import NOT_ONE, ONLY_READS, missing_relation, stopped
from pycrorm_async.store.address import BUSY_TIMEOUT_S

__all__ = ["sqlite_cursor"]

_T = TypeVar("_T")
_ALLOWED = frozenset({sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE})
_FORBIDDEN_FUNCTIONS = frozenset({"load_extension", "fts3_tokenizer"})
"""Functions that run code from a file, or return an address in the memory of this process."""
_STEPS = 10_000
"""Steps of SQLite's machine between two checks of the time; about 0.1 ms."""
_VALUE_BYTES = 16 << 20
"""Bounds a value while it is computed, so that `zeroblob` and `replace` cannot fill the memory. Stored values are
smaller: a part of a blob has 4 MiB."""
_ACTIONS = {
    value: name.removeprefix("SQLITE_").replace("_", " ")
    for name, value in vars(sqlite3).items()
    if name.startswith(("SQLITE_CREATE_", "SQLITE_DROP_", "SQLITE_ALTER_"))
    or name
    in (
        "SQLITE_INSERT", "SQLITE_UPDATE", "SQLITE_DELETE", "SQLITE_PRAGMA", "SQLITE_ATTACH", "SQLITE_DETACH",
        "SQLITE_TRANSACTION", "SQLITE_SAVEPOINT", "SQLITE_REINDEX", "SQLITE_ANALYZE",
    )
}  # fmt: skip
"""The action's name by its code, which other constants share."""
_REFUSALS = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_AUTH, sqlite3.SQLITE_TOOBIG, sqlite3.SQLITE_MISMATCH)
"""Codes of errors that are the query's own; all others are the database's."""


class _Cursor:
    def __init__(self, path: Path, bytes_max: int) -> None:
        self.columns: tuple[str, ...] = ()
        self._bytes_left = bytes_max
        self._until_s = 0.0
        self._denied: str | None = None
        uri = f"{path.as_uri()}?mode=ro"
        self._connection = sqlite3.connect(
            uri, uri=True, isolation_level=None, timeout=BUSY_TIMEOUT_S, check_same_thread=False
        )
        # Making these tables counts as an UPDATE of the schema, although nothing is stored.
        self._connection.execute("SELECT 1 FROM json_each('[]'), json_tree('[]')")
        self._names = [str(name) for (name,) in self._connection.execute("SELECT name FROM sqlite_master")]
        self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(bytes_max, _VALUE_BYTES))
        self._connection.set_progress_handler(lambda: time.monotonic() > self._until_s, _STEPS)
        self._connection.set_authorizer(self._authorize)
        self._rows: sqlite3.Cursor | None = None

    def _authorize(self, action: int, _first: str | None, second: str | None, *_: str | None) -> int:
        if action in _ALLOWED and not (action == sqlite3.SQLITE_FUNCTION and second in _FORBIDDEN_FUNCTIONS):
            return sqlite3.SQLITE_OK
        self._denied = self._denied or (
            f"{second}()" if action == sqlite3.SQLITE_FUNCTION else _ACTIONS.get(action, f"action {action}")
        )
        return sqlite3.SQLITE_DENY

    async def start(self, sql: str, seconds: float) -> None:
        def execute() -> sqlite3.Cursor:
            return self._connection.execute(sql)

        self._rows = await self._run(execute, seconds)
        if self._rows.description is None:
            raise QueryRefused(ONLY_READS)
        self.columns = tuple(each[0] for each in self._rows.description)

    async def fetch(self, rows: int, seconds: float) -> tuple[list[tuple[Any, ...]], bool]:
        def fetch() -> tuple[list[tuple[Any, ...]], bool]:
            assert self._rows is not None
            fetched: list[tuple[Any, ...]] = []
            while len(fetched) < rows and (row := self._rows.fetchone()) is not None:
                size = sum(len(each) if isinstance(each, str | bytes) else 8 for each in row)
                if size > self._bytes_left:
                    return fetched, True
                self._bytes_left -= size
                fetched.append(row)
            return fetched, False

        return await self._run(fetch, seconds)

    async def _run(self, work: Callable[[], _T], seconds: float) -> _T:
        """Run it in a thread, to its end also if this task is cancelled: then SQLite is interrupted."""
        self._until_s = time.monotonic() + seconds
        thread = asyncio.ensure_future(asyncio.to_thread(work))
        try:
            return await asyncio.shield(thread)
        except asyncio.CancelledError:
            self._until_s = 0.0
            self._connection.interrupt()
            await asyncio.wait([thread])
            raise
        except (sqlite3.Error, sqlite3.Warning, UnicodeEncodeError) as error:
            raise self._refusal(error, seconds) from None

    def _refusal(self, error: Exception, seconds: float) -> Exception:
        code = getattr(error, "sqlite_errorcode", None)
        if self._denied is not None:
            return QueryRefused(f"{ONLY_READS}; {self._denied} is not allowed")
        if code is None and "one statement" in str(error):
            return QueryRefused(NOT_ONE)
        if code == sqlite3.SQLITE_INTERRUPT:
            return QueryRefused(stopped(seconds))
        if code is None or code & 0xFF in _REFUSALS:
            text = str(error)
            if text.startswith("no such table: "):
                return missing_relation(text.removeprefix("no such table: "), self._names)
            return QueryRefused(f"the query is refused: {text}")
        return error

    def close(self) -> None:
        self._connection.close()


@asynccontextmanager
async def sqlite_cursor(path: Path, sql: str, *, bytes_max: int, seconds: float) -> AsyncIterator[_Cursor]:
    """Run one query on the file at this path."""
    cursor = await asyncio.to_thread(_Cursor, path, bytes_max)
    try:
        await cursor.start(sql, seconds)
        yield cursor
    finally:
        cursor.close()
