"""Rebuild the tables from the log beside the visible ones, and replace those in one transaction.

    async with claimed(log):
        rebuild = await Rebuild.begin(log)
        while await rebuild.fold_next_batch(): ...
        await rebuild.show()
        await clear(log)

Theory of operation. `begin` creates a generation under the key `…/making`, with tables for all declared types, or
resumes the one that an earlier rebuild left. `fold_next_batch` folds the log into it in short transactions, by one
process or by several that share the episodes. `show` makes it visible. `clear` drops replaced generations in slices.
Plans record, processes fold and queries read all the time; no plan's classes are needed. `claimed` admits one rebuild
at a time. A killed one leaves rows in `pycrorm_generation`: the next resumes `…/making` and drops `…/gone/N`.

The switch races with processes that fold into the visible tables. `show` therefore folds until little is missing and
then, in one transaction that excludes other writers, locks the visible generation's row, folds the events that the
visible tables have and the new ones lack, and replaces the views. If more than `_LATE_EVENTS_MAX` events are missing it
rolls back and folds outside the transaction again, so that others wait for a short time only. Therefore readers never
see fewer events after the switch than before. The new revision is above both old ones: a batch folded for the old
tables fails its check and is folded again (`generations`).

Queries that began before the switch may still read the replaced tables. The switch never drops them: `clear` in
the section "replaced tables" waits some seconds for such queries, and reports tables that are still in use.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Self

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError, DatabaseForeign, DatabaseUnavailable, InternalError
from pycrorm_async.projections import custom, custom_tables, pipeline
from pycrorm_async.projections.columns import CORE, OF_NO_EPISODE, next_number, physical_name
from pycrorm_async.projections.generations import (
    MAKING,
    PROJECTION,
    PROJECTION_VERSION,
    SHOWN,
    Generation,
    built_in_texts,
    current_generation,
    delete_generation,
    grow,
    grow_tables,
    make_empty,
    make_generation,
    materialised_tables,
    projections_in,
    read_generation,
    read_generations,
    refresh_some,
    show,
    with_views,
    write_generation,
)
from pycrorm_async.projections.mapped_tables import UserView, mapped_leaves, with_user_views
from pycrorm_async.projections.pipeline import WHOLE, FoldRunner, Share, SideTarget, learn_tables, sweep
from pycrorm_async.projections.views import Tables
from pycrorm_async.store.dialect import RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

_MAKING = "/making"
_BATCH_EVENTS = 8_000
"""Bounds the events of one transaction: on SQLite such a batch holds the write lock for some 50 ms."""
_LATE_EVENTS_MAX = 2_000
"""Bounds the events folded inside the switch, during which all other writers wait."""
_SHOW_ATTEMPTS = 50
"""Bounds the attempts to switch while other processes record faster than this one folds."""
_RECORDED = text("SELECT count(*), coalesce(sum(head), 0) FROM episode")


async def recorded(log: EventLog) -> tuple[int, int]:
    """Count the episodes and the events in the log."""
    async with log.reading() as connection:
        episodes, events = (await connection.execute(_RECORDED)).one()
        return int(episodes), int(events)


@asynccontextmanager
async def claimed(log: EventLog) -> AsyncIterator[None]:
    """Exclude other rebuilds of this memory inside the context. Raises `CallerError` if one is running."""
    with log.translated():
        async with dialect_of(log.engine).claim(log.engine) as claim:
            if not claim:
                raise CallerError(
                    f"{log.address}: a `pycrorm rebuild` or `pycrorm archive` is running: wait for it to end"
                )
            yield


class Rebuild:
    """One generation while it is rebuilt. `begin` needs a claimed memory; worker processes `join`.

    Attributes:
        number: of the generation.
    """

    def __init__(
        self,
        log: EventLog,
        generation: Generation,
        *,
        share: Share = WHOLE,
        projection: custom.Projection | None = None,
    ) -> None:
        self._log = log
        self.number = generation.number
        self._projection = projection
        self._key = SHOWN if projection is None else f"{PROJECTION}{projection.name}"
        name = None if projection is None else projection.name
        self._place = pipeline.place_of(generation.number, name)
        key = f"{self._key}{_MAKING}"
        self._making = SideTarget(log, key, name, generation.version, number=generation.number, share=share)
        learn = learn_tables if projection is None else custom_tables.learner_of(projection)
        batch_events = _BATCH_EVENTS if projection is None else custom_tables.events_of_batch(projection, _BATCH_EVENTS)
        self._runner = FoldRunner(self._making, learn, batch_events=batch_events)

    @classmethod
    async def begin(
        cls, log: EventLog, *, views: Sequence[UserView] = (), projection: custom.Projection | None = None
    ) -> Self:
        """Resume the generation of an earlier rebuild, or create one with the tables of all declared types.

        Registered views stay; `views` are added or replace them by name. With a projection, rebuilds only its tables.
        """
        with log.translated():
            payloads = await log.declarations()
            async with log.engine.begin() as connection:
                await dialect_of(connection).lock_log_changes(connection)
                generations = await readable_generations(log, connection)
                shown = generations.get(SHOWN)
                # The switch checks this too; checking here reports a conflict before hours of work.
                await dialect_of(connection).only_views(connection, shown.views if shown else ())
                if projection is not None:
                    return cls(log, await _begin_projection(connection, generations, projection), projection=projection)
                making = await _resumable(
                    connection, generations, SHOWN, lambda each: each.version == PROJECTION_VERSION
                )
                if making is None:
                    numbers = [each.number for key, each in generations.items() if not key.startswith(PROJECTION)]
                    making = await make_generation(connection, next_number(numbers))
                    await make_empty(connection, {pipeline.TABLE: pipeline.COLUMNS}, making.number)
                making = await grow_tables(connection, making, making.layout.with_leaves(mapped_leaves()))
                await write_generation(connection, MAKING, making)
            target = SideTarget(log, MAKING, None, making.version, number=making.number)
            while (grown := await _grow_slice(log, target, payloads)).layout != making.layout:
                making = grown
            async with log.engine.begin() as connection:
                await dialect_of(connection).lock_log_changes(connection)
                making = await target.generation(connection, "change")
                layout = making.layout
                if shown is not None:
                    layout = layout.with_views(shown.layout.user_views, shown.layout.kept)
                    layout = layout.with_failed_views(shown.layout.failed_views)
                layout = with_user_views(layout, views, connection.dialect)
                making = await grow_tables(connection, making, layout)
                await write_generation(connection, MAKING, making)
        return cls(log, making)

    @classmethod
    async def join(cls, log: EventLog, share: Share) -> Self:
        """Join the rebuild of the built-in tables that another process has begun, to fold a share of it."""
        async with log.reading() as connection:
            making = await read_generation(connection, MAKING)
        if making is None:
            raise InternalError(f"{log.address}: no rebuild is running that this worker could join")
        return cls(log, making, share=share)

    async def left(self, share: pipeline.Share = pipeline.WHOLE) -> int:
        """Return the number of events in the log that the new tables lack, without those of parked episodes."""
        async with self._log.reading() as connection:
            return await pipeline.left(connection, self._place, share)

    async def parked(self) -> dict[int, str]:
        """Return the parked episodes by number, with the reasons."""
        async with self._log.reading() as connection:
            return await pipeline.parked(connection, self._place)

    async def fold_next_batch(self) -> int | None:
        """Fold a batch; return the number of events, None when none is left of this share."""
        return await self._runner.fold_next()

    async def show(self) -> None:
        """Make the new tables visible, with at least the events of the old ones. `clear` drops the old ones."""
        with self._log.translated():
            for attempt in range(_SHOW_ATTEMPTS):
                while await self.fold_next_batch() is not None:
                    pass
                if attempt == 0:
                    await self._gather_statistics()
                await self._fill_kept()
                try:
                    if await self._show_if_complete():
                        return
                except RowRefused:
                    continue  # `fold_next_batch` folds the event again and parks its episode
        reason = f"the rebuild could not catch up with new events in {_SHOW_ATTEMPTS} attempts, the old tables stay"
        raise DatabaseUnavailable(
            f"{self._log.address}: {reason}: run `pycrorm rebuild` again when fewer robots record"
        )

    async def _gather_statistics(self) -> None:
        """Gather statistics of the new tables for the planner: without them, queries may take minutes."""
        async with self._log.engine.begin() as connection:
            making = await self._making.generation(connection, "share")
            names = [*(CORE | OF_NO_EPISODE if self._projection is None else ()), *making.layout.leaves]
            tables = [physical_name(each, self.number) for each in names]
            await dialect_of(connection).gather_statistics(connection, tables)

    async def _fill_kept(self) -> None:
        """Compute the rows of materialised views from the new tables."""
        async with self._log.reading() as connection:
            making = await self._making.generation(connection, "share")
        if not making.layout.kept:
            return
        engine = self._log.engine
        layout = making.layout
        views = built_in_texts(layout, Tables(self.number, dialect_of(engine).stored_column), engine.dialect)
        users = {name: each for name, each in layout.user_views.items() if name not in layout.failed_views}
        async with with_views(self._log.engine, views | users) as connection:
            more = True
            while more:
                more = await refresh_some(connection, making.layout, self.number, folded=pipeline.folded(self._place))
                await connection.commit()

    async def _show_if_complete(self) -> bool:
        """Switch, unless all writers would have to wait for too many missing events; return whether it did."""
        async with self._log.engine.begin() as connection:
            await dialect_of(connection).lock_log_changes(connection)
            # Every fold shares this row's lock while it writes, so no fold writes to the old tables from here on.
            old = await read_generation(connection, self._key, hold="change")
            new = await self._making.generation(connection, "change")
            seen = pipeline.SEEN
            if self._projection is not None:
                seen = pipeline.folded(pipeline.place_of(old.number, self._projection.name) if old else self._place)
            late = await pipeline.episodes_behind(connection, self._place, seen=seen, limit=_LATE_EVENTS_MAX + 1)
            if sum(each.head - each.folded for each in late) > _LATE_EVENTS_MAX:
                return False
            if late:
                spans = [Span(each.number, each.folded, each.head) for each in late]
                if not await self._runner.write_in(connection, spans):
                    await connection.rollback()
                    return False
                new = await self._making.generation(connection, "change")
            if old is not None:
                await write_generation(connection, f"{self._key}{REPLACED}{old.number}", old)
            await delete_generation(connection, f"{self._key}{_MAKING}")
            if self._projection is None:
                await self._show_tables(connection, old, new)
            else:
                await self._show_projection(connection, old, new)
        return True

    async def _show_tables(self, connection: AsyncConnection, old: Generation | None, new: Generation) -> None:
        if old is not None:
            # Keep views that were registered during the rebuild; a materialised one needs its tables created here.
            missing = old.layout.user_views.keys() - new.layout.user_views.keys()
            layout = new.layout.with_views(
                {name: old.layout.user_views[name] for name in missing},
                {name: kept for name, kept in old.layout.kept.items() if name in missing},
            )
            new = await grow_tables(connection, new, layout)
            # Above both revisions, so that every process that folded for either of them notices the switch.
            new = replace(new, revision=max(new.revision, old.revision) + 1)
        new = await show(connection, new)
        await pipeline.carry_over(connection, self._place)
        while await refresh_some(connection, new.layout, new.number):
            pass

    async def _show_projection(self, connection: AsyncConnection, old: Generation | None, new: Generation) -> None:
        revision = 1 + max(new.revision, old.revision if old is not None else 0)
        await write_generation(connection, self._key, replace(new, revision=revision))
        tables = await current_generation(connection, hold="change")
        assert tables is not None, "`begin` checked that there are tables"
        await show(connection, replace(tables, revision=tables.revision + 1))


async def _grow_slice(log: EventLog, target: SideTarget, payloads: Sequence[bytes]) -> Generation:
    """Create one slice of the missing tables of these declarations; return the generation, unchanged if none was."""
    async with log.engine.begin() as connection:
        await dialect_of(connection).lock_log_changes(connection)
        return await grow(connection, target.grow, await target.generation(connection, "change"), payloads)


async def _resumable(
    connection: AsyncConnection, generations: Mapping[str, Generation], key: str, usable: Callable[[Generation], bool]
) -> Generation | None:
    """Return the generation that an earlier rebuild left under `key`; mark it for dropping if it is not usable."""
    making = generations.get(f"{key}{_MAKING}")
    if making is None or usable(making):
        return making
    await delete_generation(connection, f"{key}{_MAKING}")
    await write_generation(connection, f"{key}{REPLACED}{making.number}", making)
    return None


async def _begin_projection(
    connection: AsyncConnection, generations: Mapping[str, Generation], projection: custom.Projection
) -> Generation:
    tables = await current_generation(connection)
    if tables is None:
        raise DatabaseForeign("the database has no tables yet: run `pycrorm rebuild` without a name")
    layout = custom_tables.layout_of(projection, connection.dialect)
    custom_tables.refuse_taken(projection.name, layout, tables.layout, projections_in(generations))
    key = f"{PROJECTION}{projection.name}"
    making = await _resumable(
        connection, generations, key, lambda each: each.version == projection.version and each.layout == layout
    )
    return making or await custom_tables.make_projection_tables(connection, projection, f"{key}{_MAKING}")


# === replaced tables ==========================================================================================
#
# Drop the tables of generations that a rebuild has replaced, in slices, while queries may still read them.

REPLACED = "/gone/"
"""Separates owner and number in the key of a replaced generation."""
_SLICE_ROWS = 10_000
"""Bounds the rows of a replaced table that one transaction deletes."""
_PAUSE_S = 0.02
"""The pause between two slices. SQLite connections poll for the write lock and would never find it free otherwise."""
_DROP_PAUSES_S = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""The pauses before the attempts to drop a table, in which queries that began before the switch end."""


async def clear(log: EventLog) -> list[str]:
    """Empty and drop replaced tables in slices; return the names of tables that are still in use and were left."""
    left: list[str] = []
    with log.translated():
        async with log.reading() as connection:
            generations = await readable_generations(log, connection)
        await sweep(log)
        for key, generation in generations.items():
            if key == SHOWN:
                await _drop(log, pipeline.place_of(generation.number))
            owner, separator, _ = key.partition(REPLACED)
            if not separator:
                continue
            is_built_in = owner == SHOWN
            tables = [
                *(CORE | OF_NO_EPISODE if is_built_in else ()),
                *generation.layout.leaves,
                *materialised_tables(generation.layout),
                pipeline.TABLE if is_built_in else f"{pipeline.TABLE}_{owner.removeprefix(PROJECTION)}",
            ]
            named = [physical_name(each, generation.number) for each in tables]
            in_use = await _drop_all(log, named)
            left += in_use
            if not in_use:
                async with log.engine.begin() as connection:
                    await delete_generation(connection, key)
    return left


async def readable_generations(log: EventLog, connection: AsyncConnection) -> dict[str, Generation]:
    """Read all generations. Raises `DatabaseForeign` if a newer version made one, whose tables this one cannot list."""
    generations = await read_generations(connection)
    newest = max((each.version for key, each in generations.items() if not key.startswith(PROJECTION)), default=0)
    if newest > PROJECTION_VERSION:
        versions = f"there are tables made by version {newest} of the fold, this is version {PROJECTION_VERSION}"
        raise DatabaseForeign(f"{log.address}: {versions}: use a newer pycrorm")
    return generations


async def _drop_all(log: EventLog, tables: list[str]) -> list[str]:
    """Drop these tables; return those that stay in use after the last attempt."""
    for pause_s in _DROP_PAUSES_S:
        await asyncio.sleep(pause_s)
        await sweep(log)  # drops replaced views first, because a table cannot be dropped before its views
        while tables and await _drop(log, tables[0]):
            tables = tables[1:]
        if not tables:
            return []
    return [each for each in tables if not await _drop(log, each)]


async def _drop(log: EventLog, table: str) -> bool:
    """Empty and drop this table if it exists; False if a query still reads it.

    A table of one slice costs one transaction: there are dozens, and most are empty.
    """
    dialect = dialect_of(log.engine)
    dropping = False
    try:
        while not dropping:
            async with log.engine.begin() as connection:
                if not await dialect.has_table(connection, table):
                    return True
                dropping = not await dialect.empty(connection, table, rows_max=_SLICE_ROWS)
                if dropping:
                    await dialect.drop(connection, table)
            if not dropping:
                await asyncio.sleep(_PAUSE_S)
    except dialect.faults:
        if not dropping:
            raise
        return False
    return True
