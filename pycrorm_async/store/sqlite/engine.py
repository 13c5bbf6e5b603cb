"""An engine for a SQLite file: durable at COMMIT, one writer at a time, readers that cannot write.

The driver's own BEGIN is switched off (it begins too late, and never for a SELECT or a CREATE) and ours is sent: a
writing transaction takes the write lock at once, so it waits at the start or not at all; a reading one is a snapshot.
"""

from __future__ import annotations

import asyncio
import sqlite3
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Self, TypeVar

import aiosqlite
from sqlalchemy import URL, event
from sqlalchemy import Connection as Begun
from sqlalchemy.ext.asyncio import AsyncEngine, create_async_engine

__all__ = ["make_engine", "BEGIN", "USE_WAL", "Connection"]

_T = TypeVar("_T")

BEGIN = "sqlite_begin"
"""Execution option: the statement that begins a transaction, None for none at all."""

_WRITE = "BEGIN IMMEDIATE"
USE_WAL = "PRAGMA journal_mode = WAL"
"""Kept in the file, so it is set once; outside a transaction, and never on a database that is not ours."""
_IN_TURN = (_WRITE, USE_WAL)
_LOOK_S = 0.001
"""So often who waits for its turn to write looks whether it has come."""
_ROWS_AT_ONCE = 64
_STATEMENTS = 512
"""Kept compiled: some ten for each table that is written."""
_WRITE_PRAGMAS = (
    "PRAGMA synchronous = FULL",  # a segment of the spool is deleted after COMMIT, so COMMIT must mean the disk
    "PRAGMA wal_autocheckpoint = 4000",  # 16 MB: about every fourth full batch instead of every one
)


def make_engine(path: Path, *, read_only: bool, busy_timeout_s: float) -> AsyncEngine:
    """An engine for the file at this absolute path, which must exist: connecting never makes one."""
    uri = f"{path.as_uri()}?mode={'ro' if read_only else 'rw'}"
    engine = create_async_engine(
        URL.create("sqlite+aiosqlite", database=str(path)),
        async_creator=lambda: _connect(uri, busy_timeout_s),
        execution_options={BEGIN: "BEGIN" if read_only else _WRITE},
        hide_parameters=True,
    )
    event.listen(engine.sync_engine, "begin", _begin)
    event.listen(engine.sync_engine, "invalidate", _roll_back)
    if not read_only:
        event.listen(engine.sync_engine, "connect", _set_write_pragmas)
    return engine


class Connection(aiosqlite.Connection):
    """Its thread is asked to end once, and whoever asks again waits for the same end.

    When a closing is cancelled SQLAlchemy asks the thread to end while the closing goes on to ask for itself: the
    thread had ended by then, and the closing waited for ever, and `asyncio.run` for it.
    """

    patience_s = 0.0
    """How long a transaction that writes waits for its turn."""
    _end: tuple[asyncio.Future[Any] | None] | None = None

    def stop(self) -> asyncio.Future[Any] | None:
        if self._end is None:
            self._end = (super().stop(),)
        return self._end[0]

    def cursor(self) -> Cursor:  # type: ignore[override]
        return Cursor(self)

    async def visit(self, work: Callable[[sqlite3.Connection], _T]) -> _T:
        """Does this in the connection's thread."""
        done: _T = await self._execute(work, self._conn)  # type: ignore[no-untyped-call]
        return done

    async def execute_in_turn(self, statements: Iterable[tuple[str, tuple[Any, ...]]]) -> None:
        """These statements, each made when its turn comes, in one visit to the thread. Raises as `sqlite3` does."""

        def execute(connection: sqlite3.Connection) -> None:
            for statement, parameters in statements:
                connection.execute(statement, parameters)

        await self.visit(execute)

    async def rows_in_turn(self, statement: str, asked: Sequence[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """The one row that this statement gives for each of these parameters, in one visit to the thread. Raises so."""

        return await self.visit(lambda connection: [connection.execute(statement, each).fetchone() for each in asked])


class Cursor:
    """What SQLAlchemy uses of a cursor. A statement and its first rows take one visit to the thread, which takes longer
    than most statements do; with the driver's own they take four."""

    arraysize = 1

    def __init__(self, connection: Connection) -> None:
        self.description: Any = None
        self.rowcount = -1
        self.lastrowid: int | None = None
        self._connection = connection
        self._cursor: sqlite3.Cursor | None = None  # while it has more rows than those here
        self._rows: list[Any] = []

    async def __aenter__(self) -> Self:
        return self

    async def execute(self, statement: str, parameters: Any = ()) -> Self:
        def execute(connection: sqlite3.Connection) -> None:
            if statement in _IN_TURN:
                self._keep(_wait_for_turn(connection, statement, self._connection.patience_s))
            else:
                self._keep(connection.execute(statement, parameters))

        await self._connection.visit(execute)
        return self

    async def executemany(self, statement: str, parameters: Any) -> Self:
        await self._connection.visit(lambda connection: self._keep(connection.executemany(statement, parameters)))
        return self

    async def fetchall(self) -> list[Any]:
        if (cursor := self._cursor) is not None:
            self._rows += await self._connection.visit(lambda _: cursor.fetchall())
        rows, self._rows, self._cursor = self._rows, [], None
        return rows

    async def fetchmany(self, size: int | None = None) -> list[Any]:
        size = size or self.arraysize
        if len(self._rows) < size and (cursor := self._cursor) is not None:
            self._rows += await self._connection.visit(lambda _: cursor.fetchmany(size))
        rows, self._rows = self._rows[:size], self._rows[size:]
        return rows

    async def fetchone(self) -> Any:
        return next(iter(await self.fetchmany(1)), None)

    async def close(self) -> None:
        self._rows = []
        if (cursor := self._cursor) is not None:
            self._cursor = None
            await self._connection.visit(lambda _: cursor.close())

    def _keep(self, cursor: sqlite3.Cursor) -> None:
        self._rows = cursor.fetchmany(_ROWS_AT_ONCE)
        self.description, self.rowcount, self.lastrowid = cursor.description, cursor.rowcount, cursor.lastrowid
        if len(self._rows) == _ROWS_AT_ONCE:
            self._cursor = cursor
        else:
            cursor.close()


async def _connect(uri: str, busy_timeout_s: float) -> aiosqlite.Connection:
    def connector() -> sqlite3.Connection:
        return sqlite3.connect(
            uri, uri=True, isolation_level=None, timeout=busy_timeout_s, cached_statements=_STATEMENTS
        )

    connection = Connection(connector, _ROWS_AT_ONCE)
    connection.patience_s = busy_timeout_s
    thread = connection._thread  # noqa: SLF001 - as SQLAlchemy's own connecting does: there is no public way to it
    thread.daemon = True
    try:
        return await connection
    except BaseException:
        # The thread reports its end to this loop; if the loop were gone by then, a traceback of it would be printed.
        while thread.is_alive():  # noqa: ASYNC110 - a thread sets no event of ours
            await asyncio.sleep(0.001)
        raise


def _wait_for_turn(connection: sqlite3.Connection, statement: str, patience_s: float) -> sqlite3.Cursor:
    """Does what others must not be at work for. To begin a transaction that writes SQLite itself would wait too, but
    sleep longer with every time it looks: beside a process that folds all the time appending took 10.5 µs an event that
    way, and 8.6 this way. To change the journal mode it does not wait for others who open the new file."""
    connection.execute("PRAGMA busy_timeout = 0")
    until_s = time.monotonic() + patience_s
    try:
        while True:
            try:
                return connection.execute(statement)
            except sqlite3.OperationalError as error:
                busy = error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY  # whatever keeps it busy
                if not busy or time.monotonic() >= until_s:
                    raise
                time.sleep(_LOOK_S)
    finally:
        connection.execute(f"PRAGMA busy_timeout = {int(patience_s * 1000)}")


def _begin(connection: Begun) -> None:
    statement = connection.get_execution_options()[BEGIN]
    if statement is not None:
        connection.exec_driver_sql(statement)


def _set_write_pragmas(connection: Any, _record: Any) -> None:
    cursor = connection.cursor()
    for pragma in _WRITE_PRAGMAS:
        cursor.execute(pragma)
    cursor.close()


def _roll_back(connection: Any, _record: Any, _fault: BaseException | None) -> None:
    # When a task is cancelled in the middle of a statement its connection is thrown away. SQLite keeps a connection
    # that is closed with a statement open until that is gone, together with its transaction and the write lock:
    # nobody could write until the garbage collector came by.
    connection.rollback()
