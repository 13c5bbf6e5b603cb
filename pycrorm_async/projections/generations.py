"""The tables of one generation and the views in front of them: made when missing, grown when types are declared.

`pycrorm_generation` notes for the projection which generation people see, its layout, and a revision that counts its
changes: who folds has read it before and finds in its own transaction that it still holds. Everything here runs in the
caller's transaction, tables and views too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection
from sqlalchemy.schema import CreateColumn, CreateIndex, CreateTable, Index

from pycrorm_async.errors import DatabaseForeign
from pycrorm_async.projections.layout import Layout
from pycrorm_async.projections.public import public_views
from pycrorm_async.projections.tables import (
    CORE,
    Storage,
    index_name,
    indexed,
    make_table,
    physical_name,
)
from pycrorm_async.projections.views import view_text
from pycrorm_async.store.dialects import dialect_of

__all__ = ["Generation", "PROJECTION", "PROJECTION_VERSION", "current_generation", "make_generation", "grow"]

PROJECTION = "tables"
PROJECTION_VERSION = 3
"""Counts what the fold means: tables of an older version must be rebuilt."""

_NOTES = "pycrorm_generation"
_CREATE = f"""
CREATE TABLE IF NOT EXISTS {_NOTES} (
 projection TEXT PRIMARY KEY,
 version INTEGER NOT NULL,
 generation INTEGER NOT NULL,
 revision INTEGER NOT NULL,
 layout TEXT NOT NULL,
 views TEXT NOT NULL)"""
_SELECT = text(
    f"SELECT version, generation, revision, layout, views FROM {_NOTES} WHERE projection = :projection"  # noqa: S608
)
_UPSERT = text(f"""
INSERT INTO {_NOTES} (projection, version, generation, revision, layout, views)
VALUES (:projection, :version, :generation, :revision, :layout, :views)
ON CONFLICT (projection) DO UPDATE SET version = excluded.version, generation = excluded.generation,
 revision = excluded.revision, layout = excluded.layout, views = excluded.views""")  # noqa: S608


@dataclass(frozen=True)
class Generation:
    """The tables people see: number, how often they changed, what they hold, and the SQL of every view by name."""

    number: int
    revision: int
    layout: Layout
    views: dict[str, str]


async def current_generation(connection: AsyncConnection) -> Generation | None:
    """What people see now; None in a memory without tables. Raises `DatabaseForeign` for another version's."""
    if not await dialect_of(connection).has_table(connection, _NOTES):
        return None
    found = (await connection.execute(_SELECT, {"projection": PROJECTION})).first()
    if found is None:
        return None
    if found.version != PROJECTION_VERSION:
        raise DatabaseForeign(
            f"the tables were made by version {found.version} of the fold, this is version {PROJECTION_VERSION}:"
            + (" use a newer pycrorm" if found.version > PROJECTION_VERSION else " run `pycrorm rebuild`")
        )
    return Generation(
        number=found.generation,
        revision=found.revision,
        layout=msgspec.json.decode(found.layout, type=Layout),
        views=msgspec.json.decode(found.views, type=dict[str, str]),
    )


async def make_generation(connection: AsyncConnection, number: int) -> Generation:
    """Makes the tables every memory has, in a generation of this number. Nobody sees them before `grow`."""
    await dialect_of(connection).make_place(connection)
    await connection.exec_driver_sql(_CREATE)
    for name, columns in CORE.items():
        await _make_table(connection, name, columns, number)
    return Generation(number, 0, Layout(), {})


async def grow(connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
    """Makes what this layout has more than the generation, and the views anew that are different now."""
    for name, columns in layout.leaves.items():
        present = generation.layout.leaves.get(name)
        if present is None:
            await _make_table(connection, name, {"id": "key", **columns}, generation.number)
        else:
            await _add_columns(connection, name, columns, present, generation.number)
    views = {
        name: view_text(meaning, connection.dialect)
        for name, meaning in public_views(layout, generation.number).items()
    } | layout.user_views
    await dialect_of(connection).replace_views(connection, generation.views, views)
    grown = replace(generation, revision=generation.revision + 1, layout=layout, views=views)
    await _note(connection, grown)
    return grown


async def _make_table(connection: AsyncConnection, name: str, columns: dict[str, Storage], generation: int) -> None:
    table = make_table(name, columns, generation)
    await connection.execute(CreateTable(table))
    for index in sorted(table.indexes, key=lambda each: str(each.name)):
        await connection.execute(CreateIndex(index))


async def _add_columns(
    connection: AsyncConnection,
    name: str,
    columns: dict[str, Storage],
    present: dict[str, Storage],
    generation: int,
) -> None:
    table = make_table(name, {"id": "key", **columns}, generation)
    quoted = connection.dialect.identifier_preparer.quote(physical_name(name, generation))
    for column in columns.keys() - present.keys():
        definition = CreateColumn(table.c[column]).compile(dialect=connection.dialect)
        await connection.exec_driver_sql(f"ALTER TABLE {quoted} ADD COLUMN {definition}")
        if column in indexed(name, columns):
            named = index_name(name, column, generation)
            await connection.execute(CreateIndex(_index_named(table.indexes, named)))


def _index_named(indexes: set[Index], name: str) -> Index:
    return next(each for each in indexes if each.name == name)


async def _note(connection: AsyncConnection, generation: Generation) -> None:
    noted = {
        "projection": PROJECTION,
        "version": PROJECTION_VERSION,
        "generation": generation.number,
        "revision": generation.revision,
        "layout": msgspec.json.encode(generation.layout).decode(),
        "views": msgspec.json.encode(generation.views).decode(),
    }
    await connection.execute(_UPSERT, noted)
