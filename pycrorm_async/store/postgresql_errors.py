"""Translate errors of PostgreSQL: a connection problem, a server state, a missing right, damage, or our defect.

Only code that has opened a server imports this module, because the server's driver takes a tenth of a second to load.
"""

import errno
import os
import re
import ssl
from collections.abc import Iterator
from contextlib import contextmanager

import asyncpg
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError, InterfaceError

from pycrorm_async.errors import CallerError, DamageError, DatabaseUnavailable, InternalError, PycrormError
from pycrorm_async.store.dialect import RowRefused
from pycrorm_async.store.postgresql_engine import POOLED

FAULTS: tuple[type[Exception], ...] = (
    DBAPIError,
    asyncpg.PostgresError,
    asyncpg.InterfaceError,
    asyncpg.InternalClientError,
    OSError,
    TimeoutError,
)

_ROW_FAULTS: tuple[type[Exception], ...] = (
    asyncpg.DataError,
    asyncpg.IntegrityConstraintViolationError,
    asyncpg.exceptions._base.DataError,  # noqa: SLF001  raised by the driver before sending; the public name is another class
    OverflowError,
)
"""The errors of a row that the database cannot store."""

_NO_RIGHT = "42501"
_RAISED = "P0001"
"""Our own statements raise it: those that make roles, with what another login must run first."""
_UNAVAILABLE = (
    "08",  # connection
    "25",  # invalid transaction state, such as a read-only one
    "28",  # authentication failed
    "3D",  # no such database
    "40",  # rolled back: deadlock, serialisation
    _NO_RIGHT,
    "53",  # out of memory, disk or connections
    "55",  # lock not available in time
    "57",  # shutting down, cancelled
    "58",  # error of the server's operating system
    "23505",  # another connection inserted the same episode at the same time
)
_DEFINITIONS = ("22", "42", "54")
"""Errors of an impossible definition: a value, syntax, a name or a server limit. `_UNAVAILABLE` takes precedence."""
_DAMAGED = ("XX001", "XX002")
_EXCHANGED = ("26000", "42P05")
"""A prepared statement of this session does not exist, or exists in a session that never prepared it."""
_MISSING = ("42P01", "3F000", "42P10")
"""A table, a schema, or the key of a table is missing."""
_OF_THE_MEMORY = re.compile(
    r"""["'«„](?:(?:pycrorm|memory_tables|memory)\b|(?:pycrorm_log|pycrorm_declaration|episode|event|episode_number)\b"""
    r"""|pycrorm_\w+|\w+__\d+\b)"""
)
"""Names of the log's schemas and tables and of derived tables, in the quotes of the server's language."""
_NO_TLS = re.compile("rejected SSL upgrade|unexpected connection_lost")
"""The driver's messages about a first answer that is not PostgreSQL's consent to encrypt."""
_DROPPED_MEANWHILE = re.compile("could not open relation with OID|cache lookup failed for relation")
"""Messages of a statement that looked up a table just before it was dropped."""


class CommitInDoubt(ConnectionError):
    """The server committed, but warns that a synchronous standby may not have the commit."""


@contextmanager
def rows_refused() -> Iterator[None]:
    """Raise `RowRefused` for an error of a row that the database cannot store."""
    try:
        yield
    except DBAPIError as error:
        if isinstance(error, DataError | IntegrityError):
            raise RowRefused(str(error.orig)) from error
        raise
    except _ROW_FAULTS as error:
        raise RowRefused(" ".join(str(error).split())) from error


def translate_error(error: Exception, database: str) -> PycrormError:
    """Return the error of this package to raise instead. Its text never quotes the URL, which may hold a password."""
    fault = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
    code = _code(fault)
    text = _text(fault)
    if code.startswith(_DAMAGED):
        return DamageError(f"{database} is damaged: {text}")
    if _is_missing(code, text):
        return DatabaseUnavailable(f"{database}: {text}: a part of the memory is missing; restore it from a backup")
    if code in _EXCHANGED:
        return DatabaseUnavailable(f"{database}: {text}: {POOLED}")
    if code == _NO_RIGHT:
        return DatabaseUnavailable(
            f"{database}: {text}: use a login with this right (operations/README.md, PostgreSQL)"
        )
    if code.startswith(_UNAVAILABLE):
        return DatabaseUnavailable(f"{database}: {text}")
    if code == _RAISED:
        return CallerError(f"{database}: {text}")
    if not code or isinstance(error, InterfaceError):  # the connection was refused, reset, closed or timed out
        return DatabaseUnavailable(f"{database}: {text}")
    return InternalError(f"{database}: {text}")


def _is_missing(code: str, text: str) -> bool:
    """Return whether a part of the memory is missing, as during a restore; names in user queries do not count."""
    if code == "42P10":  # ON CONFLICT needs keys, which a restore creates last
        return True
    if code == "XX000":
        return _DROPPED_MEANWHILE.search(text) is not None
    return code in _MISSING and _OF_THE_MEMORY.search(text) is not None


def refusal(error: Exception) -> str | None:
    """Return the reason why the server can never create a table or view of this definition; None for other errors."""
    fault = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
    code = _code(fault)
    text = _text(fault)
    is_refused = code.startswith(_DEFINITIONS) and not code.startswith(_UNAVAILABLE) and not _is_missing(code, text)
    return text if is_refused else None


def is_missing_table(error: DBAPIError) -> bool:
    """Return whether a named table is missing."""
    return error.orig is not None and _code(error.orig) == "42P01"


def _code(fault: BaseException) -> str:
    """Return the SQLSTATE; empty if the error has none."""
    return getattr(fault, "sqlstate", None) or getattr(fault.__cause__, "sqlstate", None) or ""


_HINTS = {
    "28000": ": correct the user in the URL, or let the server's administrator create or admit it",
    "28P01": ": put the right password into PYCRORM_URL or ~/.pgpass",
    "3D000": ": create it with `createdb`, or correct the URL",
}
"""The next step by SQLSTATE."""


def _text(fault: BaseException) -> str:
    """Return the driver's message in one line, without class names."""
    cause = fault.__cause__ if isinstance(fault.__cause__, asyncpg.PostgresError | OSError) else fault
    if isinstance(cause, ssl.SSLCertVerificationError):
        return f"the server's certificate is not accepted: {cause.verify_message}"
    if isinstance(cause, OSError) and not isinstance(cause, ssl.SSLError) and cause.strerror is not None:
        number = cause.errno or 0  # errors of name look-ups have negative numbers
        hint = ": start the server, or correct the URL" if number == errno.ECONNREFUSED else ""
        return f"cannot be reached: {os.strerror(number) if number > 0 else cause.strerror}{hint}"
    message = " ".join(str(cause).split())
    if isinstance(cause, TimeoutError):
        return message or "no answer in time"
    if isinstance(cause, ConnectionError) and _NO_TLS.search(message):
        return "another program answers at this address, or a PostgreSQL server that does not encrypt: correct the URL"
    return f"{message or type(cause).__name__}{_HINTS.get(_code(fault), '')}"
