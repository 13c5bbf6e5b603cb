"""Fold into generations that have their own checkpoint table: one that a rebuild fills, and those of projections.

Theory of operation. The checkpoints of the visible built-in tables are `episode.folded`. Every other generation has a
table with one row for each episode (`checkpoints`), which is dropped together with it. `SideTarget` reads the
generation under its key in every transaction. For a rebuild another number is an error. For a projection it means that
another process has rebuilt it: a batch folded for the old tables is folded again for the new ones, unless their version
differs, which is an error. On a server `CatchUp` prepares the next batch while the current one is written; the prepared
batch is used only if the current one was written whole, because it was read as continuing that one. Several workers may
fill one generation, each its `Share` of the episodes, so that no two of them advance one checkpoint.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseForeign, InternalError, LogDamaged
from pycrorm_async.projections.run import checkpoints
from pycrorm_async.projections.run.batch_fold import TABLES, BatchFold, FoldDefinition, PreparedBatch
from pycrorm_async.projections.schema.generations import (
    Generation,
    Hold,
    grow_tables,
    read_generation,
    write_generation,
)
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.store.dialect import Progress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent, beyond, share_out

__all__ = ["SideTarget", "CatchUp", "Share", "WHOLE"]

_log = logging.getLogger("pycrorm_async.projections")

_EPISODES_MAX = 400
"""Bounds the episodes in one batch, because reading each of them costs as much as folding some of its events."""


class Share(NamedTuple):
    """The episodes that one of several workers folds: those whose number modulo `many` is `part`."""

    part: int = 0
    many: int = 1


WHOLE = Share()


class SideTarget:
    """A generation with its own checkpoint table. Implements `FoldTarget`.

    Args:
        key: of its row in `pycrorm_generation`.
        projection: the custom projection's name; None for the built-in tables.
        version: of the fold in this process.
        number: of the generation; None accepts any that has the key.
    """

    def __init__(self, key: str, projection: str | None, version: int, *, number: int | None = None) -> None:
        self._key = key
        self._projection = projection
        self._version = version
        self._number = number
        self.place = ""

    async def generation(self, connection: AsyncConnection, hold: Hold) -> Generation:
        generation = await read_generation(connection, self._key, hold=hold)
        if generation is None or self._number not in (None, generation.number):
            raise InternalError(
                f"another process replaced the tables of {self._projection or 'the memory'} during the fold"
            )
        if generation.version != self._version:
            raise DatabaseForeign(
                f"its tables have version {generation.version} now, but this process folds version {self._version}"
            )
        self.place = checkpoints.place_of(generation.number, self._projection)
        return generation

    async def grow(self, connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
        grown = await grow_tables(connection, generation, layout)
        await write_generation(connection, self._key, grown)
        return grown

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
        return await checkpoints.advance(connection, self.place, steps)

    async def park(self, connection: AsyncConnection, number: int, reason: str) -> None:
        await checkpoints.park(connection, self.place, number, reason)
        if self._projection is not None:
            _log.warning("episode %s is parked in the projection %s: %s", number, self._projection, reason)


class CatchUp:
    """Folds the events that a generation lacks, batch after batch."""

    def __init__(
        self,
        log: EventLog,
        target: SideTarget,
        generation: Generation,
        *,
        definition: FoldDefinition = TABLES,
        share: Share = WHOLE,
        after_tables: bool = False,
        batch_events: int,
    ) -> None:
        self._log = log
        self._target = target
        self._share = share
        self._after_tables = after_tables
        self._batch_events = batch_events
        self.folding = BatchFold(log, target, generation, definition)
        self._after = 0
        self._ready: PreparedBatch | None = None

    async def fold_next_batch(self) -> int | None:
        """Fold a batch; return the number of events, None when none is left of this share. Raises `LogDamaged`."""
        batch, self._ready = self._ready or await self._prepared({}), None
        if batch is None:
            return None
        if self._log.address.is_sqlite:
            return await self.folding.write(batch)
        # A server writes in its own process, so this one can prepare the next batch meanwhile.
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

    async def _prepared(self, reached: Mapping[int, int]) -> PreparedBatch | None:
        """Prepare the next batch. `reached`: the checkpoints after the batch before it is written."""
        while True:
            async with self._log.reading() as connection:
                await self._target.generation(connection, "share")  # locked, so that no rebuild drops its tables
                episodes = await checkpoints.behind(
                    connection,
                    self._target.place,
                    after=self._after,
                    limit=_EPISODES_MAX,
                    share=self._share,
                    after_tables=self._after_tables,
                )
            behind = beyond(episodes, reached)
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
    """Return the error for the first event of these spans that is missing."""
    present = {(each.number, each.sequence) for each in events}
    number, sequence = next(
        (span.number, sequence)
        for span in spans
        for sequence in range(span.after + 1, span.last + 1)
        if (span.number, sequence) not in present
    )
    return LogDamaged(ids[number], sequence, f"is missing in {log.address}")
