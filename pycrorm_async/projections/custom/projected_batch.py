"""Fold a batch of events with a custom projection; subclasses keep what the fold makes, and store it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.custom.episode_folds import BatchOfFolds, EpisodeFolds
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
            self._folds = BatchOfFolds(EpisodeFolds(projection) if folds is None else folds, self._reads, self.made)

    async def restore(self, log: EventLog, spans: Sequence[Span]) -> None:
        """Restore the folds of the episodes that this batch continues."""
        if self._folds is not None:
            await self._folds.restore(log, spans)

    def fold(self, event: StoredEvent) -> None:
        """Add what the projection makes of this event. Raises `CannotFold`, and then has added nothing."""
        try:
            fold = self._projection.fold if self._folds is None else self._folds.fold_of(event)
            if self._reads is not None and event.type not in self._reads:
                return
            try:
                made = self.made(fold, event)
            except CannotFold:
                raise
            except Exception as error:
                raise CannotFold(f"{self._projection.name} raised {type(error).__name__}: {error}") from error
            if made:
                self.add(event, made)
        except CannotFold:
            if self._folds is not None:
                self._folds.discard(event.number)
            raise

    @abstractmethod
    def made(self, fold: Any, event: StoredEvent) -> Sequence[Any]:
        """Return what a fold of the projection makes of an event. Raises `CannotFold`."""

    @abstractmethod
    def add(self, event: StoredEvent, made: Sequence[Any]) -> None:
        """Add what the fold made of one event. Raises `CannotFold`, and then has added nothing."""

    async def ready(self, engine: AsyncEngine, generation: int) -> None:  # noqa: ARG002 - for subclasses
        """Leave the folds of the episodes to the next batch. Subclasses prepare their statements, too."""
        if self._folds is not None:
            self._folds.give_back()

    @abstractmethod
    async def write(self, connection: AsyncConnection, generation: int) -> None:
        """Write all rows in the caller's transaction. Raises `RowRefused`."""
