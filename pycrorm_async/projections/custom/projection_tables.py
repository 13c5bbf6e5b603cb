"""The tables of a projection of one's own, kept up to date with the log beside ours, and not at their cost.

`pycrorm_generation` notes them as `projection/NAME`. A process that does not know the projection leaves them as they
are; one that does catches up. Whatever is wrong with one is told, and the others and our own tables go on.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from sqlalchemy import Dialect
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError, DatabaseForeign, DatabaseUnavailable, PycrormError
from pycrorm_async.events.codec import declaration_of, fingerprint
from pycrorm_async.projections.custom.projection import Projection, columns_of
from pycrorm_async.projections.custom.projection_rows import CustomRows
from pycrorm_async.projections.run import checkpoints
from pycrorm_async.projections.run.batch_fold import Batch
from pycrorm_async.projections.run.catch_up import CatchUp, SideTarget
from pycrorm_async.projections.schema.generations import (
    PROJECTION,
    Generation,
    all_noted,
    grow_tables,
    make_empty,
    note,
    projections_in,
)
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.projections.schema.tables import OWN, Storage
from pycrorm_async.projections.schema.user_views import with_user_views
from pycrorm_async.store.log import EventLog

__all__ = [
    "CustomTables",
    "ProjectionState",
    "states",
    "CustomFoldDefinition",
    "layout_of",
    "make_own",
    "refuse_taken",
    "fault_in_version",
]

_LOOK_S = 1.0
"""What another process has stored is looked for so often: it costs as much as there are episodes."""

_log = logging.getLogger("pycrorm_async.projections")


class CustomFoldDefinition:
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
        return layout, lambda: CustomRows(self._projection, declared)


def layout_of(projection: Projection, dialect: Dialect) -> Layout:
    """Its tables and views. Raises `CallerError`."""
    tables = columns_of(projection)
    leaves: dict[str, dict[str, Storage]] = {
        f"{OWN}{name}": {each: storage for each, storage in columns.items() if each != "id"}
        for name, columns in tables.items()
    }
    layout = Layout(leaves=leaves)
    return with_user_views(layout, projection.views, dialect)


async def make_own(connection: AsyncConnection, projection: Projection, key: str) -> Generation:
    """Makes its tables, empty, and notes them under that key."""
    there = await all_noted(connection)
    ours = f"{PROJECTION}{projection.name}"
    numbers = [each.number for name, each in there.items() if name == ours or name.startswith(f"{ours}/")]
    empty = Generation(1 + max(numbers, default=0), 0, Layout(), {}, projection.version)
    made = await grow_tables(connection, empty, layout_of(projection, connection.dialect))
    await make_empty(connection, {f"{checkpoints.TABLE}_{projection.name}": checkpoints.COLUMNS}, made.number)
    await note(connection, key, made)
    return made


def refuse_taken(name: str, layout: Layout, tables: Layout, projections: Mapping[str, Generation]) -> None:
    """Raises `CallerError` if this projection wants a name that the memory or another one has."""
    others = {other: one for other, one in projections.items() if other != name}
    owners = {each: f"the projection {other}" for other, one in others.items() for each in _names(one.layout)}
    owners |= dict.fromkeys(_names(tables), "the memory")
    for each in _names(layout):
        if each in owners:
            raise CallerError(f"the projection {name} wants {each!r}, which {owners[each]} has: rename it")


async def _set_up(connection: AsyncConnection, projection: Projection, tables: Layout) -> tuple[Generation, bool]:
    """Makes what is missing of it; how it is, and whether the views have to be made again.

    Args:
        connection: alone in the memory.
        projection: known here.
        tables: the layout of ours.

    Raises `CallerError` for a name that is taken, `DatabaseForeign` for tables of another version.
    """
    layout = layout_of(projection, connection.dialect)
    there = projections_in(await all_noted(connection))
    refuse_taken(projection.name, layout, tables, there)
    found = there.get(projection.name)
    key = f"{PROJECTION}{projection.name}"
    if found is None:
        return await make_own(connection, projection, key), True
    fault = fault_in_version(projection, found, layout)
    if fault is not None:
        raise DatabaseForeign(fault)
    if found.layout == layout:
        return found, False
    found = replace(found, revision=found.revision + 1, layout=layout)
    await note(connection, key, found)
    return found, True


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


class CustomTables:
    """The projections that a process knows, each kept up to date. What is wrong with one is told, once."""

    def __init__(
        self, log: EventLog, named: Sequence[Projection], found: Sequence[Projection], *, batch_events: int
    ) -> None:
        self._log = log
        self._named = named
        self._found = found
        self._batch_events = batch_events
        self._folded: dict[str, CatchUp] = {}
        self._looked_s = 0.0

    async def set_up(self, connection: AsyncConnection, tables: Layout) -> bool:
        """Makes what is missing; whether the views have to be made again.

        Raises `CallerError` for a name that is taken, of a projection that was named.
        """
        changed = False
        for each in (*self._named, *self._found):
            try:
                generation, is_new = await _set_up(connection, each, tables)
            except (DatabaseForeign, CallerError) as fault:
                if isinstance(fault, CallerError) and each in self._named:
                    raise
                _log.warning("%s", fault)
                continue
            changed = changed or is_new
            target = SideTarget(f"{PROJECTION}{each.name}", each.name, each.version)
            self._folded[each.name] = CatchUp(
                self._log,
                target,
                generation,
                definition=CustomFoldDefinition(each),
                after_tables=True,
                batch_events=self._batch_events,
            )
        return changed

    async def fold_next_batch(self, *, now: bool) -> bool:
        """A batch of each; False if nothing was behind. Without `now` it is enough to look from time to time."""
        time_s = asyncio.get_running_loop().time()
        if not self._folded or (not now and time_s < self._looked_s + _LOOK_S):
            return False
        count = 0
        for name, each in [*self._folded.items()]:
            try:
                count += await each.fold_next_batch() is not None
            except DatabaseUnavailable:
                raise
            except PycrormError as fault:
                _log.warning("the projection %s is not kept up to date any more: %s", name, fault)
                del self._folded[name]
        if not count:
            self._looked_s = time_s
        return count > 0


class ProjectionState(NamedTuple):
    """How a projection is that has tables in a memory.

    Attributes:
        name, version: as its tables were made.
        behind: events that they do not show yet.
        parked: by episode number, why no more of it is folded.
        fault: why it is not kept up to date by those who know it as it is here; None if it is, or is not known here.
    """

    name: str
    version: int
    behind: int
    parked: Mapping[int, str]
    fault: str | None


async def states(log: EventLog, known: Sequence[Projection]) -> list[ProjectionState]:
    """Of every projection in this memory. `known` are those whose code is here."""
    here = {each.name: each for each in known}
    found: list[ProjectionState] = []
    async with log.reading() as connection:
        for name, each in projections_in(await all_noted(connection)).items():
            place = checkpoints.place_of(each.number, name)
            fault = None
            if name in here:
                fault = fault_in_version(here[name], each, layout_of(here[name], connection.dialect))
            left, parked = await checkpoints.left(connection, place), await checkpoints.parked(connection, place)
            found.append(ProjectionState(name, each.version, left, parked, fault))
    return found


def _names(layout: Layout) -> list[str]:
    return [name.removeprefix(OWN).lower() for name in (*layout.leaves, *layout.user_views)]
