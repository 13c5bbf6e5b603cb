"""Keep the folds of open episodes between batches, so that each event of an episode is folded with its state.

Theory of operation. An `EpisodeProjection` has one fold for each episode, and its state is a function of the episode's
events up to one sequence. That sequence is kept beside it. A batch takes the folds of its episodes out of the cache and
gives them back when it is folded, before it is written. If the batch is then not written, because another process
folded its events first or the database refused a row, the kept sequence is ahead of the checkpoint, and if another
process folded events in the meantime it is behind. So nothing relies on the cache: a batch compares the sequence with
the checkpoint that it continues. A fold that is behind reads the events in between, and one that is ahead or missing,
as after a restart, is replaced by a new one that reads the episode from its start. The rows of events that are read in
this way are discarded, because the transaction that moved the checkpoint wrote them.

Two batches may be folded at a time, one while the other is written in parts. They never share a fold, because a fold is
in the cache or in one batch.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Final, Protocol, TypeAlias

from pycrorm_async.events.types import EpisodeEnded
from pycrorm_async.projections.custom.projection import EpisodeFold, EpisodeProjection
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent, consecutive

_EPISODES_MAX: Final = 1_000
"""Bounds the folds of open episodes that are kept, and with it the memory. It is above the episodes of one batch (400).
With more open episodes than this, those that were not folded for the longest time are read from their start again."""
_PAGE_EVENTS: Final = 2_000
"""Bounds the events that are read at once to restore a fold."""
_ENDED: Final = EpisodeEnded.__name__
_TYPE: Final = attrgetter("type")
Refused: TypeAlias = tuple[int, Exception]
"""The first event that a fold cannot read, by its sequence, with the exception."""


class _Read(Protocol):
    """Gives events of one episode to a fold; discards the results if `kept` is False."""

    def __call__(self, fold: EpisodeFold, events: Sequence[StoredEvent], *, kept: bool = True) -> Refused | None: ...


@dataclass(slots=True)
class _OpenFold:
    """The fold of one episode after its event `reached`; `fault` is the reason why it could not be restored."""

    fold: EpisodeFold
    reached: int = 0
    has_ended: bool = False
    fault: str | None = None

    def advance(self, events: Sequence[StoredEvent]) -> None:
        """Note that the fold has read these events."""
        self.reached = events[-1].sequence
        self.has_ended = self.has_ended or _ENDED in map(_TYPE, events)


class EpisodeFolds:
    """The folds of the open episodes of one projection in this process."""

    def __init__(self, projection: EpisodeProjection) -> None:
        self.projection = projection
        self._open: OrderedDict[int, _OpenFold] = OrderedDict()

    def take(self, number: int) -> _OpenFold | None:
        """Return the fold of this episode and remove it; None if there is none."""
        return self._open.pop(number, None)

    def keep(self, number: int, fold: _OpenFold) -> None:
        """Keep the fold of an episode that has not ended, and drop the one that was not folded for the longest time.

        After its end an episode can only be tagged, for which its fold is restored.
        """
        if fold.has_ended or fold.fault is not None:
            return
        self._open[number] = fold
        self._open.move_to_end(number)
        if len(self._open) > _EPISODES_MAX:
            self._open.popitem(last=False)

    def __len__(self) -> int:
        return len(self._open)


class BatchOfFolds:
    """The folds of the episodes of one batch.

    Args:
        folds: those that earlier batches left.
        read: gives events to a fold.
    """

    def __init__(self, folds: EpisodeFolds, read: _Read) -> None:
        self._folds = folds
        self._read = read
        self._taken: dict[int, _OpenFold] = {}

    async def restore(self, log: EventLog, spans: Sequence[Span]) -> None:
        """Bring the fold of each episode to the event before its span."""
        for span in spans:
            fold = self._folds.take(span.number)
            if fold is None or fold.reached > span.after:
                fold = _OpenFold(self._folds.projection.episode())
            self._taken[span.number] = fold
            while fold.reached < span.after and fold.fault is None:
                page = Span(span.number, fold.reached, min(fold.reached + _PAGE_EVENTS, span.after))
                fold.fault = self._read_again(fold, await log.spans([page]), page.last)

    def fold(self, events: Sequence[StoredEvent]) -> Refused | None:
        """Give the next events of an episode to its fold, which is dropped if it cannot fold one of them."""
        first = events[0]
        taken = self._taken.get(first.number)
        if taken is None:
            assert first.sequence == 1, "a batch that continues an episode restores its fold first"
            taken = self._taken[first.number] = _OpenFold(self._folds.projection.episode())
        if taken.fault is not None:
            refused: Refused | None = (first.sequence, CannotFold(taken.fault))
        else:
            refused = self._read(taken.fold, events)
        if refused is None:
            taken.advance(events)
        else:
            del self._taken[first.number]
        return refused

    def give_back(self) -> None:
        """Keep the folds for the next batch."""
        while self._taken:
            self._folds.keep(*self._taken.popitem())

    def _read_again(self, fold: _OpenFold, events: Sequence[StoredEvent], last: int) -> str | None:
        """Fold events up to `last` whose rows are written already; return the reason if that is not possible."""
        whole = consecutive(events, fold.reached)
        if whole and (refused := self._read(fold.fold, whole, kept=False)) is not None:
            sequence, fault = refused
            raised = "" if isinstance(fault, CannotFold) else f"{type(fault).__name__}: "
            return f"event {sequence}, read again: {raised}{fault}"
        if whole:
            fold.advance(whole)
        return None if fold.reached == last else f"event {fold.reached + 1} is missing in the log"
