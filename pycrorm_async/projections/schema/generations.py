"""The tables of a generation and the views in front of them: made when missing, grown when types are declared.

`pycrorm_generation` notes which generation people see (`tables`) and which one is being made beside it
(`tables/making`) or waits to be dropped (`tables/gone/6`), and the same of each projection of somebody's own
(`projection/NAME`, `projection/NAME/making`): its number, its layout, and a revision that counts the
changes. Who folds has read the note before, and holds it in its own transaction: nobody shows another generation
meanwhile. Everything here runs in the caller's transaction, tables and views too.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import msgspec
from sqlalchemy import Integer, Text, column, delete, select, table, text
from sqlalchemy.ext.asyncio import AsyncConnection
from sqlalchemy.schema import CreateColumn, CreateIndex, CreateTable, ExecutableDDLElement, Index

from pycrorm_async.errors import DatabaseForeign, TablesOutdated
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.projections.schema.materialised_views import kept_tables, make_kept, shown_texts
from pycrorm_async.projections.schema.public_views import own_views, public_views
from pycrorm_async.projections.schema.tables import (
    CORE,
    OWN,
    Storage,
    expected,
    index_name,
    indexed,
    make_table,
    physical_name,
)
from pycrorm_async.projections.schema.user_views import view_text
from pycrorm_async.store.dialects import dialect_of

__all__ = [
    "Generation",
    "Hold",
    "PROJECTION_VERSION",
    "SHOWN",
    "MAKING",
    "GONE",
    "PROJECTION",
    "current_generation",
    "noted",
    "all_noted",
    "projections_in",
    "view_texts_of",
    "note",
    "forget",
    "make_generation",
    "make_empty",
    "grow_tables",
    "show",
]

PROJECTION_VERSION = 4
"""Counts what the fold means: tables of an older version must be rebuilt."""

SHOWN = "tables"
MAKING = "tables/making"
GONE = "tables/gone/"
PROJECTION = "projection/"

_log = logging.getLogger("pycrorm_async.projections")

Hold: TypeAlias = Literal["share", "change"]
"""Until the transaction ends nobody else changes the note; with `change`, nobody else holds it either."""

_NOTES = "pycrorm_generation"
_CREATE = f"""
CREATE TABLE IF NOT EXISTS {_NOTES} (
 projection TEXT PRIMARY KEY,
 version INTEGER NOT NULL,
 generation INTEGER NOT NULL,
 revision INTEGER NOT NULL,
 layout TEXT NOT NULL,
 views TEXT NOT NULL)"""
_UPSERT = text(f"""
INSERT INTO {_NOTES} (projection, version, generation, revision, layout, views)
VALUES (:projection, :version, :generation, :revision, :layout, :views)
ON CONFLICT (projection) DO UPDATE SET version = excluded.version, generation = excluded.generation,
 revision = excluded.revision, layout = excluded.layout, views = excluded.views""")  # noqa: S608
_notes = table(
    _NOTES,
    column("projection", Text()),
    column("version", Integer()),
    column("generation", Integer()),
    column("revision", Integer()),
    column("layout", Text()),
    column("views", Text()),
)


@dataclass(frozen=True)
class Generation:
    """Number, how often it changed, what it holds, the SQL of every view by name, and which fold made it."""

    number: int
    revision: int
    layout: Layout
    views: dict[str, str]
    version: int = PROJECTION_VERSION

    def without_unmade(self) -> Generation:
        """The generation before the database refused to make some of its tables."""
        return replace(self, layout=msgspec.structs.replace(self.layout, unmade={}))


async def current_generation(connection: AsyncConnection, *, hold: Hold | None = None) -> Generation | None:
    """What people see now; None in a memory without tables. Raises `DatabaseForeign` for another version's.

    `TablesOutdated` if it is an older one's, which `pycrorm rebuild` makes anew.
    """
    found = await noted(connection, SHOWN, hold=hold)
    if found is not None and found.version != PROJECTION_VERSION:
        made = f"the tables were made by version {found.version} of the fold, this is version {PROJECTION_VERSION}"
        if found.version > PROJECTION_VERSION:
            raise DatabaseForeign(f"{made}: use a newer pycrorm")
        raise TablesOutdated(f"{made}: run `pycrorm rebuild`")
    return found


async def noted(connection: AsyncConnection, name: str, *, hold: Hold | None = None) -> Generation | None:
    """The generation under that name, of whatever version."""
    if not await dialect_of(connection).has_table(connection, _NOTES):
        return None
    asked = select(_notes).where(_notes.c.projection == name)
    if hold is not None:  # SQLite has no row locks, and needs none: who writes there is alone
        asked = asked.with_for_update(read=hold == "share")
    found = (await connection.execute(asked)).first()
    return None if found is None else _generation(found)


async def all_noted(connection: AsyncConnection) -> dict[str, Generation]:
    """Every generation there is, by the name it is noted under."""
    if not await dialect_of(connection).has_table(connection, _NOTES):
        return {}
    rows = await connection.execute(select(_notes).order_by(_notes.c.projection))
    return {row.projection: _generation(row) for row in rows}


def projections_in(there: Mapping[str, Generation]) -> dict[str, Generation]:
    """Of all that is noted, what people see of each projection, by its name."""
    named = {key.removeprefix(PROJECTION): each for key, each in there.items() if key.startswith(PROJECTION)}
    return {name: each for name, each in named.items() if "/" not in name}


def _generation(row: Any) -> Generation:
    try:
        layout = msgspec.json.decode(row.layout, type=Layout)
    except msgspec.DecodeError:  # another version's, of which the number is enough
        layout = Layout()
    views = msgspec.json.decode(row.views, type=dict[str, str])
    return Generation(row.generation, row.revision, layout, views, row.version)


async def note(connection: AsyncConnection, name: str, generation: Generation) -> None:
    """Notes it under that name, in place of what was noted there."""
    values = {
        "projection": name,
        "version": generation.version,
        "generation": generation.number,
        "revision": generation.revision,
        "layout": msgspec.json.encode(generation.layout).decode(),
        "views": msgspec.json.encode(generation.views).decode(),
    }
    await connection.execute(_UPSERT, values)


async def forget(connection: AsyncConnection, name: str) -> None:
    """Nothing is noted under that name afterwards."""
    await connection.execute(delete(_notes).where(_notes.c.projection == name))


async def make_generation(connection: AsyncConnection, number: int) -> Generation:
    """Makes the tables every memory has, in a generation of this number. Nobody sees them before `show`."""
    await dialect_of(connection).make_place(connection)
    await connection.exec_driver_sql(_CREATE)
    await make_empty(connection, CORE, number)
    return Generation(number, 0, Layout(), {})


async def grow_tables(connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
    """Makes what this layout has more than the generation; its views stay as they are."""
    present = generation.layout.leaves
    new = {name: {"id": "key", **columns} for name, columns in layout.leaves.items() if name not in present}
    await make_empty(connection, new, generation.number)
    for name in layout.leaves.keys() & present.keys():
        await _add_columns(connection, name, layout.leaves[name], present[name], generation.number)
    there = kept_tables(generation.layout)
    for kept in layout.kept.values():
        if kept.table not in there:
            await make_kept(connection, kept, generation.number)
    return replace(generation, revision=generation.revision + 1, layout=layout)


async def show(connection: AsyncConnection, generation: Generation) -> Generation:
    """Puts views in front of its tables, in place of those of whatever was shown before."""
    before = await noted(connection, SHOWN, hold="change")
    views = view_texts_of(connection, generation, projections_in(await all_noted(connection)))
    await dialect_of(connection).replace_views(connection, before.views if before else {}, views)
    shown = replace(generation, views=views)
    await note(connection, SHOWN, shown)
    return shown


def view_texts_of(
    connection: AsyncConnection,
    generation: Generation,
    projections: Mapping[str, Generation],
    *,
    simulated: bool = False,
) -> dict[str, str]:
    """Name and SQL of every view in front of these tables; one stands on those before it.

    With `simulated` nothing is left out. A projection that has a name of ours, which a designator type may have got
    later, is not shown.
    """
    layout, number = generation.layout, generation.number
    stored = dialect_of(connection).stored_column
    meanings = public_views(layout, number, stored, simulated=simulated)
    texts = dict(layout.user_views) if simulated else shown_texts(layout, number, stored)
    users = {
        name: each for name, each in texts.items() if name not in meanings
    }  # one of ours may have been noted there
    taken = {name.lower() for name in (*meanings, *users)}
    own: dict[str, str] = {}
    for name, each in projections.items():
        names = {view.removeprefix(OWN).lower() for view in (*each.layout.leaves, *each.layout.user_views)}
        if names & taken:
            _log.warning("the projection %s is not shown: the memory itself has %s", name, ", ".join(names & taken))
            continue
        taken |= names
        meanings |= own_views(each.layout, each.number, number, stored, simulated=simulated)
        own |= each.layout.user_views
    return {name: view_text(meaning, connection.dialect) for name, meaning in meanings.items()} | users | own


async def make_empty(connection: AsyncConnection, tables: Mapping[str, Mapping[str, Storage]], generation: int) -> None:
    """Makes these tables of a generation, by name and columns, and their indexes."""
    statements: list[str] = []
    for name, columns in tables.items():
        table = make_table(name, dict(columns), generation, dialect_of(connection).stored_column)
        indexes = sorted(table.indexes, key=lambda each: str(each.name))
        made: list[ExecutableDDLElement] = [CreateTable(table), *map(CreateIndex, indexes)]
        statements += [str(each.compile(dialect=connection.dialect)) for each in made]
    if statements:
        await dialect_of(connection).execute_all(connection, statements)
        await dialect_of(connection).expect(
            connection, [expected(name, dict(columns), generation) for name, columns in tables.items()]
        )


async def _add_columns(
    connection: AsyncConnection,
    name: str,
    columns: dict[str, Storage],
    present: dict[str, Storage],
    generation: int,
) -> None:
    table = make_table(name, {"id": "key", **columns}, generation, dialect_of(connection).stored_column)
    for new in [each for each in columns if each not in present]:
        definition = CreateColumn(table.c[new]).compile(dialect=connection.dialect)
        await dialect_of(connection).add_column(connection, physical_name(name, generation), str(definition))
        if new in indexed(name, columns):
            named = index_name(name, new, generation)
            await connection.execute(CreateIndex(_index_named(table.indexes, named)))


def _index_named(indexes: set[Index], name: str) -> Index:
    return next(each for each in indexes if each.name == name)
