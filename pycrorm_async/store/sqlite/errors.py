"""Which of our errors a fault of SQLite is: the way to the file, the wrong file, a damaged one, or us."""

from __future__ import annotations

import sqlite3

from pycrorm_async.errors import (
    DamageError,
    DatabaseForeign,
    DatabaseUnavailable,
    InternalError,
    PycrormError,
)

__all__ = ["translate_error", "refusal"]

_AWAY = {
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


def translate_error(fault: BaseException | None, database: str) -> PycrormError:
    """The error to raise in place of the driver's."""
    code = getattr(fault, "sqlite_errorcode", None)
    if isinstance(fault, UnicodeDecodeError) or (code is None and str(fault).startswith("Could not decode to UTF-8")):
        return DamageError(f"{database} is damaged: {fault}")
    if code is None:  # raised by the driver between us and SQLite: a connection that is gone
        return DatabaseUnavailable(f"{database}: {fault}")
    primary = code & 0xFF
    if primary == sqlite3.SQLITE_NOTADB:
        return DatabaseForeign(f"{database} is not a database: SQLite cannot read it")
    if primary == sqlite3.SQLITE_CORRUPT:
        return DamageError(f"{database} is damaged: {fault}")
    if primary == sqlite3.SQLITE_CANTOPEN:
        return DatabaseUnavailable(
            f"{database} cannot be opened: the file must be readable and its folder writable,"
            " for SQLite makes files beside it, also to read it"
        )
    if primary in _AWAY:
        return DatabaseUnavailable(f"{database}: {fault}")
    return InternalError(f"{database}: {fault}")


def refusal(fault: BaseException | None) -> str | None:
    """Why SQLite never makes a table or view of such a definition; None for a fault of another kind."""
    code = getattr(fault, "sqlite_errorcode", None)
    if code is None or code & 0xFF not in (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_TOOBIG):
        return None
    # A full disk ends the transaction, and the savepoint that was made for the attempt is gone with it.
    return None if "savepoint" in str(fault) or "transaction" in str(fault) else str(fault)
