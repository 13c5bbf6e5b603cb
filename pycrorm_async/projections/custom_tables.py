"""Create the tables of custom projections and keep them up to date, after the built-in tables.

`pycrorm_generation` lists them under `projection/NAME`. A process without the code of a projection leaves its tables as
they are; a process that has it catches up. A fault in one projection is logged, and the others continue.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import msgspec
from sqlalchemy import Dialect
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError, DatabaseForeign, DatabaseUnavailable, PycrormError
from pycrorm_async.events.codec import declaration_of, fingerprint, short_name
from pycrorm_async.projections import pipeline as checkpoints
from pycrorm_async.projections.columns import OWN, Layout, Storage, next_number
from pycrorm_async.projections.custom import CustomRows, EpisodeFolds, PackedProjection, Projection, columns_of
from pycrorm_async.projections.fold import Batch
from pycrorm_async.projections.generations import (
    PROJECTION,
    Generation,
    grow_tables,
    make_empty,
    projections_in,
    read_generation,
    read_generations,
    write_generation,
)
from pycrorm_async.projections.mapped_tables import with_user_views
from pycrorm_async.store.log import EventLog

_log = logging.getLogger("pycrorm_async.projections")
_CHECK_S = 1.0
"""The least interval between two checks of all episodes for events that no batch of the tables has folded."""
_CHECK_SHARE_MAX = 0.02
"""Bounds the share of time in which they are checked: 100,000 take 25 ms."""
_CHECK_S_MAX = 10.0
"""Bounds the time until they are checked again, also after a check that a busy machine made slow."""
_HELP_S: Final = 30.0
"""The interval at which a process that has folded its share folds a batch of the others, and more if that is large."""


def learner_of(projection: Projection) -> checkpoints.Learn:
    """Return the function that learns to fold into the tables of a projection."""
    folds = EpisodeFolds(projection)

    def learn(layout: Layout, payloads: Sequence[bytes]) -> tuple[Layout, Callable[[], Batch]]:
        declared = {}
        for payload in payloads:
            try:
                declared[short_name(fingerprint(payload))] = declaration_of(payload)
            except ValueError:  # from a newer version: its nodes cannot be folded
                continue
        if isinstance(projection, PackedProjection):
            return layout, partial(projection.batch, declared, folds)
        return layout, partial(CustomRows, projection, declared, folds)

    return learn


def layout_of(projection: Projection, dialect: Dialect) -> Layout:
    """Return the projection's tables and views. Raises `CallerError`."""
    tables = columns_of(projection)
    leaves: dict[str, dict[str, Storage]] = {
        f"{OWN}{name}": {each: storage for each, storage in columns.items() if each != "id"}
        for name, columns in tables.items()
    }
    layout = Layout(leaves=leaves)
    return with_user_views(layout, projection.views, dialect)


def events_of_batch(projection: Projection, batch_events: int) -> int:
    """Return the most events in one transaction of a projection, where one of the tables has `batch_events`.

    A packed projection writes a few rows only, so that most of a transaction's cost does not depend on its events.
    """
    return 4 * batch_events if isinstance(projection, PackedProjection) else batch_events


async def make_projection_tables(connection: AsyncConnection, projection: Projection, key: str) -> Generation:
    """Create the projection's tables and checkpoints, empty, as a new generation under this key."""
    generations = await read_generations(connection)
    own = f"{PROJECTION}{projection.name}"
    numbers = [each.number for name, each in generations.items() if name == own or name.startswith(f"{own}/")]
    empty = Generation(next_number(numbers), 0, Layout(), {}, projection.version)
    generation = await grow_tables(connection, empty, layout_of(projection, connection.dialect))
    await make_empty(connection, {f"{checkpoints.TABLE}_{projection.name}": checkpoints.COLUMNS}, generation.number)
    await write_generation(connection, key, generation)
    return generation


def refuse_taken(name: str, layout: Layout, tables: Layout, projections: Mapping[str, Generation]) -> None:
    """Raise `CallerError` if the memory or another projection has a name of this projection's tables and views."""
    others = {other: generation for other, generation in projections.items() if other != name}
    owners = {
        each: f"the projection {other}" for other, generation in others.items() for each in _names(generation.layout)
    }
    owners |= dict.fromkeys(_names(tables), "the memory")
    for each in _names(layout):
        if each in owners:
            raise CallerError(f"the projection {name} needs the name {each!r}, which {owners[each]} has: rename it")


async def _set_up(connection: AsyncConnection, projection: Projection, tables: Layout) -> bool:
    """Create the projection's missing tables; return whether the views must be created again.

    Args:
        connection: in a transaction that excludes all other writers of the memory.
        projection: to set up.
        tables: the layout of the built-in tables.

    Raises `CallerError` for a name that is taken, `DatabaseForeign` for tables of another version.
    """
    layout = layout_of(projection, connection.dialect)
    generations = projections_in(await read_generations(connection))
    refuse_taken(projection.name, layout, tables, generations)
    generation = generations.get(projection.name)
    key = f"{PROJECTION}{projection.name}"
    if generation is None:
        await make_projection_tables(connection, projection, key)
        return True
    fault = fault_in_version(projection, generation, layout)
    if fault is not None:
        raise DatabaseForeign(fault)
    if generation.layout == layout:
        return False
    await write_generation(connection, key, replace(generation, revision=generation.revision + 1, layout=layout))
    return True


def fault_in_version(projection: Projection, generation: Generation, layout: Layout) -> str | None:
    """Return the reason why this projection cannot be folded into these tables; None if it can."""
    name = projection.name
    if generation.version != projection.version:
        return (
            f"the tables of the projection {name} have version {generation.version}, its code has version"
            f" {projection.version}: run `pycrorm rebuild {name}`"
        )
    if generation.layout.leaves != layout.leaves:
        return (
            f"the projection {name} defines other tables than its stored version {generation.version}:"
            f" raise its version, then run `pycrorm rebuild {name}`"
        )
    return None


class _CustomFold(NamedTuple):
    """The fold of one projection in this process."""

    projection: Projection
    target: checkpoints.SideTarget
    runner: checkpoints.FoldRunner


class CustomTables:
    """Folds the custom projections of a process. A fault in one is logged once, and then it is left out."""

    def __init__(
        self, log: EventLog, named: Sequence[Projection], installed: Sequence[Projection], *, batch_events: int
    ) -> None:
        self._log = log
        self._named = named
        self._installed = installed
        self._batch_events = batch_events
        self._folds: list[_CustomFold] = []
        self._due_s = 0.0
        self._help_s = time.monotonic() + _HELP_S

    async def set_up(self, connection: AsyncConnection, tables: Layout) -> bool:
        """Create missing tables; return whether the views must be created again.

        Raises `CallerError` for a taken name of a projection that the caller gave; an installed one is left out.
        """
        changed = False
        self._folds = []
        for each in (*self._named, *self._installed):
            try:
                is_new = await _set_up(connection, each, tables)
            except (DatabaseForeign, CallerError) as fault:
                if isinstance(fault, CallerError) and each in self._named:
                    raise
                _log.warning("%s", fault)
                continue
            changed = changed or is_new
            target = checkpoints.SideTarget(self._log, f"{PROJECTION}{each.name}", each.name, each.version)
            batch_events = events_of_batch(each, self._batch_events)
            runner = checkpoints.FoldRunner(target, learner_of(each), batch_events=batch_events)
            self._folds.append(_CustomFold(each, target, runner))
        return changed

    def companions(self, events: int, *, until_visible: bool) -> list[checkpoints.FoldRunner]:
        """Return the folds that take part in a batch of the tables with this number of events.

        The package's own projections take part in large batches, and where a caller waits for all; see
        `fold_next_batch`.
        """
        packed = until_visible or events >= checkpoints.LOOKAHEAD_EVENTS_MIN
        return [each.runner for each in self._folds if packed or not each.projection.is_packed]

    async def fold_next_batch(
        self, *, until_visible: bool = False, share: checkpoints.Share = checkpoints.WHOLE
    ) -> bool:
        """Fold a batch of this share of each projection; return False if none was behind.

        The process of another share may lack the code of a projection. Therefore a process that has folded its own
        share folds a batch of the other shares every 30 s, and continues if that batch was large.

        Unless `until_visible` is True, checks at intervals only: the batches of the tables leave few events, those of
        the package's own projections, of which a few cost as much as a thousand.
        """
        time_s = time.monotonic()
        if not self._folds or not (until_visible or time_s >= self._due_s):
            return False
        count = most_events = 0
        helps = share != checkpoints.WHOLE and time_s >= self._help_s
        for fold in [*self._folds]:
            projection, target, runner = fold
            try:
                target.share = share
                events = await runner.fold_next()
                if events is None and helps:
                    target.share = checkpoints.WHOLE
                    events = await runner.fold_next()
                count += events is not None
                most_events = max(most_events, events or 0)
                if (events or 0) < checkpoints.LOOKAHEAD_EVENTS_MIN:
                    await target.mark()
            except DatabaseUnavailable:
                raise
            except PycrormError as fault:
                _log.warning("this process stops folding the projection %s: %s", projection.name, fault)
                await self._note_fault(fold, str(fault))
                self._folds.remove(fold)
        if most_events < min(checkpoints.LOOKAHEAD_EVENTS_MIN, self._batch_events):
            self._help_s = time_s + _HELP_S if helps else self._help_s
            pause_s = 0 if count else (time.monotonic() - time_s) / _CHECK_SHARE_MAX
            self._due_s = time_s + min(max(pause_s, _CHECK_S), _CHECK_S_MAX)
        return count > 0

    async def _note_fault(self, fold: _CustomFold, reason: str) -> None:
        """Write the reason into the projection's generation, where `pycrorm status` reads it until it is set up again.

        Tables that another process has rebuilt in the meantime get no note.
        """
        key, folded = f"{PROJECTION}{fold.projection.name}", fold.runner.generation
        async with self._log.engine.begin() as connection:
            generation = await read_generation(connection, key, hold="change")
            if generation is not None and (folded is None or generation.number == folded.number):
                layout = msgspec.structs.replace(generation.layout, fault=reason)
                await write_generation(connection, key, replace(generation, layout=layout))


class ProjectionState(NamedTuple):
    """The state of a projection that has tables in a memory.

    Attributes:
        name, version: of its tables.
        behind: the number of events that its tables lack.
        parked: the parked episodes by number, with the reasons.
        fault: the reason why this process cannot fold it, or another one stopped; None if it can, or has not its code.
    """

    name: str
    version: int
    behind: int
    parked: Mapping[int, str]
    fault: str | None


async def states(log: EventLog, projections: Sequence[Projection]) -> list[ProjectionState]:
    """Return the state of every projection in this memory. `projections` are those whose code this process has."""
    by_name = {each.name: each for each in projections}
    result: list[ProjectionState] = []
    async with log.reading() as connection:
        for name, each in projections_in(await read_generations(connection)).items():
            place = checkpoints.place_of(each.number, name)
            fault = each.layout.fault
            if fault is not None:
                fault = f"a process stopped folding the projection {name}, start it again to try again: {fault}"
            if name in by_name:
                fault = fault_in_version(by_name[name], each, layout_of(by_name[name], connection.dialect)) or fault
            left, parked = await checkpoints.left(connection, place), await checkpoints.parked(connection, place)
            result.append(ProjectionState(name, each.version, left, parked, fault))
    return result


def _names(layout: Layout) -> list[str]:
    return [name.removeprefix(OWN).lower() for name in (*layout.leaves, *layout.user_views)]
