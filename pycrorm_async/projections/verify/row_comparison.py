"""Compare the rows that the fold makes with the rows in the tables, for one part of the log at a time.

A part may be any piece of an episode: nodes that still run where it ends are compared with a later part.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

from sqlalchemy import ColumnElement, Table, column, select
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.ids import row_key
from pycrorm_async.projections.fold.row_batch import Row
from pycrorm_async.projections.schema.core_columns import CORE, LINK_BOX, OF_NO_EPISODE, Storage
from pycrorm_async.projections.schema.generations import Generation
from pycrorm_async.projections.schema.tables import leaf_columns, make_table

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
