"""Define the findings of a verification: damage to the log, differences in the tables, parked and refused episodes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, Literal, NamedTuple, Protocol

from sqlalchemy import ColumnElement, Table, column, select
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, row_id_min, row_key
from pycrorm_async.events.types import Happening
from pycrorm_async.projections.columns import (
    CORE,
    EPISODE_KEYED,
    LINK_BOX,
    OF_NO_EPISODE,
    Storage,
    leaf_columns,
    make_table,
)
from pycrorm_async.projections.generations import Generation
from pycrorm_async.projections.row_batch import Row
from pycrorm_async.store.stored import EpisodeRow, Span, StoredEvent

# === row comparison ===========================================================================================
#
# Compare the rows that the fold makes with the rows in the tables, for some whole episodes at a time.


class TableDifference(NamedTuple):
    """A row in which a table differs from the log.

    Attributes:
        number, sequence: of the episode in this database, and of the row's event.
        table: its public name.
        column: None if the whole row is missing or superfluous.
        stored, expected: the values in the table and from the fold; None for a missing row.
    """

    number: int
    sequence: int
    table: str
    column: str | None
    stored: Any
    expected: Any

    @property
    def is_superfluous(self) -> bool:
        """True if no event makes the row."""
        return self.column is None and self.expected is None

    def __str__(self) -> str:
        if self.column is None:
            fault = "has a row that no event makes" if self.is_superfluous else "lacks a row"
            return f"{self.table} {fault}: {self.stored if self.is_superfluous else self.expected}"
        return f"{self.table}.{self.column} is {self.stored!r}, and should be {self.expected!r}"


class EpisodeRange(NamedTuple):
    """The episodes with numbers from `first` up to but not including `end`; None is the end of the memory."""

    first: int = 0
    end: int | None = None

    @property
    def limits(self) -> dict[str, int]:
        """The parameters `first` and `last` of a query."""
        return {"first": self.first, "last": EPISODE_NUMBER_MAX if self.end is None else self.end - 1}


class Comparison:
    """Compares the tables of one generation, those of its layout and `core`, with folded rows.

    Attributes:
        generation: the owner of the tables.
        count: the number of stored rows in the last comparison.
        tables: their names in the database.
    """

    def __init__(
        self, generation: Generation, stored: Callable[[str], str], core: Mapping[str, dict[str, Storage]] = CORE
    ) -> None:
        self.generation = generation
        self.count = 0
        self._tables: dict[str, Table] = {}
        leaves: dict[str, dict[str, Storage]] = {
            name: leaf_columns(columns) for name, columns in generation.layout.leaves.items()
        }
        for name, columns in (dict(core) | leaves).items():
            self._tables[name] = make_table(name, columns, generation.number, stored)
        self._link_box = make_table(LINK_BOX, OF_NO_EPISODE[LINK_BOX], generation.number, stored)
        self.tables = [each.name for each in (*self._tables.values(), *((self._link_box,) if core is CORE else ()))]

    async def box_differences(
        self, connection: AsyncConnection, boxes: Mapping[str, Sequence[Row]]
    ) -> list[TableDifference]:
        """Return the differences in the boxes of these descriptions, given by fingerprint."""
        stored = await _rows(connection, self._link_box, self._link_box.c.model.in_(sorted(boxes)))
        in_order = itemgetter(*map([*OF_NO_EPISODE[LINK_BOX]].index, self._link_box.columns.keys()))
        folded = {row[:2]: in_order(row) for rows in boxes.values() for row in rows}
        self.count += len(stored)
        return [*_compared(LINK_BOX, [*self._link_box.columns.keys()], folded, stored)]

    async def differences(
        self,
        connection: AsyncConnection,
        rows: Mapping[tuple[str, tuple[str, ...]], Sequence[Row]],
        episodes: EpisodeRange,
    ) -> list[TableDifference]:
        """Return the differences between the tables and the folded rows of these episodes, in the caller's snapshot.

        `rows` are by (table, columns).
        """
        self.count = 0
        folded = defaultdict[str, list[tuple[tuple[str, ...], Sequence[Row]]]](list)
        for (name, columns), some in rows.items():
            folded[name].append((columns, some))
        differences: list[TableDifference] = []
        first, end = episodes
        row_range = row_id_min(first), None if end is None else row_id_min(end)
        for name, table in self._tables.items():
            low, high = (first, end) if name in EPISODE_KEYED else row_range
            key = next(iter(table.primary_key.columns))
            # The first range also has the rows of numbers below 0, which no episode has.
            where = [*([key >= low] if first else []), *([key <= high - 1] if high is not None else [])]
            stored = await _rows(connection, table, *where)
            self.count += len(stored)
            differences += _compared(name, [*table.columns.keys()], _by_key(table, folded.pop(name, ())), stored)
        for name, parts in folded.items():  # of types declared after these tables were created
            differences += _compared(name, [], _by_key(None, parts), {})
        return differences


def _by_key(table: Table | None, parts: Iterable[tuple[tuple[str, ...], Sequence[Row]]]) -> dict[Row, Row]:
    """Return folded rows, given with their columns, by key and in the columns of the table."""
    by_key: dict[Row, Row] = {}
    for columns, folded in parts:
        whole = columns if table is None else tuple(table.columns.keys())
        keys = _key_of(columns, table)
        if whole == columns:
            by_key.update((keys(row), row) for row in folded)
            continue
        if set(whole) <= set(columns):
            in_order = itemgetter(*map(columns.index, whole))
            by_key.update((keys(row), in_order(row)) for row in folded)
            continue
        places = [columns.index(each) if each in columns else None for each in whole]
        for row in folded:
            by_key[keys(row)] = tuple(None if place is None else row[place] for place in places)
    return by_key


async def _rows(connection: AsyncConnection, table: Table, *where: ColumnElement[bool]) -> dict[Row, Row]:
    """Read rows by their keys, without column types, so that the stored values are compared and not converted ones."""
    untyped: list[ColumnElement[Any]] = [column(each.name) for each in table.columns]
    answer = await connection.execute(select(*untyped).select_from(table).where(*where))
    keys = _key_of(table.columns.keys(), table)
    return {keys(row): row for row in map(tuple, answer.all())}


def _key_of(columns: Sequence[str], table: Table | None) -> Callable[[Row], Row]:
    """Return a function that takes the key out of a row with these columns."""
    names = ["id"] if table is None else [each.key for each in table.primary_key.columns]
    places = [columns.index(each) for each in names]
    if len(places) == 1:
        (only,) = places
        return lambda row: (row[only],)
    return itemgetter(*places)


def _compared(
    name: str, columns: Sequence[str], folded_rows: Mapping[Row, Row], stored_rows: Mapping[Row, Row]
) -> Iterator[TableDifference]:
    if folded_rows == stored_rows:
        return
    for key in sorted(folded_rows.keys() | stored_rows.keys(), key=_comparable):
        stored, expected = stored_rows.get(key), folded_rows.get(key)
        if stored == expected:
            continue
        number, sequence = (key[0], 1) if name in EPISODE_KEYED else _event_of(key[0])
        if stored is None or expected is None:
            yield TableDifference(number, sequence, name, None, stored, expected)
            continue
        for title, one, other in zip(columns, stored, expected, strict=True):
            if one != other:
                yield TableDifference(number, sequence, name, title, one, other)


def _event_of(key: Any) -> tuple[int, int]:
    """Return number and sequence of the row's event; (0, 0) if the key is not an integer, as SQLite allows."""
    return row_key(key)[:2] if isinstance(key, int) else (0, 0)


def _comparable(key: Row) -> list[tuple[str, Any]]:
    return [(type(each).__name__, each) for each in key]


# === findings =================================================================================================

_FINDINGS_MAX = 100
"""Bounds the findings of each kind that are kept; all are counted."""


class Damage(NamedTuple):
    """A place where the log contradicts itself; without an episode, the whole database."""

    number: int | None
    sequence: int | None
    reason: str

    def __str__(self) -> str:
        if self.number is None:
            return self.reason
        return f"episode {self.number}, event {self.sequence}: {self.reason}"


class StoppedEpisode(NamedTuple):
    """An episode that is no longer folded (parked) or no longer stored (refused)."""

    number: int
    how: Literal["parked", "refused"]
    reason: str


@dataclass(kw_only=True)
class VerifyResult:
    """The result of a verification, complete when `verify` returns it.

    Attributes:
        episodes, events, rows: the number of each that was checked.
        behind: the number of events that are not folded yet, which is normal while robots record.
        damage, drift: the number of findings of damage and of differences.
        damages, differences: the first hundred of each.
        remarks: the number of unusual event orders that correct plans produce too.
        not_compared: by name, the reason why the tables of a custom projection were not compared.
        stopped: the parked and refused episodes; the rows of their earlier events were compared.
        unmade: by dtype, the reason why a designator type has no tables.
        failed_views: by name, the reason why a user's view is left out.
        blobs: by hash, the first event that refers to this blob; the content of each is compared with its hash.
        without_digest: the number of episodes without a digest; for them it is not known whether one was deleted.
        deleted: the episodes of which events were deleted.
        rows_without_event: the number of rows, among the differences, of events that the log does not have.
        outdated: the reason why no table was compared: an older fold made them. None for tables of this version.
        erased, archived: the number of episodes that were removed from the log.
    """

    episodes: int = 0
    events: int = 0
    rows: int = 0
    behind: int = 0
    damage: int = 0
    drift: int = 0
    damages: list[Damage] = field(default_factory=list)
    differences: list[TableDifference] = field(default_factory=list)
    remarks: int = 0
    not_compared: Mapping[str, str] = field(default_factory=dict)
    stopped: list[StoppedEpisode] = field(default_factory=list)
    unmade: Mapping[str, str] = field(default_factory=dict)
    failed_views: Mapping[str, str] = field(default_factory=dict)
    blobs: dict[str, tuple[int | None, int | None]] = field(default_factory=dict)
    without_digest: int = 0
    deleted: set[int] = field(default_factory=set)
    rows_without_event: int = 0
    outdated: str | None = None
    erased: int = 0
    archived: int = 0

    def __post_init__(self) -> None:
        self._without_digest: set[int] = set()
        self._drifted: set[int] = set()

    @property
    def undecided(self) -> int:
        """The number of episodes without a digest whose tables differ: either these or the log was changed."""
        return len(self._without_digest & self._drifted)

    def add_damage(self, number: int | None, sequence: int | None, reason: str) -> None:
        """Count a damage and keep it, unless there are many."""
        self.damage += 1
        if len(self.damages) < _FINDINGS_MAX:
            self.damages.append(Damage(number, sequence, " ".join(reason.split())))

    def add_deleted(self, number: int, first: int | None, reason: str) -> None:
        """Add the damage that an episode's events from `first` on, or all of them, were deleted; once for each."""
        if number not in self.deleted:
            self.deleted.add(number)
            self.add_damage(None if first is None else number, first, reason)

    def add_without_digest(self, number: int) -> None:
        """Count an episode without a digest."""
        self.without_digest += 1
        self._without_digest.add(number)

    def add_difference(self, difference: TableDifference) -> None:
        """Count a difference and keep it, unless there are many."""
        self.drift += 1
        self._drifted.add(difference.number)
        if len(self.differences) < _FINDINGS_MAX:
            self.differences.append(difference)


# === checks ===================================================================================================


class Unreadable(Exception):
    """The database cannot read this event of an episode."""

    def __init__(self, number: int, sequence: int, reason: str) -> None:
        super().__init__(reason)
        self.number = number
        self.sequence = sequence


class TableCheck(Protocol):
    """Compares one kind of tables with the log, some whole episodes at a time.

    Attributes:
        missing_table: the error for a table that is missing.
    """

    missing_table: str

    async def begin(self, connection: AsyncConnection, part: EpisodeRange, episodes: Sequence[EpisodeRow], /) -> bool:
        """Begin with these episodes, all of this range, in a snapshot; return False if a table is missing."""
        ...

    def read(self, span: Span, events: Sequence[StoredEvent], happenings: Sequence[Happening | Exception], /) -> None:
        """Fold the next events of an episode, given with their decoded payloads, or why one cannot be decoded.

        `events` lacks those that the log lacks.
        """
        ...

    def lose(self, number: int, sequence: int) -> None:
        """Stop reading an episode, whose events from this one on cannot be read."""
        ...

    async def compare(self, connection: AsyncConnection) -> None:
        """Compare the tables with the events that were read."""
        ...
