"""Run one query on a SQLite file in this process, which `query.sql` starts with this file as its program.

The parent writes one request to stdin, (URI of the file, SQL, bytes of rows, seconds), and reads an answer from stdout:
"open", then the columns, and for each number of rows that it writes these rows. A fault ends the process after its
message. All messages are marshalled values. This program imports nothing of the package, so that it starts in 20 ms.
"""

import marshal
import resource
import sqlite3
import sys
from typing import Any

_ALLOWED = frozenset({sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE})
_FORBIDDEN_FUNCTIONS = frozenset({"load_extension", "fts3_tokenizer"})
"""Functions that run code from a file, or return an address in the memory of this process."""
_VALUE_BYTES = 16 << 20
"""Bounds a value while it is computed. Stored values are smaller: a part of a blob has 4 MiB."""
_HEAP_BYTES = 128 << 20
"""Bounds SQLite's allocations, beside two values: enough to sort and to group a million rows before it uses files."""
_PROCESS_BYTES = 256 << 20
"""Bounds the address space beside SQLite's and the rows: Python's own has a tenth of it."""
_TEMPORARY_BYTES = 1 << 30
"""Bounds a temporary file, into which SQLite sorts."""
_PIECE_BYTES = 1 << 20
"""Bytes of rows after which a message ends, however few rows it has."""
_BUSY_TIMEOUT_S = 5.0
"""Bounds the wait in s for the lock of another process."""


class _Authorizer:
    """Allows reading and nothing else; `denied` is the first denied action of a statement."""

    def __init__(self) -> None:
        self.denied: tuple[int, str | None] | None = None

    def __call__(self, action: int, _first: str | None, second: str | None, *_: str | None) -> int:
        if action in _ALLOWED and not (action == sqlite3.SQLITE_FUNCTION and second in _FORBIDDEN_FUNCTIONS):
            return sqlite3.SQLITE_OK
        self.denied = self.denied or (action, second)
        return sqlite3.SQLITE_DENY


def main() -> None:
    """Answer the one request, then the requests for rows until stdin ends."""
    uri, sql, bytes_max, seconds = _read()
    authorizer, names = _Authorizer(), []
    try:
        connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_BUSY_TIMEOUT_S)
        # Making these tables counts as an UPDATE of the schema, although nothing is stored.
        connection.execute("SELECT 1 FROM json_each('[]'), json_tree('[]')")
        relations = "SELECT name FROM sqlite_master WHERE type IN ('table', 'view')"
        names = [str(name) for (name,) in connection.execute(relations)]
        _bound(connection, bytes_max, seconds)
        _write("open")
        connection.set_authorizer(authorizer)
        rows = connection.execute(sql)
        _write([each[0] for each in rows.description or ()])
        _answer(rows, bytes_max)
    except MemoryError:
        _write(("memory", None, "", None, ()))
    except (sqlite3.Error, sqlite3.Warning, UnicodeEncodeError) as error:
        code = getattr(error, "sqlite_errorcode", None)
        _write((type(error).__name__, code, str(error), authorizer.denied, names))


def _bound(connection: sqlite3.Connection, bytes_max: int, seconds: float) -> None:
    """Bound values, memory, files, and the time for which this process computes without a parent."""
    value_bytes = min(max(bytes_max, _VALUE_BYTES), 2**31 - 1)
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, value_bytes)
    heap_bytes = _HEAP_BYTES + 2 * value_bytes
    connection.execute(f"PRAGMA hard_heap_limit = {heap_bytes}").fetchall()
    _limit(resource.RLIMIT_AS, heap_bytes + _PROCESS_BYTES + 3 * value_bytes)  # a row is there up to three times
    _limit(resource.RLIMIT_FSIZE, _TEMPORARY_BYTES)
    _limit(resource.RLIMIT_CPU, int(seconds) + 5)
    _limit(resource.RLIMIT_CORE, 0)


def _limit(resource_id: int, most: int) -> None:
    most = min([most, *(each for each in resource.getrlimit(resource_id) if each != resource.RLIM_INFINITY)])
    resource.setrlimit(resource_id, (most, most))


def _answer(rows: sqlite3.Cursor, bytes_left: int) -> None:
    """Write the requested rows in pieces, each with whether the query has ended or reached its bound on bytes."""
    while True:
        wanted = _read()
        piece: list[tuple[Any, ...]] = []
        piece_bytes, state = 0, ""
        while len(piece) < wanted and piece_bytes < _PIECE_BYTES:
            row = rows.fetchone()
            if row is None:
                state = "end"
                break
            size = sum(len(each) if isinstance(each, str | bytes) else 8 for each in row)
            if piece_bytes + size > bytes_left:
                state = "full"
                break
            piece.append(row)
            piece_bytes += size
        bytes_left -= piece_bytes
        _write((piece, state))


def _read() -> Any:
    try:
        return marshal.load(sys.stdin.buffer)  # noqa: S302  from the parent
    except EOFError:
        sys.exit()


def _write(message: Any) -> None:
    try:
        marshal.dump(message, sys.stdout.buffer)
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        sys.exit()


if __name__ == "__main__":
    main()
