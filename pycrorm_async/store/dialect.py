"""Define the operations that differ between databases; `store.sqlite` and `store.postgresql` implement them."""

import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, contextmanager
from functools import cached_property
from itertools import chain
from typing import Any, ClassVar, NamedTuple, TypeAlias

import msgspec
from sqlalchemy import CursorResult, Executable, Select, Table
from sqlalchemy.engine.interfaces import Compiled
from sqlalchemy.engine.interfaces import Dialect as Syntax
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine
from sqlalchemy.schema import CreateIndex, CreateTable

from pycrorm_async.bulk_records import make
from pycrorm_async.errors import DatabaseUnavailable, PycrormError
from pycrorm_async.events.codec import Record
from pycrorm_async.store import schema
from pycrorm_async.store.placement import PLAIN, Placement
from pycrorm_async.store.stored import RemovedEpisode, Span, StoredEvent

Migrations: TypeAlias = Sequence[Sequence[str]]
"""Numbered steps; the first N of them create format N."""

RowsByTable: TypeAlias = Mapping[tuple[str, tuple[str, ...]], Iterable[tuple[Any, ...]]]
"""Rows to insert, by table and its columns."""

Insertion: TypeAlias = Any
"""Rows to insert, prepared for the driver, in a form that only their dialect reads."""

Progress: TypeAlias = tuple[int, int, int]
"""An episode's number, its folded sequence before, and its folded sequence now."""

LOG_CHANGES = 7266203370152417861
"""Key of the lock that creations and migrations of a log, and changes of its tables, take. It encodes our name."""
DECLARATIONS = LOG_CHANGES + 2
"""Key of the lock that transactions with new declarations take."""
FOLDING = LOG_CHANGES + 3
"""Key of the lock that every session shares whose process folds by share (`projections.fold_group`)."""
FOLDING_LOOKS = FOLDING & 0x7FFFFFFF
"""First part of the keys of the locks that show when these processes looked; the second is the number of the look."""


MADE = re.compile(r"__\d+$")
"""Finds the name of a table that is made from the log: it ends in the number of its generation."""


class LogIdentity(NamedTuple):
    """The identity and format of the log in a database."""

    log_id: str
    format: int


class TableState(NamedTuple):
    """Whether a table of the log exists, and whether this login may create it, read it and insert into it."""

    exists: bool
    creatable: bool
    readable: bool
    insertable: bool


class StoredOn(NamedTuple):
    """The number of machines that hold a committed event, and the known standbys that confirm each COMMIT."""

    machines: int
    standbys: tuple[str, ...] = ()


class RowRefused(ValueError):
    """The database cannot store a row: its key exists already, or a value does not fit its column."""


class Expected(NamedTuple):
    """The expected number of rows of a table, and per index the rows that share a value of its first column, of its
    first two, and so on."""

    table: str
    rows: int
    alike: Mapping[str, Sequence[int]]


class Dialect(ABC):
    """One kind of database. Methods with a connection run in the caller's transaction, with one statement per table.

    Attributes:
        syntax: SQLAlchemy's dialect, with which statements are compiled.
        log_schema: the schema of the log's tables.
        episode_id: SQL that reads an id from the table `episode`, as valid text even where it is damaged.
        select_declarations: the query of the designator types' payloads, in the order of arrival.
        has_former_numbers: the query of whether the table `episode` refuses numbers above those of version 0.1.0, and
            whether this login may change that.
        permit_numbers: the statements that change it.
        begin_snapshot: the statement that makes a transaction that begins a snapshot, where it is none by itself.
        place: the statements that create the schema of the tables made from the log, where there are schemas.
        faults: the exceptions of the driver, and those SQLAlchemy raises for it.
    """

    syntax: Syntax
    log_schema: ClassVar[str | None] = None
    episode_id: ClassVar[str]
    select_declarations: ClassVar[Select[Any]]
    has_former_numbers: ClassVar[str]
    permit_numbers: ClassVar[Sequence[str]]
    begin_snapshot: ClassVar[str | None] = None
    place: ClassVar[Sequence[str]] = ()
    faults: ClassVar[tuple[type[Exception], ...]]

    def __init__(self) -> None:
        self._compiled: dict[Executable, tuple[str, Sequence[str], dict[str, Any]]] = {}

    @cached_property
    def migrations(self) -> Migrations:
        """The statements that create the log, and those that bring it from each format to the next."""
        return (self.first_format(PLAIN),)

    def first_format(self, placement: Placement) -> tuple[str, ...]:
        """Return the statements that create a log of format 1 with its rows in this placement."""
        return tuple(chain.from_iterable(self.definition(each, placement) for each in schema.FORMAT_1))

    # --- statements of the schema ---------------------------------------------------------------------------------

    async def execute(self, connection: AsyncConnection, statement: Executable, **values: Any) -> CursorResult[Any]:
        """Execute a constant of `store.schema`; a list is passed as a JSON array."""
        return await connection.exec_driver_sql(*self._bound(statement, values))

    def _bound(self, statement: Executable, values: dict[str, Any]) -> tuple[str, tuple[Any, ...]]:
        """Return the text and the parameters of a statement."""
        compiled = self._compiled.get(statement)
        if compiled is None:
            text = self.compile(statement)
            constants = {name: each for name, each in text.params.items() if each is not None}
            compiled = self._compiled[statement] = str(text), getattr(text, "positiontup", None) or (), constants
        sql, names, constants = compiled
        batches = {name: msgspec.json.encode(each).decode() for name, each in values.items() if isinstance(each, list)}
        parameters = constants | values | batches
        return sql, tuple([parameters[each] for each in names])

    async def fetch(self, connection: AsyncConnection, sql: str, parameters: tuple[Any, ...]) -> Sequence[Any]:
        """Execute the text of a query in this database's own syntax, and fetch all rows."""
        return (await connection.exec_driver_sql(sql, parameters)).all()

    async def rows(self, connection: AsyncConnection, kind: Any, statement: Executable, **values: Any) -> list[Any]:
        """Execute a query whose rows have the fields of this NamedTuple."""
        return [make(kind, row) for row in await self.fetch(connection, *self._bound(statement, values))]

    async def payloads(self, connection: AsyncConnection, statement: Executable, **values: Any) -> list[bytes]:
        """Execute a query of payloads."""
        return [bytes(row[0]) for row in await self.fetch(connection, *self._bound(statement, values))]

    def compile(self, element: Any) -> Compiled:
        """Compile a statement or the definition of a table of the log."""
        names = {None: self.log_schema} if self.log_schema else None
        compiled: Compiled = element.compile(
            dialect=self.syntax, schema_translate_map=names, render_schema_translate=names is not None
        )
        return compiled

    def definition(self, table: Table, placement: Placement = PLAIN, *, if_missing: bool = False) -> list[str]:
        """Return the statements that create a table of the log, with its indexes and triggers."""
        indexes = sorted(table.indexes, key=lambda each: str(each.name))
        for partial in (each for each in indexes if schema.WHERE in each.info):
            partial.dialect_kwargs[f"{self.syntax.name}_where"] = partial.info[schema.WHERE]
        episode = "episode" if "episode" in table.c else None
        create = self.creation(table, if_missing=if_missing)
        name = f"{self.log_schema}.{table.name}" if self.log_schema else table.name
        parts = placement.parts(table.name, schema=self.log_schema) if episode else []
        return [
            *placement.creation(create, table.name, episode, schema=self.log_schema),
            *(str(self.compile(CreateIndex(each))) for each in indexes),
            *chain.from_iterable(self.completion(table, each, if_missing=if_missing) for each in (name, *parts)),
        ]

    def creation(self, table: Table, *, if_missing: bool) -> str:
        """Return the statement that creates a table of the log."""
        return str(self.compile(CreateTable(table, if_not_exists=if_missing)))

    async def create_if_missing(self, connection: AsyncConnection, table: Table) -> None:
        """Create a table that is not part of the log's format. Raises for a login that may not, where it is missing."""
        if not (await self.table_state(connection, table)).exists:
            await self.lock_log_changes(connection)
            await self.execute_all(connection, self.definition(table, if_missing=True))

    async def declarations(self, connection: AsyncConnection) -> list[bytes]:
        """Read the payloads of the designator types, in the order of arrival."""
        return await self.payloads(connection, self.select_declarations)

    async def descriptions(self, connection: AsyncConnection, fingerprints: Iterable[str]) -> list[bytes]:
        """Read the payloads of those of these descriptions that are stored."""
        named = [(each,) for each in fingerprints]
        return await self.payloads(connection, schema.SELECT_DESCRIPTIONS, fingerprints=named)

    async def rows_if_created(
        self, connection: AsyncConnection, table: Table, kind: Any, statement: Executable, **values: Any
    ) -> list[Any]:
        """Execute a query of a table that is not part of the log's format; empty before it is created.

        Raises `DatabaseUnavailable` for a login that may not read it.
        """
        state = await self.table_state(connection, table)
        if state.exists and not state.readable:
            raise DatabaseUnavailable(
                f"this login may not read {table.name}: the owner runs `pycrorm roles --create` again"
            )
        return await self.rows(connection, kind, statement, **values) if state.exists else []

    async def removed(self, connection: AsyncConnection, statement: Executable, **values: Any) -> list[RemovedEpisode]:
        """Execute a query of removed episodes; empty before the first removal. Raises `DatabaseUnavailable`."""
        return await self.rows_if_created(connection, schema.REMOVED, RemovedEpisode, statement, **values)

    # --- the log --------------------------------------------------------------------------------------------------

    @abstractmethod
    def completion(self, table: Table, name: str, *, if_missing: bool) -> list[str]:
        """Return the statements that refuse to change or delete rows, for a table or the partition of this name."""

    async def placement(self, connection: AsyncConnection) -> Placement:  # noqa: ARG002
        """Return the placement of the memory's rows."""
        return PLAIN

    @abstractmethod
    def deletion(self, connection: AsyncConnection, tables: Sequence[Table]) -> AbstractAsyncContextManager[None]:
        """Permit this transaction to delete rows of these tables of the log until the context ends."""

    @abstractmethod
    async def made_tables(self, connection: AsyncConnection) -> dict[str, set[str]]:
        """Return the columns of every table made from the log, of any generation, by its name in the database."""

    @abstractmethod
    async def purge(self, engine: AsyncEngine, tables: Sequence[str]) -> str | None:
        """Remove the bytes of deleted rows of the log and of these tables from the files.

        Returns what is left of them, and why; None if nothing is. Waits for no other process.
        """

    async def prepare(self, engine: AsyncEngine, name: str) -> None:  # noqa: B027
        """Prepare a database, outside a transaction, for creating or migrating a log. Raises `DatabaseForeign`."""

    async def lock_log_changes(self, connection: AsyncConnection, key: int = LOG_CHANGES) -> None:  # noqa: B027
        """Lock out other holders of this lock until the transaction ends; on SQLite a writing transaction does so."""

    @abstractmethod
    async def find_log(self, connection: AsyncConnection, name: str) -> LogIdentity | None:
        """Find the log in this database; None if it is empty. Raises `DatabaseForeign` and `DatabaseUnavailable`."""

    @abstractmethod
    async def execute_all(self, connection: AsyncConnection, statements: Sequence[str]) -> None:
        """Execute statements without parameters or results, in order; in one round trip if possible."""

    @abstractmethod
    async def table_state(self, connection: AsyncConnection, table: Table) -> TableState:
        """Return the state of a table of the log."""

    async def permit_all_numbers(self, connection: AsyncConnection) -> None:
        """Let a log of version 0.1.0 have the numbers of this version, if the login owns it.

        Programs of that version still use such a log, and refuse new episodes when they have used its former numbers.
        """
        is_former, is_owner = tuple((await connection.exec_driver_sql(self.has_former_numbers)).one())
        if is_former and is_owner:
            await self.execute_all(connection, self.permit_numbers)

    @abstractmethod
    async def new_numbers(self, connection: AsyncConnection, count: int, *, above: int = 0) -> list[int]:
        """Return numbers above `above` that no episode has."""

    async def skip_numbers(self, connection: AsyncConnection, above: int) -> None:  # noqa: B027
        """Skip the numbers up to `above` in a database that assigns numbers itself."""

    async def force_durable_commit(self, connection: AsyncConnection) -> None:  # noqa: B027
        """Make the COMMIT of a transaction without changes as durable as that of one with changes."""

    async def commit(self, connection: AsyncConnection) -> None:
        """Commit. Raises `DatabaseUnavailable` if the commit may not be durable."""
        await connection.commit()

    async def stored_on(self, connection: AsyncConnection) -> StoredOn:  # noqa: ARG002
        """Return the number of machines that hold an event when its COMMIT returns."""
        return StoredOn(1)

    @abstractmethod
    async def spans(self, connection: AsyncConnection, spans: Sequence[Span]) -> list[StoredEvent]:
        """Read the events of each span, in the order of the spans."""

    @abstractmethod
    async def keep(self, connection: AsyncConnection, tables: Sequence[str]) -> bool:
        """Protect these tables from being dropped until the transaction ends.

        Returns False if one is missing; the caller must not use the transaction any more then.
        """

    async def join_fold_group(
        self,
        connection: AsyncConnection,  # noqa: ARG002
        look: int,
    ) -> tuple[int, Mapping[int, int | None]]:
        """Join the sessions of those that fold this memory, and show the number of this look.

        Returns the id of this session, and by id the numbers that all of them show; None in an earlier version.
        """
        return 0, {0: look}

    async def faults_of_file(self, connection: AsyncConnection) -> list[str]:  # noqa: ARG002
        """Return the errors that the database finds in its own pages, if it can check them."""
        return []

    # --- tables and views made from the log ---------------------------------------------------------------------

    @abstractmethod
    async def has_table(self, connection: AsyncConnection, name: str, *, to_change: bool = False) -> bool:
        """Return whether a derived table of this name exists.

        Raises `TablesUntrusted`, and `TablesWithheld` for a login that appends and may not read or change the tables.
        """

    async def expect(self, connection: AsyncConnection, tables: Sequence[Expected]) -> None:  # noqa: B027
        """Give the query planner statistics of tables that are still empty, if it gathers none itself."""

    async def gather_statistics(self, connection: AsyncConnection, tables: Sequence[str]) -> None:  # noqa: B027
        """Count and sample the rows of tables that have been filled, for the query planner, if it needs that."""

    def stored_column(self, name: str) -> str:
        """Return the table's column for a view's column: another name if the database reserves this one."""
        return name

    @abstractmethod
    async def add_column(self, connection: AsyncConnection, table: str, definition: str) -> None:
        """Add a column; fail soon if a reader holds a lock, because later readers queue behind this statement."""

    async def only_views(self, connection: AsyncConnection, views: Collection[str]) -> None:  # noqa: B027
        """Raise `DatabaseError` if the views' schema contains other objects, which `replace_views` would drop."""

    @abstractmethod
    async def replace_views(
        self, connection: AsyncConnection, before: Mapping[str, str], after: Mapping[str, str]
    ) -> None:
        """Replace views, by name and SQL, without affecting running queries. A view may use earlier ones of `after`."""

    async def comment_views(  # noqa: B027
        self, connection: AsyncConnection, comments: Mapping[str, Mapping[str, str]]
    ) -> None:
        """Describe views and columns in the database, if it keeps comments: texts by column, the view's own by "".

        Views and columns that do not exist are skipped.
        """

    async def sweep(self, connection: AsyncConnection) -> None:  # noqa: B027
        """Drop replaced views that no query reads and no other view uses. Does not wait for locks."""

    async def empty(self, connection: AsyncConnection, table: str, *, rows_max: int) -> bool:  # noqa: ARG002
        """Delete some rows of a table before it is dropped; False when dropping it is fast enough now."""
        return False

    @abstractmethod
    async def drop(self, connection: AsyncConnection, table: str) -> None:
        """Drop a table. Fails soon if a lock is held, and if a foreign view uses the table."""

    @abstractmethod
    def claim(self, engine: AsyncEngine) -> AbstractAsyncContextManager[bool]:
        """Claim the right to rebuild tables until the context ends or the process dies; yields False if it is taken."""

    @abstractmethod
    async def shadow_views(self, connection: AsyncConnection, views: Mapping[str, str]) -> None:
        """Create views that hide those of the same names, for this connection only, until it is closed.

        Must be first in the transaction. A view may use those before it.
        """

    # --- rows -------------------------------------------------------------------------------------------------------

    @abstractmethod
    async def insertion(self, rows: RowsByTable) -> Insertion:
        """Prepare the insertion of these rows, before the transaction, so that it is short. Yields to other tasks.

        The rows are read now, or once while they are inserted.
        """

    @abstractmethod
    async def event_insertion(self, parts: Iterable[tuple[int, list[Record]]]) -> Insertion:
        """Prepare the insertion of events as `insertion` does; each part has records and their episode's number."""

    @abstractmethod
    async def insert(self, connection: AsyncConnection, insertion: Insertion) -> None:
        """Insert the prepared rows. Raises `RowRefused`."""

    @abstractmethod
    async def update_rows(
        self,
        connection: AsyncConnection,
        table: str,
        columns: Mapping[str, str],
        rows: Sequence[tuple[Any, ...]],
        *,
        episode: str | None = None,
    ) -> None:
        """Update rows by id. `columns` maps names to SQL types; the first is the id.

        `episode` names the column with the number of the episode, which leads to the partition of a row. Raises
        `RowRefused`.
        """

    # --- faults -------------------------------------------------------------------------------------------------

    @abstractmethod
    def refusal(self, error: Exception) -> str | None:
        """Return the reason why the database can never create such a table or view; None for a temporary error."""

    @abstractmethod
    def translate_error(self, error: Exception, database: str) -> PycrormError:
        """Return the error of this package to raise instead."""

    @contextmanager
    def translated(self, name: str) -> Iterator[None]:
        """Translate driver errors raised inside to errors of this package, which name this database."""
        try:
            yield
        except PycrormError:
            raise
        except self.faults as error:
            raise self.translate_error(error, name) from error
