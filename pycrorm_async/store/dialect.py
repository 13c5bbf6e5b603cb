"""Define the operations that differ between databases; `store.sqlite` and `store.postgresql` implement them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Any, NamedTuple, Protocol, TypeAlias

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.errors import PycrormError
from pycrorm_async.store.stored import EpisodeRow, Incarnation, Span, StoredEvent

Migrations: TypeAlias = Sequence[Sequence[str]]
"""Numbered steps; the first N of them create format N."""

RowsByTable: TypeAlias = Mapping[tuple[str, tuple[str, ...]], Sequence[tuple[Any, ...]]]
"""Rows to insert, by table and its columns."""

Insertion: TypeAlias = Any
"""Rows to insert, prepared for the driver, in a form that only their dialect reads."""

Progress: TypeAlias = tuple[int, int, int]
"""An episode's number, its folded sequence before, and its folded sequence now."""


class Birth(NamedTuple):
    """The identity of a new log: its id, a UUID as text, and its creation time."""

    log_id: str
    created_wall_ns: int


class LogIdentity(NamedTuple):
    """The identity and format of the log in a database."""

    log_id: str
    format: int


class DigestStatements(NamedTuple):
    """The SQL of the table of digests, for the driver.

    Attributes:
        table: creates the table and its triggers.
        creatable: selects whether the table is missing and this login may create it.
        usable: selects whether this login may read it, and whether it may insert into it.
        insert: inserts rows, given as a JSON array of arrays, and skips keys that exist.
    """

    table: Sequence[str]
    creatable: str
    usable: str
    insert: str


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


class Dialect(Protocol):
    """One kind of database. Methods with a connection run in the caller's transaction, with one statement per table."""

    # --- finding and creating a log -------------------------------------------------------------------------

    migrations: Migrations
    digest_statements: DigestStatements
    blob_table: Sequence[str]
    """Statements that create the table of the blobs unless it exists."""
    episode_id: str
    """SQL that reads an id from the table `episode`, as valid text even where it is damaged."""

    async def prepare(self, engine: AsyncEngine, name: str) -> None:
        """Prepare a database, outside a transaction, for creating or migrating a log. Raises `DatabaseForeign`."""
        ...

    async def lock_log_changes(self, connection: AsyncConnection) -> None:
        """Lock out other creations and migrations of a log here until the transaction ends."""
        ...

    async def find_log(self, connection: AsyncConnection, name: str) -> LogIdentity | None:
        """Find the log in this database; None if it is empty. Raises `DatabaseForeign` and `DatabaseUnavailable`."""
        ...

    async def execute_all(self, connection: AsyncConnection, statements: Sequence[str]) -> None:
        """Execute statements without parameters or results, in order; in one round trip if possible."""
        ...

    async def insert_log(self, connection: AsyncConnection, birth: Birth, format_now: int) -> None: ...

    async def set_format(self, connection: AsyncConnection, format_now: int) -> None: ...

    # --- appending ----------------------------------------------------------------------------------------------

    async def insert_declarations(self, connection: AsyncConnection, named: Sequence[tuple[str, str]]) -> None:
        """Insert (fingerprint, payload) pairs; existing ones stay unchanged."""
        ...

    async def episodes_by_id(
        self, connection: AsyncConnection, ids: Sequence[str], *, witness: str | None = None
    ) -> list[EpisodeRow]:
        """Read and lock these episodes' rows until the transaction ends, and read the witness's row without a lock.

        If the witness is one of the episodes, its row may appear twice.
        """
        ...

    async def new_numbers(self, connection: AsyncConnection, count: int, *, above: int = 0) -> list[int]:
        """Return numbers above `above` that no episode has."""
        ...

    async def skip_numbers(self, connection: AsyncConnection, above: int) -> None:
        """Skip the numbers up to `above` in a database that assigns numbers itself."""
        ...

    async def numbers_taken(self, connection: AsyncConnection, numbers: Sequence[int]) -> set[int]:
        """Return those of these numbers that an episode has."""
        ...

    async def heads(self, connection: AsyncConnection, ids: Sequence[str]) -> list[EpisodeRow]:
        """Read these episodes' rows without locks."""
        ...

    async def note_incarnation(self, connection: AsyncConnection, incarnation: Incarnation) -> None:
        """Record that the log went back, in a table that is created if missing."""
        ...

    async def incarnations(self, connection: AsyncConnection) -> list[Incarnation]:
        """Read each time the log went back, the oldest first; none if the table is missing."""
        ...

    async def stored_on(self, connection: AsyncConnection) -> StoredOn:
        """Return the number of machines that hold an event when its COMMIT returns."""
        ...

    async def event_insertion(self, rows: Iterator[tuple[Any, ...]]) -> Insertion:
        """Prepare the insertion of these events. A row has the fields of a `StoredEvent`, with the payload as text.

        The rows are read now, or once while they are inserted.
        """
        ...

    async def insert_events(self, connection: AsyncConnection, insertion: Insertion) -> None: ...

    async def upsert_episodes(self, connection: AsyncConnection, episodes: Sequence[EpisodeRow]) -> None:
        """Insert or update these rows, without `folded` and `parked`."""
        ...

    async def force_durable_commit(self, connection: AsyncConnection) -> None:
        """Make the COMMIT of a transaction without changes as durable as that of one with changes."""
        ...

    async def commit(self, connection: AsyncConnection) -> None:
        """Commit. Raises `DatabaseUnavailable` if the commit may not be durable."""
        ...

    async def events_by_key(self, connection: AsyncConnection, keys: Sequence[tuple[int, int]]) -> list[StoredEvent]:
        """Read the stored events under these keys (episode number, sequence)."""
        ...

    # --- reading ------------------------------------------------------------------------------------------------

    async def episode(self, connection: AsyncConnection, identity: str) -> EpisodeRow | None: ...

    async def episodes(self, connection: AsyncConnection, first: int, last: int) -> list[EpisodeRow]:
        """Read the episodes with these numbers and those between them, by number."""
        ...

    async def behind(self, connection: AsyncConnection, *, after: int, limit: int) -> list[EpisodeRow]:
        """Read the episodes with unfolded events whose number is above `after`, by number, without parked ones."""
        ...

    async def stopped(self, connection: AsyncConnection) -> list[EpisodeRow]: ...

    async def last_number(self, connection: AsyncConnection) -> int:
        """Return the highest episode number; 0 without episodes."""
        ...

    async def long_episodes(self, connection: AsyncConnection, events_min: int) -> list[EpisodeRow]:
        """Read the episodes that have not ended and hold at least this many events."""
        ...

    async def events(
        self, connection: AsyncConnection, number: int, *, after: int, limit: int
    ) -> list[StoredEvent]: ...

    async def spans(self, connection: AsyncConnection, spans: Sequence[Span]) -> list[StoredEvent]:
        """Read the events of each span, in the order of the spans."""
        ...

    async def declarations(self, connection: AsyncConnection) -> list[bytes]:
        """Read the designator types, in the order of arrival."""
        ...

    async def descriptions(self, connection: AsyncConnection, fingerprints: Sequence[str]) -> list[bytes]:
        """Read those of these descriptions that are stored."""
        ...

    async def begin_snapshot(self, connection: AsyncConnection) -> None:
        """Make the transaction that begins now a snapshot."""
        ...

    async def keep(self, connection: AsyncConnection, tables: Sequence[str]) -> bool:
        """Protect these tables from being dropped until the transaction ends.

        Returns False if one is missing; the caller must not use the transaction any more then.
        """
        ...

    async def faults_of_file(self, connection: AsyncConnection) -> list[str]:
        """Return the errors that the database finds in its own pages, if it can check them."""
        ...

    # --- what a projector adds ----------------------------------------------------------------------------------

    async def advance_folded(self, connection: AsyncConnection, steps: Sequence[Progress]) -> int:
        """Advance `folded`; return the number of episodes that were at the given sequence before."""
        ...

    async def park(self, connection: AsyncConnection, number: int, reason: str | None) -> None: ...

    # --- tables and views made from the log ---------------------------------------------------------------------

    async def make_place(self, connection: AsyncConnection) -> None:
        """Create the schema for tables and views, if the database has schemas."""
        ...

    async def has_table(self, connection: AsyncConnection, name: str, *, to_change: bool = False) -> bool:
        """Return whether a derived table of this name exists.

        Raises `TablesUntrusted`, and `TablesWithheld` for a login that appends and may not read or change the tables.
        """
        ...

    async def expect(self, connection: AsyncConnection, tables: Sequence[Expected]) -> None:
        """Give the query planner statistics of tables that are still empty."""
        ...

    async def gather_statistics(self, connection: AsyncConnection, tables: Sequence[str]) -> None:
        """Count and sample the rows of tables that have been filled, for the query planner, if it needs that."""
        ...

    def stored_column(self, name: str) -> str:
        """Return the table's column for a view's column: another name if the database reserves this one."""
        ...

    async def add_column(self, connection: AsyncConnection, table: str, definition: str) -> None:
        """Add a column; fail soon if a reader holds a lock, because later readers queue behind this statement."""
        ...

    async def only_views(self, connection: AsyncConnection, views: Collection[str]) -> None:
        """Raise `DatabaseError` if the views' schema contains other objects, which `replace_views` would drop."""
        ...

    async def replace_views(
        self, connection: AsyncConnection, before: Mapping[str, str], after: Mapping[str, str]
    ) -> None:
        """Replace views, by name and SQL, without affecting running queries. A view may use earlier ones of `after`."""
        ...

    async def comment_views(self, connection: AsyncConnection, comments: Mapping[str, Mapping[str, str]]) -> None:
        """Describe views and columns in the database, if it keeps comments: texts by column, the view's own by "".

        Views and columns that do not exist are skipped.
        """
        ...

    async def sweep(self, connection: AsyncConnection) -> None:
        """Drop replaced views that no query reads and no other view uses. Does not wait for locks."""
        ...

    async def empty(self, connection: AsyncConnection, table: str, *, rows_max: int) -> bool:
        """Delete some rows of a table before it is dropped; False when dropping it is fast enough now."""
        ...

    async def drop(self, connection: AsyncConnection, table: str) -> None:
        """Drop a table. Fails soon if a lock is held, and if a foreign view uses the table."""
        ...

    def claim(self, engine: AsyncEngine) -> AbstractAsyncContextManager[bool]:
        """Claim the right to rebuild tables until the context ends or the process dies; yields False if it is taken."""
        ...

    async def shadow_views(self, connection: AsyncConnection, views: Mapping[str, str]) -> None:
        """Create views that hide those of the same names, for this connection only, until it is closed.

        Must be first in the transaction. A view may use those before it.
        """
        ...

    async def insertion(self, rows: RowsByTable) -> Insertion:
        """Prepare the insertion of these rows, before the transaction, so that it is short. Yields to other tasks."""
        ...

    async def insert(self, connection: AsyncConnection, insertion: Insertion) -> None:
        """Insert the prepared rows. Raises `RowRefused`."""
        ...

    async def update_rows(
        self, connection: AsyncConnection, table: str, columns: Mapping[str, str], rows: Sequence[tuple[Any, ...]]
    ) -> None:
        """Update rows by id. `columns` maps names to SQL types; the first is the id. Raises `RowRefused`."""
        ...

    # --- faults -------------------------------------------------------------------------------------------------

    faults: tuple[type[Exception], ...]
    """The exceptions of the driver, and those SQLAlchemy raises for it."""

    def refusal(self, error: Exception) -> str | None:
        """Return the reason why the database can never create such a table or view; None for a temporary error."""
        ...

    def translate_error(self, error: Exception, name: str) -> PycrormError:
        """Return the error of this package to raise instead."""
        ...
