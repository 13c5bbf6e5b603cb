"""Folds batch after batch with several hands: while one writes its batch, another one prepares the next.

    pipeline = FoldPipeline(log)
    while await pipeline.fold_next(hands) is not None: ...

A hand is a process, or anything else, that folds into the tables of the same log. It prepares a batch (reads the events
and folds them into rows) and writes it later in one transaction. The pipeline decides which events each batch has. A
batch that was prepared is written only if the batch before it was written whole; otherwise the pipeline forgets it and
reads from the tables how far they are. So no order of answers, deaths or restarts folds an event twice or leaves one
out: the tables themselves refuse a batch that does not continue them.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, Protocol

from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

__all__ = ["FoldPipeline", "Hand", "Outlook", "LOOKAHEAD_EVENTS_MIN"]

LOOKAHEAD_EVENTS_MIN: Final = 2_000
"""A smaller batch is not prepared ahead: more events may join it while the one before it is written."""


class Outlook(NamedTuple):
    """The state of the tables once a prepared batch is written.

    Attributes:
        events: folded in the batch.
        reached: by episode number, the last sequence folded.
        is_whole: False if the batch stops an episode.
    """

    events: int
    reached: Mapping[int, int]
    is_whole: bool


class Hand(Protocol):
    """Folds one batch at a time into the tables. Both methods raise `DatabaseUnavailable`."""

    async def prepare(self, spans: Sequence[Span]) -> Outlook:
        """Reads and folds these events, and forgets the batch it had prepared before. Writes nothing."""
        ...

    async def write(self) -> int:
        """Writes the batch; the number of events of it that are in the tables now."""
        ...


class FoldPipeline:
    """The order in which one log is folded. At most one batch is prepared ahead."""

    def __init__(self, log: EventLog, *, batch_events: int = 10_000) -> None:
        self._log = log
        self._batch_events = batch_events
        self._ready: tuple[Hand, Outlook] | None = None
        self._last_number = 0

    async def fold_next(self, hands: Sequence[Hand]) -> int | None:
        """Folds one batch with these hands, of which there is one or more; the number of events, None if none is left.

        Fewer events than the batch has (none, if another process was quicker) are no fault: the next call goes on.
        Raises what a hand raises; what was written stays.
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
        """The number of events that the next batch would have."""
        with self._log.translated():
            return size_of(await self._log.unfolded(self._batch_events, after=0))

    async def _spans(self, reached: Mapping[int, int]) -> list[Span]:
        # Each time from where the last one ended, so that an episode that is always behind does not hold up others.
        spans = await self._log.unfolded(self._batch_events, after=self._last_number, reached=reached)
        if spans:
            self._last_number = spans[-1].number
        return spans


def size_of(spans: Sequence[Span]) -> int:
    """The number of events in these spans.

    >>> size_of([Span(1, 0, 7), Span(2, 3, 4)])
    8
    """
    return sum(each.last - each.after for each in spans)
