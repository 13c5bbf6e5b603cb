"""Fold batch after batch into one target: while one batch is written, prepare the next.

    pipeline = FoldPipeline(LiveTarget(log))
    while await pipeline.fold_next(workers) is not None: ...

Theory of operation. A `BatchWorker` folds into the target's tables, in this process or in one of its own. It prepares a
batch (reads the events and folds them into rows) and later writes it in one transaction. The pipeline chooses the
events of each batch. It prepares at most one batch ahead, and writes a prepared batch only if the batch before it was
written whole; otherwise it discards the prepared one and reads the checkpoints again. A worker process may die or be
replaced at any moment: its batch then counts as not written. If its transaction committed although its answer was lost,
the checkpoints show it, because the next batch is read from them, and a batch that does not continue the checkpoints is
rolled back. So no event is folded twice or left out.

Another worker prepares ahead, if there is one. A `local` worker can also prepare ahead itself, which is faster where a
server writes in its own process, and slower with SQLite, which writes in this one.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Final, Protocol

from pycrorm_async.projections.run.batch_fold import BatchPreview, FoldTarget
from pycrorm_async.store.stored import Span, size_of

LOOKAHEAD_EVENTS_MIN: Final = 2_000
"""The smallest batch that is prepared ahead; a smaller one waits for the events that arrive during the write."""


class BatchWorker(Protocol):
    """Folds one batch at a time into the tables. Both methods raise `DatabaseUnavailable`."""

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        """Read and fold these events, and discard the batch prepared before. Writes nothing."""
        ...

    async def write(self) -> int:
        """Write the batch; return the number of its events that are in the tables now."""
        ...


class FoldPipeline:
    """Assigns the events that a target lacks to workers, batch by batch.

    Args:
        target: of all workers.
        batch_events: the most events in one transaction.
        local: a worker of this process that prepares the next batch while it writes.
    """

    def __init__(self, target: FoldTarget, *, batch_events: int = 10_000, local: BatchWorker | None = None) -> None:
        self._target = target
        self._batch_events = batch_events
        self._local = local
        self._ready: tuple[BatchWorker, BatchPreview] | None = None
        self._last_number = 0

    async def fold_next(self, workers: Sequence[BatchWorker]) -> int | None:
        """Fold one batch with one or more workers; return the number of events, None if no episode is behind.

        The number is smaller than the batch if an episode was parked, and 0 if another process folded it first. Raises
        the errors of the workers; rows that were written stay.
        """
        prepared, self._ready = self._ready, None
        if prepared is None or prepared[0] not in workers:
            spans = await self._spans(None)
            if not spans:
                return None
            prepared = workers[0], await workers[0].prepare(spans)
        worker, preview = prepared
        following = next((each for each in workers if each is not worker), self._local)
        if following is None or not preview.is_whole:
            return await worker.write()
        # `write` comes first, because a local worker takes its batch before it prepares another.
        count, ready = await asyncio.gather(
            worker.write(), self._prepare_ahead(following, preview), return_exceptions=True
        )
        for fault in (count, ready):
            if isinstance(fault, BaseException):
                raise fault
        assert isinstance(count, int)
        if count == preview.events and isinstance(ready, BatchPreview):
            self._ready = following, ready
        return count

    async def size(self) -> int:
        """Return the number of events that the next batch would have."""
        return size_of(await self._target.unfolded(self._batch_events, after=0, reached={}))

    async def _prepare_ahead(self, worker: BatchWorker, before: BatchPreview) -> BatchPreview | None:
        spans = await self._spans(before)
        return await worker.prepare(spans) if size_of(spans) >= min(LOOKAHEAD_EVENTS_MIN, self._batch_events) else None

    async def _spans(self, before: BatchPreview | None) -> list[Span]:
        # Start behind the last batch's episode, so that an episode that always grows does not starve the others.
        reached = before.reached if before is not None else {}
        spans = await self._target.unfolded(self._batch_events, after=self._last_number, reached=reached)
        if spans:
            self._last_number = spans[-1].number
        return spans
