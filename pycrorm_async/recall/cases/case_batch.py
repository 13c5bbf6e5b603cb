"""Collect the cases of a batch of events, and write them as one block."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.custom.episode_folds import EpisodeFolds, Refused
from pycrorm_async.projections.custom.packed_projection import PackedProjection
from pycrorm_async.projections.custom.projected_batch import ProjectedBatch
from pycrorm_async.recall.blocks import Block
from pycrorm_async.recall.case import Case
from pycrorm_async.recall.cases.episode_cases import EpisodeCases
from pycrorm_async.recall.cases.stored_blocks import merge_blocks, rows_of
from pycrorm_async.store.dialect import Insertion
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.stored import StoredEvent


class CaseBatch(ProjectedBatch):
    """The cases of one batch of events, which it writes as one block. Implements `Batch`."""

    def __init__(
        self, projection: PackedProjection, declared: Mapping[str, DesignatorTypeDeclared], folds: EpisodeFolds
    ) -> None:
        super().__init__(projection, declared, folds)
        self.cases: list[Case] = []
        self._insertion: Insertion = None

    def add(self, fold: EpisodeCases, events: Sequence[StoredEvent], *, kept: bool) -> Refused | None:
        return fold.read(events, self._declared.get, self.cases if kept else [])

    async def ready(self, engine: AsyncEngine, generation: int) -> None:
        await super().ready(engine, generation)
        if self.cases:
            rows = rows_of(Block.of(self.cases), generation)
            self._insertion = await dialect_of(engine).insertion(rows)

    async def write(self, connection: AsyncConnection, generation: int) -> None:
        if self.cases:
            await dialect_of(connection).insert(connection, self._insertion)
            await merge_blocks(connection, generation)
