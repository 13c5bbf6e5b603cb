"""Multi-row inserts into SQLite keep every value, whichever columns are None and however many rows there are."""

from __future__ import annotations

import random
from typing import Any

import pytest
from sqlalchemy import BigInteger, Boolean, Column, Double, Integer, MetaData, Table, Text, select

from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog

COLUMNS = ("id", "whole", "text", "real", "truth", "empty", "late")
TABLE = Table(
    "kept",
    MetaData(),
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("whole", BigInteger),
    Column("text", Text),
    Column("real", Double),
    Column("truth", Boolean),
    Column("empty", Text),
    Column("late", BigInteger),
)
VALUES: tuple[tuple[Any, ...], ...] = (
    (None, 0, 1, -1, 2**62, -(2**62)),
    (None, "", "0", "null", "NULL", "'", "\u2028ü"),
    (None, 0.0, 0.1, 1e-320, float("inf")),
    (None, True, False),
    (None,),
)


def any_rows(count: int, *, empty_often: float) -> list[tuple[Any, ...]]:
    """Return rows with columns that are None in all, some and no rows; the last column has its first value late."""
    choice = random.Random(count)
    rows = []
    for number in range(count):
        some = (None if choice.random() < empty_often else choice.choice(values) for values in VALUES)
        rows.append((number + 1, *some, None if number < count - 3 else number))
    return rows


@pytest.mark.parametrize("empty_often", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("count", [1, 63, 64, 65, 300, 5_000])
async def test_inserted_and_updated_rows_hold_the_values_that_were_passed(
    file_log: EventLog, count: int, empty_often: float
) -> None:
    rows = any_rows(count, empty_often=empty_often)
    async with file_log.engine.begin() as connection:
        await connection.run_sync(TABLE.create)
        dialect = dialect_of(connection)
        await dialect.insert(connection, await dialect.insertion({("kept", COLUMNS): rows}))
        stored = [tuple(row) for row in await connection.execute(select(TABLE).order_by(TABLE.c.id))]
        assert repr(stored) == repr(rows)

        changed = [(row[0], *other[1:]) for row, other in zip(rows, reversed(rows), strict=True)]
        kinds = {name: TABLE.c[name].type.compile(dialect=connection.dialect) for name in COLUMNS}
        await dialect.update_rows(connection, "kept", kinds, changed)
        stored = [tuple(row) for row in await connection.execute(select(TABLE).order_by(TABLE.c.id))]
        assert repr(stored) == repr(changed)
