"""Which of our errors a fault of PostgreSQL is: the way to the server, its state, our rights, damage, or us."""

from __future__ import annotations

import os

import asyncpg
from sqlalchemy.exc import DBAPIError, InterfaceError

from pycrorm_async.errors import DamageError, DatabaseUnavailable, InternalError, PycrormError

__all__ = ["FAULTS", "ROW_FAULTS", "ours", "is_missing_table"]

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
_DAMAGED = ("XX001", "XX002")


def ours(error: Exception, database: str) -> PycrormError:
    """The error to raise in its place. No text of it repeats the URL, which may hold a password."""
    fault = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
    code = _code(fault)
    text = _text(fault)
    if code.startswith(_DAMAGED):
        return DamageError(f"{database} is damaged: {text}")
    if code.startswith(_AWAY):
        return DatabaseUnavailable(f"{database}: {text}")
    if not code or isinstance(error, InterfaceError):  # between us and the server: refused, reset, timed out, closed
        return DatabaseUnavailable(f"{database}: {text}")
    return InternalError(f"{database}: {text}")


def is_missing_table(error: DBAPIError) -> bool:
    """Whether a table that was named is not there."""
    return error.orig is not None and _code(error.orig) == "42P01"


def _code(fault: BaseException) -> str:
    """The SQLSTATE; empty if the server did not say it."""
    return getattr(fault, "sqlstate", None) or getattr(fault.__cause__, "sqlstate", None) or ""


def _text(fault: BaseException) -> str:
    """What the driver said, in one line, without the names of its classes."""
    cause = fault.__cause__ if isinstance(fault.__cause__, asyncpg.PostgresError | OSError) else fault
    if isinstance(cause, OSError) and cause.strerror is not None:
        number = cause.errno or 0  # those of name look-ups are below zero
        return f"cannot be reached: {os.strerror(number) if number > 0 else cause.strerror}"
    said = " ".join(str(cause).split())
    if isinstance(cause, TimeoutError):
        return said or "no answer in time"
    return said or type(cause).__name__
