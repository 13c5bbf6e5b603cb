"""Is there a log, is it ours, is it of this version: looked at before anything is changed.

Opened for writing, an empty database becomes a log and an older format is brought up to date, in one transaction.
Opened for reading, nothing is written whatever is found.
"""

from __future__ import annotations

import os
import sqlite3
import stat
from pathlib import Path

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable
from pycrorm_async.settings import FILE_MODES, FileAccess
from pycrorm_async.store.dialect import Birth, Dialect, Found, Migrations
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.sqlite.leftovers import move_leftovers

__all__ = ["Birth", "make_or_migrate", "recognise", "make_file", "must_exist"]

_HOW_TO_MAKE_ONE = "record one with `pycrorm run` or `pycrorm demo`"


async def recognise(connection: AsyncConnection, name: str, migrations: Migrations | None = None) -> str:
    """The id of the log in this database. Raises `DatabaseUnavailable` without one, `DatabaseForeign` if not ours."""
    dialect = dialect_of(connection)
    migrations = dialect.migrations if migrations is None else migrations
    found = await _look(dialect, connection, name, len(migrations))
    if found is None:
        raise DatabaseUnavailable(f"{name} holds no memory yet: {_HOW_TO_MAKE_ONE}")
    if found.format < len(migrations):
        raise DatabaseUnavailable(f"{name} was made by an older version: `pycrorm writer --once` brings it up to date")
    return found.log_id


async def make_or_migrate(
    engine: AsyncEngine,
    name: str,
    *,
    birth: Birth,
    migrations: Migrations | None = None,
    belongs_to: str | None = None,
) -> str:
    """The id of the log in this database, which is made or brought up to date if need be.

    Raises `DatabaseUnavailable` instead of making one where the log `belongs_to` should be.
    """
    dialect = dialect_of(engine)
    migrations = dialect.migrations if migrations is None else migrations
    await dialect.prepare(engine, name)
    async with engine.begin() as connection:
        await dialect.alone(connection)
        found = await _look(dialect, connection, name, len(migrations))
        if found is None and belongs_to is not None:
            raise DatabaseUnavailable(f"{name} {_gone(belongs_to)}")
        for statements in migrations[found.format if found else 0 :]:
            await dialect.execute_all(connection, statements)
        if found is None:
            await dialect.note_birth(connection, birth, len(migrations))
            return birth.log_id
        if found.format < len(migrations):
            await dialect.note_format(connection, len(migrations))
        return found.log_id


def make_file(path: Path, name: str, access: FileAccess, *, belongs_to: str | None = None) -> None:
    """Makes an empty file if there is none, which SQLite takes for an empty database.

    SQLite gives the files that it makes beside it the same mode. An existing file keeps its own. Raises
    `DatabaseUnavailable` instead of making one where the file of the log `belongs_to` should be.

    Without opening it: whoever closes a file takes from his whole process the locks that SQLite has on it, and then
    another process that closes the database deletes the write-ahead log that this one goes on writing into.
    """
    if sqlite3.sqlite_version_info < (3, 38):
        raise DatabaseUnavailable(f"SQLite 3.38 or newer is needed, this is {sqlite3.sqlite_version}")
    if belongs_to is not None and not path.exists():
        raise DatabaseUnavailable(f"{name} {_gone(belongs_to)}")
    try:
        real = Path(os.path.realpath(path))
        if not real.exists():
            move_leftovers(real)
        os.mknod(real, 0o600 | stat.S_IFREG)
        real.chmod(FILE_MODES[access])  # whatever the umask took off
    except FileExistsError:
        if path.is_dir():
            raise DatabaseUnavailable(f"{name} cannot be opened: Is a directory ({path})") from None
    except OSError as error:
        raise DatabaseUnavailable(f"{name} cannot be opened: {error.strerror} ({path})") from error


def must_exist(path: Path, name: str) -> None:
    """Says how to make a database where there is none."""
    if not path.is_file():
        raise DatabaseUnavailable(f"{name} does not exist: {_HOW_TO_MAKE_ONE}")


def _gone(log_id: str) -> str:
    return (
        f"holds no memory, and the spool belongs to log {log_id}: restore that log, choose another spool, or"
        " store what it holds in a new one with `pycrorm spool rebind`"
    )


async def _look(dialect: Dialect, connection: AsyncConnection, name: str, format_known: int) -> Found | None:
    found = await dialect.look(connection, name)
    if found is not None and found.format > format_known:
        raise DatabaseForeign(
            f"{name} was made by a newer version: its format is {found.format}, this version knows {format_known}"
        )
    return found
