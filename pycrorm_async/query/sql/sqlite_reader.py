"""Run one query on a SQLite file, in a process of its own that can only read.

**Theory of operation.** `mode=ro` and `PRAGMA query_only` still let ATTACH create a file. So an authorizer, which
SQLite asks about every action when it compiles a statement, allows SELECT, READ, FUNCTION and RECURSIVE, and nothing
else. The connection is one of the driver's own: SQLAlchemy adds REGEXP, a function in Python.

SQLite checks for an interruption between the steps of its machine, and one step, such as `instr` of two large values,
can take hours. It can bound its memory only for a whole process, the writer in it included. So each query has a process
(`sqlite_process`). It starts in 20 ms, has limits on its memory, its temporary files and its CPU time, and is killed
when the time is over or the query is cancelled. A killed reader leaves no lock, and its temporary files have no names.
It has a session of its own, so that Ctrl-C interrupts only the parent. When the parent dies, the process ends with its
stdin, or at the limit on its CPU time.
"""

from __future__ import annotations

import asyncio
import marshal
import re
import sqlite3
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from pycrorm_async.errors import QueryRefused
from pycrorm_async.query.sql.refusals import NO_PARAMETERS, NOT_ONE, ONLY_READS, missing_relation, stopped

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
_REFUSALS = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_AUTH, sqlite3.SQLITE_TOOBIG)
"""Codes of errors that are the query's own; all others are the database's."""
_NO_ROOM = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE)
"""Codes of a temporary file that cannot grow, because a reader writes no other."""
_FAULT_VALUES = 5
"""The values in a message that has the reason for which the query ended."""
_TOO_LARGE = (
    "the query has a value of more than 16 MiB: select a part of it, as substr does, or raise the limit on bytes"
)
_WITH_EMPTY_END = re.compile(
    r"""((?>'[^']*'?|"[^"]*"?|`[^`]*`?|\[[^]]*]?|--[^\n]*|/\*(?:.*?\*/|.*)|[^;])*+);"""
    r"""(?>[ \t\n\f\r;]|--[^\n]*|/\*(?:.*?\*/|.*))*+""",
    re.DOTALL,
)
"""A statement, a semicolon outside of its strings, quoted names and comments, and behind it no other statement.

What has no end reaches to the end of the text, so that matching takes time in proportion to its length.
"""
_NO_INTEGER = "the query is refused: LIMIT and OFFSET must be integers"
"""A query converts values strictly only there, so no other one has the code SQLITE_MISMATCH."""
_TOO_MUCH = "the query needs more {} than it may use: select or sort less"


class _Cursor:
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


def _without_end(sql: str) -> str:
    """Return one statement without its semicolon and the empty statements and comments behind it.

    The driver refuses empty statements as further ones. SQLite and the authorizer check what is returned, so a text
    that SQLite divides in another way gains nothing.
    """
    match = _WITH_EMPTY_END.fullmatch(sql)
    return match[1] if match else sql


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
    if text.startswith("Could not decode to UTF-8 column"):
        return QueryRefused("the query has a text that is not UTF-8: select it as bytes, with CAST(… AS BLOB)")
    if code is not None and code & 0xFF == sqlite3.SQLITE_MISMATCH:
        return QueryRefused(_NO_INTEGER)
    if code in _NO_ROOM:
        return QueryRefused(_TOO_MUCH.format("space for temporary files"))
    if code is None or code & 0xFF in _REFUSALS:
        if text.startswith("no such table: "):
            return missing_relation(text.removeprefix("no such table: "), names)
        return QueryRefused(f"the query is refused: {text}")
    error = sqlite3.OperationalError(text)
    error.sqlite_errorcode = code
    return error


@asynccontextmanager
async def sqlite_cursor(path: Path, sql: str, *, bytes_max: int, seconds: float) -> AsyncIterator[_Cursor]:
    """Run one query on the file at this path."""
    cursor = _Cursor()
    try:
        await cursor.start(path, sql, bytes_max, seconds)
        yield cursor
    finally:
        await asyncio.to_thread(cursor.close)
