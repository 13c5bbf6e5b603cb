"""Users' views that are kept as tables: an episode that has changed has its rows deleted and inserted again.

So such a view is exact if each of its rows comes from one episode alone, which its column `process_metadata_id` names.
A table beside it notes how much of each episode was folded when its rows were made. Whoever folds keeps it up to date,
also a process that does not know the view: what it means is noted as SQL.
"""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import Index, text
from sqlalchemy.ext.asyncio import AsyncConnection
from sqlalchemy.schema import CreateIndex, CreateTable

from pycrorm_async.projections.schema.layout import Kept, Layout
from pycrorm_async.projections.schema.tables import Storage, index_name, make_table, physical_name
from pycrorm_async.store.dialects import dialect_of

__all__ = ["EPISODE", "make_kept", "refresh_some", "shown_texts", "kept_tables"]

EPISODE = "process_metadata_id"
_EPISODES = 200
"""So many episodes are made anew in one transaction."""
_PROGRESS: dict[str, Storage] = {"id": "key", "folded": "integer"}


async def make_kept(connection: AsyncConnection, kept: Kept, generation: int) -> None:
    """Makes its two tables, empty."""
    stored = dialect_of(connection).stored_column
    rows = make_table(kept.table, kept.columns, generation, stored)
    await connection.execute(CreateTable(rows))
    index = Index(index_name(kept.table, EPISODE, generation), rows.c[EPISODE])
    await connection.execute(CreateIndex(index))
    await connection.execute(CreateTable(make_table(kept.progress, _PROGRESS, generation, stored)))


def kept_tables(layout: Layout) -> list[str]:
    """All tables of kept views, also of those whose meaning was changed since."""
    now = [name for kept in layout.kept.values() for name in (kept.table, kept.progress)]
    return [*now, *layout.outdated]


def shown_texts(layout: Layout, generation: int, stored: Callable[[str], str]) -> dict[str, str]:
    """Name and SQL of every user's view, as people see it."""
    texts = dict(layout.user_views)
    for name, kept in layout.kept.items():
        renamed = any(stored(each) != each for each in kept.columns)
        columns = ", ".join(f'"{stored(each)}" AS "{each}"' for each in kept.columns) if renamed else "*"
        texts[name] = f"SELECT {columns} FROM {physical_name(kept.table, generation)}"  # noqa: S608
    return texts


async def refresh_some(
    connection: AsyncConnection, layout: Layout, generation: int, *, folded: str = "SELECT number, folded FROM episode"
) -> bool:
    """Makes the rows of some changed episodes anew, as the connection's views show them; False if none has changed.

    Args:
        connection: everything happens in its transaction; nobody else refreshes meanwhile.
        layout, generation: of the tables behind the views.
        folded: what tells, for each episode, how much of it they show.
    """
    done = False
    for name, kept in layout.kept.items():
        table, progress = physical_name(kept.table, generation), physical_name(kept.progress, generation)
        found = await connection.execute(
            text(
                f"SELECT source.number, source.folded FROM ({folded}) AS source"  # noqa: S608
                f" LEFT JOIN {progress} AS progress ON progress.id = source.number"
                " WHERE source.folded <> coalesce(progress.folded, 0) ORDER BY source.number LIMIT :limit"
            ),
            {"limit": _EPISODES},
        )
        behind = [tuple(row) for row in found]
        if not behind:
            continue
        done = True
        numbers = ", ".join(str(int(number)) for number, _ in behind)
        columns = ", ".join(f'"{each}"' for each in kept.columns)
        stored = ", ".join(f'"{dialect_of(connection).stored_column(each)}"' for each in kept.columns)
        meaning = layout.user_views[name]
        some = f"{EPISODE} IN ({numbers})"
        for statement in (
            f"DELETE FROM {table} WHERE {some}",  # noqa: S608
            f"INSERT INTO {table} ({stored}) SELECT {columns} FROM ({meaning}) AS meaning WHERE {some}",  # noqa: S608
            f"DELETE FROM {progress} WHERE id IN ({numbers})",  # noqa: S608
        ):
            await connection.exec_driver_sql(statement)  # a meaning may hold what looks like a parameter
        dialect = dialect_of(connection)
        await dialect.insert(connection, await dialect.insertion({(progress, tuple(_PROGRESS)): behind}))
    return done
