"""Fold batch after batch with several workers: while one writes its batch, another prepares the next.

    pipeline = FoldPipeline(log)
    while await pipeline.fold_next(hands) is not None: ...

Theory of operation. A `Hand` folds into the tables of the log, usually in a process of its own. It prepares a batch
(reads the events and folds them into rows) and later writes it in one transaction. The pipeline chooses the events of
each batch. It prepares at most one batch ahead, and writes a prepared batch only if the batch before it was written
whole; otherwise it discards the prepared one and reads the checkpoints again. A hand may die or be replaced at any
moment: its batch then counts as not written. If its transaction committed although its answer was lost, the checkpoints
show it, because the next batch is read from them, and a batch that does not continue the checkpoints is rolled back. So
no event is folded twice or left out.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, Protocol

from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

__all__ = ["FoldPipeline", "Hand", "Outlook", "LOOKAHEAD_EVENTS_MIN"]

LOOKAHEAD_EVENTS_MIN: Final = 2_000
"""The smallest batch that is prepared ahead; a smaller one waits for the events that arrive during the write."""


class Outlook(NamedTuple):
    """The state of the tables after a prepared batch is written.

    Attributes:
        events: the number folded in the batch.
        reached: by episode number, the last sequence folded.
        is_whole: False if the batch parks an episode.
    """

    events: int
    reached: Mapping[int, int]
    is_whole: bool


class Hand(Protocol):
    """A worker that folds one batch at a time into the tables. Both methods raise `DatabaseUnavailable`."""

    async def prepare(self, spans: Sequence[Span]) -> Outlook:
        """Read and fold these events, and discard the batch prepared before. Writes nothing."""
        ...

    async def write(self) -> int:
        """Write the batch; return the number of its events that are in the tables now."""
        ...


class FoldPipeline:
    """Assigns the events of one log to hands, batch by batch."""

    def __init__(self, log: EventLog, *, batch_events: int = 10_000) -> None:
        self._log = log
        self._batch_events = batch_events
        self._ready: tuple[Hand, Outlook] | None = None
        self._last_number = 0

    async def fold_next(self, hands: Sequence[Hand]) -> int | None:
        """Fold one batch with one or more hands; return the number of events, None if no episode is behind.

        The number is smaller than the batch if an episode was parked, and 0 if another process folded it first. Raises
        the errors of the hands; rows that were written stay.
        """
        prepared, self._ready = self._ready, None
        if prepared is None or prepared[0] not in hands:
            spans = await self._spans({})
            if not spans:
                return None
            prepared = hands[0], await hands[0].prepare(spans)
        hand, outlook = prepared
        following = next((each for each in hands if each is not hand), None)
        ahead = await self._spans(outlook.reached) if following is not None and outlook.is_whole else []
        if following is None or size_of(ahead) < LOOKAHEAD_EVENTS_MIN:
            return await hand.write()
        count, ready = await asyncio.gather(hand.write(), following.prepare(ahead), return_exceptions=True)
        for fault in (count, ready):
            if isinstance(fault, BaseException):
                raise fault
        assert isinstance(count, int)
        assert isinstance(ready, Outlook)
        if count == outlook.events:
            self._ready = following, ready
        return count

    async def size(self) -> int:
        """Return the number of events that the next batch would have."""
        with self._log.translated():
            return size_of(await self._log.unfolded(self._batch_events, after=0))

    async def _spans(self, reached: Mapping[int, int]) -> list[Span]:
        # Start behind the last batch's episode, so that an episode that always grows does not starve the others.
        spans = await self._log.unfolded(self._batch_events, after=self._last_number, reached=reached)
        if spans:
            self._last_number = spans[-1].number
        return spans


def size_of(spans: Sequence[Span]) -> int:
    """Return the number of events in these spans.

    >>> size_of([Span(1, 0, 7), Span(2, 3, 4)])
    8
    """
    return sum(each.last - each.after for each in spans)
