"""A memory opened for asking: sessions, frames and named questions; nothing is ever written through it.

async with Reading.open("sqlite:///memory.db") as reading:
    async with reading.session() as session:
        actions = (await session.scalars(select(Action))).all()
    frame = await reading.dataframe(select(PickUpWithContextView))
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import datetime
from typing import TYPE_CHECKING, Any, Self

from sqlalchemy import Select
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncSession, async_sessionmaker

from pycrorm_async.errors import DatabaseUnavailable, UnknownEpisode
from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.orm.designators import Designator
from pycrorm_async.orm.dynamic import DynamicClasses
from pycrorm_async.projections.schema.generations import Generation, current_generation
from pycrorm_async.projections.schema.layout import unite
from pycrorm_async.projections.schema.session_views import all_views, with_views
from pycrorm_async.query import named_queries
from pycrorm_async.query.as_of import AnyEpisode, as_of
from pycrorm_async.query.dataframes import dataframe
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Reading"]


class Reading:
    """The asking side of one memory. Belongs to the loop it was opened in.

    What was only thought through (`plan.SimulatedTaskTree`) is left out of every answer. With `simulated=True` the same
    questions see it too; `TaskTreeNode.simulated` and `ProcessMetaData.simulated` tell it from what happened. Such a
    session or frame costs some ms more.
    """

    def __init__(self, log: EventLog | DatabaseAddress) -> None:
        """Of an open log; or of one at an address, which is opened at the first question and closed by `close`."""
        self._address = log if isinstance(log, DatabaseAddress) else log.address
        self._opened: EventLog | None = None
        self._opening = asyncio.Lock()
        self._classes = DynamicClasses()
        self._declarations: list[bytes] = []
        self._all_views: tuple[int, dict[str, str]] = (-1, {})
        if isinstance(log, EventLog):
            self._use(log)

    @classmethod
    @asynccontextmanager
    async def open(cls, url: str) -> AsyncIterator[Self]:
        """The memory at a URL, which must be there.

        Raises `UnknownUrl`; `DatabaseUnavailable` without a memory at that place, `DatabaseForeign` for another
        program's or a newer version's.
        """
        with DatabaseAddress.parse(url).located() as address:
            async with cls.open_address(address) as reading:
                yield reading

    @classmethod
    @asynccontextmanager
    async def open_address(cls, address: DatabaseAddress) -> AsyncIterator[Self]:
        """The memory at a located address. Raises as `open` does."""
        reading = cls(address)
        try:
            await reading.refresh()
            yield reading
        finally:
            await reading.close()

    @property
    def is_open(self) -> bool:
        """Whether anything was asked yet."""
        return self._opened is not None

    async def close(self) -> None:
        """Ends its connections and its classes. Twice is once."""
        async with self._opening:
            log, self._opened = self._opened, None
            self._classes.dispose()
            if log is not None:
                await log.close()

    async def refresh(self) -> None:
        """Learns the designator types that were declared since; every session begins with it."""
        await self._ready()
        declarations = await self._log.declarations()
        if declarations != self._declarations:
            generation = await _generation(self._log)
            united = unite(generation.layout, declarations)
            self._classes.learn(united.accepted.values(), united.layout.renamed)
            self._declarations = declarations

    @asynccontextmanager
    async def session(self, *, simulated: bool = False) -> AsyncIterator[AsyncSession]:
        """An ordinary session. Its objects stay readable when it is over."""
        await self.refresh()
        if not simulated:
            async with self._sessions() as session:
                yield session
            return
        async with (
            self._connection(simulated=True) as connection,
            AsyncSession(connection, expire_on_commit=False) as session,
        ):
            yield session

    async def dataframe(self, statement: Select[*tuple[Any, ...]], *, simulated: bool = False) -> pd.DataFrame:
        """The answer as a pandas DataFrame, see `pycrorm_async.query.dataframes`. Raises `MissingExtra`."""
        await self._ready()
        with self._log.translated():
            async with self._connection(simulated=simulated) as connection:
                return await dataframe(connection, statement)

    def mapped(self, designator: str | type) -> type[Designator]:
        """The mapped class of a dtype, a table or a designator class, as of the last `refresh`.

        Raises `CallerError` for a type this memory has never seen.
        """
        return self._classes.of(designator)

    # --- named questions --------------------------------------------------------------------------------------

    async def episodes(self, *, simulated: bool = False) -> list[EpisodeSummary]:
        """Every episode, the oldest first."""
        await self._ready()
        with self._log.translated():
            async with self._connection(simulated=simulated) as connection:
                return await named_queries.episodes(connection)

    async def episode(self, name: str) -> EpisodeSummary:
        """The episode of that number, or id, or first digits of its id, also one that was only thought through.

        `last` is the newest that really happened. Raises `UnknownEpisode`.
        """
        await self._ready()
        with self._log.translated():
            async with self._connection(simulated=True) as connection:
                return await named_queries.episode_named(connection, name)

    async def tree(self, number: int) -> list[NodeSummary]:
        """The task tree of an episode, also of one that was only thought through; each node before its children."""
        await self._ready()
        with self._log.translated():
            async with self._connection(simulated=True) as connection:
                return await named_queries.task_tree(connection, number)

    async def as_of(
        self, episode: AnyEpisode, *, time: float | datetime | None = None, sequence: int | None = None
    ) -> Moment:
        """The task tree and the world of an episode at any moment, from the log: also while it runs, and of thoughts.

        Args:
            episode: its number, its id or the first digits of it, `last`, or as it was opened or listed.
            time: seconds since the episode's start, by the monotonic clock; or a moment, aware, by the wall clock,
                where what came before the first event that is later is told.
            sequence: of the last event to be told.

        Beyond the end it is the end, or how far the log is. Raises `UnknownEpisode`; `CallerError` for a moment before
        the start, or for none or two of them; `LogDamaged`, `DatabaseForeign` for an event that cannot be understood.
        """
        await self._ready()
        return await as_of(self._log, episode, time=time, sequence=sequence)

    async def number_of(self, episode: str) -> int:
        """The number this database gave to the episode of that UUID. Raises `UnknownEpisode`."""
        await self._ready()
        number = await self._log.episode_number(parse_episode_id(episode))
        if number is None:
            raise UnknownEpisode(f"nothing of the episode {episode} is in this database yet")
        return number

    # --- inside -----------------------------------------------------------------------------------------------

    async def _ready(self) -> None:
        """The log is open afterwards: what is asked of it is asked after this."""
        if self._opened is None:
            async with self._opening:
                if self._opened is None:
                    log = await EventLog.open(self._address, create=False)
                    try:
                        await _generation(log)
                    except BaseException:
                        await log.close()
                        raise
                    self._use(log)

    def _use(self, log: EventLog) -> None:
        self._opened = log
        self._classes.use_in(log.engine)
        self._sessions = async_sessionmaker(log.engine, expire_on_commit=False)

    @property
    def _log(self) -> EventLog:
        assert self._opened is not None, "made ready before it is asked"
        return self._opened

    @asynccontextmanager
    async def _connection(self, *, simulated: bool) -> AsyncIterator[AsyncConnection]:
        if not simulated:
            async with self._log.engine.connect() as connection:
                yield connection
            return
        generation = await _generation(self._log)
        if generation.revision != self._all_views[0]:
            async with self._log.engine.connect() as connection:
                self._all_views = generation.revision, await all_views(connection, generation)
        async with with_views(self._log.engine, self._all_views[1]) as connection:
            yield connection


async def _generation(log: EventLog) -> Generation:
    with log.translated():
        async with log.engine.connect() as connection:
            generation = await current_generation(connection)
    if generation is None:
        raise DatabaseUnavailable(f"{log.address} has a log and no tables yet: `pycrorm writer --once` makes them")
    return generation
