"""Implement `Dialect` for SQLite; the SQL is in `statements` and `tables`."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import AsyncIterator, Collection, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy.dialects.sqlite import dialect as make_dialect
from sqlalchemy.exc import DBAPIError
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.bulk_records import make
from pycrorm_async.errors import DamageError, DatabaseForeign, DatabaseUnavailable, PycrormError
from pycrorm_async.store.dialect import (
    Birth,
    Expected,
    Insertion,
    LogIdentity,
    Migrations,
    Progress,
    RowRefused,
    RowsByTable,
    StoredOn,
)
from pycrorm_async.store.sqlite import errors, tables
from pycrorm_async.store.sqlite import statements as sql
from pycrorm_async.store.sqlite.engine import BEGIN, USE_WAL, Connection
from pycrorm_async.store.sqlite.multi_row_insert import bound, inserts
from pycrorm_async.store.sqlite.rebuild_lock import claim
from pycrorm_async.store.stored import EpisodeRow, Incarnation, Span, StoredEvent, numbers_reserved


class SQLite:
    """Implements `Dialect`. A batch takes few statements: `executemany` releases the interpreter lock at every row."""

    migrations: Migrations = tables.MIGRATIONS
    blob_table: Sequence[str] = tables.BLOB
    digest_statements = sql.DIGEST_STATEMENTS
    faults: tuple[type[Exception], ...] = (
        DBAPIError,
        sqlite3.Error,
        UnicodeDecodeError,
    )  # UnicodeDecodeError: a name in a damaged file

    # --- finding and creating a log ---------------------------------------------------------------------------------

    async def prepare(self, engine: AsyncEngine, name: str) -> None:
        async with engine.connect() as connection:
            # First check that the database is ours or empty: setting the journal mode changes the file permanently.
            await connection.execution_options(**{BEGIN: None})
            await self.find_log(connection, name)
            mode = (await connection.exec_driver_sql(USE_WAL)).scalar_one()
            if mode != "wal":
                raise DatabaseUnavailable(f"{name}: SQLite cannot keep a write-ahead log existing (a network folder?)")

    async def lock_log_changes(self, connection: AsyncConnection) -> None:
        """Do nothing: a writing transaction holds the write lock from its beginning."""

    async def find_log(self, connection: AsyncConnection, name: str) -> LogIdentity | None:
        tables_and_logs: Sequence[int] = (await connection.exec_driver_sql(tables.COUNT_TABLES)).one()
        if tables_and_logs[0] == 0:
            return None
        if tables_and_logs[1] == 0:
            raise DatabaseForeign(f"{name} is a database of another program: it has tables but no pycrorm_log")
        return LogIdentity._make((await connection.exec_driver_sql(tables.READ_LOG)).one())

    async def execute_all(self, connection: AsyncConnection, statements: Sequence[str]) -> None:
        await (await _driver(connection)).execute_in_turn((statement, ()) for statement in statements)

    async def insert_log(self, connection: AsyncConnection, birth: Birth, format_now: int) -> None:
        await connection.exec_driver_sql(tables.INSERT_LOG, (birth.log_id, format_now, birth.created_wall_ns))

    async def set_format(self, connection: AsyncConnection, format_now: int) -> None:
        await connection.exec_driver_sql(tables.SET_FORMAT, (format_now,))

    # --- appending ----------------------------------------------------------------------------------------------

    async def insert_declarations(self, connection: AsyncConnection, named: Sequence[tuple[str, str]]) -> None:
        await connection.exec_driver_sql(sql.INSERT_DECLARATIONS, (_json(named),))

    async def episodes_by_id(
        self, connection: AsyncConnection, ids: Sequence[str], *, witness: str | None = None
    ) -> list[EpisodeRow]:
        return await self.heads(connection, ids if witness is None else [*ids, witness])

    async def new_numbers(self, connection: AsyncConnection, count: int, *, above: int = 0) -> list[int]:
        taken = (await connection.exec_driver_sql(sql.SELECT_NUMBER_MAX)).scalar_one()
        if taken < above:
            taken = above + numbers_reserved(above)
        return list(range(taken + 1, taken + 1 + count))

    async def skip_numbers(self, connection: AsyncConnection, above: int) -> None:
        """Do nothing: SQLite has no sequence; `new_numbers` skips the numbers."""

    async def numbers_taken(self, connection: AsyncConnection, numbers: Sequence[int]) -> set[int]:
        return set((await connection.exec_driver_sql(sql.SELECT_NUMBERS_TAKEN, (_json(numbers),))).scalars())

    async def heads(self, connection: AsyncConnection, ids: Sequence[str]) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, sql.SELECT_EPISODES_BY_ID, _json(ids))

    async def note_incarnation(self, connection: AsyncConnection, incarnation: Incarnation) -> None:
        await connection.exec_driver_sql(tables.INCARNATION)
        await connection.exec_driver_sql(sql.INSERT_INCARNATION, incarnation)

    async def incarnations(self, connection: AsyncConnection) -> list[Incarnation]:
        if not await self.has_table(connection, "pycrorm_incarnation"):
            return []
        return await _rows(Incarnation, connection, sql.SELECT_INCARNATIONS)

    async def stored_on(self, connection: AsyncConnection) -> StoredOn:  # noqa: ARG002
        return StoredOn(1)

    async def event_insertion(self, rows: Iterator[tuple[Any, ...]]) -> Insertion:
        return await self.insertion({("event", sql.EVENT_COLUMNS): list(rows)})

    async def insert_events(self, connection: AsyncConnection, insertion: Insertion) -> None:
        await (await _driver(connection)).execute_in_turn(insertion)

    async def upsert_episodes(self, connection: AsyncConnection, episodes: Sequence[EpisodeRow]) -> None:
        await connection.exec_driver_sql(sql.UPSERT_EPISODES, (_json([_columns(each) for each in episodes]),))

    async def force_durable_commit(self, connection: AsyncConnection) -> None:
        """Do nothing: another transaction's changes are on the disk before this one sees them."""

    async def commit(self, connection: AsyncConnection) -> None:
        await connection.commit()

    async def events_by_key(self, connection: AsyncConnection, keys: Sequence[tuple[int, int]]) -> list[StoredEvent]:
        return await _rows(StoredEvent, connection, sql.SELECT_STORED_AGAIN, _json(keys))

    # --- reading ------------------------------------------------------------------------------------------------

    async def episode(self, connection: AsyncConnection, identity: str) -> EpisodeRow | None:
        return next(iter(await self.episodes_by_id(connection, [identity])), None)

    async def episodes(self, connection: AsyncConnection) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, sql.SELECT_EPISODES)

    async def behind(self, connection: AsyncConnection, *, after: int, limit: int) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, sql.SELECT_BEHIND, after, limit)

    async def stopped(self, connection: AsyncConnection) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, sql.SELECT_STOPPED)

    async def last_number(self, connection: AsyncConnection) -> int:
        return int((await connection.exec_driver_sql(sql.SELECT_NUMBER_MAX)).scalar_one())

    async def long_episodes(self, connection: AsyncConnection, events_min: int) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, sql.SELECT_LONG, events_min)

    async def events(self, connection: AsyncConnection, number: int, *, after: int, limit: int) -> list[StoredEvent]:
        return await _rows(StoredEvent, connection, sql.SELECT_EVENTS, number, after, limit)

    async def spans(self, connection: AsyncConnection, spans: Sequence[Span]) -> list[StoredEvent]:
        driver = await _driver(connection)
        parts = [part for span in spans for part in _parts_of(span, _EVENTS_AT_ONCE)]
        try:
            rows = await driver.rows_in_turn(sql.SELECT_SPAN, parts)
        except sqlite3.DataError:  # together too large for one SQLite value
            parts = [part for span in spans for part in _parts_of(span, 1)]
            rows = await driver.rows_in_turn(sql.SELECT_SPAN, parts)
        events: list[StoredEvent] = []
        for part, row in zip(parts, rows, strict=True):
            events += _events(part.number, *row)
        return events

    async def declarations(self, connection: AsyncConnection) -> list[bytes]:
        return [bytes(row[0]) for row in await connection.exec_driver_sql(sql.SELECT_DECLARATIONS)]

    async def descriptions(self, connection: AsyncConnection, fingerprints: Sequence[str]) -> list[bytes]:
        wanted = _json(fingerprints)
        return [bytes(row[0]) for row in await connection.exec_driver_sql(sql.SELECT_DESCRIPTIONS, (wanted,))]

    async def begin_snapshot(self, connection: AsyncConnection) -> None:
        """Do nothing: a transaction is a snapshot."""

    async def keep(self, connection: AsyncConnection, tables: Sequence[str]) -> bool:  # the snapshot protects them
        existing = (await connection.exec_driver_sql("SELECT name FROM sqlite_master WHERE type = 'table'")).scalars()
        return set(tables) <= set(existing)

    async def faults_of_file(self, connection: AsyncConnection) -> list[str]:
        rows = list((await connection.exec_driver_sql("PRAGMA integrity_check")).scalars())
        return [] if rows == ["ok"] else rows

    # --- folding ------------------------------------------------------------------------------------------------

    async def advance_folded(self, connection: AsyncConnection, steps: Sequence[Progress]) -> int:
        return (await connection.exec_driver_sql(sql.ADVANCE_FOLDED, (_json(steps),))).rowcount

    async def park(self, connection: AsyncConnection, number: int, reason: str | None) -> None:
        await connection.exec_driver_sql(sql.PARK, (reason, number))

    # --- tables and views ---------------------------------------------------------------------------------------

    async def make_place(self, connection: AsyncConnection) -> None:
        """Do nothing: tables and views are in the same file."""

    async def has_table(self, connection: AsyncConnection, name: str) -> bool:
        return (await connection.exec_driver_sql(tables.HAS_TABLE, (name,))).first() is not None

    async def expect(self, connection: AsyncConnection, tables: Sequence[Expected]) -> None:
        # Counting the rows would hold the write lock all that time. Without statistics the planner assumes equal sizes:
        # a query by status began with all nodes and took four times as long.
        await connection.exec_driver_sql(f"ANALYZE {_quote(tables[0].table)}")  # creates the planner's table
        rows: list[tuple[str, str | None, str]] = [(each.table, None, str(each.rows)) for each in tables]
        for each in tables:
            rows += [
                (each.table, index, " ".join(map(str, (each.rows, *alike)))) for index, alike in each.alike.items()
            ]
        await connection.exec_driver_sql(sql.EXPECT, (_json(rows),))

    async def gather_statistics(self, connection: AsyncConnection, tables: Sequence[str]) -> None:
        """Do nothing: `expect` has given the planner estimates, and counting would hold the write lock."""

    def stored_column(self, name: str) -> str:
        return name

    async def add_column(self, connection: AsyncConnection, table: str, definition: str) -> None:
        await connection.exec_driver_sql(f"ALTER TABLE {_quote(table)} ADD COLUMN {definition}")

    async def only_views(self, connection: AsyncConnection, views: Collection[str]) -> None:
        """Do nothing: foreign objects do not hinder `replace_views`."""

    async def replace_views(
        self, connection: AsyncConnection, before: Mapping[str, str], after: Mapping[str, str]
    ) -> None:
        drops = [f"DROP VIEW {_quote(name)}" for name, text in before.items() if after.get(name) != text]
        changed = ((name, text) for name, text in after.items() if before.get(name) != text)
        await self.execute_all(
            connection, [*drops, *(f"CREATE VIEW {_quote(name)} AS {text}" for name, text in changed)]
        )

    async def comment_views(self, connection: AsyncConnection, comments: Mapping[str, Mapping[str, str]]) -> None:
        """Do nothing: SQLite keeps no comments."""

    async def sweep(self, connection: AsyncConnection) -> None:
        """Do nothing: replaced views are dropped at once; readers have a snapshot."""

    async def empty(self, connection: AsyncConnection, table: str, *, rows_max: int) -> bool:
        # Dropping a full table would hold the only write lock for seconds.
        quoted = _quote(table)
        some = f"SELECT rowid FROM {quoted} LIMIT {rows_max}"  # noqa: S608
        deleted = await connection.exec_driver_sql(f"DELETE FROM {quoted} WHERE rowid IN ({some})")  # noqa: S608
        return deleted.rowcount == rows_max

    async def drop(self, connection: AsyncConnection, table: str) -> None:
        await connection.exec_driver_sql(f"DROP TABLE IF EXISTS {_quote(table)}")

    @asynccontextmanager
    async def claim(self, engine: AsyncEngine) -> AsyncIterator[bool]:
        with claim(Path(engine.url.database or "")) as claimed:
            yield claimed

    async def shadow_views(self, connection: AsyncConnection, views: Mapping[str, str]) -> None:
        creations = [f"CREATE TEMP VIEW {_quote(name)} AS {text}" for name, text in views.items()]
        await self.execute_all(connection, creations)

    async def insertion(self, rows: RowsByTable) -> Insertion:
        insertions = []
        for (table, columns), some in rows.items():
            for statement in inserts(_quote(table), [*map(_quote, columns)], some):
                insertions.append(statement)
                await asyncio.sleep(0)
        return insertions

    async def insert(self, connection: AsyncConnection, insertion: Insertion) -> None:
        with _rows_refused():
            await (await _driver(connection)).execute_in_turn(insertion)

    async def update_rows(
        self, connection: AsyncConnection, table: str, columns: Mapping[str, str], rows: Sequence[tuple[Any, ...]]
    ) -> None:
        names = list(columns)[1:]
        changes = ", ".join(f"{column} = change.column{index}" for index, column in enumerate(names, 2))
        update = f"UPDATE {table} SET {changes} FROM (VALUES "  # noqa: S608
        of = f") AS change WHERE {table}.id = change.column1"
        statements = ((update + values + of, parameters) for values, parameters in bound(rows, len(columns)))
        with _rows_refused():
            await (await _driver(connection)).execute_in_turn(statements)

    # --- faults -------------------------------------------------------------------------------------------------

    def refusal(self, error: Exception) -> str | None:
        return errors.refusal(error.orig if isinstance(error, DBAPIError) else error)

    def translate_error(self, error: Exception, name: str) -> PycrormError:
        return errors.translate_error(error.orig if isinstance(error, DBAPIError) else error, name)


_quote = make_dialect().identifier_preparer.quote
_EVENTS_AT_ONCE = 250
"""Bounds the events read as one row, and so the size of its payloads value."""
_HEADS = msgspec.json.Decoder(list[tuple[int, str, int, int, int, int]])


def _parts_of(span: Span, events_max: int) -> Iterator[Span]:
    for after in range(span.after, span.last, events_max):
        yield Span(span.number, after, min(after + events_max, span.last))


def _events(number: int, heads: str, payloads: bytes | None) -> list[StoredEvent]:
    try:
        rows = _HEADS.decode(heads)
    except msgspec.DecodeError as error:
        raise DamageError(f"events of episode {number} are damaged: {error}") from None
    end = 0
    payloads = payloads or b""  # NULL for no events, and for empty payloads only
    events: list[StoredEvent] = []
    for sequence, type_name, version, wall_ns, monotonic_ns, length in rows:
        start, end = end, end + length
        values = (number, sequence, type_name, version, wall_ns, monotonic_ns, payloads[start:end])
        events.append(make(StoredEvent, values))
    return events


async def _driver(connection: AsyncConnection) -> Connection:
    """Return the driver's connection, to run many statements in one visit to its thread; begin a transaction."""
    if not connection.in_transaction():
        await connection.begin()
    driver = (await connection.get_raw_connection()).driver_connection
    assert isinstance(driver, Connection)
    return driver


@contextmanager
def _rows_refused() -> Iterator[None]:
    try:
        yield
    except (sqlite3.DataError, sqlite3.IntegrityError, OverflowError) as error:
        raise RowRefused(str(error)) from error


async def _rows(kind: Any, connection: AsyncConnection, statement: str, *parameters: Any) -> list[Any]:
    return [make(kind, row) for row in await connection.exec_driver_sql(statement, parameters)]


def _columns(row: EpisodeRow) -> tuple[Any, ...]:
    return row.number, row.id, row.head, row.started_wall_ns, row.ended_wall_ns, row.refused


def _json(rows: Any) -> str:
    return msgspec.json.encode(rows).decode()
