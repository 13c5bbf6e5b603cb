"""Is there a log, is it ours, is it of this version: looked at before anything is changed.

Opened for writing, a missing file or an empty database becomes a log and an older format is brought up to date, both in
one transaction. Opened for reading, nothing is written whatever is found.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable
from pycrorm_async.store.sqlite import tables as sql
from pycrorm_async.store.sqlite.engine import BEGIN

__all__ = ["Birth", "make_or_migrate", "recognise", "make_file", "must_exist", "MIGRATIONS"]

MIGRATIONS = sql.MIGRATIONS

_HOW_TO_MAKE_ONE = "record one with `pycrorm run` or `pycrorm demo`"

_Migrations = Sequence[Sequence[str]]


class Birth(NamedTuple):
    """What a log gets when it is made: its id, a UUID as text, and the time."""

    log_id: str
    created_wall_ns: int


class _Found(NamedTuple):
    log_id: str
    format: int


async def recognise(connection: AsyncConnection, name: str, migrations: _Migrations = MIGRATIONS) -> str:
    """The id of the log in this database. Raises `DatabaseUnavailable` without one, `DatabaseForeign` if not ours."""
    found = await _look(connection, name, len(migrations))
    if found is None:
        raise DatabaseUnavailable(f"{name} holds no memory yet: {_HOW_TO_MAKE_ONE}")
    if found.format < len(migrations):
        raise DatabaseUnavailable(f"{name} was made by an older version: `pycrorm writer --once` brings it up to date")
    return found.log_id


async def make_or_migrate(engine: AsyncEngine, name: str, *, birth: Birth, migrations: _Migrations = MIGRATIONS) -> str:
    """The id of the log in this database, which is made or brought up to date if need be."""
    async with engine.connect() as connection:
        # Not before the database is known to be ours or empty: the journal mode is a lasting change of the file.
        await connection.execution_options(**{BEGIN: None})
        await _look(connection, name, len(migrations))
        mode = (await connection.exec_driver_sql(sql.USE_WAL)).scalar_one()
        if mode != "wal":
            raise DatabaseUnavailable(f"{name}: SQLite cannot keep a write-ahead log there (a network folder?)")
    async with engine.begin() as connection:
        found = await _look(connection, name, len(migrations))
        for statements in migrations[found.format if found else 0 :]:
            for statement in statements:
                await connection.exec_driver_sql(statement)
        if found is None:
            await connection.exec_driver_sql(sql.INSERT_LOG, (birth.log_id, len(migrations), birth.created_wall_ns))
            return birth.log_id
        if found.format < len(migrations):
            await connection.exec_driver_sql(sql.SET_FORMAT, (len(migrations),))
        return found.log_id


def make_file(path: Path, name: str) -> None:
    """Makes an empty file if there is none, which SQLite takes for an empty database."""
    if sqlite3.sqlite_version_info < (3, 38):
        raise DatabaseUnavailable(f"SQLite 3.38 or newer is needed, this is {sqlite3.sqlite_version}")
    try:
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666))
    except OSError as error:
        raise DatabaseUnavailable(f"{name} cannot be opened: {error.strerror} ({path})") from error


def must_exist(path: Path, name: str) -> None:
    """Says how to make a database where there is none."""
    if not path.is_file():
        raise DatabaseUnavailable(f"{name} does not exist: {_HOW_TO_MAKE_ONE}")


async def _look(connection: AsyncConnection, name: str, format_known: int) -> _Found | None:
    tables = set((await connection.exec_driver_sql(sql.TABLE_NAMES)).scalars())
    if not tables:
        return None
    if "pycrorm_log" not in tables:
        raise DatabaseForeign(f"{name} is a database of another program: it has tables but no pycrorm_log")
    found = _Found._make((await connection.exec_driver_sql(sql.READ_LOG)).one())
    if found.format > format_known:
        raise DatabaseForeign(
            f"{name} was made by a newer version: its format is {found.format}, this version knows {format_known}"
        )
    return found
