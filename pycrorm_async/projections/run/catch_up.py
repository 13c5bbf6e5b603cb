"""Generations with a progress of their own: one that is made beside what people see, and those of projections."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseForeign, InternalError, LogDamaged
from pycrorm_async.projections.run import checkpoints
from pycrorm_async.projections.run.batch_fold import TABLES, FoldDefinition, Folding, Prepared
from pycrorm_async.projections.schema.generations import Generation, Hold, grow_tables, note, noted
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.store.dialect import Progress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent, beyond, share_out

__all__ = ["SideTarget", "CatchUp", "Share", "WHOLE"]

_log = logging.getLogger("pycrorm_async.projections")

_EPISODES_MAX = 400
"""So many episodes that have more are looked up for a batch: each costs as much as folding some of its events."""


class Share(NamedTuple):
    """Which episodes one of several workers folds: those whose number leaves `part` when divided by `many`."""

    part: int = 0
    many: int = 1


WHOLE = Share()


class SideTarget:
    """A generation that is noted under a name of its own. Implements `Goal`.

    Args:
        key: under which it is noted.
        projection: whose; None for our own tables.
        version: of the fold here.
        number: of the generation; None for whichever is noted.
    """

    def __init__(self, key: str, projection: str | None, version: int, *, number: int | None = None) -> None:
        self._key = key
        self._projection = projection
        self._version = version
        self._number = number
        self.place = ""

    async def generation(self, connection: AsyncConnection, hold: Hold) -> Generation:
        found = await noted(connection, self._key, hold=hold)
        if found is None or self._number not in (None, found.number):
            raise InternalError(f"the tables of {self._projection or 'the memory'} that were folded into are gone")
        if found.version != self._version:
            raise DatabaseForeign(f"its tables are of version {found.version} now, and here it is {self._version}")
        self.place = checkpoints.place_of(found.number, self._projection)
        return found

    async def grow(self, connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
        grown = await grow_tables(connection, generation, layout)
        await note(connection, self._key, grown)
        return grown

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
        return await checkpoints.advance(connection, self.place, steps)

    async def park(self, connection: AsyncConnection, number: int, reason: str) -> None:
        await checkpoints.park(connection, self.place, number, reason)
        if self._projection is not None:
            _log.warning("episode %s is parked in the projection %s: %s", number, self._projection, reason)


class CatchUp:
    """Folds into such a generation what the log has more, batch after batch."""

    def __init__(
        self,
        log: EventLog,
        goal: SideTarget,
        generation: Generation,
        *,
        meaning: FoldDefinition = TABLES,
        share: Share = WHOLE,
        after_tables: bool = False,
        batch_events: int,
    ) -> None:
        self._log = log
        self._goal = goal
        self._share = share
        self._after_tables = after_tables
        self._batch_events = batch_events
        self.folding = Folding(log, goal, generation, meaning)
        self._after = 0
        self._ready: Prepared | None = None

    async def fold_next_batch(self) -> int | None:
        """Folds a batch; the number of events, None when none is left of this share. Raises `LogDamaged`."""
        batch, self._ready = self._ready or await self._prepared({}), None
        if batch is None:
            return None
        if self._log.address.is_sqlite:
            return await self.folding.write(batch)
        # While a server writes, the next batch is read and folded. Where this process writes, that gains nothing.
        following = asyncio.create_task(self._prepared(batch.reached))
        try:
            count = await self.folding.write(batch)
            ready = await following
        except BaseException:
            following.cancel()
            await asyncio.gather(following, return_exceptions=True)
            raise
        if count == batch.count and batch.is_whole:
            self._ready = ready
        return count

    async def _prepared(self, reached: Mapping[int, int]) -> Prepared | None:
        """The next batch. `reached` is how far episodes are once the one before it is written."""
        while True:
            async with self._log.reading() as connection:
                await self._goal.generation(connection, "share")  # it is not dropped meanwhile
                found = await checkpoints.behind(
                    connection,
                    self._goal.place,
                    after=self._after,
                    limit=_EPISODES_MAX,
                    share=self._share,
                    after_tables=self._after_tables,
                )
            behind = beyond(found, reached)
            if behind:
                break
            if self._after == 0:
                return None
            self._after = 0
        spans = share_out(behind, self._batch_events)
        events = await self._log.spans(spans)
        if len(events) < sum(each.last - each.after for each in spans):
            raise _damage(self._log, spans, events, {each.number: each.id for each in behind})
        self._after = spans[-1].number
        return await self.folding.prepare(spans, events)


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
