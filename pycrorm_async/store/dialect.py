"""What the log asks of a kind of database: `store.sqlite` and `store.postgresql` answer, nothing else of it differs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Any, NamedTuple, Protocol, TypeAlias

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.errors import PycrormError
from pycrorm_async.store.stored import EpisodeRow, Incarnation, Span, StoredEvent

__all__ = [
    "Dialect",
    "Birth",
    "Expected",
    "Found",
    "Insertion",
    "Migrations",
    "Progress",
    "RowRefused",
    "RowsByTable",
    "StoredOn",
]

Migrations: TypeAlias = Sequence[Sequence[str]]
"""Numbered steps; format N is what the first N of them make."""

RowsByTable: TypeAlias = Mapping[tuple[str, tuple[str, ...]], Sequence[tuple[Any, ...]]]
"""Rows to insert, by table and its columns."""

Insertion: TypeAlias = Any
"""Rows to insert as the driver takes them: known to the dialect alone."""

Progress: TypeAlias = tuple[int, int, int]
"""An episode's number, how far it was folded, how far it is now."""


class Birth(NamedTuple):
    """What a log gets when it is made: its id, a UUID as text, and the time."""

    log_id: str
    created_wall_ns: int


class Found(NamedTuple):
    """The log that is in a database already."""

    log_id: str
    format: int


class StoredOn(NamedTuple):
    """On how many machines a committed event is; the `standbys` that confirm each COMMIT, as far as they are known."""

    machines: int
    standbys: tuple[str, ...] = ()


class RowRefused(ValueError):
    """A row that the database cannot hold: a key that is taken, a value that does not fit its column."""


class Expected(NamedTuple):
    """How many rows of a table are expected, and by index how many of them have a value in common: that of its first
    column, those of its first two."""

    table: str
    rows: int
    alike: Mapping[str, Sequence[int]]


class Dialect(Protocol):
    """Everything that is given a connection happens within the caller's transaction, in one statement a table."""

    # --- is there a log, and making one -------------------------------------------------------------------------

    migrations: Migrations

    async def prepare(self, engine: AsyncEngine, name: str) -> None:
        """What must be done outside a transaction before a log is made or grown in a database that is ours or empty."""
        ...

    async def alone(self, connection: AsyncConnection) -> None:
        """Until the transaction ends nobody else makes or grows a log here."""
        ...

    async def look(self, connection: AsyncConnection, name: str) -> Found | None:
        """The log in this database, None if it is empty. Raises `DatabaseForeign`, `DatabaseUnavailable`."""
        ...

    async def execute_all(self, connection: AsyncConnection, statements: Sequence[str]) -> None:
        """Without parameters and answers, one after the other; over a slow line as fast as one of them."""
        ...

    async def note_birth(self, connection: AsyncConnection, birth: Birth, format_now: int) -> None: ...

    async def note_format(self, connection: AsyncConnection, format_now: int) -> None: ...

    # --- appending ----------------------------------------------------------------------------------------------

    async def insert_declarations(self, connection: AsyncConnection, named: Sequence[tuple[str, str]]) -> None:
        """(fingerprint, payload) of each; those that are there already stay as they are."""
        ...

    async def episodes_by_id(
        self, connection: AsyncConnection, ids: Sequence[str], *, witness: str | None = None
    ) -> list[EpisodeRow]:
        """Those of them that are there; nobody else changes them before the transaction ends. And the witness, which
        others may change, perhaps twice."""
        ...

    async def new_numbers(self, connection: AsyncConnection, count: int, *, above: int = 0) -> list[int]:
        """Numbers that no episode has or will have had; if some up to `above` are not given yet, with a reserve left
        free behind it (`numbers_reserved`)."""
        ...

    async def skip_numbers(self, connection: AsyncConnection, above: int) -> None:
        """From now on no transaction gets a new number up to `above` and the reserve behind it, if it gives them out
        by itself; else `new_numbers` sees to it."""
        ...

    async def numbers_taken(self, connection: AsyncConnection, numbers: Sequence[int]) -> set[int]:
        """Those of these numbers that an episode has."""
        ...

    async def heads(self, connection: AsyncConnection, ids: Sequence[str]) -> list[EpisodeRow]:
        """As `episodes_by_id`, and nobody waits for anybody."""
        ...

    async def note_incarnation(self, connection: AsyncConnection, incarnation: Incarnation) -> None:
        """Notes that the log went back, in a table that is made if need be."""
        ...

    async def incarnations(self, connection: AsyncConnection) -> list[Incarnation]:
        """How often the log went back, the oldest first; none where there is no table of it."""
        ...

    async def stored_on(self, connection: AsyncConnection) -> StoredOn:
        """On how many machines an event is when its COMMIT returned."""
        ...

    async def event_insertion(self, rows: Sequence[tuple[Any, ...]]) -> Insertion:
        """What inserts these events, as `insertion`. Each row is a `StoredEvent`'s fields, but the payload is text."""
        ...

    async def insert_events(self, connection: AsyncConnection, insertion: Insertion) -> None: ...

    async def upsert_episodes(self, connection: AsyncConnection, episodes: Sequence[EpisodeRow]) -> None:
        """`folded` and `parked` stay as they are."""
        ...

    async def note_again(self, connection: AsyncConnection) -> None:
        """Makes COMMIT of a transaction that changes nothing as durable as that of one that does."""
        ...

    async def commit(self, connection: AsyncConnection) -> None:
        """Commits. Raises `DatabaseUnavailable` where it is not certain that what was committed is durable."""
        ...

    async def stored_again(self, connection: AsyncConnection, keys: Sequence[tuple[int, int]]) -> list[StoredEvent]:
        """The events under these (episode number, sequence), as far as they are there."""
        ...

    # --- reading ------------------------------------------------------------------------------------------------

    async def episode(self, connection: AsyncConnection, identity: str) -> EpisodeRow | None: ...

    async def episodes(self, connection: AsyncConnection) -> list[EpisodeRow]: ...

    async def behind(self, connection: AsyncConnection, *, after: int, limit: int) -> list[EpisodeRow]:
        """By number, those that follow number `after`."""
        ...

    async def stopped(self, connection: AsyncConnection) -> list[EpisodeRow]: ...

    async def last_number(self, connection: AsyncConnection) -> int:
        """The highest episode number; 0 without episodes."""
        ...

    async def long_episodes(self, connection: AsyncConnection, events_min: int) -> list[EpisodeRow]:
        """The episodes that have not ended and hold at least so many events."""
        ...

    async def events(
        self, connection: AsyncConnection, number: int, *, after: int, limit: int
    ) -> list[StoredEvent]: ...

    async def spans(self, connection: AsyncConnection, spans: Sequence[Span]) -> list[StoredEvent]:
        """The events of each span, in the order of the spans."""
        ...

    async def declarations(self, connection: AsyncConnection) -> list[bytes]: ...

    async def hold_still(self, connection: AsyncConnection) -> None:
        """Whatever is read in the transaction that begins now is of one moment."""
        ...

    async def in_order(self, connection: AsyncConnection) -> None:
        """What is asked for in an order in this transaction is read in it where that can be done, not sorted: for the
        first few of many."""
        ...

    async def keep(self, connection: AsyncConnection, tables: Sequence[str]) -> bool:
        """Until the transaction ends, none of these tables is dropped; False, and the transaction over, if one is."""
        ...

    async def faults_of_file(self, connection: AsyncConnection) -> list[str]:
        """What the database finds wrong with its own pages, if it can be asked."""
        ...

    # --- what a projector adds ----------------------------------------------------------------------------------

    async def advance_folded(self, connection: AsyncConnection, steps: Sequence[Progress]) -> int:
        """How many of the episodes were where they are said to have been."""
        ...

    async def park(self, connection: AsyncConnection, number: int, reason: str | None) -> None: ...

    # --- tables and views made from the log ---------------------------------------------------------------------

    async def make_place(self, connection: AsyncConnection) -> None:
        """Where tables and views go is there afterwards."""
        ...

    async def has_table(self, connection: AsyncConnection, name: str) -> bool:
        """Whether there is a table of that name among them."""
        ...

    async def expect(self, connection: AsyncConnection, tables: Sequence[Expected]) -> None:
        """Of empty tables: how they will be. Which of them a question is best begun with depends on it."""
        ...

    def stored_column(self, name: str) -> str:
        """The column of a table that holds a column of the view before it: another name if the database has its own
        use for this one."""
        ...

    async def add_column(self, connection: AsyncConnection, table: str, definition: str) -> None:
        """Gives up soon where a reader is in the way, so that nobody waits behind the two for long."""
        ...

    async def only_views(self, connection: AsyncConnection, known: Collection[str]) -> None:
        """Raises `DatabaseError` if beside these views stands what `replace_views` would not leave as it is."""
        ...

    async def replace_views(
        self, connection: AsyncConnection, before: Mapping[str, str], after: Mapping[str, str]
    ) -> None:
        """Name and SQL of each. A view may stand on those before it in `after`. Who reads the old ones goes on."""
        ...

    async def sweep(self, connection: AsyncConnection) -> None:
        """Takes away the views that were replaced, unless somebody reads them or stands on them. Waits for nobody."""
        ...

    async def empty(self, connection: AsyncConnection, table: str, *, rows_max: int) -> bool:
        """Deletes rows of a table that is to be dropped; False if dropping it takes no longer now than it must."""
        ...

    async def drop(self, connection: AsyncConnection, table: str) -> None:
        """Gives up soon where somebody is in the way; refuses where a view of somebody else stands on it."""
        ...

    def claim(self, engine: AsyncEngine) -> AbstractAsyncContextManager[bool]:
        """Whether nobody else makes tables anew here; then nobody can until the context is left or the process dies."""
        ...

    async def shadow_views(self, connection: AsyncConnection, views: Mapping[str, str]) -> None:
        """For this connection alone, until it is closed, these views stand before those of the same names.

        Nothing may have happened in the transaction before. A view may stand on those before it.
        """
        ...

    async def insertion(self, rows: RowsByTable) -> Insertion:
        """What inserts these rows: made before the transaction, so that nobody waits for it. Gives way to others."""
        ...

    async def insert(self, connection: AsyncConnection, insertion: Insertion) -> None:
        """Raises `RowRefused`."""
        ...

    async def update_rows(
        self, connection: AsyncConnection, table: str, columns: Mapping[str, str], rows: Sequence[tuple[Any, ...]]
    ) -> None:
        """`columns` maps names to SQL types; the first is the id. Raises `RowRefused`."""
        ...

    # --- faults -------------------------------------------------------------------------------------------------

    faults: tuple[type[Exception], ...]
    """What its driver raises, and SQLAlchemy in its name."""

    def refusal(self, error: Exception) -> str | None:
        """Why the database never makes a table or view as it was asked to; None if it only did not do so now."""
        ...

    def ours(self, error: Exception, name: str) -> PycrormError:
        """The error of ours to raise in its place."""
        ...
