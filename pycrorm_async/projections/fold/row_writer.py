"""From rows to statements: one for each table and batch, as far as the number of its parameters allows.

Values are bound or copied, not written as JSON, so every double arrives as it was; and many rows a statement, not with
`executemany`, which gives up the interpreter's lock at every row and falls to a thousand rows a second beside a busy
plan (measured: 872 against 123,000 a second).
"""

from __future__ import annotations

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.projections.fold.row_batch import EpisodeEnd, NodeEnd, Rows
from pycrorm_async.projections.schema.tables import CORE, column_type, physical_name
from pycrorm_async.store.dialect import Insertion, RowsByTable
from pycrorm_async.store.dialects import dialect_of

__all__ = ["insertion_of", "stored_rows", "write_rows"]


async def insertion_of(engine: AsyncEngine, rows: Rows, generation: int) -> Insertion:
    """What inserts them."""
    return await dialect_of(engine).insertion(stored_rows(engine, rows.to_insert(), generation))


def stored_rows(engine: AsyncEngine, rows: RowsByTable, generation: int) -> RowsByTable:
    """The rows by the names that their tables and columns have in this database, in a generation."""
    stored = dialect_of(engine).stored_column
    return {
        (physical_name(table, generation), (*map(stored, columns),)): some for (table, columns), some in rows.items()
    }


async def write_rows(connection: AsyncConnection, rows: Rows, insertion: Insertion, generation: int) -> None:
    """Inserts and updates all of it in this transaction, which notes the progress too.

    No row may be there already; one that is would be a fault of the fold or of the log, and raises `RowRefused`.
    """
    dialect = dialect_of(connection)
    await dialect.insert(connection, insertion)
    for table, fields, ends in (
        ("task_tree_node", NodeEnd._fields, rows.node_ends),
        ("process_metadata", EpisodeEnd._fields, rows.episode_ends),
    ):
        if ends:
            kinds = {name: column_type(CORE[table][name]).compile(dialect=connection.dialect) for name in fields}
            await dialect.update_rows(connection, physical_name(table, generation), kinds, ends)
    for number in rows.lost:
        await connection.execute(
            text(
                f"UPDATE {physical_name('task_tree_node', generation)} SET status = 'LOST'"  # noqa: S608
                " WHERE process_metadata_id = :number AND status = 'RUNNING'"
            ),
            {"number": number},
        )
