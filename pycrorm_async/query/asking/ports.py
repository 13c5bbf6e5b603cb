"""The port through which questions and comparisons read a memory; `query.reading.Reading` implements it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

from sqlalchemy import Dialect, Row, Select

if TYPE_CHECKING:
    from pycrorm_async.query.frames.dataframe import Library
    from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary


class EpisodeReader(Protocol):
    """Reads the rows of selects, and episodes by their names."""

    @property
    def dialect(self) -> Dialect:
        """The dialect of the database, to write a statement in its SQL."""
        ...

    async def rows(
        self, statement: Select[*tuple[Any, ...]], *, simulated: bool = False
    ) -> list[Row[*tuple[Any, ...]]]:
        """Return the rows of a select over columns as named tuples."""
        ...

    async def dataframe(self, statement: Select[*tuple[Any, ...]], *, to: Library, simulated: bool = False) -> Any:
        """Return the rows of a select as a frame. Raises `MissingExtra`."""
        ...

    async def episode(self, name: str) -> EpisodeSummary:
        """Return the episode with this number, id, or first digits of its id. Raises `UnknownEpisode`."""
        ...

    async def tree(self, episode: EpisodeSummary) -> Sequence[NodeSummary]:
        """Return the nodes of an episode, each before its children."""
        ...
