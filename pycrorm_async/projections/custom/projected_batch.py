"""Fold a batch of events with a custom projection, and collect the changes of rows that it makes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.events.types import DesignatorTypeDeclared, NodeStarted
from pycrorm_async.projections.custom.episode_folds import BatchOfFolds, EpisodeFolds
from pycrorm_async.projections.custom.projection import (
    Changes,
    EpisodeProjection,
    Event,
    PackedProjection,
    Projection,
)
from pycrorm_async.projections.fold.column_values import is_missing, microseconds
from pycrorm_async.projections.fold.fold import CannotFold, happening_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent

__all__ = ["ProjectedBatch"]


class ProjectedBatch(ABC):
    """A batch of a custom projection. Subclasses store its rows. Implements `Batch`.

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
            self._folds = BatchOfFolds(EpisodeFolds(projection) if folds is None else folds, self._event)

    async def restore(self, log: EventLog, spans: Sequence[Span]) -> None:
        """Restore the folds of the episodes that this batch continues."""
        if self._folds is not None:
            await self._folds.restore(log, spans)

    def fold(self, event: StoredEvent) -> None:
        """Add the projection's changes for this event. Raises `CannotFold`, and then has added none."""
        changes = Changes()
        try:
            try:
                if self._folds is not None:
                    self._folds.fold(event, changes)
                elif (read := self._event(event)) is not None:
                    self._projection.fold(read, changes)
            except CannotFold:
                raise
            except Exception as error:
                raise CannotFold(f"{self._projection.name} raised {type(error).__name__}: {error}") from error
            if changes.all:
                self.add(event, changes)
        except CannotFold:
            if self._folds is not None:
                self._folds.discard(event.number)
            raise

    @abstractmethod
    def add(self, event: StoredEvent, changes: Changes) -> None:
        """Add the changes of one event. Raises `CannotFold`, and then has added none."""

    async def ready(self, engine: AsyncEngine, generation: int) -> None:  # noqa: ARG002 - for subclasses
        """Leave the folds of the episodes to the next batch. Subclasses prepare their statements, too."""
        if self._folds is not None:
            self._folds.give_back()

    @abstractmethod
    async def write(self, connection: AsyncConnection, generation: int) -> None:
        """Write all rows in the caller's transaction. Raises `RowRefused`."""

    def _event(self, stored: StoredEvent) -> Event | None:
        if self._reads is not None and stored.type not in self._reads:
            return None
        happening = happening_of(stored)
        declaration: DesignatorTypeDeclared | None = None
        parameters: Mapping[str, Any] = {}
        if isinstance(happening, NodeStarted) and happening.designator is not None:
            declaration = self._declared.get(happening.designator)
            if declaration is None and not isinstance(self._projection, PackedProjection):
                raise CannotFold(f"the designator type {happening.designator} was never declared")
            parameters = {name: None if is_missing(each) else each for name, each in happening.parameters.items()}
        number, sequence, _, _, wall_ns, monotonic_ns, _ = stored
        dtype = None if declaration is None else declaration.dtype
        return Event(number, sequence, microseconds(wall_ns), monotonic_ns, happening, dtype, parameters, declaration)
