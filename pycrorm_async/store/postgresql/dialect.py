"""Implement `Dialect` for PostgreSQL; the SQL is in `statements` and `tables`."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

from sqlalchemy.exc import DBAPIError
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.bulk_records import make
from pycrorm_async.errors import DatabaseError, DatabaseForeign, DatabaseUnavailable, PycrormError, TablesUntrusted
from pycrorm_async.store.dialect import (
    Birth,
    Expected,
    Insertion,
    LogIdentity,
    Migrations,
    Progress,
    RowsByTable,
    StoredOn,
)
from pycrorm_async.store.postgresql import errors, tables
from pycrorm_async.store.postgresql import statements as sql
from pycrorm_async.store.postgresql.engine import WARNING
from pycrorm_async.store.postgresql.search_path import LOG_SCHEMA, TABLES_SCHEMA, VIEWS_SCHEMA
from pycrorm_async.store.stored import EpisodeRow, Incarnation, Span, StoredEvent, numbers_reserved

_SERVER_MIN = 140_000
"""The lowest supported `server_version_num`: PostgreSQL 14."""
_RESTORING = "a restore may be running; try again when it has finished"


class PostgreSQL:
    """Implements `Dialect`. Events are inserted by COPY; an append locks its episodes' rows until COMMIT."""

    migrations: Migrations = tables.MIGRATIONS
    digest_statements = sql.DIGEST_STATEMENTS
    blob_table: Sequence[str] = tables.BLOB
    faults: tuple[type[Exception], ...] = errors.FAULTS

    # --- finding and creating a log ---------------------------------------------------------------------------------

    async def prepare(self, engine: AsyncEngine, name: str) -> None:
        """Do nothing: PostgreSQL needs no preparation outside a transaction."""

    async def lock_log_changes(self, connection: AsyncConnection) -> None:
        await connection.exec_driver_sql(tables.ALONE)

    async def find_log(self, connection: AsyncConnection, name: str) -> LogIdentity | None:
        version = (await connection.exec_driver_sql(tables.SERVER_VERSION)).scalar_one()
        if version < _SERVER_MIN:
            raise DatabaseUnavailable(f"{name}: PostgreSQL 14 or newer is needed, this is {version // 10_000}")
        names = set((await connection.exec_driver_sql(tables.TABLE_NAMES)).scalars())
        if not names:
            return None
        if "pycrorm_log" not in names:
            if names & {"episode", "event", "pycrorm_declaration"} == set():
                raise DatabaseForeign(f"{name} has a schema {LOG_SCHEMA!r} of another program: it has no pycrorm_log")
            raise DatabaseUnavailable(f"{name}: the table pycrorm_log is missing: {_RESTORING}")
        row = (await connection.exec_driver_sql(tables.READ_LOG)).one_or_none()
        if row is None:
            raise DatabaseUnavailable(f"{name}: the table pycrorm_log is empty: {_RESTORING}")
        return LogIdentity._make(row)

    async def execute_all(self, connection: AsyncConnection, statements: Sequence[str]) -> None:
        # One message, bypassing SQLAlchemy, in the transaction that an earlier statement through SQLAlchemy began.
        await (await _driver(connection)).execute("; ".join(statements))

    async def insert_log(self, connection: AsyncConnection, birth: Birth, format_now: int) -> None:
        await connection.exec_driver_sql(tables.INSERT_LOG, (birth.log_id, format_now, birth.created_wall_ns))

    async def set_format(self, connection: AsyncConnection, format_now: int) -> None:
        await connection.exec_driver_sql(tables.SET_FORMAT, (format_now,))

    # --- appending ----------------------------------------------------------------------------------------------

    async def insert_declarations(self, connection: AsyncConnection, named: Sequence[tuple[str, str]]) -> None:
        await connection.exec_driver_sql(sql.INSERT_DECLARATIONS, _arrays(named, 2))

    async def episodes_by_id(
        self, connection: AsyncConnection, ids: Sequence[str], *, witness: str | None = None
    ) -> list[EpisodeRow]:
        if witness is None:
            return await _rows(EpisodeRow, connection, sql.SELECT_EPISODES_BY_ID, list(ids))
        return await _rows(EpisodeRow, connection, sql.SELECT_EPISODES_AND_WITNESS, list(ids), witness)

    async def new_numbers(self, connection: AsyncConnection, count: int, *, above: int = 0) -> list[int]:
        numbers = list((await connection.exec_driver_sql(sql.NEW_NUMBERS, (count,))).scalars())
        if numbers[0] > above:
            return numbers
        await self._skip(connection, numbers[-1], above)
        return list((await connection.exec_driver_sql(sql.NEW_NUMBERS, (count,))).scalars())

    async def skip_numbers(self, connection: AsyncConnection, above: int) -> None:
        number = (await connection.exec_driver_sql(sql.NEW_NUMBERS, (1,))).scalar_one()
        if number <= above:
            await self._skip(connection, number, above)

    async def _skip(self, connection: AsyncConnection, current: int, above: int) -> None:
        # Uses nextval, because setval needs a privilege and could move the sequence back behind another session.
        count = above + numbers_reserved(above) - current
        if count > 0:
            await connection.exec_driver_sql(sql.SKIP_NUMBERS, (count,))

    async def numbers_taken(self, connection: AsyncConnection, numbers: Sequence[int]) -> set[int]:
        return set((await connection.exec_driver_sql(sql.SELECT_NUMBERS_TAKEN, (list(numbers),))).scalars())

    async def heads(self, connection: AsyncConnection, ids: Sequence[str]) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, sql.SELECT_HEADS, list(ids))

    async def note_incarnation(self, connection: AsyncConnection, incarnation: Incarnation) -> None:
        # A role without the privilege to create tables relies on the owner's (`roles.GRANTS`).
        if not await self._has_incarnations(connection):
            await self.lock_log_changes(connection)
            await connection.exec_driver_sql(tables.INCARNATION)
        await connection.exec_driver_sql(sql.INSERT_INCARNATION, tuple(incarnation))

    async def incarnations(self, connection: AsyncConnection) -> list[Incarnation]:
        if not await self._has_incarnations(connection):
            return []
        return await _rows(Incarnation, connection, sql.SELECT_INCARNATIONS)

    async def _has_incarnations(self, connection: AsyncConnection) -> bool:
        return bool((await connection.exec_driver_sql(tables.HAS_INCARNATION)).scalar_one())

    async def stored_on(self, connection: AsyncConnection) -> StoredOn:
        configured = (await connection.exec_driver_sql(sql.SYNCHRONOUS_STANDBYS)).scalar_one().strip()
        if not configured:
            return StoredOn(1)
        # Without pg_read_all_stats their states are null, but COMMIT still waits for them.
        names = tuple((await connection.exec_driver_sql(sql.SELECT_SYNCHRONOUS)).scalars())
        return StoredOn(1 + max(1, _confirming(configured)), names or (configured,))

    async def event_insertion(self, rows: Iterator[tuple[Any, ...]]) -> Insertion:
        return rows  # read while COPY runs, so that the server stores the first rows while the last are computed

    async def insert_events(self, connection: AsyncConnection, insertion: Insertion) -> None:
        await _copy(connection, LOG_SCHEMA, "event", sql.EVENT_COLUMNS, insertion)

    async def upsert_episodes(self, connection: AsyncConnection, episodes: Sequence[EpisodeRow]) -> None:
        rows = [
            (each.number, each.id, each.head, each.started_wall_ns, each.ended_wall_ns, each.refused)
            for each in sorted(episodes)
        ]
        await connection.exec_driver_sql(sql.UPSERT_EPISODES, _arrays(rows, 6))

    async def force_durable_commit(self, connection: AsyncConnection) -> None:
        await connection.exec_driver_sql(sql.WRITE_AHEAD)

    async def commit(self, connection: AsyncConnection) -> None:
        # A COMMIT that is cancelled while it waits for a synchronous standby succeeds, with a warning.
        connected = (await connection.get_raw_connection()).info
        connected.pop(WARNING, None)
        await connection.commit()
        if WARNING in connected:
            raise errors.CommitInDoubt(connected[WARNING])

    async def events_by_key(self, connection: AsyncConnection, keys: Sequence[tuple[int, int]]) -> list[StoredEvent]:
        return await _rows(StoredEvent, connection, sql.SELECT_STORED_AGAIN, *_arrays(keys, 2))

    # --- reading ------------------------------------------------------------------------------------------------

    async def episode(self, connection: AsyncConnection, identity: str) -> EpisodeRow | None:
        return next(iter(await _rows(EpisodeRow, connection, sql.SELECT_EPISODE_BY_ID, identity)), None)

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
        # Bypasses SQLAlchemy, which processes every row twice.
        rows = await (await _driver(connection)).fetch(sql.SELECT_SPANS, *_arrays(spans, 3))
        return [make(StoredEvent, row) for row in rows]

    async def declarations(self, connection: AsyncConnection) -> list[bytes]:
        return [bytes(row[0]) for row in await connection.exec_driver_sql(sql.SELECT_DECLARATIONS)]

    async def descriptions(self, connection: AsyncConnection, fingerprints: Sequence[str]) -> list[bytes]:
        wanted = list(fingerprints)
        return [bytes(row[0]) for row in await connection.exec_driver_sql(sql.SELECT_DESCRIPTIONS, (wanted,))]

    async def begin_snapshot(self, connection: AsyncConnection) -> None:
        await connection.exec_driver_sql("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")

    async def keep(self, connection: AsyncConnection, tables: Sequence[str]) -> bool:
        quote = connection.dialect.identifier_preparer.quote
        named = ", ".join(f"{TABLES_SCHEMA}.{quote(each)}" for each in tables)
        try:
            await connection.exec_driver_sql(f"LOCK TABLE {named} IN ACCESS SHARE MODE")
        except DBAPIError as error:
            if errors.is_missing_table(error):
                return False
            raise
        return True

    async def faults_of_file(self, connection: AsyncConnection) -> list[str]:  # noqa: ARG002
        return []  # a server checks its pages itself

    # --- folding ------------------------------------------------------------------------------------------------

    async def advance_folded(self, connection: AsyncConnection, steps: Sequence[Progress]) -> int:
        return (await connection.exec_driver_sql(sql.ADVANCE_FOLDED, _arrays(steps, 3))).rowcount

    async def park(self, connection: AsyncConnection, number: int, reason: str | None) -> None:
        await connection.exec_driver_sql(sql.PARK, (reason, number))

    # --- tables and views ---------------------------------------------------------------------------------------

    async def make_place(self, connection: AsyncConnection) -> None:
        await connection.exec_driver_sql(f"CREATE SCHEMA IF NOT EXISTS {TABLES_SCHEMA}")

    async def has_table(self, connection: AsyncConnection, name: str) -> bool:
        exists, stranger, login = tuple((await connection.exec_driver_sql(tables.HAS_TABLE, (name,))).one())
        if stranger is not None:
            raise TablesUntrusted(
                f"the tables belong to {stranger}, whose members could run their code with the rights of {login}:"
                f" fold with a login that is a member of {stranger} and has no right to the log, read with one of"
                " pycrorm_reader"
            )
        return bool(exists)

    async def expect(self, connection: AsyncConnection, tables: Sequence[Expected]) -> None:
        """Do nothing: the server gathers statistics itself."""

    async def gather_statistics(self, connection: AsyncConnection, tables: Sequence[str]) -> None:
        quote = connection.dialect.identifier_preparer.quote
        await connection.exec_driver_sql(f"ANALYZE {', '.join(f'{TABLES_SCHEMA}.{quote(each)}' for each in tables)}")

    def stored_column(self, name: str) -> str:
        return f"_{name}" if name in tables.SYSTEM_COLUMNS else name

    async def add_column(self, connection: AsyncConnection, table: str, definition: str) -> None:
        quote = connection.dialect.identifier_preparer.quote
        await connection.exec_driver_sql(tables.WAIT_BRIEFLY)
        await connection.exec_driver_sql(f"ALTER TABLE {quote(table)} ADD COLUMN {definition}")
        await connection.exec_driver_sql(tables.WAIT_AS_EVER)

    async def only_views(self, connection: AsyncConnection, views: Collection[str]) -> None:
        names = await connection.exec_driver_sql(tables.IN_VIEWS_SCHEMA, (list(views),))
        strangers = list(names.scalars())
        if strangers:
            raise DatabaseError(
                f"{VIEWS_SCHEMA}.{strangers[0]} does not belong to the memory, which replaces the schema {VIEWS_SCHEMA}"
                " with every change of its views: move it to another schema"
            )

    async def replace_views(
        self, connection: AsyncConnection, before: Mapping[str, str], after: Mapping[str, str]
    ) -> None:
        """Create all views in a new schema and rename it into place.

        Replacing a view in place would lock it: wait for every reader's transaction, with new readers queued behind.
        """
        if before == after:
            return
        await self.only_views(connection, before)
        quote = connection.dialect.identifier_preparer.quote
        creations = [f"CREATE VIEW {quote(name)} AS {text}" for name, text in after.items()]
        await self.execute_all(connection, [*tables.NEW_VIEWS_SCHEMA, *creations, *tables.SHOW_NEW_VIEWS_SCHEMA])

    async def comment_views(self, connection: AsyncConnection, comments: Mapping[str, Mapping[str, str]]) -> None:
        columns = (await connection.exec_driver_sql(tables.COLUMNS_OF_VIEWS)).all()
        await self.execute_all(connection, tables.comment_statements(map(tuple, columns), comments))

    async def sweep(self, connection: AsyncConnection) -> None:
        for schema, views in await _rows(_ReplacedSchema, connection, tables.GONE_SCHEMAS):
            try:
                async with connection.begin_nested():
                    await connection.exec_driver_sql(tables.WAIT_FOR_NOBODY)
                    if views:
                        await connection.exec_driver_sql(f"DROP VIEW {', '.join(views)}")
                    await connection.exec_driver_sql(f"DROP SCHEMA {schema}")
            except DBAPIError as error:
                if error.connection_invalidated:
                    raise
                continue  # still read, or used by another view: the next sweep retries

    async def empty(self, connection: AsyncConnection, table: str, *, rows_max: int) -> bool:  # noqa: ARG002
        return False  # dropping deletes files, whatever their size

    async def drop(self, connection: AsyncConnection, table: str) -> None:
        await connection.exec_driver_sql(tables.WAIT_FOR_NOBODY)
        name = connection.dialect.identifier_preparer.quote(table)
        await connection.exec_driver_sql(f"DROP TABLE IF EXISTS {TABLES_SCHEMA}.{name}")

    @asynccontextmanager
    async def claim(self, engine: AsyncEngine) -> AsyncIterator[bool]:
        async with engine.connect() as connection:
            # Autocommit, because an idle transaction would be terminated; the lock belongs to the session.
            connection = await connection.execution_options(isolation_level="AUTOCOMMIT")
            claimed = bool((await connection.exec_driver_sql(tables.CLAIM)).scalar_one())
            try:
                yield claimed
            finally:
                if claimed:
                    await connection.exec_driver_sql(tables.RELEASE)

    async def shadow_views(self, connection: AsyncConnection, views: Mapping[str, str]) -> None:
        quote = connection.dialect.identifier_preparer.quote
        # Also on a read-only connection, because a temporary view belongs to the session alone.
        await connection.exec_driver_sql("SET TRANSACTION READ WRITE")
        await self.execute_all(
            connection, [f"CREATE TEMP VIEW {quote(name)} AS {text}" for name, text in views.items()]
        )

    async def insertion(self, rows: RowsByTable) -> Insertion:
        return rows  # the driver encodes a row while the server stores the previous ones

    async def insert(self, connection: AsyncConnection, insertion: Insertion) -> None:
        for (table, columns), some in insertion.items():
            await _copy(connection, TABLES_SCHEMA, table, columns, some)

    async def update_rows(
        self, connection: AsyncConnection, table: str, columns: Mapping[str, str], rows: Sequence[tuple[Any, ...]]
    ) -> None:
        arrays = ", ".join(f"${index}::{kind}[]" for index, kind in enumerate(columns.values(), 1))
        changes = ", ".join(f"{column} = change.{column}" for column in list(columns)[1:])
        with errors.rows_refused():
            await connection.exec_driver_sql(
                f"UPDATE {table} SET {changes}"  # noqa: S608
                f" FROM unnest({arrays}) AS change ({', '.join(columns)}) WHERE {table}.id = change.id",
                _arrays(rows, len(columns)),
            )

    # --- faults -------------------------------------------------------------------------------------------------

    def refusal(self, error: Exception) -> str | None:
        return errors.refusal(error)

    def translate_error(self, error: Exception, name: str) -> PycrormError:
        return errors.translate_error(error, name)


def _confirming(configured: str) -> int:
    """Return the number of standbys that confirm each COMMIT, from `synchronous_standby_names`.

    >>> _confirming("ANY 2 (a, b, c)"), _confirming("FIRST 1 (a)"), _confirming("2 (a, b)"), _confirming("a, b")
    (2, 1, 2, 1)
    """
    words = configured.partition("(")[0].split()
    return int(words[-1]) if "(" in configured and words and words[-1].isdigit() else 1


class _ReplacedSchema(NamedTuple):
    """A schema of replaced views."""

    schema: str
    views: list[str] | None


async def _copy(
    connection: AsyncConnection, schema: str, table: str, columns: Sequence[str], rows: Iterable[tuple[Any, ...]]
) -> None:
    """Insert rows by COPY, in the transaction that an earlier statement through SQLAlchemy began."""
    driver = await _driver(connection)
    with errors.rows_refused():
        await driver.copy_records_to_table(table, schema_name=schema, columns=columns, records=rows)


async def _driver(connection: AsyncConnection) -> Any:
    driver = (await connection.get_raw_connection()).driver_connection
    assert driver is not None
    return driver


async def _rows(kind: Any, connection: AsyncConnection, statement: str, *parameters: Any) -> list[Any]:
    return [make(kind, row) for row in await connection.exec_driver_sql(statement, parameters)]


def _arrays(rows: Sequence[tuple[Any, ...]], columns: int) -> tuple[list[Any], ...]:
    """Transpose rows to one array per column, the form in which a statement takes many rows."""
    return tuple([row[column] for row in rows] for column in range(columns))
