"""Makes the tables anew from the log, beside those that people see, and shows them at once when they are complete.

    async with claimed(log):
        rebuild = await Rebuild.begin(log)
        while await rebuild.fold_next_batch(): ...
        await rebuild.show()
        await clear(log)

Recording, folding and reading go on meanwhile. Every step is a short transaction of its own. Killed anywhere, the next
rebuild takes up what is there: a generation that was being made is made to its end, one that is not shown any more is
dropped. It is folded from the log alone; no class of a plan is needed.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Self

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError, DatabaseForeign, DatabaseUnavailable, InternalError
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.custom.projection_tables import CustomFoldDefinition, layout_of, make_own, refuse_taken
from pycrorm_async.projections.run import checkpoints
from pycrorm_async.projections.run.batch_fold import TABLES
from pycrorm_async.projections.run.catch_up import WHOLE, CatchUp, Share, SideTarget
from pycrorm_async.projections.schema.generations import (
    MAKING,
    PROJECTION,
    PROJECTION_VERSION,
    SHOWN,
    Generation,
    all_noted,
    current_generation,
    forget,
    grow_tables,
    make_empty,
    make_generation,
    note,
    noted,
    projections_in,
    show,
)
from pycrorm_async.projections.schema.growth import grow
from pycrorm_async.projections.schema.mapped_tables import mapped_leaves
from pycrorm_async.projections.schema.materialised_views import kept_tables, refresh_some
from pycrorm_async.projections.schema.public_views import public_views
from pycrorm_async.projections.schema.session_views import with_views
from pycrorm_async.projections.schema.tables import CORE, physical_name
from pycrorm_async.projections.schema.user_views import UserView, view_text, with_user_views
from pycrorm_async.store.dialect import RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

__all__ = ["Rebuild", "Share", "claimed", "clear", "recorded"]

_MAKING, _GONE = "/making", "/gone/"
_BATCH_EVENTS = 8_000
"""So that nobody waits long for a turn to write: on SQLite such a batch holds the write lock for some 50 ms."""
_SLICE_ROWS = 10_000
"""So many rows of a table that is not shown any more are deleted at once."""
_PAUSE_S = 0.02
"""So long nobody deletes: on SQLite whoever waits to write looks from time to time, and would find no gap."""
_LATE_EVENTS_MAX = 2_000
"""So many events may be left to fold when the new tables are shown: they are folded while everybody waits."""
_SHOW_ATTEMPTS = 50
_DROP_PAUSES_S = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""Before each attempt: a question that was asked before the new tables were shown is answered by then."""
_RECORDED = text("SELECT count(*), coalesce(sum(head), 0) FROM episode")


async def recorded(log: EventLog) -> tuple[int, int]:
    """How many episodes and how many events there are in the log."""
    async with log.reading() as connection:
        episodes, events = (await connection.execute(_RECORDED)).one()
        return int(episodes), int(events)


@asynccontextmanager
async def claimed(log: EventLog) -> AsyncIterator[None]:
    """Nobody else rebuilds this memory until the context is left. Raises `CallerError` if somebody does."""
    with log.translated():
        async with dialect_of(log.engine).claim(log.engine) as alone:
            if not alone:
                raise CallerError(f"{log.address}: another `pycrorm rebuild` is at work: wait for it to end")
            yield


class Rebuild:
    """One generation on its way from the log to the people. Begun in a claimed memory; its workers join it.

    Attributes:
        number: of the generation.
    """

    def __init__(
        self,
        log: EventLog,
        generation: Generation,
        *,
        share: Share = WHOLE,
        projection: Projection | None = None,
    ) -> None:
        self._log = log
        self.number = generation.number
        self._projection = projection
        self._key = SHOWN if projection is None else f"{PROJECTION}{projection.name}"
        name = None if projection is None else projection.name
        self._place = checkpoints.place_of(generation.number, name)
        self._making = SideTarget(f"{self._key}{_MAKING}", name, generation.version, number=generation.number)
        self._catch_up = CatchUp(
            log,
            self._making,
            generation,
            meaning=TABLES if projection is None else CustomFoldDefinition(projection),
            share=share,
            after_tables=projection is not None,
            batch_events=_BATCH_EVENTS,
        )

    @classmethod
    async def begin(
        cls, log: EventLog, *, views: Sequence[UserView] = (), projection: Projection | None = None
    ) -> Self:
        """Takes up the generation that is being made, or makes a new one, of all types that were ever declared.

        The views people have registered are kept; `views` are added, or take the place of those of the same names. With
        a projection it is the tables of that one alone.
        """
        with log.translated():
            payloads = await log.declarations()
            async with log.engine.begin() as connection:
                await dialect_of(connection).alone(connection)
                there = await _known(log, connection)
                shown = there.get(SHOWN)
                # Asked at the end too; but who must move something is told before hours of work.
                await dialect_of(connection).only_views(connection, shown.views if shown else ())
                if projection is not None:
                    return cls(log, await _begin_own(connection, there, projection), projection=projection)
                making = await _going_on(connection, there, SHOWN, lambda each: each.version == PROJECTION_VERSION)
                if making is None:
                    numbers = [each.number for key, each in there.items() if not key.startswith(PROJECTION)]
                    making = await make_generation(connection, 1 + max(numbers, default=0))
                    await make_empty(connection, {checkpoints.TABLE: checkpoints.COLUMNS}, making.number)
                making = await grow_tables(connection, making, making.layout.with_leaves(mapped_leaves()))
                await note(connection, MAKING, making)
            goal = SideTarget(MAKING, None, making.version, number=making.number)
            while (grown := await _grown(log, goal, payloads)).layout != making.layout:
                making = grown
            async with log.engine.begin() as connection:
                await dialect_of(connection).alone(connection)
                making = await goal.generation(connection, "change")
                layout = making.layout
                if shown is not None:
                    layout = layout.with_views(shown.layout.user_views, shown.layout.kept)
                layout = with_user_views(layout, views, connection.dialect)
                making = await grow_tables(connection, making, layout)
                await note(connection, MAKING, making)
        return cls(log, making)

    @classmethod
    async def join(cls, log: EventLog, share: Share) -> Self:
        """The rebuild of our tables that another process has begun, to fold a share of it."""
        async with log.reading() as connection:
            making = await noted(connection, MAKING)
        if making is None:
            raise InternalError("nothing is being rebuilt")
        return cls(log, making, share=share)

    async def left(self) -> int:
        """How many events of the log are not in the new tables yet."""
        async with self._log.reading() as connection:
            done = await checkpoints.total(connection, self._place)
        _, events = await recorded(self._log)
        return events - done

    async def parked(self) -> dict[int, str]:
        """By episode number, why not all of it could be folded."""
        async with self._log.reading() as connection:
            return await checkpoints.parked(connection, self._place)

    async def fold_next_batch(self) -> int | None:
        """Folds a batch; the number of events, None when none is left of this share."""
        with self._log.translated():
            return await self._catch_up.fold_next_batch()

    async def show(self) -> None:
        """Puts the new tables before the people, with all that the old ones showed. The old ones wait for `clear`."""
        with self._log.translated():
            for _ in range(_SHOW_ATTEMPTS):
                while await self.fold_next_batch() is not None:
                    pass
                await self._fill_kept()
                try:
                    if await self._show_if_complete():
                        return
                except RowRefused:
                    continue  # folded again, it parks its episode
        raise DatabaseUnavailable(f"{self._log.address}: more is recorded than can be folded meanwhile: run it again")

    async def _fill_kept(self) -> None:
        """Makes the rows of the views that are kept, from the new tables."""
        async with self._log.reading() as connection:
            making = await self._making.generation(connection, "share")
        if not making.layout.kept:
            return
        engine = self._log.engine
        meanings = public_views(making.layout, self.number, dialect_of(engine).stored_column)
        views = {name: view_text(each, engine.dialect) for name, each in meanings.items()}
        async with with_views(self._log.engine, views | making.layout.user_views) as connection:
            more = True
            while more:
                more = await refresh_some(
                    connection, making.layout, self.number, folded=checkpoints.folded(self._place)
                )
                await connection.commit()

    async def _show_if_complete(self) -> bool:
        """False if so much is missing that everybody would have to wait for it."""
        async with self._log.engine.begin() as connection:
            await dialect_of(connection).alone(connection)
            # Whoever folds holds the note that is changed here: from now on nobody does, until this is over.
            old = await noted(connection, self._key, hold="change")
            new = await self._making.generation(connection, "change")
            seen = checkpoints.SEEN
            if self._projection is not None:
                seen = checkpoints.folded(
                    checkpoints.place_of(old.number, self._projection.name) if old else self._place
                )
            late = await checkpoints.late(connection, self._place, seen=seen, limit=_LATE_EVENTS_MAX + 1)
            if sum(each.head - each.folded for each in late) > _LATE_EVENTS_MAX:
                return False
            if late:
                spans = [Span(each.number, each.folded, each.head) for each in late]
                if not await self._catch_up.folding.batch_in(connection, spans, await self._log.spans(spans)):
                    await connection.rollback()
                    return False
                new = await self._making.generation(connection, "change")
            if old is not None:
                await note(connection, f"{self._key}{_GONE}{old.number}", old)
            await forget(connection, f"{self._key}{_MAKING}")
            if self._projection is None:
                await self._show_tables(connection, old, new)
            else:
                await self._show_own(connection, old, new)
        return True

    async def _show_tables(self, connection: AsyncConnection, old: Generation | None, new: Generation) -> None:
        # A view that was registered meanwhile is kept; and whoever has read a revision before must see another one.
        if old is not None:
            # A view registered meanwhile that is kept has no table here: then there is more to make first.
            missing = old.layout.user_views.keys() - new.layout.user_views.keys()
            layout = new.layout.with_views(
                {name: old.layout.user_views[name] for name in missing},
                {name: kept for name, kept in old.layout.kept.items() if name in missing},
            )
            new = await grow_tables(connection, new, layout)
            new = replace(new, revision=max(new.revision, old.revision) + 1)
        new = await show(connection, new)
        await checkpoints.carry_over(connection, self._place)
        while await refresh_some(connection, new.layout, new.number):
            pass

    async def _show_own(self, connection: AsyncConnection, old: Generation | None, new: Generation) -> None:
        revision = 1 + max(new.revision, old.revision if old is not None else 0)
        await note(connection, self._key, replace(new, revision=revision))
        tables = await current_generation(connection, hold="change")
        assert tables is not None, "looked for when this was begun"
        await show(connection, replace(tables, revision=tables.revision + 1))


async def _grown(log: EventLog, goal: SideTarget, payloads: Sequence[bytes]) -> Generation:
    """The generation with more of the tables of these declarations, or as it was if it has all that can be made."""
    async with log.engine.begin() as connection:
        await dialect_of(connection).alone(connection)
        return await grow(connection, goal, await goal.generation(connection, "change"), payloads)


async def _going_on(
    connection: AsyncConnection, there: Mapping[str, Generation], key: str, usable: Callable[[Generation], bool]
) -> Generation | None:
    """The generation that an earlier rebuild has begun; one that is of no use waits to be dropped afterwards."""
    making = there.get(f"{key}{_MAKING}")
    if making is None or usable(making):
        return making
    await forget(connection, f"{key}{_MAKING}")
    await note(connection, f"{key}{_GONE}{making.number}", making)
    return None


async def _begin_own(
    connection: AsyncConnection, there: Mapping[str, Generation], projection: Projection
) -> Generation:
    tables = await current_generation(connection)
    if tables is None:
        raise DatabaseForeign("there are no tables yet: run `pycrorm rebuild` without a name")
    layout = layout_of(projection, connection.dialect)
    refuse_taken(projection.name, layout, tables.layout, projections_in(there))
    key = f"{PROJECTION}{projection.name}"
    making = await _going_on(
        connection, there, key, lambda each: each.version == projection.version and each.layout == layout
    )
    return making or await make_own(connection, projection, f"{key}{_MAKING}")


async def clear(log: EventLog) -> list[str]:
    """Drops what is not shown any more, little by little; gives the names of the tables that had to be left."""
    left: list[str] = []
    with log.translated():
        async with log.reading() as connection:
            there = await _known(log, connection)
        await _sweep(log)
        for key, generation in there.items():
            if key == SHOWN:
                await _drop(log, checkpoints.place_of(generation.number))
            of, gone, _ = key.partition(_GONE)
            if not gone:
                continue
            ours = of == SHOWN
            tables = [
                *(CORE if ours else ()),
                *generation.layout.leaves,
                *kept_tables(generation.layout),
                checkpoints.TABLE if ours else f"{checkpoints.TABLE}_{of.removeprefix(PROJECTION)}",
            ]
            named = [physical_name(each, generation.number) for each in tables]
            kept = await _drop_all(log, named)
            left += kept
            if not kept:
                async with log.engine.begin() as connection:
                    await forget(connection, key)
    return left


async def _known(log: EventLog, connection: AsyncConnection) -> dict[str, Generation]:
    """Every generation there is. Raises `DatabaseForeign` where a newer version made one: it alone knows its tables."""
    there = await all_noted(connection)
    newest = max((each.version for key, each in there.items() if not key.startswith(PROJECTION)), default=0)
    if newest > PROJECTION_VERSION:
        raise DatabaseForeign(
            f"{log.address}: there are tables made by version {newest} of the fold, this is version"
            f" {PROJECTION_VERSION}: use a newer pycrorm"
        )
    return there


async def _sweep(log: EventLog) -> None:
    async with log.engine.begin() as connection:
        await dialect_of(connection).sweep(connection)


async def _drop_all(log: EventLog, tables: list[str]) -> list[str]:
    """Those of them that somebody uses, and goes on using."""
    for pause_s in _DROP_PAUSES_S:
        await asyncio.sleep(pause_s)
        await _sweep(log)  # where a view that was replaced cannot go yet, its tables cannot
        while tables and await _drop(log, tables[0]):
            tables = tables[1:]
        if not tables:
            return []
    return [each for each in tables if not await _drop(log, each)]


async def _drop(log: EventLog, table: str) -> bool:
    dialect = dialect_of(log.engine)
    async with log.reading() as connection:
        if not await dialect.has_table(connection, table):
            return True
    full = True
    while full:
        async with log.engine.begin() as connection:
            full = await dialect.empty(connection, table, rows_max=_SLICE_ROWS)
        if full:
            await asyncio.sleep(_PAUSE_S)
    try:
        async with log.engine.begin() as connection:
            await dialect.drop(connection, table)
    except dialect.faults:
        return False  # somebody reads it still
    return True
