"""Fold a batch of events with a custom projection; subclasses collect the results of the fold, and store them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.custom.episode_folds import BatchOfFolds, EpisodeFolds, Refused
from pycrorm_async.projections.custom.projection import EpisodeProjection, Projection
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent


class ProjectedBatch(ABC):
    """A batch of a custom projection. Implements `Batch`.

    Args:
        projection: to fold with.
        declared: designator types by fingerprint.
        folds: of an `EpisodeProjection`, those of the episodes that earlier batches began.
    """

    def __init__(
        self,
        projection: Projection,
        declared: Mapping[str, DesignatorTypeDeclared],
        folds: EpisodeFolds | None = None,
    ) -> None:
        self._projection = projection
        self._declared = declared
        reads = projection.reads
        self._reads = None if reads is None else frozenset(each.__name__ for each in reads)
        self._folds: BatchOfFolds | None = None
        if isinstance(projection, EpisodeProjection):
            self._folds = BatchOfFolds(EpisodeFolds(projection) if folds is None else folds, self._read)

    async def restore(self, log: EventLog, spans: Sequence[Span]) -> None:
        """Restore the folds of the episodes that this batch continues."""
        if self._folds is not None:
            await self._folds.restore(log, spans)

    def fold(self, events: Sequence[StoredEvent]) -> tuple[int, str] | None:
        """Fold consecutive events of an episode, and add the results to the batch; implements `Batch.fold`."""
        refused = self._read(self._projection.fold, events) if self._folds is None else self._folds.fold(events)
        if refused is None:
            return None
        sequence, fault = refused
        raised = "" if isinstance(fault, CannotFold) else f"{self._projection.name} raised {type(fault).__name__}: "
        return sequence, f"{raised}{fault}"

    def _read(self, fold: Any, events: Sequence[StoredEvent], *, kept: bool = True) -> Refused | None:
        reads = self._reads
        return self.add(fold, events if reads is None else [each for each in events if each.type in reads], kept=kept)

    @abstractmethod
    def add(self, fold: Any, events: Sequence[StoredEvent], *, kept: bool) -> Refused | None:
        """Fold events of an episode, and add the results to the batch, or discard them if `kept` is False.

        Returns the sequence of the first event that cannot be folded, with the exception; its results are not added.
        """

    async def ready(self, engine: AsyncEngine, generation: int) -> None:  # noqa: ARG002 - for subclasses
        """Leave the folds of the episodes to the next batch. Subclasses prepare their statements, too."""
        if self._folds is not None:
            self._folds.give_back()

    @abstractmethod
    async def write(self, connection: AsyncConnection, generation: int) -> None:
        """Write all rows in the caller's transaction. Raises `RowRefused`."""
