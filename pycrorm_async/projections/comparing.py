"""What a fold makes against what the tables show, row by row, part after part of the log.

Nodes that have not ended where a part ends are carried to the next one, so that a part can be any piece of an episode,
and memory stays flat however long that is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, Table, select
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.ids import row_key
from pycrorm_async.projections.generations import Generation
from pycrorm_async.projections.rows import Row, Rows
from pycrorm_async.projections.tables import COLUMNS, CORE, Storage, make_table

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


class Range(NamedTuple):
    """The rows with an id from `low` on and below `high`; and the episodes from number `first` on and below `end`."""

    low: int
    high: int
    first: int
    end: int


class Comparison:
    """Compares the tables of one generation with what folds make.

    Attributes:
        count: of the rows that were looked at.
        tables: their names in the database.
    """

    def __init__(self, generation: Generation) -> None:
        self.count = 0
        self.tables: list[str] = []
        self._tables: dict[str, Table] = {}
        self._columns: dict[str, tuple[str, ...]] = dict(COLUMNS)
        leaves: dict[str, dict[str, Storage]] = {
            name: {"id": "key", **columns} for name, columns in generation.layout.leaves.items()
        }
        for name, columns in (CORE | leaves).items():
            self._tables[name] = make_table(name, columns, generation.number)
            self.tables.append(self._tables[name].name)
            self._columns[name] = tuple(columns)

    async def differences(
        self, connection: AsyncConnection, rows: Rows, within: Range, *, carried: Sequence[int], settled: Sequence[int]
    ) -> list[Difference]:
        """What is different in a part of the log.

        Args:
            connection: everything is read in its transaction.
            rows: what the fold makes of this part.
            within: the rows this part must have made, and no other.
            carried: ids of nodes that have not ended yet; they are looked at later.
            settled: ids of nodes that were carried and are looked at now.
        """
        expected = self._expected(rows)
        later = set(carried)
        found: list[Difference] = []
        for name, table in self._tables.items():
            made = expected.get(name, {})
            key = list(table.primary_key.columns)
            first, end = (within.first, within.end) if name in _EPISODE_KEYED else (within.low, within.high)
            there = await self._read(connection, table, key, key[0] >= first, key[0] < end)
            if name == _NODES:
                for start in range(0, len(settled), _KEYS_AT_ONCE):
                    some = settled[start : start + _KEYS_AT_ONCE]
                    there |= await self._read(connection, table, key, key[0].in_(some))
                for each in later:
                    made.pop((each,), None)
                    there.pop((each,), None)
            self.count += len(there)
            found += self._compared(name, made, there)
        return found

    async def _read(
        self, connection: AsyncConnection, table: Table, key: Sequence[ColumnElement[Any]], *where: ColumnElement[bool]
    ) -> dict[Row, Row]:
        width = len(key)
        answer = await connection.execute(select(*key, *table.columns).where(*where))
        return {tuple(row[:width]): tuple(row[width:]) for row in answer}

    def _expected(self, rows: Rows) -> dict[str, dict[Row, Row]]:
        expected: dict[str, dict[Row, Row]] = {}
        for (name, columns), made in rows.to_insert().items():
            whole = self._columns[name]
            places = [columns.index(each) if each in columns else None for each in whole]
            keys = [whole.index(each.name) for each in self._tables[name].primary_key.columns]
            into = expected.setdefault(name, {})
            for row in made:
                values = tuple(None if place is None else row[place] for place in places)
                into[tuple(values[key] for key in keys)] = values
        return expected

    def _compared(self, name: str, made: Mapping[Row, Row], there: Mapping[Row, Row]) -> Iterator[Difference]:
        for key in _ordered(made.keys() | there.keys()):
            stored, expected = there.get(key), made.get(key)
            if stored == expected:
                continue
            number, sequence = (key[0], 1) if name in _EPISODE_KEYED else row_key(key[0])[:2]
            if stored is None or expected is None:
                yield Difference(number, sequence, name, None, stored, expected)
                continue
            for column, one, other in zip(self._columns[name], stored, expected, strict=True):
                if one != other:
                    yield Difference(number, sequence, name, column, one, other)


def _ordered(keys: Iterable[Row]) -> list[Row]:
    return sorted(keys, key=lambda key: tuple(map(str, key)) if len(key) > 1 else key)
