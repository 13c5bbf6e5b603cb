"""The tables of a projection of one's own, kept up to date with the log beside ours, and not at their cost.

`pycrorm_generation` notes them as `projection/NAME`. A process that does not know the projection leaves them as they
are; one that does catches up. Whatever is wrong with one is told, and the others and our own tables go on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence

from sqlalchemy import Dialect
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError, DatabaseForeign
from pycrorm_async.events.codec import declaration_of, fingerprint
from pycrorm_async.projections import progress
from pycrorm_async.projections.beside import Beside, CatchUp
from pycrorm_async.projections.folding import Batch
from pycrorm_async.projections.generations import (
    PROJECTION,
    Generation,
    all_noted,
    grow_tables,
    make_empty,
    note,
    projections_in,
)
from pycrorm_async.projections.layout import Layout
from pycrorm_async.projections.own import Projection, columns_of
from pycrorm_async.projections.own_rows import OwnRows
from pycrorm_async.projections.views import view_texts
from pycrorm_async.store.log import EventLog

__all__ = ["OwnMeaning", "layout_of", "make_own", "set_up", "kept_up"]

_log = logging.getLogger("pycrorm_async")


class OwnMeaning:
    """What events mean to this projection. Implements `Meaning`."""

    def __init__(self, projection: Projection) -> None:
        self._projection = projection

    def learn(self, layout: Layout, payloads: Sequence[bytes]) -> tuple[Layout, Callable[[], Batch]]:
        declared = {}
        for payload in payloads:
            try:
                declared[fingerprint(payload)] = declaration_of(payload)
            except ValueError:  # a newer version's: its nodes cannot be folded
                continue
        return layout, lambda: OwnRows(self._projection, declared)


def layout_of(projection: Projection, dialect: Dialect) -> Layout:
    """Its tables and views. Raises `CallerError`."""
    tables = columns_of(projection)
    leaves = {name: {each: tables[name][each] for each in columns if each != "id"} for name, columns in tables.items()}
    layout = Layout(leaves=leaves)
    return layout.with_views(view_texts(projection.views, layout, dialect))


async def make_own(connection: AsyncConnection, projection: Projection, key: str) -> Generation:
    """Makes its tables, empty, and notes them under that key."""
    there = await all_noted(connection)
    ours = f"{PROJECTION}{projection.name}"
    numbers = [each.number for name, each in there.items() if name == ours or name.startswith(f"{ours}/")]
    empty = Generation(1 + max(numbers, default=0), 0, Layout(), {}, projection.version)
    made = await grow_tables(connection, empty, layout_of(projection, connection.dialect))
    await make_empty(connection, f"{progress.TABLE}_{projection.name}", progress.COLUMNS, made.number)
    await note(connection, key, made)
    return made


async def set_up(connection: AsyncConnection, projection: Projection, taken: Iterable[str]) -> bool:
    """Makes what is missing of it; whether the views have to be made again.

    Args:
        connection: alone in the memory.
        projection: known here.
        taken: the names of tables and views that are not of projections.

    Raises `CallerError` for a name that is taken, `DatabaseForeign` for tables of another version.
    """
    layout = layout_of(projection, connection.dialect)
    there = projections_in(await all_noted(connection))
    others = {name: f"the projection {owner}" for owner, each in there.items() for name in _names(each.layout)}
    owners = {name.lower(): "the memory" for name in taken}
    owners |= {name: owner for name, owner in others.items() if owner != f"the projection {projection.name}"}
    for name in _names(layout):
        if name in owners:
            raise CallerError(f"the projection {projection.name} wants {name!r}, which {owners[name]} has: rename it")
    found = there.get(projection.name)
    key = f"{PROJECTION}{projection.name}"
    if found is None:
        await make_own(connection, projection, key)
        return True
    fault = fault_in_version(projection, found, layout)
    if fault is not None:
        raise DatabaseForeign(fault)
    if found.layout == layout:
        return False
    await note(connection, key, Generation(found.number, found.revision + 1, layout, {}, found.version))
    return True


def fault_in_version(projection: Projection, found: Generation, layout: Layout) -> str | None:
    """Why this projection cannot be folded into the tables that are there; None if it can."""
    name = projection.name
    if found.version != projection.version:
        return (
            f"the tables of the projection {name} are of version {found.version}, and the one here of version"
            f" {projection.version}: `pycrorm rebuild {name}` makes them anew"
        )
    if found.layout.leaves != layout.leaves:
        return f"the projection {name} has other tables than its version {found.version} had: count that up"
    return None


class OwnTables:
    """A projection that is kept up to date."""

    def __init__(self, log: EventLog, projection: Projection, generation: Generation, *, batch_events: int) -> None:
        self.name = projection.name
        goal = _Live(f"{PROJECTION}{projection.name}", projection.name, projection.version)
        self._catch_up = CatchUp(
            log, goal, generation, meaning=OwnMeaning(projection), after_tables=True, batch_events=batch_events
        )


def _names(layout: Layout) -> list[str]:
    return [name.lower() for name in (*layout.leaves, *layout.user_views)]
