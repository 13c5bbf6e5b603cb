"""The composition root: opens a memory, wires its parts, drains and closes it.

>>> async with Memory.open("sqlite:///memory.db") as memory:
...     async with memory.episode(description="Tutorial"):
...         await plan()
...     await memory.flush()
...     async with memory.session() as session:
...         actions = (await session.scalars(select(Action))).all()
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import (
    AbstractAsyncContextManager,
    AbstractContextManager,
    AsyncExitStack,
    asynccontextmanager,
    suppress,
)
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from sqlalchemy import Select
from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async import __version__
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.connected_var import set_inside
from pycrorm_async.errors import CallerError, EpisodeParked, PycrormError, TablesForeign
from pycrorm_async.events.ids import episode_id
from pycrorm_async.hooks.emitter import Emitter
from pycrorm_async.hooks.episode import Episode
from pycrorm_async.hooks.plan_recorder import Recorder, current_episode
from pycrorm_async.memory_parts import Parts
from pycrorm_async.memory_status import MemoryStatus
from pycrorm_async.operations.destination import expected_log, open_destination
from pycrorm_async.operations.recovery import dead_queues
from pycrorm_async.plan.execution.unawaited_performs import called_performs
from pycrorm_async.projections.custom.discovery import checked
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.schema.user_views import UserView
from pycrorm_async.query.as_of import AnyEpisode
from pycrorm_async.query.experience import PickUpExperience
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.queue.files.locks import call_in_forked_child
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.live.recorder_queue import RecorderQueue
from pycrorm_async.settings import Settings, Writer
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.delegated_writer import DelegatedWriter
from pycrorm_async.writer.writer_thread import WriterThread

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["Memory", "MemoryStatus"]

_log = logging.getLogger("pycrorm_async")


class Memory:
    """The memory of one process in one database. Use `Memory.open` as an async context manager.

    While it is open, every plan performed in its context is remembered: in the episode that is open, or in one of its
    own. Reading an older memory at the same time is fine; what is performed goes to the one opened last, or to the one
    whose episode is open.
    """

    def __init__(
        self,
        address: DatabaseAddress,
        *,
        spool: Path | None,
        views: Sequence[UserView],
        projections: Sequence[Projection],
        settings: Settings,
        clock: Clock,
    ) -> None:
        self._address = address
        self._spool = spool
        self._views = tuple(views)
        self._projections = tuple(projections)
        self._settings = settings
        self._clock = clock
        self._unadopted: dict[str, PycrormError] = {}
        self._stack = AsyncExitStack()
        self._parts: Parts | None = None
        self._told: set[str] = set()
        call_in_forked_child(self._forked)

    @classmethod
    def open(
        cls,
        url: str,
        *,
        spool: Path | str | None = None,
        views: Sequence[UserView] = (),
        projections: Sequence[Projection] = (),
        writer: Writer | None = None,
        settings: Settings | None = None,
        clock: Clock = SYSTEM_CLOCK,
    ) -> Memory:
        """A memory to be entered with `async with`, once.

        Args:
            url: `sqlite:///memory.db`, `sqlite:////absolute/path.db`, or `sqlite://` for one that is gone when closed.
            spool: folder of the write-ahead queue; by default `memory.db.spool` beside `memory.db`.
            views: questions with a name, kept beside the tables.
            projections: of your own, kept up to date with those that installed packages offer. What one cannot fold
                stops its episode there alone: `flush` does not raise for it, `pycrorm status` says why.
            writer: who moves events to the database, by default as the settings say: a `thread` of this process, or
                the `daemon`, a `pycrorm writer` for the same URL and spool. With a daemon this process has no
                connection for writing, the database need not be there yet, and `session()`, `dataframe()` and
                `reading` open their own connection at the first question.
            settings, clock: limits and rhythms; where the time comes from.

        Raises:
            UnknownUrl: at once. `CallerError`: at once, for a private database or views of this process with a daemon.
                On entering: `DatabaseUnavailable`, `DatabaseForeign`, `SpoolUnavailable`,
                `SpoolForeign`.
        """
        address, settings = DatabaseAddress.parse(url), settings or Settings()
        keep_s = 0.0 if address.is_private else settings.keep_stored_s  # sqlite:// is never restored
        settings = replace(settings, writer=writer or settings.writer, keep_stored_s=keep_s)
        if settings.writer == "daemon" and address.is_private:
            raise CallerError("sqlite:// is private to this process: no daemon can write it")
        if settings.writer == "daemon" and (views or projections):
            what = "views" if views else "projections"
            raise CallerError(f"a daemon makes the tables and knows no {what} of this process: use writer='thread'")
        return cls(
            address,
            spool=Path(spool) if spool is not None else None,
            views=views,
            projections=checked(projections),
            settings=settings,
            clock=clock,
        )

    @classmethod
    async def connect(
        cls,
        url: str,
        *,
        spool: Path | str | None = None,
        views: Sequence[UserView] = (),
        projections: Sequence[Projection] = (),
        writer: Writer | None = None,
        settings: Settings | None = None,
    ) -> Memory:
        """Open a memory for all contexts of this process that have none of their own, until `close`; as `open` does.

        For notebooks, whose cells have a context each: what the following cells perform is recorded, each action in an
        episode of its own or in that of its cell. If several are connected, the last one records. A thread of the
        user's own finds it as well. One that is not closed keeps in its spool what was not stored when the process
        ends, and the next memory of that database stores it.
        """
        memory = cls.open(url, spool=spool, views=views, projections=projections, writer=writer, settings=settings)
        return await memory._enter(Parts.in_process)  # noqa: SLF001  its own class

    async def close(self) -> None:
        """Store and fold what is left; open episodes end as INTERRUPTED. Twice is once."""
        await self.__aexit__(None, None, None)

    # --- opening and closing ----------------------------------------------------------------------------------

    async def __aenter__(self) -> Self:
        return await self._enter(Parts.in_context)

    async def _enter(self, found: Callable[[Parts], AbstractContextManager[None]]) -> Self:
        try:
            self._parts = await self._open()
            self._stack.enter_context(found(self._parts))
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def _open(self) -> Parts:
        address = self._stack.enter_context(self._address.located())
        by_daemon = self._settings.writer == "daemon"
        spool = Spool(self._spool or address.default_spool, self._settings.file_access)
        if not by_daemon:
            # The database first: where it is refused, no spool is made. Then bound, while this recorder is not in it.
            access, expected = spool.access, expected_log(address, spool)
            log = await EventLog.open(address, create=True, clock=self._clock, file_access=access, belongs_to=expected)
            await log.close()
            spool.bind(log.log_id)
        recorder_id = episode_id(self._clock.wall_ns(), os.urandom(10))
        queue = RecorderQueue.create(
            spool.path, settings=self._settings, clock=self._clock, recorder=recorder_id, offered=by_daemon
        )
        self._stack.callback(queue.release)
        writer: WriterThread | DelegatedWriter
        if by_daemon:
            writer = DelegatedWriter(queue, self._settings)
        else:
            opened = partial(open_destination, address, spool, clock=self._clock, settings=self._settings)
            writer = WriterThread(
                source=queue,
                open_destination=partial(opened, views=self._views, projections=self._projections),
                adopt=lambda: dead_queues(spool, self._unadopted, settings=self._settings),
                settings=self._settings,
            )
            await writer.start()
        self._stack.push_async_exit(partial(self._drain, queue, writer))
        reading = Reading(address)
        self._stack.push_async_callback(reading.close)
        if not by_daemon:
            with suppress(TablesForeign):  # recording goes on; who asks, or flushes, is told
                await reading.refresh()
        emitter = Emitter(queue, self._settings)
        told = Recorder(emitter, clock=self._clock, software=__version__)
        return Parts(queue, writer, reading, emitter, told, PickUpExperience(reading))

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._parts is None:  # a forked child leaves the memory of its parent alone
            return
        told = self._parts.recorder
        for episode in told.open_episodes:
            told.close_episode(episode, error or asyncio.CancelledError("the memory was closed"))
        self._parts.emitter.is_closed = self._parts.experience.over = True
        told.close()
        await self._stack.__aexit__(kind, error, traceback)

    async def _drain(
        self,
        queue: RecorderQueue,
        writer: WriterThread | DelegatedWriter,
        _kind: type[BaseException] | None,
        error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        """Store and fold what is left. A failure of ours never hides the plan's own.

        A parked episode is no failure of closing: it is logged, and `pycrorm status` names it. `flush` raises for it.
        """
        self._parts = None
        queue.close()
        try:
            await writer.close()
        except PycrormError as fault:
            news = self._news(fault)
            if news is not None and error is None and not isinstance(news, EpisodeParked):
                raise news from fault
            if news is not None:
                _log.error("when closing the memory: %s", news)

    def _news(self, fault: PycrormError) -> PycrormError | None:
        """The fault without the parked episodes that a flush has told already; None if nothing is left of it."""
        if not isinstance(fault, EpisodeParked):
            return fault
        reasons = {episode: reason for episode, reason in fault.reasons.items() if episode not in self._told}
        self._told.update(reasons)
        return EpisodeParked(reasons) if reasons else None

    def _forked(self) -> None:
        """In a forked child: the memory is its parent's; plans go on and nothing is told."""
        if self._parts is not None:
            self._parts.emitter.is_closed = self._parts.experience.over = True
            self._parts = None

    # --- recording --------------------------------------------------------------------------------------------

    @asynccontextmanager
    async def episode(
        self, *, description: str | None = None, plan: str | None = None, seed: int | None = None
    ) -> AsyncIterator[Episode]:
        """An episode: what is performed inside belongs to it, and so does the world that is entered inside or before.

        Waits for room in a full spool, or raises `SpoolFull`, as `Settings.on_full` says.

        Args:
            description: why; default: the plan's name.
            plan: the plan's name.
            seed: of the plan's random numbers, to find it again; 64 bits.

        Raises:
            EpisodeRefused: one is open in this task already. A child task may open its own.
        """
        parts = self._now
        told = parts.recorder
        if (room := told.admit()) is not None:
            await room
        episode = told.open_episode(description=description or plan or "an episode", plan=plan, seed=seed)
        failure: BaseException | None = None
        with (
            parts.in_context(),
            set_inside(current_episode, episode),
            set_inside(called_performs, episode.calls),
        ):
            try:
                yield episode
            except BaseException as raised:
                failure = raised
                raise
            finally:
                told.close_episode(episode, failure)

    async def synced(self) -> None:
        """All emitted so far survives power loss when this returns.

        Raises `SpoolUnavailable` when the disk refuses, or when files of the spool were deleted or replaced: recording
        goes on in a new folder where one can be made, and `status` says what was lost.
        """
        await self._now.queue.synced_to(self._now.queue.written)

    async def flush(self) -> None:
        """All emitted so far is stored and visible in the tables when this returns.

        Raises:
            EpisodeParked: with the reason, if an episode could not be stored or folded; each is told once.
            FlushTimeout: nothing was stored or folded for `flush_timeout_s`. What was emitted is safe in the spool.
        """
        parts = self._now
        position = parts.queue.written
        await parts.queue.synced_to(position)
        try:
            await parts.writer.flush(position)
        except EpisodeParked as fault:
            news = self._news(fault)
            if news is not None:
                raise news from fault
        if parts.reading.is_open:
            await parts.reading.refresh()

    @property
    def status(self) -> MemoryStatus:
        """How the memory is, at this moment."""
        return MemoryStatus.of(self._now, self._unadopted)

    @property
    def recent_episodes(self) -> tuple[str, ...]:
        """The ids of the last hundred episodes this memory opened."""
        return self._now.recorder.recent_episodes

    @property
    def opened_count(self) -> int:
        """How many episodes this memory opened."""
        return self._now.recorder.opened_count

    @property
    def is_open(self) -> bool:
        """Whether it can be used."""
        return self._parts is not None

    # --- asking -----------------------------------------------------------------------------------------------

    @property
    def reading(self) -> Reading:
        """The asking side on its own: named questions, sessions, frames."""
        return self._now.reading

    def session(self, *, simulated: bool = False) -> AbstractAsyncContextManager[AsyncSession]:
        """An ordinary SQLAlchemy `AsyncSession` on this memory, as an async context manager.

        With `simulated` it also sees what was only thought through (`SimulatedTaskTree`).
        """
        return self._now.reading.session(simulated=simulated)

    async def dataframe(self, statement: Select[*tuple[Any, ...]], *, simulated: bool = False) -> DataFrame:
        """The answer as a pandas DataFrame (extra `learning`); with `simulated`, thoughts too."""
        return await self._now.reading.dataframe(statement, simulated=simulated)

    def mapped(self, designator: str | type) -> Any:
        """The mapped class of a designator type, by its dtype or its class, once one of it was flushed.

        Where a daemon writes, also once something was asked, for until then there is no connection.
        """
        reading = self._now.reading
        if not reading.is_open:
            raise CallerError("open a session first: until then this memory does not know its types")
        return reading.mapped(designator)

    async def as_of(
        self, episode: AnyEpisode, *, time: float | datetime | None = None, sequence: int | None = None
    ) -> Moment:
        """The task tree and the world at any moment of an episode, as far as it was flushed; see `Reading.as_of`."""
        return await self._now.reading.as_of(episode, time=time, sequence=sequence)

    async def number_of(self, episode: Episode) -> int:
        """The number this database gave the episode; after `flush`."""
        return await self._now.reading.number_of(str(episode))

    @property
    def _now(self) -> Parts:
        if self._parts is None:
            raise CallerError("this memory is not open: use `async with Memory.open(url) as memory`")
        return self._parts
