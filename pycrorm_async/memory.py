"""The composition root: opens a memory, wires its parts, drains and closes it. No other module sees both ends.

async with Memory.open("sqlite:///memory.db") as memory:
    async with memory.episode(description="Tutorial"):
        await plan()
    await memory.flush()
    async with memory.session() as session:
        actions = (await session.scalars(select(Action))).all()
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager, suppress
from contextvars import ContextVar, Token
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar

from sqlalchemy import Select
from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async import __version__
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.config import Settings
from pycrorm_async.errors import CallerError, PycrormError
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.hooks.emitter import Emitter, Faults
from pycrorm_async.hooks.episode import Episode
from pycrorm_async.hooks.recorder import Recorder, current_episode
from pycrorm_async.plan.ports import PlanObserver, recorder
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.views import UserView
from pycrorm_async.query.reading import Reading
from pycrorm_async.queue.recorder import RecorderQueue
from pycrorm_async.queue.recovery import RecoveredQueue, open_dead
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.world.watch import WorldWatcher, watcher
from pycrorm_async.writer.live import WriterState
from pycrorm_async.writer.once import Recovered, drain_once
from pycrorm_async.writer.thread import WriterThread

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["Memory", "MemoryStatus", "RecoveryReport", "recover", "spool_of"]

_log = logging.getLogger("pycrorm_async")
_T = TypeVar("_T")


class MemoryStatus(NamedTuple):
    """How a memory is.

    Attributes:
        written, synced, stored: positions in this memory's queue: what survives the process, the machine, and is in
            the database.
        bytes_spooled: what the queue holds on disk.
        faults: what the hooks failed to record.
        writer: what the writer does.
        unadopted: folders of dead recorders that could not be recovered, and why.
    """

    written: int
    synced: int
    stored: int
    bytes_spooled: int
    faults: Faults
    writer: WriterState
    unadopted: Mapping[str, PycrormError]


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
        settings: Settings,
        clock: Clock,
    ) -> None:
        self._address = address
        self._spool_path = spool
        self._views = tuple(views)
        self._settings = settings
        self._clock = clock
        self._unadopted: dict[str, PycrormError] = {}
        self._stack = AsyncExitStack()
        self._closed = False

    @classmethod
    def open(
        cls,
        url: str,
        *,
        spool: Path | str | None = None,
        views: Sequence[UserView] = (),
        settings: Settings | None = None,
        clock: Clock = SYSTEM_CLOCK,
    ) -> Memory:
        """A memory to be entered with `async with`.

        Args:
            url: `sqlite:///memory.db`, `sqlite:////absolute/path.db`, or `sqlite://` for one that is gone when closed.
            spool: folder of the write-ahead queue; by default `memory.db.spool` beside `memory.db`.
            views: questions with a name, kept beside the tables.
            settings: limits and rhythms.
            clock: where the time comes from.

        Raises:
            UnknownUrl: at once. On entering: `DatabaseUnavailable`, `DatabaseForeign`, `SpoolUnavailable`,
                `SpoolForeign`.
        """
        return cls(
            DatabaseAddress.parse(url),
            spool=Path(spool) if spool is not None else None,
            views=views,
            settings=settings or Settings(),
            clock=clock,
        )

    # --- opening and closing ----------------------------------------------------------------------------------

    async def __aenter__(self) -> Self:
        try:
            await self._open()
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def _open(self) -> None:
        address = self._stack.enter_context(self._address.located())
        self._address = address
        # The database first: where it is refused, no spool is made beside it.
        await (await EventLog.open(address, create=True, clock=self._clock)).close()
        self._spool = Spool(self._spool_path or address.default_spool)
        self._queue = RecorderQueue.create(
            self._spool.path,
            settings=self._settings,
            clock=self._clock,
            recorder=episode_id(self._clock.wall_ns(), os.urandom(10)),
        )
        self._stack.callback(self._queue.release)
        self._writer = WriterThread(
            source=self._queue,
            open_destination=lambda: _destination(address, self._spool, self._clock, self._views),
            adopt=self._dead_queues,
            settings=self._settings,
        )
        await self._writer.start()
        self._stack.push_async_exit(self._drain)
        self._reading = await self._stack.enter_async_context(Reading.open_address(address))
        self._emitter = Emitter(self._queue, self._settings)
        self._recorder = Recorder(self._emitter, clock=self._clock, software=__version__)
        self._tokens: tuple[Token[PlanObserver | None], Token[WorldWatcher | None]] = (
            recorder.set(self._recorder),
            watcher.set(self._recorder),
        )

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._closed = True
        _reset(recorder, self._tokens[0])
        _reset(watcher, self._tokens[1])
        for episode in self._recorder.open_episodes:
            self._recorder.close_episode(episode, error or asyncio.CancelledError("the memory was closed"))
        await self._stack.__aexit__(kind, error, traceback)

    async def _drain(
        self, _kind: type[BaseException] | None, error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        """Store and fold what is left. A failure of ours never hides the plan's own."""
        self._queue.close()
        try:
            await self._writer.close()
        except PycrormError as fault:
            if error is None:
                raise
            _log.error("when closing the memory: %s", fault)

    # --- recording --------------------------------------------------------------------------------------------

    @asynccontextmanager
    async def episode(
        self, *, description: str | None = None, plan: str | None = None, seed: int | None = None
    ) -> AsyncIterator[Episode]:
        """An episode: what is performed inside belongs to it, and so does the world that is entered inside or before.

        Args:
            description: why; default: the plan's name.
            plan: the plan's name.
            seed: of the plan's random numbers, to find it again.

        Raises:
            EpisodeRefused: one is open in this task already. A child task may open its own.
        """
        self._require_open()
        episode = self._recorder.open_episode(description=description or plan or "an episode", plan=plan, seed=seed)
        tokens = recorder.set(self._recorder), watcher.set(self._recorder), current_episode.set(episode)
        try:
            yield episode
        except BaseException as failure:
            self._recorder.close_episode(episode, failure)
            raise
        else:
            self._recorder.close_episode(episode, None)
        finally:
            _reset(recorder, tokens[0])
            _reset(watcher, tokens[1])
            _reset(current_episode, tokens[2])

    async def synced(self) -> None:
        """All emitted so far survives power loss when this returns."""
        self._require_open()
        await self._queue.synced_to(self._queue.written)

    async def flush(self) -> None:
        """All emitted so far is stored and visible in the tables when this returns.

        Raises:
            EpisodeParked: with the reason, if an episode could not be stored or folded.
            FlushTimeout: after `flush_timeout_s`. What was emitted is safe in the spool.
        """
        self._require_open()
        position = self._queue.written
        await self._queue.synced_to(position)
        await self._writer.flush(position)
        await self._reading.refresh()

    @property
    def status(self) -> MemoryStatus:
        """How the memory is, at this moment."""
        return MemoryStatus(
            written=self._queue.written,
            synced=self._queue.synced,
            stored=self._queue.stored,
            bytes_spooled=self._queue.bytes_spooled,
            faults=self._emitter.faults,
            writer=self._writer.state,
            unadopted=dict(self._unadopted),
        )

    @property
    def recent_episodes(self) -> tuple[str, ...]:
        """The ids of the last hundred episodes this memory opened."""
        return self._recorder.recent_episodes

    # --- asking -----------------------------------------------------------------------------------------------

    @property
    def reading(self) -> Reading:
        """The asking side on its own: named questions, sessions, frames."""
        return self._reading

    def session(self) -> AbstractAsyncContextManager[AsyncSession]:
        """An ordinary SQLAlchemy `AsyncSession` on this memory, as an async context manager."""
        return self._reading.session()

    async def dataframe(self, statement: Select[Any]) -> DataFrame:
        """The answer as a pandas DataFrame (extra `learning`)."""
        return await self._reading.dataframe(statement)

    def mapped(self, designator: str | type) -> Any:
        """The mapped class of a designator type, by its dtype or its class."""
        return self._reading.mapped(designator)

    async def number_of(self, episode: Episode) -> int:
        """The number this database gave the episode; after `flush`."""
        return await self._reading.number_of(str(episode))

    # --- inside -----------------------------------------------------------------------------------------------

    def _require_open(self) -> None:
        if self._closed or not hasattr(self, "_recorder"):
            raise CallerError("this memory is not open: use `async with Memory.open(url) as memory`")

    def _dead_queues(self) -> Iterator[RecoveredQueue]:
        return _dead_queues(self._spool, self._unadopted)


def _reset(variable: ContextVar[_T], token: Token[_T]) -> None:
    """Back to what it was. Left in another context than it was entered in, there is nothing of ours to undo."""
    with suppress(ValueError):
        variable.reset(token)


class _Destination:
    """The writer's far end: the log, and the tables behind it."""

    def __init__(self, log: EventLog, projector: Projector) -> None:
        self._log = log
        self._projector = projector

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        return await self._log.append(records)

    async def fold(self) -> int:
        return await self._projector.fold_behind()

    async def stopped(self) -> Mapping[str, str]:
        return {each.id: each.refused or each.parked or "" for each in await self._log.stopped()}


@asynccontextmanager
async def _destination(
    address: DatabaseAddress, spool: Spool, clock: Clock, views: Sequence[UserView] = ()
) -> AsyncIterator[_Destination]:
    log = await EventLog.open(address, create=True, clock=clock)
    try:
        spool.bind(log.log_id)
        projector = Projector(log, views=views)
        await projector.open()
        yield _Destination(log, projector)
    finally:
        await log.close()


def _dead_queues(
    spool: Spool, failures: dict[str, PycrormError], lost: list[str] | None = None
) -> Iterator[RecoveredQueue]:
    """What dead recorders left, one after the other; each folder is deleted once all of it is stored.

    One that cannot be recovered is noted in `failures` and does not keep the others from being recovered; the ids of
    episodes that were left open are added to `lost`.
    """
    for folder in spool.recorders():
        if folder.alive:
            continue
        try:
            recovered = open_dead(folder.path)
            if recovered is None:
                continue
            if lost is not None:
                lost += [episode_text(end.episode) for end in recovered.lost if end.episode is not None]
            try:
                yield recovered
            finally:
                if recovered.stored == recovered.last:
                    recovered.remove()
                else:
                    recovered.release()
        except PycrormError as error:
            failures[folder.name] = error
            _log.warning("%s", error)


class RecoveryReport(NamedTuple):
    """What `recover` did: the rounds of draining and folding, the episodes that ended LOST, the folders that failed."""

    round: Recovered
    lost: tuple[str, ...]
    failed: Mapping[str, PycrormError]


async def recover(url: str, *, spool: Path | None = None, settings: Settings | None = None) -> RecoveryReport:
    """Append and fold all that dead processes left in the spool of a database. Raises as `Memory.open` does."""
    failures: dict[str, PycrormError] = {}
    lost: list[str] = []
    address = DatabaseAddress.parse(url)
    if address.is_private:
        raise CallerError("sqlite:// is gone with its process: there is nothing to recover")
    place = Spool(spool or address.default_spool)
    async with _destination(address, place, SYSTEM_CLOCK) as destination:
        done = await drain_once(_dead_queues(place, failures, lost), destination, settings=settings or Settings())
    return RecoveryReport(done, tuple(lost), {**done.failed, **failures})


def spool_of(url: str) -> Path:
    """Where the write-ahead queue of this database is, if nobody says otherwise."""
    return DatabaseAddress.parse(url).default_spool
