"""Fold the events of episodes into cases, which are stored as blocks. Every memory has this projection, `recall`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.custom.episode_folds import EpisodeFolds
from pycrorm_async.projections.custom.packed_projection import PackedProjection
from pycrorm_async.projections.custom.projected_batch import ProjectedBatch
from pycrorm_async.projections.verify.findings import VerifyResult
from pycrorm_async.projections.verify.parts import PartCheck
from pycrorm_async.recall.cases.case_batch import CaseBatch
from pycrorm_async.recall.cases.case_check import CaseCheck
from pycrorm_async.recall.cases.episode_cases import READS, EpisodeCases
from pycrorm_async.recall.cases.situation import FeatureFields
from pycrorm_async.recall.cases.stored_blocks import (
    BLOCK_COLUMNS,
    BLOCKS,
    COLUMN_COLUMNS,
    COLUMNS,
)


class CaseProjection(PackedProjection):
    """Makes a case of each action that ends. The row of a case is packed with others into a block."""

    name = "recall"
    version = 1
    tables: ClassVar[Any] = {BLOCKS: BLOCK_COLUMNS, COLUMNS: COLUMN_COLUMNS}
    reads = READS

    def __init__(self) -> None:
        self._types: dict[str, FeatureFields] = {}

    def episode(self) -> Any:
        return EpisodeCases(self._types)

    def batch(self, declared: Mapping[str, DesignatorTypeDeclared], folds: EpisodeFolds) -> ProjectedBatch:
        return CaseBatch(self, declared, folds)

    def check(self, result: VerifyResult) -> PartCheck:
        return CaseCheck(self, result)
