"""Open a memory, wire its parts, drain and close it. This is the composition root of the package.

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
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, AsyncExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pycrorm_async import __version__
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import CallerError, EpisodeParked, PycrormError, TablesForeign
from pycrorm_async.events.codec import declaration_of
from pycrorm_async.events.ids import episode_id
from pycrorm_async.hooks.observations import Observations
from pycrorm_async.hooks.plan_recorder import Recorder
from pycrorm_async.memory_parts import MemoryStatus, Parts
from pycrorm_async.memory_recording import RecordingMemory
from pycrorm_async.operations.destination import expected_log, open_destination
from pycrorm_async.operations.recovery import dead_queues
from pycrorm_async.projections.custom.discovery import validate_projections
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.schema.user_views import UserView
from pycrorm_async.query.reading import Reading
from pycrorm_async.queue.files.locks import call_in_forked_child
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.live.recorder_queue import RecorderQueue
from pycrorm_async.recall.experience import PickUpExperience
from pycrorm_async.recording.recording import Recording
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.open_episodes import OpenEpisodes
from pycrorm_async.recording.writing.provenance import PlanSource, Provenance
from pycrorm_async.settings import Settings, Writer
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.sync_memory import SyncMemory
from pycrorm_async.writer.delegated_writer import DelegatedWriter
from pycrorm_async.writer.writer_thread import WriterThread

__all__ = ["Memory", "MemoryStatus"]

_log = logging.getLogger("pycrorm_async")


class Memory(RecordingMemory):
    """The memory of one process in one database. Use `Memory.open` as an async context manager.

    While it is open, it records every plan performed in its context: in the open episode, or in one of the plan's own.
    Of several open memories the one whose episode is open records, or else the one opened last.
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
        plan_source: PlanSource | None = None,
    ) -> None:
        self._address = address
        self._spool = spool
        self._views = tuple(views)
        self._projections = tuple(projections)
        self._settings = settings
        self._clock = clock
        self._plan_source = plan_source
        self._unadopted: dict[str, PycrormError] = {}
        self._stack = AsyncExitStack()
        self._parts: Parts | None = None
        self._reported: set[str] = set()
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
        plan_source: PlanSource | None = None,
    ) -> Memory:
        """Return a memory to enter with `async with`, once.

        Args:
            url: `sqlite:///memory.db`, `sqlite:////absolute/path.db`, or `sqlite://` for one that exists in this
                process only and is deleted when it is closed.
            spool: folder of the write-ahead queue; by default `memory.db.spool` beside `memory.db`.
            views: named queries to create beside the tables.
            projections: custom projections to fold besides the installed ones. An event that one cannot fold parks the
                episode in that projection only: `flush` does not raise, `pycrorm status` shows the reason.
            writer: `thread` for a thread of this process that moves events to the database, or `daemon` for a
                `pycrorm writer` with the same URL and spool; by default as in the settings. With a daemon this process
                has no connection for writing, the database may not exist yet, and `session()`, `dataframe()` and
                `reading` open their own connection at the first query.
            settings, clock: limits and intervals; the time source.
            plan_source: recorded with each episode; `pycrorm run` passes hash and commit of the plan's file.

        Raises:
            UnknownUrl: at once. `CallerError`: at once, for a private database or views of this process with a daemon.
                On entering: `DatabaseUnavailable`, `DatabaseForeign`, `SpoolUnavailable`, `SpoolForeign`.
        """
        address, settings = DatabaseAddress.parse(url), settings or Settings()
        keep_s = 0.0 if address.is_private else settings.keep_stored_s  # sqlite:// is never restored
        settings = replace(settings, writer=writer or settings.writer, keep_stored_s=keep_s)
        if settings.writer == "daemon" and address.is_private:
            raise CallerError("sqlite:// is private to this process, so no daemon can write it: use writer='thread'")
        if settings.writer == "daemon" and (views or projections):
            unused = "views" if views else "projections"
            raise CallerError(
                f"the daemon creates the tables, without the {unused} of this process: use writer='thread'"
            )
        return cls(
            address,
            spool=Path(spool) if spool is not None else None,
            views=views,
            projections=validate_projections(projections),
            settings=settings,
            clock=clock,
            plan_source=plan_source,
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

        It is meant for notebooks, where each cell has a context of its own: actions of the following cells are
        recorded, each in an episode of its own or in that of its cell, also in threads that the user starts. If several
        memories are connected, the last one records. Events that are not stored when the process ends without `close`
        stay in the spool, and the next memory of that database stores them.
        """
        memory = cls.open(url, spool=spool, views=views, projections=projections, writer=writer, settings=settings)
        return await memory._enter(Parts.in_process)  # noqa: SLF001  its own class

    @classmethod
    def sync(cls, url: str, **options: Any) -> SyncMemory:
        """Return a memory to enter with `with`, for code without asyncio; the arguments are those of `open`."""
        return SyncMemory(cls.open(url, **options))

    async def close(self) -> None:
        """Store and fold all recorded events; open episodes end as INTERRUPTED. A second call has no effect."""
        await self.__aexit__(None, None, None)

    # --- opening and closing ----------------------------------------------------------------------------------

    async def __aenter__(self) -> Self:
        return await self._enter(Parts.in_context)

    async def _enter(self, connect: Callable[[Parts], AbstractContextManager[None]]) -> Self:
        try:
            self._parts = await self._open()
            self._stack.enter_context(connect(self._parts))
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def _open(self) -> Parts:
        address = self._located = self._stack.enter_context(self._address.located())
        by_daemon, declared = self._settings.writer == "daemon", []
        spool = Spool(self._spool or address.default_spool, self._settings.file_access)
        if not by_daemon:
            # Open the database before making a spool, and bind the spool before this recorder adds its folder to it.
            access, expected = spool.access, expected_log(address, spool)
            log = await EventLog.open(address, create=True, clock=self._clock, file_access=access, belongs_to=expected)
            try:
                declared = [declaration_of(each) for each in await log.declarations()]
            finally:
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
            open_ = partial(open_destination, address, spool, clock=self._clock, settings=self._settings)
            writer = WriterThread(
                source=queue,
                open_destination=partial(open_, views=self._views, projections=self._projections),
                adopt=lambda: dead_queues(spool, self._unadopted, settings=self._settings),
                settings=self._settings,
            )
            await writer.start()
        self._stack.push_async_exit(partial(self._drain, queue, writer))
        reading = Reading(address)
        self._stack.push_async_callback(reading.close)
        if not by_daemon:
            with suppress(TablesForeign):  # recording works without tables; queries and `flush` raise this again
                await reading.refresh(maps=False)
        emitter = Emitter(queue, self._settings)
        provenance = Provenance.of(self._plan_source, self._settings, self._clock)
        episodes = OpenEpisodes(emitter, self._clock)
        recorder = Recorder(emitter, episodes=episodes, software=__version__, provenance=provenance)
        recording = Recording(
            emitter, episodes, recorder.known_types, declared, software=__version__, provenance=provenance
        )
        return Parts(
            queue,
            writer,
            reading,
            emitter,
            recorder,
            recording,
            Observations(emitter, recorder),
            PickUpExperience(reading, lambda: self.recall.reader),
        )

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._parts is None:  # in a forked child the memory belongs to the parent
            return
        recorder = self._parts.recorder
        recorder.episodes.refuse_new()
        for episode in recorder.episodes.all:
            recorder.close_episode(episode, error or asyncio.CancelledError("the memory was closed"))
        self._parts.emitter.is_closed = self._parts.experience.is_closed = True
        recorder.close()
        await self._parts.emitter.feed.close()
        await self._stack.__aexit__(kind, error, traceback)

    async def _drain(
        self,
        queue: RecorderQueue,
        writer: WriterThread | DelegatedWriter,
        _kind: type[BaseException] | None,
        error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        """Store and fold all recorded events. An error in doing so is logged, not raised, if the plan failed itself.

        A parked episode is logged and does not make closing fail; `pycrorm status` lists it, and `flush` raises for it.
        """
        self._parts = None
        queue.close()
        try:
            await writer.close()
        except PycrormError as fault:
            unreported = self._unreported(fault)
            if unreported is not None and error is None and not isinstance(unreported, EpisodeParked):
                raise unreported from fault
            if unreported is not None:
                _log.error("when closing the memory: %s", unreported)

    def _forked(self) -> None:
        """Disconnect a forked child: the memory belongs to its parent, and plans of the child are not recorded."""
        if self._parts is not None:
            self._parts.emitter.is_closed = self._parts.experience.is_closed = True
            self._parts = None
