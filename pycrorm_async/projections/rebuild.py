"""Makes the tables anew from the log, beside those that people see, and shows them at once when they are complete.

    async with claimed(log):
        rebuild = await Rebuild.begin(log)
        while await rebuild.fold_some(): ...
        await rebuild.show()
        await clear(log)

Recording, folding and reading go on meanwhile. Every step is a short transaction of its own. Killed anywhere, the next
rebuild takes up what is there: a generation that was being made is made to its end, one that is not shown any more is
dropped. It is folded from the log alone; no class of a plan is needed.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import NamedTuple, Self

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError, DatabaseForeign, DatabaseUnavailable, InternalError, LogDamaged
from pycrorm_async.projections import progress
from pycrorm_async.projections.classes import mapped_leaves
from pycrorm_async.projections.folding import Folding
from pycrorm_async.projections.generations import (
    GONE,
    MAKING,
    PROJECTION_VERSION,
    SHOWN,
    Generation,
    Hold,
    all_noted,
    forget,
    grow_tables,
    make_empty,
    make_generation,
    note,
    noted,
    show,
)
from pycrorm_async.projections.layout import Layout
from pycrorm_async.projections.materialised import kept_tables, refresh_some
from pycrorm_async.projections.public import public_views
from pycrorm_async.projections.shadowing import with_views
from pycrorm_async.projections.tables import CORE, physical_name
from pycrorm_async.projections.union import unite
from pycrorm_async.projections.views import BUILT_IN_VIEWS, UserView, view_text, with_user_views
from pycrorm_async.store.dialect import Progress, RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.rows import Span, StoredEvent, share_out

__all__ = ["Rebuild", "Share", "claimed", "clear"]

_BATCH_EVENTS = 4_000
"""So that nobody waits long for a turn to write: on SQLite such a batch holds the write lock for some 50 ms."""
_EPISODES_MAX = 400
"""So many episodes that have more are looked up for a batch: each costs as much as folding some of its events."""
_SLICE_ROWS = 10_000
"""So many rows of a table that is not shown any more are deleted at once."""
_PAUSE_S = 0.02
"""So long nobody deletes: on SQLite whoever waits to write looks from time to time, and would find no gap."""
_LATE_EVENTS_MAX = 2_000
"""So many events may be left to fold when the new tables are shown: they are folded while everybody waits."""
_SHOW_ATTEMPTS = 50
_DROP_PAUSES_S = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""Before each attempt: a question that was asked before the new tables were shown is answered by then."""
_EVENTS = text("SELECT coalesce(sum(head), 0) FROM episode")


class Share(NamedTuple):
    """Which episodes one of several workers folds: those whose number leaves `part` when divided by `many`."""

    part: int = 0
    many: int = 1


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

    def __init__(self, log: EventLog, generation: Generation, *, share: Share) -> None:
        self._log = log
        self.number = generation.number
        self._share = share
        self._folding = Folding(log, _Making(generation.number), generation)
        self._after = 0

    @classmethod
    async def begin(cls, log: EventLog, *, views: Sequence[UserView] = ()) -> Self:
        """Takes up the generation that is being made, or makes a new one, of all types that were ever declared.

        The views people have registered are kept; `views` are added, or take the place of those of the same names.
        """
        with log.translated():
            payloads = await log.declarations()
            async with log.engine.begin() as connection:
                await dialect_of(connection).alone(connection)
                there = await _known(log, connection)
                making = there.get(MAKING)
                if making is not None and making.version != PROJECTION_VERSION:
                    await forget(connection, MAKING)
                    await note(connection, f"{GONE}{making.number}", making)
                    making = None
                if making is None:
                    making = await make_generation(
                        connection, 1 + max((each.number for each in there.values()), default=0)
                    )
                    await make_empty(connection, progress.TABLE, progress.COLUMNS, making.number)
                shown = there.get(SHOWN)
                layout = unite(making.layout.with_leaves(mapped_leaves()), payloads).layout
                if shown is not None:
                    layout = layout.with_views(shown.layout.user_views, shown.layout.kept)
                layout = with_user_views(layout, (*BUILT_IN_VIEWS, *views), connection.dialect)
                making = await grow_tables(connection, making, layout)
                await note(connection, MAKING, making)
        return cls(log, making, share=Share())

    @classmethod
    async def join(cls, log: EventLog, share: Share) -> Self:
        """The rebuild that another process has begun, to fold a share of it."""
        with log.translated():
            async with log.engine.connect() as connection:
                making = await noted(connection, MAKING)
        if making is None:
            raise InternalError("nothing is being rebuilt")
        return cls(log, making, share=share)

    async def left(self) -> int:
        """How many events of the log are not in the new tables yet."""
        async with self._log.engine.connect() as connection:
            whole = (await connection.execute(_EVENTS)).scalar_one()
            return int(whole) - await progress.total(connection, self.number)

    async def fold_some(self) -> int | None:
        """Folds a batch; the number of events, None when none is left of this share."""
        with self._log.translated():
            while True:
                async with self._log.engine.connect() as connection:
                    behind = await progress.behind(
                        connection, self.number, after=self._after, limit=_EPISODES_MAX, share=self._share
                    )
                if behind:
                    break
                if self._after == 0:
                    return None
                self._after = 0
            spans = share_out(behind, _BATCH_EVENTS)
            events = await self._log.spans(spans)
            if len(events) < sum(each.last - each.after for each in spans):
                raise _damage(self._log, spans, events, {each.number: each.id for each in behind})
            self._after = spans[-1].number
            return await self._folding.batch(spans, events)

    async def show(self) -> None:
        """Puts the new tables before the people, with all that the old ones showed. The old ones wait for `clear`."""
        with self._log.translated():
            for _ in range(_SHOW_ATTEMPTS):
                while await self.fold_some() is not None:
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
        async with self._log.engine.connect() as connection:
            making = await _Making(self.number).generation(connection, "share")
        if not making.layout.kept:
            return
        dialect = self._log.engine.dialect
        views = {name: view_text(each, dialect) for name, each in public_views(making.layout, self.number).items()}
        async with with_views(self._log.engine, views | making.layout.user_views) as connection:
            more = True
            while more:
                more = await refresh_some(connection, making.layout, self.number, folded=progress.folded(self.number))
                await connection.commit()

    async def _show_if_complete(self) -> bool:
        """False if so much is missing that everybody would have to wait for it."""
        async with self._log.engine.begin() as connection:
            await dialect_of(connection).alone(connection)
            # Whoever folds holds the note that is changed here: from now on nobody does, until this is over.
            old = await noted(connection, SHOWN, hold="change")
            new = await noted(connection, MAKING, hold="change")
            if new is None:
                raise InternalError("the new tables are gone")
            late = await progress.late(connection, self.number, limit=_LATE_EVENTS_MAX + 1)
            if sum(each.head - each.folded for each in late) > _LATE_EVENTS_MAX:
                return False
            if late:
                spans = [Span(each.number, each.folded, each.head) for each in late]
                if not await self._folding.batch_in(connection, spans, await self._log.spans(spans)):
                    await connection.rollback()
                    return False
                new = await noted(connection, MAKING) or new
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
                await note(connection, f"{GONE}{old.number}", old)
            new = await show(connection, new)
            await progress.carry_over(connection, self.number)
            await forget(connection, MAKING)
            while await refresh_some(connection, new.layout, new.number):
                pass
        return True


async def clear(log: EventLog) -> list[str]:
    """Drops what is not shown any more, little by little; gives the names of the tables that had to be left."""
    left: list[str] = []
    with log.translated():
        async with log.engine.connect() as connection:
            there = await _known(log, connection)
        await _sweep(log)
        for name, generation in there.items():
            if name == SHOWN:
                await _drop(log, physical_name(progress.TABLE, generation.number))
            if not name.startswith(GONE):
                continue
            tables = (*CORE, *generation.layout.leaves, *kept_tables(generation.layout), progress.TABLE)
            named = [physical_name(each, generation.number) for each in tables]
            kept = await _drop_all(log, named)
            left += kept
            if not kept:
                async with log.engine.begin() as connection:
                    await forget(connection, name)
    return left


async def _known(log: EventLog, connection: AsyncConnection) -> dict[str, Generation]:
    """Every generation there is. Raises `DatabaseForeign` where a newer version made one: it alone knows its tables."""
    there = await all_noted(connection)
    newest = max((each.version for each in there.values()), default=0)
    if newest > PROJECTION_VERSION:
        raise DatabaseForeign(
            f"{log.address}: there are tables made by version {newest} of the fold, this is version"
            f" {PROJECTION_VERSION}: use a newer pycrorm"
        )
    return there


def _damage(log: EventLog, spans: Sequence[Span], events: Sequence[StoredEvent], ids: dict[int, str]) -> LogDamaged:
    """What to raise of the first event that should be there."""
    there = {(each.number, each.sequence) for each in events}
    number, sequence = next(
        (span.number, sequence)
        for span in spans
        for sequence in range(span.after + 1, span.last + 1)
        if (span.number, sequence) not in there
    )
    return LogDamaged(ids[number], sequence, f"is missing in {log.address}")


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
    return [each for each in tables if not await _drop(log, each)]


async def _drop(log: EventLog, table: str) -> bool:
    dialect = dialect_of(log.engine)
    async with log.engine.connect() as connection:
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


class _Making:
    """The generation of this number while it is made. Implements `Goal`."""

    def __init__(self, number: int) -> None:
        self._number = number

    async def generation(self, connection: AsyncConnection, hold: Hold) -> Generation:
        making = await noted(connection, MAKING, hold=hold)
        if making is None or making.number != self._number:
            raise InternalError("the tables that were being made are gone")
        return making

    async def grow(self, connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
        grown = await grow_tables(connection, generation, layout)
        await note(connection, MAKING, grown)
        return grown

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
        return await progress.advance(connection, self._number, steps)

    async def park(self, connection: AsyncConnection, number: int, reason: str) -> None:
        await progress.park(connection, self._number, number, reason)
