"""Implement the log on SQLite: its triggers, statements of its own, and locks.

A statement takes a batch as one JSON array or as many rows of VALUES, not row by row: `executemany` releases the
interpreter lock at every row and waits up to 5 ms to get it back beside a busy plan. Fetching many rows costs the same,
so events are read as one row per few hundred, with their payloads as one blob. A blob needs no escaping, so the
payloads keep the bytes of the queue.
"""

# ruff: noqa: S608 - the SQL is composed of names only; every value is a parameter

import asyncio
import sqlite3
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar

import msgspec
from sqlalchemy import CheckConstraint, DefaultClause, Select, Table
from sqlalchemy.dialects.sqlite.aiosqlite import SQLiteDialect_aiosqlite
from sqlalchemy.exc import DBAPIError
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async import core
from pycrorm_async.bulk_records import make
from pycrorm_async.errors import DamageError, DatabaseForeign, DatabaseUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, EPISODE_NUMBER_MAX_0_1
from pycrorm_async.store import dialect, schema, sqlite_engine
from pycrorm_async.store.dialect import MADE
from pycrorm_async.store.sqlite_engine import BEGIN, USE_WAL, StoppableConnection, claim
from pycrorm_async.store.stored import Span, StoredEvent

_COUNT_TABLES: Final = (
    "SELECT count(*), total(name = 'pycrorm_log') FROM sqlite_master"
    " WHERE type IN ('table', 'view') AND name NOT LIKE 'sqlite\\_%' ESCAPE '\\'"
)
_CHECK: Final = "number BETWEEN 1 AND "
_COLUMNS: Final = """
SELECT t.name, c.name FROM sqlite_master AS t JOIN pragma_table_info(t.name) AS c WHERE t.type = 'table'"""
# Ordered by the primary key, the only usable index. Selects sequence to monotonic_ns and the payload's length.
SELECT_SPAN: Final = """
SELECT json_group_array(json_array(sequence, type, version, wall_ns, monotonic_ns, length(CAST(payload AS BLOB)))),
       CAST(group_concat(payload, '') AS BLOB)
FROM event WHERE episode = ? AND sequence > ? AND sequence <= ?"""


class SQLite(dialect.Dialect):
    """Implements `Dialect`. A writing transaction holds the only write lock from its beginning."""

    syntax = SQLiteDialect_aiosqlite()
    episode_id = schema.VALID_ID["sqlite"]
    # The prefix of a description's fingerprint is behind the hexadecimal digits, so the index on fingerprints leads to
    # the designator types alone, however many descriptions there are.
    select_declarations: ClassVar[Select[Any]] = schema.select_declarations("fingerprint < 'g'")
    has_former_numbers = (
        f"SELECT instr(sql, '{_CHECK}{EPISODE_NUMBER_MAX_0_1})'), 1 FROM sqlite_master"
        " WHERE type = 'table' AND name = 'episode'"
    )
    # A CHECK can only be changed in the text of the table. Making a view shows other connections that it has changed.
    permit_numbers = (
        "PRAGMA writable_schema = ON",
        f"""UPDATE sqlite_master SET sql = replace(sql, '{_CHECK}{EPISODE_NUMBER_MAX_0_1})',
            '{_CHECK}{EPISODE_NUMBER_MAX})') WHERE type = 'table' AND name = 'episode'""",
        "PRAGMA writable_schema = RESET",
        "CREATE VIEW pycrorm_changed AS SELECT 1",
        "DROP VIEW pycrorm_changed",
    )
    faults = (DBAPIError, sqlite3.Error, UnicodeDecodeError)  # UnicodeDecodeError: a name in a damaged file

    # --- the log --------------------------------------------------------------------------------------------------

    def creation(self, table: Table, *, if_missing: bool) -> str:
        # Written as in every earlier version, because SQLite keeps the text: a new memory equals a migrated one.
        key = list(table.primary_key)
        lines = []
        for column in table.columns:
            words = [column.name, self.syntax.type_compiler_instance.process(column.type)]
            words += ["PRIMARY KEY"] if key == [column] else ["NOT NULL"] if not column.nullable else []
            words += ["UNIQUE"] * bool(column.unique)
            words += ["DEFAULT 0"] * isinstance(column.server_default, DefaultClause)
            words += [f"CHECK ({each.sqltext})" for each in column.constraints if isinstance(each, CheckConstraint)]
            lines.append(" ".join(words))
        lines += [f"PRIMARY KEY ({', '.join(each.name for each in key)})"] if len(key) > 1 else []
        columns = ",\n    ".join(lines)
        exists, options = "IF NOT EXISTS " * if_missing, ", WITHOUT ROWID" * (table is schema.DIGEST)
        return f"CREATE TABLE {exists}{table.name} (\n    {columns}\n) STRICT{options}"

    def completion(self, table: Table, name: str, *, if_missing: bool) -> list[str]:
        if "noun" not in table.info:
            return []
        noun, fixed = table.info["noun"], table.info["fixed"]
        changes = {"renamed": f"UPDATE OF {fixed}"} if fixed else {"updated": "UPDATE"}
        return [
            f"CREATE TRIGGER {'IF NOT EXISTS ' * if_missing}{noun}_is_not_{effect} BEFORE {change} ON {name} BEGIN"
            f" SELECT RAISE(ABORT, 'the event log is append-only: {table.name} refuses {change.split()[0]}'); END"
            for effect, change in {**changes, "deleted": "DELETE"}.items()
        ]

    @asynccontextmanager
    async def deletion(self, connection: AsyncConnection, tables: Sequence[Table]) -> AsyncIterator[None]:
        await self.execute_all(connection, [f"DROP TRIGGER {each.info['noun']}_is_not_deleted" for each in tables])
        yield
        triggers = chain.from_iterable(self.completion(each, each.name, if_missing=True) for each in tables)
        await self.execute_all(connection, list(triggers))

    async def made_tables(self, connection: AsyncConnection) -> dict[str, set[str]]:
        tables: dict[str, set[str]] = {}
        for name, column in map(tuple, await connection.exec_driver_sql(_COLUMNS)):
            if MADE.search(name):
                tables.setdefault(name, set()).add(column)
        return tables

    async def purge(self, engine: AsyncEngine, tables: Sequence[str]) -> str | None:  # noqa: ARG002
        async with engine.connect() as connection:
            await connection.execution_options(**{BEGIN: None})
            await connection.exec_driver_sql("VACUUM")  # writes each row that is left into new pages
            [busy, *_] = (await connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")).one()
        return "the file or its write-ahead log, because another process reads old pages of them" if busy else None

    async def prepare(self, engine: AsyncEngine, name: str) -> None:
        async with engine.connect() as connection:
            # First check that the database is ours or empty: setting the journal mode changes the file permanently.
            await connection.execution_options(**{BEGIN: None})
            await self.find_log(connection, name)
            mode = (await connection.exec_driver_sql(USE_WAL)).scalar_one()
            if mode != "wal":
                raise DatabaseUnavailable(f"{name}: SQLite cannot keep a write-ahead log existing (a network folder?)")

    async def find_log(self, connection: AsyncConnection, name: str) -> dialect.LogIdentity | None:
        tables_and_logs: Sequence[int] = (await connection.exec_driver_sql(_COUNT_TABLES)).one()
        if tables_and_logs[0] == 0:
            return None
        if tables_and_logs[1] == 0:
            raise DatabaseForeign(f"{name} is a database of another program: it has tables but no pycrorm_log")
        return dialect.LogIdentity._make((await self.execute(connection, schema.SELECT_LOG)).one())

    async def execute_all(self, connection: AsyncConnection, statements: Sequence[str]) -> None:
        await (await _driver(connection)).execute_in_turn((statement, ()) for statement in statements)

    async def table_state(self, connection: AsyncConnection, table: Table) -> dialect.TableState:
        exists = await self.has_table(connection, table.name)
        return dialect.TableState(exists, not exists, exists, exists)

    async def fetch(self, connection: AsyncConnection, sql: str, parameters: tuple[Any, ...]) -> Sequence[Any]:
        # A visit to the thread takes 0.03 ms, and 0.14 ms through SQLAlchemy.
        return await (await _driver(connection)).visit(lambda driver: driver.execute(sql, parameters).fetchall())

    async def new_numbers(self, connection: AsyncConnection, count: int, *, above: int = 0) -> list[int]:
        taken = (await self.execute(connection, schema.SELECT_NUMBER_MAX)).scalar_one()
        if await self.has_table(connection, schema.REMOVED.name):
            taken = max(taken, (await self.execute(connection, schema.SELECT_REMOVED_MAX)).scalar_one())
        first = max(taken, above) + 1
        return list(range(first, first + count))

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

    async def keep(self, connection: AsyncConnection, tables: Sequence[str]) -> bool:  # the snapshot protects them
        existing = (await connection.exec_driver_sql("SELECT name FROM sqlite_master WHERE type = 'table'")).scalars()
        return set(tables) <= set(existing)

    async def faults_of_file(self, connection: AsyncConnection) -> list[str]:
        rows = list((await connection.exec_driver_sql("PRAGMA integrity_check")).scalars())
        return [] if rows == ["ok"] else rows

    # --- tables and views made from the log ---------------------------------------------------------------------

    async def has_table(self, connection: AsyncConnection, name: str, *, to_change: bool = False) -> bool:  # noqa: ARG002
        sql = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?"
        return bool(await self.fetch(connection, sql, (name,)))

    async def expect(self, connection: AsyncConnection, tables: Sequence[dialect.Expected]) -> None:
        # Counting the rows would hold the write lock all that time. Without statistics the planner assumes equal sizes:
        # a query by status began with all nodes and took four times as long.
        await connection.exec_driver_sql(f"ANALYZE {_quote(tables[0].table)}")  # creates the planner's table
        rows: list[tuple[str, str | None, str]] = [(each.table, None, str(each.rows)) for each in tables]
        for each in tables:
            rows += [
                (each.table, index, " ".join(map(str, (each.rows, *alike)))) for index, alike in each.alike.items()
            ]
        await connection.exec_driver_sql(
            "INSERT INTO sqlite_stat1 (tbl, idx, stat) SELECT value->>0, value->>1, value->>2 FROM json_each(?)",
            (msgspec.json.encode(rows).decode(),),
        )

    async def add_column(self, connection: AsyncConnection, table: str, definition: str) -> None:
        await connection.exec_driver_sql(f"ALTER TABLE {_quote(table)} ADD COLUMN {definition}")

    async def replace_views(
        self, connection: AsyncConnection, before: Mapping[str, str], after: Mapping[str, str]
    ) -> None:
        drops = [f"DROP VIEW {_quote(name)}" for name, text in before.items() if after.get(name) != text]
        changed = ((name, text) for name, text in after.items() if before.get(name) != text)
        await self.execute_all(
            connection, [*drops, *(f"CREATE VIEW {_quote(name)} AS {text}" for name, text in changed)]
        )

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

    async def insertion(self, rows: dialect.RowsByTable) -> dialect.Insertion:
        insertions = []
        for (table, columns), some in rows.items():
            into = f"INSERT INTO {_quote(table)} ({', '.join(map(_quote, columns))}) VALUES "
            for values, parameters in bound(list(some), len(columns)):
                insertions.append((into + values, parameters))
                await asyncio.sleep(0)
        return insertions

    async def event_insertion(self, parts: Iterable[tuple[int, list[Record]]]) -> dialect.Insertion:
        columns = schema.EVENT_COLUMNS
        into = f"INSERT INTO {schema.EVENT.name} ({', '.join(columns)}) VALUES "
        insertions = []
        for number, records in parts:
            some = _parts(records, len(columns))
            insertions += [(into + _marks(len(each), len(columns)), core.event_values(each, number)) for each in some]
            await asyncio.sleep(0)
        return insertions

    async def insert(self, connection: AsyncConnection, insertion: dialect.Insertion) -> None:
        with _rows_refused():
            await (await _driver(connection)).execute_in_turn(insertion)

    async def update_rows(
        self,
        connection: AsyncConnection,
        table: str,
        columns: Mapping[str, str],
        rows: Sequence[tuple[Any, ...]],
        *,
        episode: str | None = None,  # noqa: ARG002  a file has no partitions
    ) -> None:
        names = list(columns)[1:]
        changes = ", ".join(f"{column} = change.column{index}" for index, column in enumerate(names, 2))
        update = f"UPDATE {table} SET {changes} FROM (VALUES "
        of = f") AS change WHERE {table}.id = change.column1"
        statements = ((update + values + of, parameters) for values, parameters in bound(rows, len(columns)))
        with _rows_refused():
            await (await _driver(connection)).execute_in_turn(statements)

    refusal = staticmethod(sqlite_engine.refusal)
    translate_error = staticmethod(sqlite_engine.translate_error)


_quote = SQLite.syntax.identifier_preparer.quote
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


async def _driver(connection: AsyncConnection) -> StoppableConnection:
    """Return the driver's connection, to run many statements in one visit to its thread; begin a transaction."""
    if not connection.in_transaction():
        await connection.begin()
    driver = (await connection.get_raw_connection()).driver_connection
    assert isinstance(driver, StoppableConnection)
    return driver


@contextmanager
def _rows_refused() -> Iterator[None]:
    try:
        yield
    except (sqlite3.DataError, sqlite3.IntegrityError, OverflowError) as error:
        raise dialect.RowRefused(str(error)) from error


# === multi row insert =========================================================================================
#
# Insert or update many rows in few statements: generate VALUES lists and their parameters.

_PARAMETERS_MAX: Final = 8_000
"""Bounds the parameters of a statement. SQLite allows 32,766 but is a third slower with that many; with fewer, the
writer waits for a busy plan more often."""
_Rows = TypeVar("_Rows", bound=Sequence[Any])
_NULL: Final = float("nan")
"""The value bound in place of None: SQLite stores NaN, which no row has, as NULL."""


def bound(rows: Sequence[tuple[Any, ...]], columns: int) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Generate VALUES lists and their parameters, some rows at a time. The lists differ by their length alone."""
    for part in _parts(rows, columns):
        # Binding None or a boolean takes 0.28 µs, because the driver looks for an adapter; a number takes 0.04 µs. Half
        # of a node's row is None.
        yield _marks(len(part), columns), core.row_values([*part], _NULL)


def _marks(rows: int, columns: int) -> str:
    return ", ".join([f"({', '.join('?' * columns)})"] * rows)


def _parts(rows: _Rows, columns: int) -> Iterator[_Rows]:
    """Split rows into powers of two, so that few statements differ: compiling one takes longer than running it."""
    size, start = 1 << (_PARAMETERS_MAX // columns).bit_length() - 1, 0
    while start < len(rows):
        while size > len(rows) - start:
            size //= 2
        yield rows[start : start + size]  # type: ignore[misc]  # a slice has the type of its sequence
        start += size
