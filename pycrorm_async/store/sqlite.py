"""Implement the log on SQLite: connections, locks, tables, statements and errors."""

# ruff: noqa: S608 - the SQL is composed of column lists only; every value is a parameter

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import AsyncIterator, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from itertools import chain
from pathlib import Path
from types import NoneType
from typing import Any, Final

import msgspec
from sqlalchemy.dialects.sqlite import dialect as make_dialect
from sqlalchemy.exc import DBAPIError
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.bulk_records import make
from pycrorm_async.errors import DamageError, DatabaseForeign, DatabaseUnavailable, PycrormError
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX
from pycrorm_async.store import sqlite_engine
from pycrorm_async.store.dialect import (
    Birth,
    DigestStatements,
    Expected,
    Insertion,
    LogIdentity,
    Migrations,
    Progress,
    RowRefused,
    RowsByTable,
    StoredOn,
)
from pycrorm_async.store.sqlite_engine import BEGIN, USE_WAL, Connection, claim
from pycrorm_async.store.stored import EpisodeRow, Incarnation, Span, StoredEvent

# === tables ===================================================================================================
#
# Define the log's tables on SQLite as numbered migrations; the first N of them create format N.


def _refuse(name: str, change: str, table: str) -> str:
    return (
        f"CREATE TRIGGER {name} BEFORE {change} ON {table} BEGIN"
        f" SELECT RAISE(ABORT, 'the event log is append-only: {table} refuses {change.split()[0]}'); END"
    )


_LOG = """
CREATE TABLE pycrorm_log (
    one INTEGER PRIMARY KEY CHECK (one = 1),
    id TEXT NOT NULL,
    format INTEGER NOT NULL,
    created_wall_ns INTEGER NOT NULL
) STRICT"""

_DECLARATION = """
CREATE TABLE pycrorm_declaration (
    ordinal INTEGER PRIMARY KEY,
    fingerprint TEXT NOT NULL UNIQUE,
    payload TEXT NOT NULL
) STRICT"""

_EPISODE = f"""
CREATE TABLE episode (
    number INTEGER PRIMARY KEY CHECK (number BETWEEN 1 AND {EPISODE_NUMBER_MAX}),
    id TEXT NOT NULL UNIQUE,
    head INTEGER NOT NULL CHECK (head BETWEEN 0 AND {SEQUENCE_MAX}),
    folded INTEGER NOT NULL DEFAULT 0 CHECK (folded BETWEEN 0 AND head),
    started_wall_ns INTEGER NOT NULL,
    ended_wall_ns INTEGER,
    refused TEXT,
    parked TEXT
) STRICT"""

# Each poll reads this index; it contains few rows, whatever the number of episodes.
_BEHIND = "CREATE INDEX episode_behind ON episode (number) WHERE folded < head AND parked IS NULL"
_STOPPED = "CREATE INDEX episode_stopped ON episode (number) WHERE refused IS NOT NULL OR parked IS NOT NULL"

# The table has a rowid, because the rows are too long for WITHOUT ROWID, which appended a third slower.
_EVENT = """
CREATE TABLE event (
    episode INTEGER NOT NULL,
    sequence INTEGER NOT NULL,
    type TEXT NOT NULL,
    version INTEGER NOT NULL,
    wall_ns INTEGER NOT NULL,
    monotonic_ns INTEGER NOT NULL,
    payload TEXT NOT NULL,
    PRIMARY KEY (episode, sequence)
) STRICT"""

_FIRST = (
    _LOG,
    _DECLARATION,
    _EPISODE,
    _BEHIND,
    _STOPPED,
    _EVENT,
    _refuse("event_is_not_updated", "UPDATE", "event"),
    _refuse("event_is_not_deleted", "DELETE", "event"),
    _refuse("declaration_is_not_updated", "UPDATE", "pycrorm_declaration"),
    _refuse("declaration_is_not_deleted", "DELETE", "pycrorm_declaration"),
    _refuse("episode_is_not_renamed", "UPDATE OF number, id", "episode"),
    _refuse("episode_is_not_deleted", "DELETE", "episode"),
    _refuse("log_is_not_renamed", "UPDATE OF id", "pycrorm_log"),
    _refuse("log_is_not_deleted", "DELETE", "pycrorm_log"),
)

MIGRATIONS: tuple[tuple[str, ...], ...] = (_FIRST,)

INCARNATION = """
CREATE TABLE IF NOT EXISTS pycrorm_incarnation (
    number INTEGER PRIMARY KEY,
    noticed_wall_ns INTEGER NOT NULL,
    noticed_by TEXT NOT NULL,
    reason TEXT NOT NULL
) STRICT"""
"""Created when a log is first found to have gone back. Not part of the format: older programs still use the log."""

BLOB = (
    """
CREATE TABLE IF NOT EXISTS pycrorm_blob (
    hash TEXT NOT NULL,
    part INTEGER NOT NULL,
    parts INTEGER NOT NULL,
    media_type TEXT NOT NULL,
    size INTEGER NOT NULL,
    content BLOB NOT NULL,
    PRIMARY KEY (hash, part)
) STRICT""",
    _refuse("IF NOT EXISTS blob_is_not_updated", "UPDATE", "pycrorm_blob"),
    _refuse("IF NOT EXISTS blob_is_not_deleted", "DELETE", "pycrorm_blob"),
)
"""Created with the first blob. Not part of the format: older programs still use the log."""

DIGEST = (
    """
CREATE TABLE IF NOT EXISTS pycrorm_digest (
    episode INTEGER NOT NULL,
    sequence INTEGER NOT NULL,
    digest TEXT NOT NULL,
    PRIMARY KEY (episode, sequence)
) STRICT, WITHOUT ROWID""",
    _refuse("IF NOT EXISTS digest_is_not_updated", "UPDATE", "pycrorm_digest"),
    _refuse("IF NOT EXISTS digest_is_not_deleted", "DELETE", "pycrorm_digest"),
)
"""Created when a log is opened for writing. Not part of the format: older programs still use the log."""

COUNT_TABLES = (
    "SELECT count(*), total(name = 'pycrorm_log') FROM sqlite_master"
    " WHERE type IN ('table', 'view') AND name NOT LIKE 'sqlite\\_%' ESCAPE '\\'"
)
HAS_TABLE = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?"
READ_LOG = "SELECT id, format FROM pycrorm_log"
INSERT_LOG = "INSERT INTO pycrorm_log (one, id, format, created_wall_ns) VALUES (1, ?, ?, ?)"
SET_FORMAT = "UPDATE pycrorm_log SET format = ?"


# === statements ===============================================================================================
#
# Define the log's SQL for SQLite. A batch is one statement per table.
#
# A statement takes a batch as one JSON array or as many rows of VALUES, not row by row: `executemany` releases the
# interpreter lock at every row and waits up to 5 ms to get it back beside a busy plan. Fetching many rows costs the
# same, so events are read as one row per few hundred, with their payloads as one blob. A blob needs no escaping, so the
# payloads keep the bytes of the queue.

# --- append ---------------------------------------------------------------------------------------------------

INSERT_DECLARATIONS = """
INSERT INTO pycrorm_declaration (fingerprint, payload)
SELECT value->>0, value->>1 FROM json_each(?) WHERE true ON CONFLICT (fingerprint) DO NOTHING"""

SELECT_NUMBER_MAX = "SELECT coalesce(max(number), 0) FROM episode"
SELECT_NUMBERS_TAKEN = "SELECT number FROM episode WHERE number IN (SELECT value FROM json_each(?))"

INSERT_INCARNATION = "INSERT INTO pycrorm_incarnation (noticed_wall_ns, noticed_by, reason) VALUES (?, ?, ?)"
SELECT_INCARNATIONS = "SELECT noticed_wall_ns, noticed_by, reason FROM pycrorm_incarnation ORDER BY number"

EVENT_COLUMNS = ("episode", "sequence", "type", "version", "wall_ns", "monotonic_ns", "payload")

UPSERT_EPISODES = """
INSERT INTO episode (number, id, head, started_wall_ns, ended_wall_ns, refused)
SELECT value->>0, value->>1, value->>2, value->>3, value->>4, value->>5 FROM json_each(?) WHERE true
ON CONFLICT (number) DO UPDATE
SET head = excluded.head, ended_wall_ns = excluded.ended_wall_ns, refused = excluded.refused"""

_EVENT_ROW = (
    "event.episode, event.sequence, event.type, event.version, event.wall_ns, event.monotonic_ns,"
    " CAST(event.payload AS BLOB)"
)

SELECT_STORED_AGAIN = f"""
SELECT {_EVENT_ROW} FROM json_each(?) JOIN event ON event.episode = value->>0 AND event.sequence = value->>1"""

_IS_DIGEST = "FROM sqlite_master WHERE type = 'table' AND name = 'pycrorm_digest'"
DIGEST_STATEMENTS = DigestStatements(
    table=DIGEST,
    creatable=f"SELECT count(*) = 0 {_IS_DIGEST}",
    usable=f"SELECT count(*), count(*) {_IS_DIGEST}",
    insert="""
INSERT INTO pycrorm_digest (episode, sequence, digest)
SELECT value->>0, value->>1, value->>2 FROM json_each(?) WHERE true ON CONFLICT DO NOTHING""",
)

# --- read -----------------------------------------------------------------------------------------------------

# A damaged id of one episode, which may not be UTF-8, must not keep the other rows from being read.
_DAMAGED = "episode.id GLOB '*[^ -~]*' OR length(episode.id) <> length(CAST(episode.id AS BLOB))"
_EPISODE_ID = f"CASE WHEN {_DAMAGED} THEN quote(CAST(episode.id AS BLOB)) ELSE episode.id END"
_EPISODE_ROW = f"number, {_EPISODE_ID}, head, folded, started_wall_ns, ended_wall_ns, refused, parked"

SELECT_EPISODES_BY_ID = f"SELECT {_EPISODE_ROW} FROM episode WHERE id IN (SELECT value FROM json_each(?))"
SELECT_EPISODES = f"SELECT {_EPISODE_ROW} FROM episode WHERE number BETWEEN ? AND ? ORDER BY number"
SELECT_BEHIND = f"""
SELECT {_EPISODE_ROW} FROM episode WHERE folded < head AND parked IS NULL AND number > ? ORDER BY number LIMIT ?"""
SELECT_STOPPED = f"SELECT {_EPISODE_ROW} FROM episode WHERE refused IS NOT NULL OR parked IS NOT NULL ORDER BY number"
SELECT_LONG = f"SELECT {_EPISODE_ROW} FROM episode WHERE head >= ? AND ended_wall_ns IS NULL ORDER BY number"

SELECT_EVENTS = f"SELECT {_EVENT_ROW} FROM event WHERE episode = ? AND sequence > ? ORDER BY sequence LIMIT ?"

# Ordered by the primary key, the only usable index. Selects sequence to monotonic_ns and the payload's length.
SELECT_SPAN = """
SELECT json_group_array(json_array(sequence, type, version, wall_ns, monotonic_ns, length(CAST(payload AS BLOB)))),
       CAST(group_concat(payload, '') AS BLOB)
FROM event WHERE episode = ? AND sequence > ? AND sequence <= ?"""

# The prefix of a description's fingerprint is behind the hexadecimal digits, so the index on fingerprints leads to the
# designator types alone, however many descriptions there are; `+` keeps SQLite from a scan in rowid order.
SELECT_DECLARATIONS = "SELECT CAST(payload AS BLOB) FROM pycrorm_declaration WHERE fingerprint < 'g' ORDER BY +ordinal"
SELECT_DESCRIPTIONS = (
    "SELECT CAST(payload AS BLOB) FROM pycrorm_declaration WHERE fingerprint IN (SELECT value FROM json_each(?))"
)

# --- what a projector adds to its own transaction -------------------------------------------------------------

ADVANCE_FOLDED = """
UPDATE episode SET folded = step.folded
FROM (SELECT value->>0 AS number, value->>1 AS before, value->>2 AS folded FROM json_each(?)) AS step
WHERE episode.number = step.number AND episode.folded = step.before"""

PARK = "UPDATE episode SET parked = ? WHERE number = ?"

# --- the planner ----------------------------------------------------------------------------------------------

EXPECT = """
INSERT INTO sqlite_stat1 (tbl, idx, stat) SELECT value->>0, value->>1, value->>2 FROM json_each(?)"""


# === dialect ==================================================================================================
#
# Implement `Dialect` for SQLite; the SQL is in the sections before.


class SQLite:
    """Implements `Dialect`. A batch takes few statements: `executemany` releases the interpreter lock at every row."""

    migrations: Migrations = MIGRATIONS
    blob_table: Sequence[str] = BLOB
    digest_statements = DIGEST_STATEMENTS
    episode_id = _EPISODE_ID
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
        tables_and_logs: Sequence[int] = (await connection.exec_driver_sql(COUNT_TABLES)).one()
        if tables_and_logs[0] == 0:
            return None
        if tables_and_logs[1] == 0:
            raise DatabaseForeign(f"{name} is a database of another program: it has tables but no pycrorm_log")
        return LogIdentity._make((await connection.exec_driver_sql(READ_LOG)).one())

    async def execute_all(self, connection: AsyncConnection, statements: Sequence[str]) -> None:
        await (await _driver(connection)).execute_in_turn((statement, ()) for statement in statements)

    async def insert_log(self, connection: AsyncConnection, birth: Birth, format_now: int) -> None:
        await connection.exec_driver_sql(INSERT_LOG, (birth.log_id, format_now, birth.created_wall_ns))

    async def set_format(self, connection: AsyncConnection, format_now: int) -> None:
        await connection.exec_driver_sql(SET_FORMAT, (format_now,))

    # --- appending ----------------------------------------------------------------------------------------------

    async def insert_declarations(self, connection: AsyncConnection, named: Sequence[tuple[str, str]]) -> None:
        await connection.exec_driver_sql(INSERT_DECLARATIONS, (_json(named),))

    async def episodes_by_id(
        self, connection: AsyncConnection, ids: Sequence[str], *, witness: str | None = None
    ) -> list[EpisodeRow]:
        return await self.heads(connection, ids if witness is None else [*ids, witness])

    async def new_numbers(self, connection: AsyncConnection, count: int, *, above: int = 0) -> list[int]:
        taken = (await connection.exec_driver_sql(SELECT_NUMBER_MAX)).scalar_one()
        first = max(taken, above) + 1
        return list(range(first, first + count))

    async def skip_numbers(self, connection: AsyncConnection, above: int) -> None:
        """Do nothing: SQLite has no sequence; `new_numbers` skips the numbers."""

    async def numbers_taken(self, connection: AsyncConnection, numbers: Sequence[int]) -> set[int]:
        return set((await connection.exec_driver_sql(SELECT_NUMBERS_TAKEN, (_json(numbers),))).scalars())

    async def heads(self, connection: AsyncConnection, ids: Sequence[str]) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_EPISODES_BY_ID, _json(ids))

    async def note_incarnation(self, connection: AsyncConnection, incarnation: Incarnation) -> None:
        await connection.exec_driver_sql(INCARNATION)
        await connection.exec_driver_sql(INSERT_INCARNATION, incarnation)

    async def incarnations(self, connection: AsyncConnection) -> list[Incarnation]:
        if not await self.has_table(connection, "pycrorm_incarnation"):
            return []
        return await _rows(Incarnation, connection, SELECT_INCARNATIONS)

    async def stored_on(self, connection: AsyncConnection) -> StoredOn:  # noqa: ARG002
        return StoredOn(1)

    async def event_insertion(self, rows: Iterator[tuple[Any, ...]]) -> Insertion:
        return await self.insertion({("event", EVENT_COLUMNS): list(rows)})

    async def insert_events(self, connection: AsyncConnection, insertion: Insertion) -> None:
        await (await _driver(connection)).execute_in_turn(insertion)

    async def upsert_episodes(self, connection: AsyncConnection, episodes: Sequence[EpisodeRow]) -> None:
        await connection.exec_driver_sql(UPSERT_EPISODES, (_json([_columns(each) for each in episodes]),))

    async def force_durable_commit(self, connection: AsyncConnection) -> None:
        """Do nothing: another transaction's changes are on the disk before this one sees them."""

    async def commit(self, connection: AsyncConnection) -> None:
        await connection.commit()

    async def events_by_key(self, connection: AsyncConnection, keys: Sequence[tuple[int, int]]) -> list[StoredEvent]:
        return await _rows(StoredEvent, connection, SELECT_STORED_AGAIN, _json(keys))

    # --- reading ------------------------------------------------------------------------------------------------

    async def episode(self, connection: AsyncConnection, identity: str) -> EpisodeRow | None:
        return next(iter(await self.episodes_by_id(connection, [identity])), None)

    async def episodes(self, connection: AsyncConnection, first: int, last: int) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_EPISODES, first, last)

    async def behind(self, connection: AsyncConnection, *, after: int, limit: int) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_BEHIND, after, limit)

    async def stopped(self, connection: AsyncConnection) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_STOPPED)

    async def last_number(self, connection: AsyncConnection) -> int:
        return int((await connection.exec_driver_sql(SELECT_NUMBER_MAX)).scalar_one())

    async def long_episodes(self, connection: AsyncConnection, events_min: int) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_LONG, events_min)

    async def events(self, connection: AsyncConnection, number: int, *, after: int, limit: int) -> list[StoredEvent]:
        return await _rows(StoredEvent, connection, SELECT_EVENTS, number, after, limit)

    async def spans(self, connection: AsyncConnection, spans: Sequence[Span]) -> list[StoredEvent]:
        driver = await _driver(connection)
        parts = [part for span in spans for part in _parts_of(span, _EVENTS_AT_ONCE)]
        try:
            rows = await driver.rows_in_turn(SELECT_SPAN, parts)
        except sqlite3.DataError:  # together too large for one SQLite value
            parts = [part for span in spans for part in _parts_of(span, 1)]
            rows = await driver.rows_in_turn(SELECT_SPAN, parts)
        events: list[StoredEvent] = []
        for part, row in zip(parts, rows, strict=True):
            events += _events(part.number, *row)
        return events

    async def declarations(self, connection: AsyncConnection) -> list[bytes]:
        return [bytes(row[0]) for row in await connection.exec_driver_sql(SELECT_DECLARATIONS)]

    async def descriptions(self, connection: AsyncConnection, fingerprints: Sequence[str]) -> list[bytes]:
        wanted = _json(fingerprints)
        return [bytes(row[0]) for row in await connection.exec_driver_sql(SELECT_DESCRIPTIONS, (wanted,))]

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
        return (await connection.exec_driver_sql(ADVANCE_FOLDED, (_json(steps),))).rowcount

    async def park(self, connection: AsyncConnection, number: int, reason: str | None) -> None:
        await connection.exec_driver_sql(PARK, (reason, number))

    # --- tables and views ---------------------------------------------------------------------------------------

    async def make_place(self, connection: AsyncConnection) -> None:
        """Do nothing: tables and views are in the same file."""

    async def has_table(self, connection: AsyncConnection, name: str, *, to_change: bool = False) -> bool:  # noqa: ARG002
        return (await connection.exec_driver_sql(HAS_TABLE, (name,))).first() is not None

    async def expect(self, connection: AsyncConnection, tables: Sequence[Expected]) -> None:
        # Counting the rows would hold the write lock all that time. Without statistics the planner assumes equal sizes:
        # a query by status began with all nodes and took four times as long.
        await connection.exec_driver_sql(f"ANALYZE {_quote(tables[0].table)}")  # creates the planner's table
        rows: list[tuple[str, str | None, str]] = [(each.table, None, str(each.rows)) for each in tables]
        for each in tables:
            rows += [
                (each.table, index, " ".join(map(str, (each.rows, *alike)))) for index, alike in each.alike.items()
            ]
        await connection.exec_driver_sql(EXPECT, (_json(rows),))

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
        some = f"SELECT rowid FROM {quoted} LIMIT {rows_max}"
        deleted = await connection.exec_driver_sql(f"DELETE FROM {quoted} WHERE rowid IN ({some})")
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
        update = f"UPDATE {table} SET {changes} FROM (VALUES "
        of = f") AS change WHERE {table}.id = change.column1"
        statements = ((update + values + of, parameters) for values, parameters in bound(rows, len(columns)))
        with _rows_refused():
            await (await _driver(connection)).execute_in_turn(statements)

    # --- faults -------------------------------------------------------------------------------------------------

    def refusal(self, error: Exception) -> str | None:
        return sqlite_engine.refusal(error.orig if isinstance(error, DBAPIError) else error)

    def translate_error(self, error: Exception, name: str) -> PycrormError:
        return sqlite_engine.translate_error(error.orig if isinstance(error, DBAPIError) else error, name)


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


# === multi row insert =========================================================================================
#
# Insert or update many rows in few statements: generate VALUES lists and their parameters.

_PARAMETERS_MAX: Final = 8_000
"""Bounds the parameters of a statement. SQLite allows 32,766 but is a third slower with that many; with fewer, the
writer waits for a busy plan more often."""
_SHAPED_ROWS: Final = 64
"""Rows from which a statement with its own VALUES shape pays off."""
_NOTHING: Final = bytearray()
"""The value bound in place of None, which NULLIF restores."""


def inserts(table: str, columns: Sequence[str], rows: Sequence[tuple[Any, ...]]) -> Iterator[tuple[str, Any]]:
    """Generate the statements that insert these rows, with their parameters."""
    into = f"INSERT INTO {table} ({', '.join(columns)}) VALUES "
    return ((into + values, parameters) for values, parameters in bound(rows, len(columns)))


def bound(rows: Sequence[tuple[Any, ...]], columns: int) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Generate VALUES lists and their parameters, some rows at a time. No value may be a blob."""
    for part in _parts(rows, columns):
        marks, values_rows = (
            _shaped(part) if len(part) >= _SHAPED_ROWS and _is_worth_shaping(part[0]) else (["?"] * columns, part)
        )
        yield ", ".join([f"({', '.join(marks)})"] * len(part)), tuple(chain.from_iterable(values_rows))


def _parts(rows: Sequence[tuple[Any, ...]], columns: int) -> Iterator[Sequence[tuple[Any, ...]]]:
    """Split rows into powers of two, so that few statements differ: compiling one takes longer than running it."""
    size, start = 1 << (_PARAMETERS_MAX // columns).bit_length() - 1, 0
    while start < len(rows):
        while size > len(rows) - start:
            size //= 2
        yield rows[start : start + size]
        start += size


def _is_worth_shaping(row: Sequence[Any]) -> bool:
    """Return whether rows like this one, with many None or booleans, gain from a shape of their own."""
    return sum(each is None or each is True or each is False for each in row) > 2


def _shaped(rows: Sequence[tuple[Any, ...]]) -> tuple[list[str], Iterable[tuple[Any, ...]]]:
    """Return the expression for each column in VALUES, and the rows of the values to bind.

    Binding None or a boolean takes 0.28 µs, because the driver looks for an adapter; a number takes 0.04 µs, and NULLIF
    of an empty blob 0.12 µs. Half of a node's row is None.
    """
    marks: list[str] = []
    columns: list[Sequence[Any]] = []
    for column in zip(*rows, strict=True):
        kinds = {int} if all(column) and column[0] is not True else set(map(type, column))
        if kinds == {NoneType}:
            marks.append("NULL")
            continue
        values: Sequence[Any] = column
        if bool in kinds:
            values = [int(each) if each is True or each is False else each for each in values]
        if NoneType in kinds:
            values = [_NOTHING if each is None else each for each in values]
        marks.append("NULLIF(?, x'')" if NoneType in kinds else "?")
        columns.append(values)
    return marks, zip(*columns, strict=True)
