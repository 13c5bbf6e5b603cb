"""An engine for a SQLite file: durable at COMMIT, one writer at a time, readers that cannot write.

The driver's own BEGIN is switched off (it begins too late, and never for a SELECT or a CREATE) and ours is sent: a
writing transaction takes the write lock at once, so it waits at the start or not at all; a reading one is a snapshot.
"""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import aiosqlite
from sqlalchemy import URL, event
from sqlalchemy import Connection as Begun
from sqlalchemy.ext.asyncio import AsyncEngine, create_async_engine

__all__ = ["make_engine", "BEGIN", "Connection"]

BEGIN = "sqlite_begin"
"""Execution option: the statement that begins a transaction, None for none at all."""

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
        execution_options={BEGIN: "BEGIN" if read_only else "BEGIN IMMEDIATE"},
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

    _end: tuple[asyncio.Future[Any] | None] | None = None

    def stop(self) -> asyncio.Future[Any] | None:
        if self._end is None:
            self._end = (super().stop(),)
        return self._end[0]

    async def execute_in_turn(self, statements: Sequence[tuple[str, tuple[Any, ...]]]) -> None:
        """These statements, one after the other, in one visit to the thread. Raises as `sqlite3` does."""

        def execute() -> None:
            for statement, parameters in statements:
                self._conn.execute(statement, parameters)

        await self._execute(execute)  # type: ignore[no-untyped-call]


async def _connect(uri: str, busy_timeout_s: float) -> aiosqlite.Connection:
    def connector() -> sqlite3.Connection:
        return sqlite3.connect(
            uri, uri=True, isolation_level=None, timeout=busy_timeout_s, cached_statements=_STATEMENTS
        )

    connection = Connection(connector, _ROWS_AT_ONCE)
    thread = connection._thread  # noqa: SLF001 - as SQLAlchemy's own connecting does: there is no public way to it
    thread.daemon = True
    try:
        return await connection
    except BaseException:
        # The thread reports its end to this loop; if the loop were gone by then, a traceback of it would be printed.
        while thread.is_alive():  # noqa: ASYNC110 - a thread sets no event of ours
            await asyncio.sleep(0.001)
        raise


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
