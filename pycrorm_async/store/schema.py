"""Recognise, create and migrate the log in a database, without changing a foreign one.

Opening for writing creates a log in an empty database and migrates an older format, in one transaction. Opening for
reading never writes.
"""

from __future__ import annotations

import os
import sqlite3
import stat
from pathlib import Path

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable
from pycrorm_async.settings import FILE_MODES, FileAccess
from pycrorm_async.store.dialect import Birth, Dialect, LogIdentity, Migrations
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.digests.digest_table import create_digest_table
from pycrorm_async.store.sqlite.leftovers import move_leftovers

_HOW_TO_CREATE = "record one with `pycrorm run` or `pycrorm demo`"


async def recognise(connection: AsyncConnection, name: str, migrations: Migrations | None = None) -> str:
    """Return the id of the log in this database. Raises `DatabaseUnavailable` without one, and `DatabaseForeign`."""
    dialect = dialect_of(connection)
    migrations = dialect.migrations if migrations is None else migrations
    identity = await _find_log(dialect, connection, name, len(migrations))
    if identity is None:
        raise DatabaseUnavailable(f"{name} holds no memory yet: {_HOW_TO_CREATE}")
    if identity.format < len(migrations):
        raise DatabaseUnavailable(f"{name} was made by an older version: `pycrorm writer --once` brings it up to date")
    return identity.log_id


async def make_or_migrate(
    engine: AsyncEngine,
    name: str,
    *,
    birth: Birth,
    migrations: Migrations | None = None,
    belongs_to: str | None = None,
) -> str:
    """Create or migrate the log in this database if necessary; return its id.

    With `belongs_to`, the id of the log that should be here, raises `DatabaseUnavailable` instead of creating another.
    """
    dialect = dialect_of(engine)
    migrations = dialect.migrations if migrations is None else migrations
    await dialect.prepare(engine, name)
    async with engine.begin() as connection:
        await dialect.lock_log_changes(connection)
        identity = await _find_log(dialect, connection, name, len(migrations))
        if identity is None and belongs_to is not None:
            raise DatabaseUnavailable(f"{name} {_missing_log(belongs_to)}")
        for statements in migrations[identity.format if identity else 0 :]:
            await dialect.execute_all(connection, statements)
        await create_digest_table(dialect, connection)
        if identity is None:
            await dialect.insert_log(connection, birth, len(migrations))
            return birth.log_id
        if identity.format < len(migrations):
            await dialect.set_format(connection, len(migrations))
        return identity.log_id


def make_file(path: Path, name: str, access: FileAccess, *, belongs_to: str | None = None) -> None:
    """Create an empty file, an empty database for SQLite, unless it exists.

    SQLite creates its side files with the same mode. An existing file keeps its mode. Raises `DatabaseUnavailable`;
    with `belongs_to`, the id of the log whose file should be here, also instead of creating another.

    Creates the file without opening it, because closing a descriptor drops all POSIX locks of the process on that file,
    SQLite's included; another process that closes the database could then delete the write-ahead log in use.
    """
    if sqlite3.sqlite_version_info < (3, 38):
        raise DatabaseUnavailable(f"SQLite 3.38 or newer is needed, this is {sqlite3.sqlite_version}")
    if belongs_to is not None and not path.exists():
        raise DatabaseUnavailable(f"{name} {_missing_log(belongs_to)}")
    try:
        real = Path(os.path.realpath(path))
        if not real.exists():
            move_leftovers(real)
        os.mknod(real, 0o600 | stat.S_IFREG)
        real.chmod(FILE_MODES[access])  # independent of the umask
    except FileExistsError:
        if path.is_dir():
            raise DatabaseUnavailable(f"{name} cannot be opened: Is a directory ({path})") from None
        if not os.access(real, os.W_OK):
            reason = "this user may only read it: record with a user who may write it, or name another file"
            raise DatabaseUnavailable(f"{name} cannot be written: {reason}") from None
    except FileNotFoundError as error:
        reason = f"{error.strerror} ({path}): create the folder {path.parent} first"
        raise DatabaseUnavailable(f"{name} cannot be opened: {reason}") from error
    except OSError as error:
        raise DatabaseUnavailable(f"{name} cannot be opened: {error.strerror} ({path})") from error


def must_exist(path: Path, name: str) -> None:
    """Raise `DatabaseUnavailable` for a missing file, with the command that creates one, and for what is no file."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise DatabaseUnavailable(f"{name} does not exist: {_HOW_TO_CREATE}") from None
    except OSError as error:
        raise DatabaseUnavailable(f"{name} cannot be opened: {error.strerror} ({path})") from error
    if not stat.S_ISREG(mode):
        reason = "Is a directory" if stat.S_ISDIR(mode) else "Is no file"
        raise DatabaseUnavailable(f"{name} cannot be opened: {reason} ({path})")


def _missing_log(log_id: str) -> str:
    return (
        f"holds no memory, and the spool belongs to log {log_id}: restore that log, choose another spool, or"
        " move the spool's records to a new log with `pycrorm spool rebind`"
    )


async def _find_log(dialect: Dialect, connection: AsyncConnection, name: str, format_max: int) -> LogIdentity | None:
    identity = await dialect.find_log(connection, name)
    if identity is not None and identity.format > format_max:
        raise DatabaseForeign(
            f"{name} was made by a newer version: its format is {identity.format}, this version reads {format_max}"
        )
    return identity
