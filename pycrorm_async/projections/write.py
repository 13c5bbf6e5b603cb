"""From rows to statements: one for each table and batch, as far as the number of its parameters allows.

Values are bound, not written as JSON, so every double arrives as it was; and in many rows a statement, not with
`executemany`, which gives up the interpreter's lock at every row and falls to a thousand rows a second beside a busy
plan (measured: 872 against 123,000 a second).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.projections.rows import EpisodeEnd, NodeEnd, Rows
from pycrorm_async.projections.tables import physical_name

__all__ = ["write_rows"]

_PARAMETERS_MAX = 8_000
"""In one statement. SQLite takes 32,766, but is a third slower with so many; with fewer, a busy plan is waited for more
often."""


async def write_rows(connection: AsyncConnection, rows: Rows, generation: int) -> None:
    """Inserts and updates all of it in this transaction, which notes the progress too.

    So no row is there already; one that is would be a fault of the fold or of the log, and raises `IntegrityError`.
    """
    for (table, columns), made in rows.to_insert().items():
        await _insert(connection, physical_name(table, generation), columns, made)
    await _update(connection, physical_name("task_tree_node", generation), NodeEnd._fields, rows.node_ends)
    await _update(connection, physical_name("process_metadata", generation), EpisodeEnd._fields, rows.episode_ends)
    for number in rows.lost:
        await connection.exec_driver_sql(
            f"UPDATE {physical_name('task_tree_node', generation)} SET status = 'LOST'"  # noqa: S608
            " WHERE process_metadata_id = ? AND status = 'RUNNING'",
            (number,),
        )


async def _insert(
    connection: AsyncConnection, table: str, columns: Sequence[str], rows: Sequence[tuple[Any, ...]]
) -> None:
    quote = connection.dialect.identifier_preparer.quote
    into = f"INSERT INTO {quote(table)} ({', '.join(map(quote, columns))}) VALUES "  # noqa: S608
    for part in _parts(rows, len(columns)):
        await connection.exec_driver_sql(f"{into}{_placeholders(part)}", tuple(chain.from_iterable(part)))


async def _update(
    connection: AsyncConnection, table: str, columns: Sequence[str], rows: Sequence[tuple[Any, ...]]
) -> None:
    changes = ", ".join(f"{column} = change.column{place}" for place, column in enumerate(columns[1:], 2))
    for part in _parts(rows, len(columns)):
        await connection.exec_driver_sql(
            f"UPDATE {table} SET {changes}"  # noqa: S608
            f" FROM (VALUES {_placeholders(part)}) AS change WHERE {table}.id = change.column1",
            tuple(chain.from_iterable(part)),
        )


def _parts(rows: Sequence[tuple[Any, ...]], columns: int) -> Iterator[Sequence[tuple[Any, ...]]]:
    size = _PARAMETERS_MAX // columns
    for start in range(0, len(rows), size):
        yield rows[start : start + size]


def _placeholders(rows: Sequence[tuple[Any, ...]]) -> str:
    one = f"({', '.join('?' * len(rows[0]))})"
    return ", ".join([one] * len(rows))
