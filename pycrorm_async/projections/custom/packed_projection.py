"""Define projections that pack many rows of a fold into one row of a table."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.custom.episode_folds import EpisodeFolds
from pycrorm_async.projections.custom.projected_batch import ProjectedBatch
from pycrorm_async.projections.custom.projection import EpisodeProjection

if TYPE_CHECKING:
    from pycrorm_async.projections.verify.findings import VerifyResult
    from pycrorm_async.projections.verify.parts import PartCheck


class PackedProjection(EpisodeProjection):
    """The base class of projections of this package that pack rows into other rows, as cases into blocks.

    Its tables may have columns of every storage, and names that are reserved for it. Its batch reads the stored events,
    collects the results of the fold, and packs them.
    """

    is_packed: ClassVar[bool] = True

    @abstractmethod
    def episode(self) -> Any:
        """Return the fold of one episode, as the batch needs it."""

    @abstractmethod
    def batch(self, declared: Mapping[str, DesignatorTypeDeclared], folds: EpisodeFolds) -> ProjectedBatch:
        """Return an empty batch."""

    @abstractmethod
    def check(self, result: VerifyResult) -> PartCheck:
        """Return the check that compares the tables with the log."""
