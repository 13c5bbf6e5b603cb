"""Keeps the tables up to date with the log: reads what is behind, folds it, writes rows and progress together.

Reading and folding hold no lock. The write transaction then checks that both the tables and the progress are as they
were taken to be; if somebody else was quicker it is rolled back and the loop reads again. So any number of projectors
may work on one memory, and none of them ever shows an event twice or half.

    projector = Projector(log)
    await projector.open()
    await projector.fold_behind()
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter

from sqlalchemy.exc import DBAPIError
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseError, InternalError
from pycrorm_async.projections.classes import mapped_leaves
from pycrorm_async.projections.fold import CannotFold, fold
from pycrorm_async.projections.generations import (
    Generation,
    current_generation,
    grow,
    make_generation,
)
from pycrorm_async.projections.layout import Layout
from pycrorm_async.projections.parameters import Designators
from pycrorm_async.projections.rows import Rows
from pycrorm_async.projections.union import unite
from pycrorm_async.projections.views import BUILT_IN_VIEWS, UserView, view_texts
from pycrorm_async.projections.write import write_rows
from pycrorm_async.store.dialect import RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.progress import advance_folded, park
from pycrorm_async.store.rows import StoredEvent

__all__ = ["Projector"]


@dataclass(frozen=True)
class _Folded:
    """A batch after the fold: its rows, (episode, folded before, folded now) of each episode, and why some stop."""

    rows: Rows
    steps: list[tuple[int, int, int]]
    parked: dict[int, str]


@dataclass(frozen=True)
class _Types:
    """What the declarations that were read make of the generation's layout."""

    payloads: list[bytes]
    revision: int
    layout: Layout
    designators: Designators


class Projector:
    """Folds one log into its tables.

    Args:
        log: open for writing.
        views: users' views to make beside the tables.
        batch_events: how many events one transaction takes at most.
    """

    def __init__(self, log: EventLog, *, views: Sequence[UserView] = (), batch_events: int = 10_000) -> None:
        self._log = log
        self._views = (*BUILT_IN_VIEWS, *views)
        self._batch_events = batch_events
        self._generation: Generation | None = None
        self._types: _Types | None = None

    async def open(self) -> None:
        """Makes tables and views that are missing: those of every memory, of the mapped classes, of the users.

        Raises `DatabaseForeign` for tables of another version, `CallerError` for a view whose name is taken.
        """
        with self._log.translated():
            async with self._log.engine.begin() as connection:
                await dialect_of(connection).alone(connection)
                found = await current_generation(connection)
                generation = found or await make_generation(connection, 1)
                layout = generation.layout.with_leaves(mapped_leaves())
                layout = layout.with_views(view_texts(self._views, layout, connection.dialect))
                if found is None or layout != generation.layout:
                    generation = await grow(connection, generation, layout)
        self._generation = generation

    async def fold_behind(self) -> int:
        """Shows in the tables what the log holds; the number of events folded.

        An event that cannot be folded parks its episode with the reason, what came before it is shown, and the others
        go on. Raises `DatabaseUnavailable`; what was folded stays, and the call may be made again.
        """
        count = 0
        with self._log.translated():
            while events := await self._log.unfolded(self._batch_events):
                count += await self._fold_batch(events)
        return count

    async def fold_some(self) -> bool:
        """One batch of the same; False if nothing was behind."""
        with self._log.translated():
            events = await self._log.unfolded(self._batch_events)
            if events:
                await self._fold_batch(events)
        return bool(events)

    async def _fold_batch(self, events: Sequence[StoredEvent]) -> int:
        types = await self._types_now()
        folded = _folded(events, types.designators)
        try:
            async with self._log.engine.begin() as connection:
                written = await self._write(connection, folded, types)
                if written is None:
                    await connection.rollback()
                    return 0
            self._generation = written
        except RowRefused as refusal:
            return await self._fold_apart(events, refusal)
        return sum(now - before for _, before, now in folded.steps)

    async def _write(self, connection: AsyncConnection, folded: _Folded, types: _Types) -> Generation | None:
        """The generation written to; None if the tables or the progress are not what the fold took them to be."""
        if self._generation is None or types.layout != self._generation.layout:
            await dialect_of(connection).alone(connection)
        generation = await current_generation(connection)
        if generation is None:
            raise InternalError("the tables are gone: open the memory again")
        if generation.revision != types.revision:
            self._generation = generation
            return None
        if types.layout != generation.layout:
            try:
                generation = await grow(connection, generation, types.layout)
            except DBAPIError as error:
                if "already exists" not in str(error.orig):
                    raise
                raise DatabaseError(
                    f"{self._log.address}: {error.orig}, and the memory needs that name: rename yours, then flush again"
                ) from error
        if not await advance_folded(connection, folded.steps):
            return None
        await write_rows(connection, folded.rows, generation.number)
        for number, reason in folded.parked.items():
            await park(connection, number, reason)
        return generation

    async def _types_now(self) -> _Types:
        """Read after the events: a declaration is stored before the first event that needs it."""
        assert self._generation is not None, "opened before anything is folded"
        payloads = await self._log.declarations()
        types = self._types
        if types is None or types.revision != self._generation.revision or types.payloads != payloads:
            layout, accepted, refused = unite(self._generation.layout, payloads)
            types = _Types(payloads, self._generation.revision, layout, Designators(accepted, refused))
            self._types = types
        return types

    async def _fold_apart(self, events: Sequence[StoredEvent], refusal: RowRefused) -> int:
        """The database refused a row of this batch: find the episode it belongs to, and park that one."""
        episodes = [list(each) for _, each in groupby(events, key=attrgetter("number"))]
        if len(episodes) > 1:
            return sum([await self._fold_batch(each) for each in episodes])
        if len(events) > 1:
            # Halves, so that all that comes before the event is shown.
            middle = len(events) // 2
            count = await self._fold_batch(events[:middle])
            return count + (await self._fold_batch(events[middle:]) if count == middle else 0)
        async with self._log.engine.begin() as connection:
            await park(connection, events[0].number, f"event {events[0].sequence}: the database refuses it: {refusal}")
        return 0


def _folded(events: Sequence[StoredEvent], designators: Designators) -> _Folded:
    rows, steps, parked = Rows(), [], {}
    for number, episode in groupby(events, key=attrgetter("number")):
        first = last = None
        for event in episode:
            if first is None:
                first = last = event.sequence - 1
            if number in parked:
                continue
            try:
                fold(event, designators, rows)
                last = event.sequence
            except CannotFold as reason:
                parked[number] = f"event {event.sequence}: {reason}"
        assert first is not None
        assert last is not None
        steps.append((number, first, last))
    return _Folded(rows, steps, parked)
