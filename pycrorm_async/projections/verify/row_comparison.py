"""What a fold makes against what the tables show, row by row, part after part of the log.

A part can be any piece of an episode: nodes that have not ended where it ends are looked at in a later one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

from sqlalchemy import ColumnElement, Table, column, select
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.ids import row_key
from pycrorm_async.projections.fold.row_batch import Row
from pycrorm_async.projections.schema.generations import Generation
from pycrorm_async.projections.schema.tables import CORE, Storage, make_table

__all__ = ["Comparison", "Difference", "Range"]

_EPISODE_KEYED = ("process_metadata", "simulated_episode")
_NODES = "task_tree_node"
_KEYS_AT_ONCE = 1_000


class Difference(NamedTuple):
    """A place where a table does not show what the log says.

    Attributes:
        number, sequence: of the episode in this database, and of the event that makes the row.
        table: as people know it.
        column: None if the row as a whole is missing, or should not be there.
        stored, expected: what the table has and what the fold makes; None for a row that is not there.
    """

    number: int
    sequence: int
    table: str
    column: str | None
    stored: Any
    expected: Any

    def __str__(self) -> str:
        if self.column is None:
            what = "has a row that no event makes" if self.expected is None else "lacks a row"
            return f"{self.table} {what}: {self.stored if self.expected is None else self.expected}"
        return f"{self.table}.{self.column} is {self.stored!r}, and should be {self.expected!r}"


class Made(Protocol):
    """What a fold makes of events."""

    def to_insert(self) -> Mapping[tuple[str, tuple[str, ...]], Sequence[Row]]:
        """Rows by (table, columns)."""
        ...


class Range(NamedTuple):
    """The rows with an id from `low` on and below `high`; and the episodes from number `first` on and below `end`.

    None: whatever there is on that side.
    """

    low: int | None
    high: int | None
    first: int | None
    end: int | None


class Comparison:
    """Compares the tables of one generation with what folds make: those of its layout, and `core`.

    Attributes:
        generation: whose tables these are.
        count: of the rows that were looked at last.
        tables: their names in the database.
    """

    def __init__(
        self, generation: Generation, stored: Callable[[str], str], core: Mapping[str, dict[str, Storage]] = CORE
    ) -> None:
        self.generation = generation
        self.count = 0
        self._tables: dict[str, Table] = {}
        leaves: dict[str, dict[str, Storage]] = {
            name: {"id": "key", **columns} for name, columns in generation.layout.leaves.items()
        }
        for name, columns in (dict(core) | leaves).items():
            self._tables[name] = make_table(name, columns, generation.number, stored)
        self.tables = [each.name for each in self._tables.values()]

    async def differences(
        self,
        connection: AsyncConnection,
        rows: Made,
        within: Range,
        *,
        carried: Collection[int],
        settled: Collection[int],
    ) -> list[Difference]:
        """What is different in a part of the log.

        Args:
            connection: everything is read in its transaction.
            rows: what the fold makes of this part.
            within: the rows this part must have made, and no other.
            carried: ids of nodes that have not ended yet; they are looked at later.
            settled: ids of nodes that were carried and are looked at now.
        """
        self.count = 0
        expected = self._expected(rows)
        found: list[Difference] = []
        for name, table in self._tables.items():
            made = expected.pop(name, {})
            first, end = (within.first, within.end) if name in _EPISODE_KEYED else (within.low, within.high)
            there = await self._read(connection, table, first, end)
            if name == _NODES:
                there |= await self._nodes(connection, table, [*settled])
                for each in carried:
                    made.pop((each,), None)
                    there.pop((each,), None)
            self.count += len(there)
            found += _compared(name, [*table.columns.keys()], made, there)
        for name, made in expected.items():  # of a type that came later than these tables
            found += _compared(name, [], made, {})
        return found

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

    def _expected(self, rows: Made) -> dict[str, dict[Row, Row]]:
        expected: dict[str, dict[Row, Row]] = {}
        for (name, columns), made in rows.to_insert().items():
            table = self._tables.get(name)
            whole = columns if table is None else tuple(table.columns.keys())
            into = expected.setdefault(name, {})
            keys = _key_of(columns, table)
            if whole == columns:
                into.update((keys(row), row) for row in made)
                continue
            places = [columns.index(each) if each in columns else None for each in whole]
            for row in made:
                into[keys(row)] = tuple(None if place is None else row[place] for place in places)
        return expected


async def _rows(connection: AsyncConnection, table: Table, *where: ColumnElement[bool]) -> dict[Row, Row]:
    """By their keys. Without their types: what a database holds is compared, not what is made of it."""
    untyped: list[ColumnElement[Any]] = [column(each.name) for each in table.columns]
    answer = await connection.execute(select(*untyped).select_from(table).where(*where))
    keys = _key_of(table.columns.keys(), table)
    return {keys(row): row for row in map(tuple, answer.all())}


def _key_of(columns: Sequence[str], table: Table | None) -> Callable[[Row], Row]:
    """The key of a row of these columns."""
    names = ["id"] if table is None else [each.key for each in table.primary_key.columns]
    places = [columns.index(each) for each in names]
    if len(places) == 1:
        (only,) = places
        return lambda row: (row[only],)
    return itemgetter(*places)


def _compared(
    name: str, columns: Sequence[str], made: Mapping[Row, Row], there: Mapping[Row, Row]
) -> Iterator[Difference]:
    if made == there:
        return
    for key in sorted(made.keys() | there.keys(), key=_comparable):
        stored, expected = there.get(key), made.get(key)
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
    """Episode and event that make the row; SQLite also keeps what is no number where a number belongs."""
    return row_key(key)[:2] if isinstance(key, int) else (0, 0)


def _comparable(key: Row) -> list[tuple[str, Any]]:
    return [(type(each).__name__, each) for each in key]
