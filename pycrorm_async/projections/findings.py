"""Define the findings of a verification: damage to the log, differences in the tables, parked and refused episodes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, Literal, NamedTuple, Protocol

from sqlalchemy import ColumnElement, Table, column, select
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseForeign
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, row_id_min, row_key
from pycrorm_async.projections.columns import CORE, LINK_BOX, OF_NO_EPISODE, Storage, leaf_columns, make_table
from pycrorm_async.projections.generations import Generation
from pycrorm_async.projections.row_batch import Row
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

# === row comparison ===========================================================================================
#
# Compare the rows that the fold makes with the rows in the tables, for one part of the log at a time.
#
# A part may be any piece of an episode: nodes that still run where it ends are compared with a later part.

_EPISODE_KEYED = ("process_metadata", "simulated_episode")
_NODES = "task_tree_node"
_KEYS_AT_ONCE = 1_000
"""Bounds the keys of one query, because databases bound its parameters."""


class Difference(NamedTuple):
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


class FoldedRows(Protocol):
    """The rows that a fold makes of events."""

    def to_insert(self) -> Mapping[tuple[str, tuple[str, ...]], Sequence[Row]]:
        """Return the rows by (table, columns)."""
        ...


class Range(NamedTuple):
    """A half-open range of row ids, `low` to `high`, and of episode numbers, `first` to `end`. None is unbounded."""

    low: int | None
    high: int | None
    first: int | None
    end: int | None


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
    ) -> list[Difference]:
        """Return the differences in the boxes of these descriptions, given by fingerprint."""
        stored = await _rows(connection, self._link_box, self._link_box.c.model.in_(sorted(boxes)))
        in_order = itemgetter(*map([*OF_NO_EPISODE[LINK_BOX]].index, self._link_box.columns.keys()))
        folded = {row[:2]: in_order(row) for rows in boxes.values() for row in rows}
        self.count += len(stored)
        return [*_compared(LINK_BOX, [*self._link_box.columns.keys()], folded, stored)]

    async def differences(
        self,
        connection: AsyncConnection,
        rows: FoldedRows,
        within: Range,
        *,
        carried: Collection[int],
        settled: Collection[int],
    ) -> list[Difference]:
        """Return the differences in one part of the log.

        Args:
            connection: in the transaction to read in.
            rows: the folded rows of this part.
            within: the range of rows that this part, and no other, makes.
            carried: ids of nodes that still run and are compared with a later part.
            settled: ids of nodes carried from earlier parts that are compared now.
        """
        self.count = 0
        expected = self._expected(rows)
        differences: list[Difference] = []
        for name, table in self._tables.items():
            folded = expected.pop(name, {})
            first, end = (within.first, within.end) if name in _EPISODE_KEYED else (within.low, within.high)
            stored = await self._read(connection, table, first, end)
            if name == _NODES:
                stored |= await self._nodes(connection, table, [*settled])
                for each in carried:
                    folded.pop((each,), None)
                    stored.pop((each,), None)
            self.count += len(stored)
            differences += _compared(name, [*table.columns.keys()], folded, stored)
        for name, folded in expected.items():  # of types declared after these tables were created
            differences += _compared(name, [], folded, {})
        return differences

    async def _nodes(self, connection: AsyncConnection, table: Table, keys: list[int]) -> dict[Row, Row]:
        read: dict[Row, Row] = {}
        for start in range(0, len(keys), _KEYS_AT_ONCE):
            read |= await _rows(connection, table, table.c.id.in_(keys[start : start + _KEYS_AT_ONCE]))
        return read

    async def _read(
        self, connection: AsyncConnection, table: Table, first: int | None, end: int | None
    ) -> dict[Row, Row]:
        key = next(iter(table.primary_key.columns))
        where = [key >= first] if first is not None else []
        return await _rows(connection, table, *where, *([key < end] if end is not None else []))

    def _expected(self, rows: FoldedRows) -> dict[str, dict[Row, Row]]:
        expected: dict[str, dict[Row, Row]] = {}
        for (name, columns), folded in rows.to_insert().items():
            table = self._tables.get(name)
            whole = columns if table is None else tuple(table.columns.keys())
            into = expected.setdefault(name, {})
            keys = _key_of(columns, table)
            if whole == columns:
                into.update((keys(row), row) for row in folded)
                continue
            if set(whole) <= set(columns):
                in_order = itemgetter(*map(columns.index, whole))
                into.update((keys(row), in_order(row)) for row in folded)
                continue
            places = [columns.index(each) if each in columns else None for each in whole]
            for row in folded:
                into[keys(row)] = tuple(None if place is None else row[place] for place in places)
        return expected


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
) -> Iterator[Difference]:
    if folded_rows == stored_rows:
        return
    for key in sorted(folded_rows.keys() | stored_rows.keys(), key=_comparable):
        stored, expected = stored_rows.get(key), folded_rows.get(key)
        if stored == expected:
            continue
        number, sequence = (key[0], 1) if name in _EPISODE_KEYED else _event_of(key[0])
        if stored is None or expected is None:
            yield Difference(number, sequence, name, None, stored, expected)
            continue
        for title, one, other in zip(columns, stored, expected, strict=True):
            if one != other:
                yield Difference(number, sequence, name, title, one, other)


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
    """

    episodes: int = 0
    events: int = 0
    rows: int = 0
    behind: int = 0
    damage: int = 0
    drift: int = 0
    damages: list[Damage] = field(default_factory=list)
    differences: list[Difference] = field(default_factory=list)
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

    def add_difference(self, difference: Difference) -> None:
        """Count a difference and keep it, unless there are many."""
        self.drift += 1
        self._drifted.add(difference.number)
        if len(self.differences) < _FINDINGS_MAX:
            self.differences.append(difference)


# === parts ====================================================================================================
#
# Check a range of episodes part by part, each part in one snapshot, with a `PartCheck` for the tables to compare.

_PART_EVENTS = 4_000
"""Bounds the events of one part, and so the memory used."""
_ATTEMPTS = 10
"""Bounds the snapshots for one part while rebuilds replace the tables."""


class Unreadable(Exception):
    """The database cannot read the first event of this span, or a later one."""

    def __init__(self, span: Span, reason: str) -> None:
        super().__init__(reason)
        self.span = span


class Place(NamedTuple):
    """The place in the log behind event `after` of episode `number`."""

    number: int
    after: int = 0

    @property
    def row(self) -> int:
        """The smallest id of a row made by an event behind this place."""
        return row_id_min(self.number, self.after + 1 if self.after else 0)


class PartCheck(Protocol):
    """Compares one kind of tables with the log.

    Attributes:
        result: to which the findings are added.
        missing_table: the error for a table that is missing.
    """

    result: VerifyResult
    missing_table: str

    async def comparison(self, connection: AsyncConnection) -> Comparison | None:
        """Return the comparison with the tables of this snapshot; None ends the check."""
        ...

    async def check(
        self, connection: AsyncConnection, comparison: Comparison, at: Place, within: EpisodeRange, limit: int
    ) -> Place | None:
        """Check some `limit` events behind this place; return the next place, None at the end of the range.

        Raises `Unreadable`, and then has reported nothing.
        """
        ...


class EpisodeRange(NamedTuple):
    """The episodes with numbers from `first` up to but not including `end`; None is the end of the memory."""

    first: int = 0
    end: int | None = None

    @property
    def limits(self) -> dict[str, int]:
        """The parameters `first` and `end` of a query."""
        return {"first": self.first, "end": EPISODE_NUMBER_MAX + 1 if self.end is None else self.end}

    async def check(self, log: EventLog, check: PartCheck) -> None:
        """Check all parts of this range. Raises `DatabaseForeign` if a table is missing."""
        at: Place | None = Place(self.first)
        limit = _PART_EVENTS
        while at is not None:
            try:
                at = await self._check_part(log, check, at, limit)
                limit = min(limit * 8, _PART_EVENTS)
            except Unreadable as fault:
                if limit > 1:  # shorten the part until the unreadable event is alone
                    limit = max(limit // 8, 1)
                else:
                    check.result.add_damage(fault.span.number, fault.span.last, f"cannot be read: {fault}")
                    at = Place(fault.span.number + 1)

    async def _check_part(self, log: EventLog, check: PartCheck, at: Place, limit: int) -> Place | None:
        for _ in range(_ATTEMPTS):
            async with log.snapshot() as connection:
                comparison = await check.comparison(connection)
                if comparison is None:
                    return None
                if not comparison.tables or await dialect_of(connection).keep(connection, comparison.tables):
                    return await check.check(connection, comparison, at, self, limit)
            # A rebuild replaced and dropped the tables between two statements: read the generation again.
        raise DatabaseForeign(f"{log.address}: {check.missing_table}")
