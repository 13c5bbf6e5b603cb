"""`ReadableMemory` holds the queries of an open memory: sessions, data frames, mapped classes, past states."""

from __future__ import annotations

from contextlib import AbstractAsyncContextManager
from datetime import datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import Select
from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async.errors import CallerError
from pycrorm_async.events.blobs import Blob
from pycrorm_async.hooks.episode import Episode
from pycrorm_async.memory_parts import PartsHolder
from pycrorm_async.query.as_of import AnyEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import Moment

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["ReadableMemory"]


class ReadableMemory(PartsHolder):
    """The queries of a memory. Each raises `CallerError` while the memory is not open."""

    @property
    def reading(self) -> Reading:
        """The reading side of this memory: named queries, sessions, data frames."""
        return self._open_parts.reading

    def session(self, *, simulated: bool = False) -> AbstractAsyncContextManager[AsyncSession]:
        """Return an ordinary SQLAlchemy `AsyncSession` on this memory, as an async context manager.

        With `simulated` it also sees simulations (`SimulatedTaskTree`).
        """
        return self._open_parts.reading.session(simulated=simulated)

    async def dataframe(self, statement: Select[*tuple[Any, ...]], *, simulated: bool = False) -> DataFrame:
        """Return the rows as a pandas DataFrame (extra `learning`); with `simulated`, those of simulations too."""
        return await self._open_parts.reading.dataframe(statement, simulated=simulated)

    def mapped(self, designator: str | type) -> Any:
        """Return the mapped class of a designator type, by its dtype or its class, after one of it was flushed.

        With a daemon it needs an earlier query, because until then this memory has no connection.
        """
        reading = self._open_parts.reading
        if not reading.is_open:
            raise CallerError("this memory has not read its types yet: open a session first")
        return reading.mapped(designator)

    async def as_of(
        self,
        episode: AnyEpisode,
        *,
        time: float | datetime | None = None,
        sequence: int | None = None,
        meshes: bool = False,
    ) -> Moment:
        """Return the task tree and the world at any moment of an episode, up to the last flush; see `Reading.as_of`."""
        return await self._open_parts.reading.as_of(episode, time=time, sequence=sequence, meshes=meshes)

    async def blob(self, name: str) -> Blob | None:
        """Return the blob with this SHA-256, up to the last flush; None if it is not stored."""
        return await self._open_parts.reading.blob(name)

    async def number_of(self, episode: Episode) -> int:
        """Return the number that this database gave to the episode, after `flush`."""
        return await self._open_parts.reading.number_of(str(episode))
