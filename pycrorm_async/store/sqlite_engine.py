"""Create an engine for a SQLite file: durable at COMMIT, one writer at a time, read-only readers.

The driver's own BEGIN is disabled, because it begins too late, and never for a SELECT or a CREATE. The engine sends its
own: a writing transaction takes the write lock at its beginning, so it waits there or not at all; a reading one is a
snapshot.
"""

from __future__ import annotations

import asyncio
import fcntl
import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import aiosqlite
from sqlalchemy import URL, Connection, event
from sqlalchemy.engine.interfaces import IsolationLevel
from sqlalchemy.exc import DBAPIError
from sqlalchemy.ext.asyncio import AsyncEngine, create_async_engine
from sqlalchemy.pool import AsyncAdaptedQueuePool, ConnectionPoolEntry

from pycrorm_async.errors import DamageError, DatabaseForeign, DatabaseUnavailable, InternalError, PycrormError

_T = TypeVar("_T")

BEGIN = "sqlite_begin"
"""Execution option: the statement that begins a transaction; None sends no statement."""

READ = "BEGIN"
_WRITE = "BEGIN IMMEDIATE"
USE_WAL = "PRAGMA journal_mode = WAL"
"""The file keeps the mode, so it is set once, outside a transaction, and never on a foreign database."""
_IN_TURN = (_WRITE, USE_WAL)
_POLL_S = 0.001
"""Interval at which a connection tries again to get the write lock."""
_START_S = 1.0
"""Bounds the wait for the start of a thread after Ctrl-C; a loaded machine starts one in milliseconds."""
_ROWS_AT_ONCE = 64
"""The rows that are fetched from SQLite's cursor at once, or more if more are asked for."""
_CACHED_STATEMENTS = 512
"""Size of the cache of compiled statements: about ten per table that is written."""
_READ_PRAGMAS = ("PRAGMA cache_size = -16384",)
"""16 MB of pages: with SQLite's 2 MB, each query of a memory of 10 MB reads the same pages from the file again."""
_WRITE_PRAGMAS = (
    "PRAGMA synchronous = FULL",  # a segment of the spool is deleted after COMMIT, so COMMIT must mean the disk
    "PRAGMA wal_autocheckpoint = 4000",  # 16 MB: about every fourth full batch instead of every one
)


def make_engine(path: Path, *, read_only: bool, busy_timeout_s: float) -> AsyncEngine:
    """Create an engine for the file at this absolute path; connecting never creates a missing file."""
    uri = f"{path.as_uri()}?mode={'ro' if read_only else 'rw'}"
    engine = create_async_engine(
        URL.create("sqlite+aiosqlite", database=str(path)),
        async_creator=lambda: _connect(uri, busy_timeout_s),
        poolclass=_Pool,
        execution_options={BEGIN: READ if read_only else _WRITE},
        hide_parameters=True,
    )
    event.listen(engine.sync_engine, "begin", _begin)
    event.listen(engine.sync_engine, "invalidate", _roll_back)
    pragmas = _READ_PRAGMAS if read_only else _WRITE_PRAGMAS
    event.listen(engine.sync_engine, "connect", partial(_set_pragmas, pragmas))
    # SQLAlchemy would query the first connection, which has the default.
    engine.dialect.get_default_isolation_level = _isolation_level  # type: ignore[method-assign]
    return engine


class _Pool(AsyncAdaptedQueuePool):
    """A pool whose connections are closed when it is disposed of, those in use as soon as they are returned.

    A task that is cancelled while it returns its connection disposes of the engine, perhaps before another task has
    completed the return. The connection then comes back to a pool that no call empties any more.
    """

    _is_disposed = False

    def dispose(self) -> None:
        self._is_disposed = True
        super().dispose()

    def _do_return_conn(self, record: ConnectionPoolEntry) -> None:
        if self._is_disposed:
            record.close()
        else:
            super()._do_return_conn(record)


class StoppableConnection(aiosqlite.Connection):
    """An aiosqlite connection whose `stop` may be called twice.

    When a close is cancelled, SQLAlchemy stops the thread while the close still runs and stops it again. The second
    request would wait for ever for a thread that has ended, and `asyncio.run` with it; so it gets the first result.
    """

    patience_s = 0.0
    """Bounds the wait of a writing transaction for the write lock."""
    _end: tuple[asyncio.Future[Any] | None] | None = None
    _begins = False
    """True between the beginning of a reading transaction and its first statement."""
    _is_idle = True
    """False while the thread may be running a function, also one that a cancelled task does not wait for any more."""

    def stop(self) -> asyncio.Future[Any] | None:
        if self._end is None:
            self._end = (super().stop(),)
        return self._end[0]

    def cursor(self) -> SharedCursor:  # type: ignore[override]
        return SharedCursor(self)

    def begin_to_read(self) -> None:
        """Begin a reading transaction with the next statement, because only a statement takes the snapshot."""
        self._begins = True

    async def visit(self, work: Callable[[sqlite3.Connection], _T]) -> _T:
        """Run a function in the connection's thread."""
        begins, self._begins = self._begins, False
        result: _T = await self._execute(partial(_begin_and, work) if begins else work, self._conn)
        return result

    async def _execute(self, fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        self._is_idle = False
        try:
            result = await super()._execute(fn, *args, **kwargs)  # type: ignore[no-untyped-call]
        except Exception:
            self._is_idle = True
            raise
        self._is_idle = True
        return result

    async def create_function(self, *args: Any, **kwargs: Any) -> None:
        """Create a function without a visit: SQLAlchemy does so before the first statement."""
        self._conn.create_function(*args, **kwargs)

    async def commit(self) -> None:
        if self._is_in_transaction():
            await super().commit()

    async def rollback(self) -> None:
        if not self._is_in_transaction():
            return
        if self._is_idle:  # here, because a visit takes longer: nothing is written, and the thread uses nothing
            self._conn.rollback()
        else:
            await super().rollback()

    def _is_in_transaction(self) -> bool:
        """Return whether the connection has an open transaction.

        SQLAlchemy asks for a rollback on every return to the pool. Without a transaction the call to the connection's
        thread is saved.
        """
        self._begins = False
        return not self._is_idle or self._conn.in_transaction

    async def execute_in_turn(self, statements: Iterable[tuple[str, tuple[Any, ...]]]) -> None:
        """Execute statements, generated lazily, in one visit to the thread. Raises as `sqlite3` does."""

        def execute(connection: sqlite3.Connection) -> None:
            for statement, parameters in statements:
                connection.execute(statement, parameters)

        await self.visit(execute)

    async def rows_in_turn(self, statement: str, parameter_sets: Sequence[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """Fetch one row of this statement per parameter set, in one visit to the thread. Raises as `sqlite3` does."""

        return await self.visit(
            lambda connection: [connection.execute(statement, each).fetchone() for each in parameter_sets]
        )


class SharedCursor:
    """The part of a cursor that SQLAlchemy uses.

    A statement and its first rows take one visit to the thread instead of the driver's four, because a visit takes
    longer than most statements.
    """

    arraysize = 1

    def __init__(self, connection: StoppableConnection) -> None:
        self.description: Any = None
        self.rowcount = -1
        self.lastrowid: int | None = None
        self._connection = connection
        self._cursor: sqlite3.Cursor | None = None  # set while it has more rows than `_rows`
        self._rows: list[Any] = []

    async def __aenter__(self) -> Self:
        return self

    async def execute(self, statement: str, parameters: Any = ()) -> Self:
        def execute(connection: sqlite3.Connection) -> list[Any]:
            if statement in _IN_TURN:
                cursor = _wait_for_turn(connection, statement, self._connection.patience_s)
            else:
                cursor = connection.execute(statement, parameters)
            return self._next_rows(cursor, _ROWS_AT_ONCE)

        self._rows = await self._connection.visit(execute)
        return self

    async def executemany(self, statement: str, parameters: Any) -> Self:
        self._rows = await self._connection.visit(
            lambda connection: self._next_rows(connection.executemany(statement, parameters), _ROWS_AT_ONCE)
        )
        return self

    async def fetchall(self) -> list[Any]:
        if (cursor := self._cursor) is not None:
            self._rows += await self._connection.visit(lambda _: cursor.fetchall())
        rows, self._rows, self._cursor = self._rows, [], None
        return rows

    async def fetchmany(self, size: int | None = None) -> list[Any]:
        size = size or self.arraysize
        if len(self._rows) < size and (cursor := self._cursor) is not None:
            self._rows += await self._connection.visit(lambda _: self._next_rows(cursor, max(size, _ROWS_AT_ONCE)))
        rows, self._rows = self._rows[:size], self._rows[size:]
        return rows

    async def fetchone(self) -> Any:
        return next(iter(await self.fetchmany(1)), None)

    async def close(self) -> None:
        self._rows = []
        if (cursor := self._cursor) is not None:
            self._cursor = None
            await self._connection.visit(lambda _: cursor.close())

    def _next_rows(self, cursor: sqlite3.Cursor, count: int) -> list[Any]:
        rows = cursor.fetchmany(count)
        self.description, self.rowcount, self.lastrowid = cursor.description, cursor.rowcount, cursor.lastrowid
        if len(rows) == count:
            self._cursor = cursor
        else:
            self._cursor = None
            cursor.close()
        return rows


async def _connect(uri: str, busy_timeout_s: float) -> StoppableConnection:
    opened: list[sqlite3.Connection] = []

    def connector() -> sqlite3.Connection:
        opened.append(
            sqlite3.connect(
                uri,
                uri=True,
                isolation_level=None,
                timeout=busy_timeout_s,
                cached_statements=_CACHED_STATEMENTS,
                check_same_thread=False,
            )
        )
        return opened[0]

    connection = StoppableConnection(connector, _ROWS_AT_ONCE)
    connection.patience_s = busy_timeout_s
    thread = connection._thread  # noqa: SLF001 - as SQLAlchemy does; aiosqlite has no public attribute
    thread.daemon = True
    try:
        await connection
    except BaseException:
        # The thread reports its end to this loop; if the loop were closed by then, it would print a traceback. The
        # driver drops what the thread opened after the task had been cancelled, and does not close it.
        connection.stop()  # the driver has not done so if Ctrl-C came while it waited for the thread to start
        _join(thread)
        for each in opened:
            each.close()
        raise
    return connection


def _join(thread: threading.Thread) -> None:
    """Wait for the end of a thread that was stopped, and that may not have started yet."""
    for _ in range(round(_START_S / _POLL_S)):
        try:
            thread.join()
        except RuntimeError:  # it is starting, or Ctrl-C came before it was to start
            time.sleep(_POLL_S)
        else:
            return


def _wait_for_turn(connection: sqlite3.Connection, statement: str, patience_s: float) -> sqlite3.Cursor:
    """Execute a statement that needs the write lock, and poll until it is free.

    SQLite's own wait sleeps longer after each attempt: beside a process that folds all the time, appending took 10.5 µs
    an event that way and 8.6 this way. SQLite does not wait at all before it changes the journal mode.
    """
    connection.execute("PRAGMA busy_timeout = 0")
    polls_left = round(patience_s / _POLL_S)  # not a time: on a busy machine the holder of the lock is slower too
    try:
        while True:
            try:
                return connection.execute(statement)
            except sqlite3.OperationalError as error:
                busy = error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY  # the primary code, without the detail
                if not busy or polls_left <= 0:
                    raise
                polls_left -= 1
                time.sleep(_POLL_S)
    finally:
        connection.execute(f"PRAGMA busy_timeout = {int(patience_s * 1000)}")


def _begin_and(work: Callable[[sqlite3.Connection], _T], connection: sqlite3.Connection) -> _T:
    connection.execute(READ)
    return work(connection)


def _begin(connection: Connection) -> None:
    statement = connection.get_execution_options()[BEGIN]
    if statement == READ:
        driver = connection.connection.driver_connection
        assert isinstance(driver, StoppableConnection)
        driver.begin_to_read()
    elif statement is not None:
        connection.connection.run_async(lambda driver: driver.cursor().execute(statement))


def _set_pragmas(pragmas: Sequence[str], connection: Any, _record: Any) -> None:
    connection.run_async(lambda driver: driver.execute_in_turn((each, ()) for each in pragmas))


def _isolation_level(dbapi_conn: object) -> IsolationLevel:  # noqa: ARG001  SQLAlchemy's name
    return "SERIALIZABLE"


def _roll_back(connection: Any, _record: Any, _fault: BaseException | None) -> None:
    # A task cancelled during a statement discards its connection. SQLite keeps a connection closed with an open
    # statement alive until the statement is collected, with its transaction and the write lock: without this rollback
    # no process could write until then.
    connection.rollback()


# === errors ===================================================================================================
#
# Translate errors of SQLite: an unreachable file, the wrong file, a damaged file, or our own defect.

_UNAVAILABLE = {
    sqlite3.SQLITE_PERM,
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_INTERRUPT,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_PROTOCOL,
    sqlite3.SQLITE_SCHEMA,
    sqlite3.SQLITE_AUTH,
}


_READ_ONLY_FOLDER = {
    sqlite3.SQLITE_READONLY_DIRECTORY,
    sqlite3.SQLITE_READONLY_CANTINIT,
    sqlite3.SQLITE_READONLY_CANTLOCK,
}

_DISK_FULL = {sqlite3.SQLITE_IOERR_SHMSIZE, sqlite3.SQLITE_IOERR_SHMMAP, sqlite3.SQLITE_IOERR_WRITE}


def translate_error(error: Exception, database: str) -> PycrormError:
    """Return the error of this package to raise instead of the driver's."""
    fault = error.orig if isinstance(error, DBAPIError) else error
    code = getattr(fault, "sqlite_errorcode", None)
    if isinstance(fault, UnicodeDecodeError) or (code is None and str(fault).startswith("Could not decode to UTF-8")):
        return DamageError(f"{database} is damaged: {fault}")
    if code is None:  # raised by the driver itself: the connection is closed
        return DatabaseUnavailable(f"{database}: {fault}")
    primary = code & 0xFF
    if primary == sqlite3.SQLITE_NOTADB:
        return DatabaseForeign(f"{database} is not a database: SQLite cannot read it; name another file")
    if primary == sqlite3.SQLITE_CORRUPT:
        return DamageError(f"{database} is damaged: {fault}")
    if primary == sqlite3.SQLITE_CANTOPEN or code in _READ_ONLY_FOLDER:
        return DatabaseUnavailable(
            f"{database} cannot be opened: the file must be readable and its folder writable,"
            " because SQLite creates files beside it, also for reading"
        )
    if code in _DISK_FULL:
        return DatabaseUnavailable(
            f"{database}: {fault}: the disk may be full; SQLite needs some space beside the file, also for reading"
        )
    if primary in _UNAVAILABLE:
        return DatabaseUnavailable(f"{database}: {fault}")
    return InternalError(f"{database}: {fault}")


def refusal(error: Exception) -> str | None:
    """Return the reason why SQLite can never create a table or view of this definition; None for other errors."""
    fault = error.orig if isinstance(error, DBAPIError) else error
    code = getattr(fault, "sqlite_errorcode", None)
    if code is None or code & 0xFF not in (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_TOOBIG):
        return None
    # A full disk rolls back the transaction, and with it the savepoint of the attempt: a temporary error.
    return None if "savepoint" in str(fault) or "transaction" in str(fault) else str(fault)


# === leftovers ================================================================================================
#
# Move away the files that SQLite left beside a removed database, before a new one of the same name is created.
#
# A write-ahead log and its index belong to one file, but SQLite finds them by name. A process that still has the
# removed file open would share the index with every process that opens the new one, and both would read each other's
# pages. SQLite also deletes a write-ahead log beside an empty database, with transactions that a crash kept out of the
# old file; here it is kept.

_INDEX: Final = "-shm"
_WITH_CONTENT: Final = ("-wal", "-journal")
_ORPHANED: Final = ".orphaned"
"""Suffix of a kept file; the next one replaces it, so that at most one is kept."""
_LOCK_WAIT_S: Final = 10.0
"""Bounds the wait for another process that does the same, which takes milliseconds. Another user, who can read the
folder, can hold its lock for ever: after this time the leftovers are moved without it."""
_RETRY_S: Final = 0.001
"""The pause in s between two attempts."""

_log = logging.getLogger("pycrorm_async")


def move_leftovers(database: Path) -> None:
    """Move or delete the leftovers of a database that does not exist. Raises `OSError`.

    Processes that create the same database take turns. A leftover is moved only while the database does not exist, so
    it never belongs to one that another process has created and opened meanwhile.
    """
    leftovers = [database.with_name(database.name + suffix) for suffix in (*_WITH_CONTENT, _INDEX)]
    if not any(each.exists() for each in leftovers):
        return
    folder = os.open(database.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        _lock_folder(folder)
        if database.exists():
            return
        for each in leftovers:
            if not each.exists():
                continue
            if each.name.endswith(_INDEX) or not each.stat().st_size:
                each.unlink(missing_ok=True)
            else:
                kept = each.replace(each.with_name(each.name + _ORPHANED))
                _log.warning("%s was removed without %s, which is kept as %s", database, each.name, kept.name)
    finally:
        os.close(folder)


def _lock_folder(folder: int) -> None:
    for _ in range(round(_LOCK_WAIT_S / _RETRY_S)):
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_RETRY_S)
        else:
            return


# === rebuild lock =============================================================================================
#
# Lock out a second rebuild with a lock on a file beside the database, which is deleted at the end.


@contextmanager
def claim(database: Path) -> Iterator[bool]:
    """Lock the file beside this database until the context ends or the process dies; yields False if it is locked.

    The file gets the database's mode, so that a process of the same group can reuse one that a killed process left.
    Raises `DatabaseUnavailable` if the file cannot be created.
    """
    path = database.with_name(f"{database.name}-rebuild")
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        with suppress(PermissionError):  # another user created it
            os.fchmod(file, database.stat().st_mode & 0o666)
    except OSError as error:
        raise DatabaseUnavailable(f"{path} cannot be created: {error.strerror}") from error
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        if not (path.exists() and path.stat().st_ino == os.fstat(file).st_ino):
            yield False  # its last holder deleted it after we had opened it
            return
        try:
            yield True
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(file)
