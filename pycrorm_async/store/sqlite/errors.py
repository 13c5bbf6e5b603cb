"""Translate errors of SQLite: an unreachable file, the wrong file, a damaged file, or our own defect."""

from __future__ import annotations

import sqlite3

from pycrorm_async.errors import (
    DamageError,
    DatabaseForeign,
    DatabaseUnavailable,
    InternalError,
    PycrormError,
)

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


def translate_error(fault: BaseException | None, database: str) -> PycrormError:
    """Return the error of this package to raise instead of the driver's."""
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


def refusal(fault: BaseException | None) -> str | None:
    """Return the reason why SQLite can never create a table or view of this definition; None for other errors."""
    code = getattr(fault, "sqlite_errorcode", None)
    if code is None or code & 0xFF not in (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_TOOBIG):
        return None
    # A full disk rolls back the transaction, and with it the savepoint of the attempt: a temporary error.
    return None if "savepoint" in str(fault) or "transaction" in str(fault) else str(fault)
