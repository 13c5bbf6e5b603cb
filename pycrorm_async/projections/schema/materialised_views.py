"""Keep materialised views up to date: delete and insert again the rows of each episode that has changed.

The result is exact because each row comes from one episode only, which its column `process_metadata_id` names. A
second table stores how much of each episode was folded when its rows were computed. Every process that folds refreshes
all materialised views, because their SQL is stored in the database.
"""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import Index, text
from sqlalchemy.ext.asyncio import AsyncConnection
from sqlalchemy.schema import CreateIndex, CreateTable

from pycrorm_async.errors import DatabaseError
from pycrorm_async.projections.schema.core_columns import EPISODE, Storage
from pycrorm_async.projections.schema.layout import Layout, MaterialisedView
from pycrorm_async.projections.schema.tables import make_table
from pycrorm_async.projections.table_names import index_name, physical_name
from pycrorm_async.store.dialects import dialect_of

_EPISODES = 200
"""Bounds the episodes refreshed in one transaction, and so the time for which it locks out other writers."""
_PROGRESS: dict[str, Storage] = {"id": "key", "folded": "integer"}


class ViewRefused(DatabaseError):
    """The database refuses the query of a materialised view, such as one of a table that was dropped."""

    def __init__(self, view: str, reason: str) -> None:
        super().__init__(f"the database refuses the rows of the view {view}: {reason}")
        self.view = view
        self.reason = reason


async def make_materialised(connection: AsyncConnection, kept: MaterialisedView, generation: int) -> None:
    """Create the two tables of a materialised view, empty."""
    stored = dialect_of(connection).stored_column
    rows = make_table(kept.table, kept.columns, generation, stored)
    await connection.execute(CreateTable(rows))
    index = Index(index_name(kept.table, EPISODE, generation), rows.c[EPISODE])
    await connection.execute(CreateIndex(index))
    await connection.execute(CreateTable(make_table(kept.progress, _PROGRESS, generation, stored)))


def materialised_tables(layout: Layout) -> list[str]:
    """Return all tables of materialised views, including those of views whose SQL was changed since."""
    present = [name for kept in layout.kept.values() for name in (kept.table, kept.progress)]
    return [*present, *layout.outdated]


def shown_texts(layout: Layout, generation: int, stored: Callable[[str], str]) -> dict[str, str]:
    """Return name and public SQL of every user's view; that of a materialised view selects from its table."""
    texts = dict(layout.user_views)
    for name, kept in layout.kept.items():
        columns = ", ".join(f'"{stored(each)}" AS "{each}"' for each in kept.columns)
        texts[name] = f"SELECT {columns} FROM {physical_name(kept.table, generation)}"  # noqa: S608
    return texts


async def refresh_some(
    connection: AsyncConnection, layout: Layout, generation: int, *, folded: str = "SELECT number, folded FROM episode"
) -> bool:
    """Refresh the rows of some changed episodes from the connection's views; return False if none has changed.

    Leaves out the views that failed. Raises `ViewRefused`; then the transaction can continue.

    Args:
        connection: in a transaction that excludes other refreshes.
        layout, generation: of the tables behind the views.
        folded: SQL that selects, for each episode, the last sequence in those tables.
    """
    done = False
    dialect = dialect_of(connection)
    for name, kept in layout.kept.items():
        if name in layout.failed_views:
            continue
        table, progress = physical_name(kept.table, generation), physical_name(kept.progress, generation)
        episodes = await connection.execute(
            text(
                f"SELECT source.number, source.folded FROM ({folded}) AS source"  # noqa: S608
                f" LEFT JOIN {progress} AS progress ON progress.id = source.number"
                " WHERE source.folded <> coalesce(progress.folded, 0) ORDER BY source.number LIMIT :limit"
            ),
            {"limit": _EPISODES},
        )
        behind = [tuple(row) for row in episodes]
        if not behind:
            continue
        done = True
        numbers = ", ".join(str(int(number)) for number, _ in behind)
        columns = ", ".join(f'"{each}"' for each in kept.columns)
        stored = ", ".join(f'"{dialect.stored_column(each)}"' for each in kept.columns)
        query = layout.user_views[name]
        changed = f"{EPISODE} IN ({numbers})"
        try:
            async with connection.begin_nested():
                for statement in (
                    f"DELETE FROM {table} WHERE {changed}",  # noqa: S608
                    f"INSERT INTO {table} ({stored}) SELECT {columns} FROM ({query}) AS meaning WHERE {changed}",  # noqa: S608
                    f"DELETE FROM {progress} WHERE id IN ({numbers})",  # noqa: S608
                ):
                    await connection.exec_driver_sql(statement)  # unlike `text()` it leaves a ':name' alone
        except dialect.faults as error:
            reason = dialect.refusal(error)
            if reason is None:
                raise
            raise ViewRefused(name, reason) from error
        await dialect.insert(connection, await dialect.insertion({(progress, tuple(_PROGRESS)): behind}))
    return done
