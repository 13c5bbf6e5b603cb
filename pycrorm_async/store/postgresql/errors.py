"""Which of our errors a fault of PostgreSQL is: the way to the server, its state, our rights, damage, or us."""

from __future__ import annotations

import os
import re
import ssl

import asyncpg
from sqlalchemy.exc import DBAPIError, InterfaceError

from pycrorm_async.errors import DamageError, DatabaseUnavailable, InternalError, PycrormError

__all__ = ["FAULTS", "ROW_FAULTS", "CommitInDoubt", "translate_error", "refusal", "is_missing_table"]

FAULTS: tuple[type[Exception], ...] = (
    DBAPIError,
    asyncpg.PostgresError,
    asyncpg.InterfaceError,
    asyncpg.InternalClientError,
    OSError,
    TimeoutError,
)

ROW_FAULTS: tuple[type[Exception], ...] = (
    asyncpg.DataError,
    asyncpg.IntegrityConstraintViolationError,
    asyncpg.exceptions._base.DataError,  # noqa: SLF001  what the driver raises before it sends; the name hides another
    OverflowError,
)
"""What says that a row cannot be held."""

_AWAY = (
    "08",  # connection
    "25",  # a read-only transaction, among others
    "28",  # who we are is not believed
    "3D",  # no such database
    "40",  # rolled back: deadlock, serialisation
    "42501",  # we may not
    "53",  # no memory, no disk, no connection left
    "55",  # a lock was not given in time
    "57",  # shutting down, cancelled
    "58",  # its operating system
    "23505",  # the same episode came through another connection at the same moment
)
_DEFINITIONS = ("22", "42", "54")
"""Of a definition that cannot be: a value in it, its syntax or names, a limit of the server. `_AWAY` comes first."""
_DAMAGED = ("XX001", "XX002")
_MISSING = ("42P01", "3F000", "42P10")
"""A table, a schema, or the key of a table is not there."""
_OF_THE_MEMORY = re.compile(
    r"""["'«„](?:(?:pycrorm|memory_tables|memory)\b|(?:pycrorm_log|pycrorm_declaration|episode|event|episode_number)\b"""
    r"""|pycrorm_\w+|\w+__\d+\b)"""
)
"""Names of the log's schemas and tables, and of tables made from it, as the server quotes them in whatever language."""
_DROPPED_MEANWHILE = re.compile("could not open relation with OID|cache lookup failed for relation")
"""What a statement meets that had looked a table up just before it was dropped."""


class CommitInDoubt(ConnectionError):
    """The server committed, and warns that the machine it should have waited for may not have the commit."""


def translate_error(error: Exception, database: str) -> PycrormError:
    """The error to raise in its place. No text of it repeats the URL, which may hold a password."""
    fault = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
    code = _code(fault)
    text = _text(fault)
    if code.startswith(_DAMAGED):
        return DamageError(f"{database} is damaged: {text}")
    if _is_missing(code, text):
        return DatabaseUnavailable(f"{database}: {text}: a part of the memory is missing; restore it from a backup")
    if code.startswith(_AWAY):
        return DatabaseUnavailable(f"{database}: {text}")
    if not code or isinstance(error, InterfaceError):  # between us and the server: refused, reset, timed out, closed
        return DatabaseUnavailable(f"{database}: {text}")
    return InternalError(f"{database}: {text}")


def _is_missing(code: str, text: str) -> bool:
    """Whether a part of the memory is not there, as while a backup is put back; what users name is theirs."""
    if code == "42P10":  # ON CONFLICT names keys, which are made last
        return True
    if code == "XX000":
        return _DROPPED_MEANWHILE.search(text) is not None
    return code in _MISSING and _OF_THE_MEMORY.search(text) is not None


def refusal(error: Exception) -> str | None:
    """Why the server never makes a table or view of such a definition; None for a fault of another kind."""
    fault = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
    code = _code(fault)
    text = _text(fault)
    is_refused = code.startswith(_DEFINITIONS) and not code.startswith(_AWAY) and not _is_missing(code, text)
    return text if is_refused else None


def is_missing_table(error: DBAPIError) -> bool:
    """Whether a table that was named is not there."""
    return error.orig is not None and _code(error.orig) == "42P01"


def _code(fault: BaseException) -> str:
    """The SQLSTATE; empty if the server did not say it."""
    return getattr(fault, "sqlstate", None) or getattr(fault.__cause__, "sqlstate", None) or ""


def _text(fault: BaseException) -> str:
    """What the driver said, in one line, without the names of its classes."""
    cause = fault.__cause__ if isinstance(fault.__cause__, asyncpg.PostgresError | OSError) else fault
    if isinstance(cause, ssl.SSLCertVerificationError):
        return f"the server's certificate is not accepted: {cause.verify_message}"
    if isinstance(cause, OSError) and not isinstance(cause, ssl.SSLError) and cause.strerror is not None:
        number = cause.errno or 0  # those of name look-ups are below zero
        return f"cannot be reached: {os.strerror(number) if number > 0 else cause.strerror}"
    said = " ".join(str(cause).split())
    if isinstance(cause, TimeoutError):
        return said or "no answer in time"
    return said or type(cause).__name__
