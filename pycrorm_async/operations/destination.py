"""Where queues end, and what becomes of those whose process died: drained into the log, folded, deleted.

With `memory.py` this is where the parts are wired: no other module sees a queue and a database.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, asynccontextmanager
from itertools import chain
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import CallerError, DatabaseError, PycrormError, TablesForeign
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.operations.healed_log import HealedLog
from pycrorm_async.projections.custom.discovery import checked, installed_besides
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.schema.user_views import UserView
from pycrorm_async.queue.files.recorder_folder import fault_in
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.maintenance.inspection import inspect_spool
from pycrorm_async.queue.retention.stored_segments import StoredSegments
from pycrorm_async.queue.sources.dead_source import RecoveredQueue, open_dead
from pycrorm_async.queue.sources.live_source import LiveQueue
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain_once import DrainSummary, drain_once
from pycrorm_async.writer.ports import Source

__all__ = [
    "LogAndTables",
    "open_destination",
    "expected_log",
    "shared_address",
    "dead_queues",
    "RecoveryReport",
    "recover",
    "Rebinding",
    "rebind",
    "PendingRecorders",
    "pending_recorders",
]

_APPENDS_AT_ONCE = 4
"""On a server, however many recorders a daemon drains: as many as its pool has connections for, and one to fold."""

_WATCH_S = 1.0
"""How often a SQLite file is looked at: a look takes two microseconds."""

_log = logging.getLogger("pycrorm_async")


class LogAndTables:
    """The writer's far end: the log, and the tables behind it. Implements the writer's `Destination` and `Shown`.

    While the tables cannot be used by this process events are appended, and folding raises `TablesForeign`.
    """

    def __init__(self, log: EventLog, projector: Projector, healed: HealedLog | None = None) -> None:
        self.log = log
        self.log_id = log.log_id
        self._healed = healed
        self._projector = projector
        self._refused = False
        self._rounds = 0
        # SQLite has one writer at a time, and whoever waits for it sleeps and tries again: better to wait in turn here.
        self._appending = asyncio.Semaphore(1 if log.address.is_sqlite else _APPENDS_AT_ONCE)

    async def open_tables(self) -> None:
        """Raises as `Projector.open`, but for `TablesForeign`: then this is tried again before each fold."""
        try:
            await self._projector.open()
        except TablesForeign as error:
            self._refused = True
            _log.warning("%s; events are recorded meanwhile", error)

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        async with self._appending:
            if self._healed is None:
                return await self.log.append(records)
            async with self._shown_again(self._healed):
                return await self._healed.append(records)

    async def confirm(self) -> None:
        if self._healed is not None:
            async with self._shown_again(self._healed):
                await self._healed.confirm()

    @asynccontextmanager
    async def _shown_again(self, healed: HealedLog) -> AsyncIterator[None]:
        """What is offered again inside shows in the tables afterwards: a flush waits for new events alone."""
        rounds = healed.rounds
        yield
        if healed.rounds != rounds:
            try:
                await self.fold()
            except DatabaseError as error:
                _log.warning("what was offered again does not show in the tables yet: %s", error)

    @property
    def writes(self) -> int:
        return self.log.writes

    async def fold(self) -> int:
        async with self._tables():
            return await self._projector.catch_up()

    async def fold_next_batch(self) -> bool:
        async with self._tables():
            return await self._projector.fold_next_batch()

    @asynccontextmanager
    async def _tables(self) -> AsyncIterator[None]:
        """Opened again after a fold that failed, and after the log went back: they may be of another shape then."""
        if self._refused or self._rounds != self._rounds_healed:
            self._rounds = self._rounds_healed
            self._refused = True
            await self._projector.open()
            self._refused = False
        try:
            yield
        except Exception:
            self._refused = True
            raise

    @property
    def _rounds_healed(self) -> int:
        return 0 if self._healed is None else self._healed.rounds

    async def behind(self) -> Mapping[str, int]:
        return {each.id: each.folded for each in await self.log.behind()}

    async def stopped(self) -> Mapping[str, str]:
        return {each.id: each.refused or each.parked or "" for each in await self.log.stopped()}


@asynccontextmanager
async def open_destination(
    address: DatabaseAddress,
    spool: Spool,
    *,
    clock: Clock,
    views: Sequence[UserView] = (),
    projections: Sequence[Projection] = (),
    settings: Settings | None = None,
) -> AsyncIterator[LogAndTables]:
    """Opens log and tables for writing, in the running loop, and binds the spool to them. Raises `SpoolForeign`.

    Keeps up to date these projections and those that are installed. With `settings`, a log that went back is offered
    again what the spool keeps.
    """
    expected = expected_log(address, spool)
    log = await EventLog.open(address, create=True, clock=clock, file_access=spool.access, belongs_to=expected)
    if address.is_sqlite:
        log.advice = (
            "put it back, or end this process and store what it recorded in a new database with:"
            f" pycrorm spool rebind --url {quote(address.to_type)} --spool {quote(str(spool.path))}"
        )
    watching = asyncio.create_task(_watch_file(log), name="pycrorm watch file")
    try:
        spool.bind(log.log_id)
        found = installed_besides(projections)
        projector = Projector(log, views=views, projections=projections, found=found)
        healed = HealedLog(log, spool.path, settings, clock=clock) if settings is not None else None
        destination = LogAndTables(log, projector, healed)
        await destination.open_tables()
        yield destination
    finally:
        watching.cancel()
        await log.close()


def expected_log(address: DatabaseAddress, spool: Spool) -> str | None:
    """The log that must be in the database; None where a new one may be made.

    A SQLite file that was deleted while nothing waits in the spool starts afresh. A server's database that is empty may
    be restored at this moment.
    """
    return None if address.is_sqlite and not spool.recorders() else spool.log_id()


async def _watch_file(log: EventLog) -> None:
    """Logs that the database was removed, also while there is nothing to store."""
    lost = False
    while True:
        await asyncio.sleep(_WATCH_S)
        loss = log.loss
        if loss is not None and not lost:
            _log.error("%s", loss)
        elif loss is None and lost:
            _log.warning("%s: the file is back", log.address)
        lost = loss is not None


def dead_queues(
    spool: Spool,
    failures: dict[str, PycrormError],
    lost: list[str] | None = None,
    *,
    settings: Settings | None = None,
) -> Iterator[RecoveredQueue]:
    """What dead recorders left, one after the other; each folder goes once all of it is stored.

    With `settings` its segments are kept as those say.

    One that cannot be recovered is noted in `failures` and does not keep the others from being recovered; the ids of
    episodes that were left open are added to `lost`.
    """
    stored = None if settings is None else StoredSegments(spool.path, settings, wall_ns=SYSTEM_CLOCK.wall_ns)
    for folder in spool.recorders():
        if folder.alive:
            continue
        try:
            recovered = open_dead(folder.path, stored=stored)
            if recovered is None:
                continue
            try:
                yield recovered
            finally:
                if lost is not None:
                    lost += [episode_text(end.episode) for end in recovered.lost if end.episode is not None]
                if recovered.all_stored:
                    recovered.remove()
                else:
                    recovered.release()
            if recovered.damage is not None:  # whoever drained it was told, and tells
                failures[folder.name] = recovered.damage
        except Exception as error:  # noqa: BLE001 - noted; the next folder may be in order
            failures[folder.name] = fault_in(folder.path, error)
            _log.warning("%s", failures[folder.name])


class RecoveryReport(NamedTuple):
    """What `recover` did.

    Attributes:
        drained: what was drained and folded.
        living: how many of the sources drained, the first ones, belong to living processes.
        lost: ids of the episodes that were left open and ended LOST.
        failed: by the folder's name, why it could not be recovered.
        dead_letters: by episode id, the folder that keeps what the database refused of it, now or earlier.
    """

    drained: DrainSummary
    living: int
    lost: tuple[str, ...]
    failed: Mapping[str, PycrormError]
    dead_letters: Mapping[str, Path]


async def recover(
    url: str,
    *,
    spool: Path | None = None,
    settings: Settings | None = None,
    projections: Sequence[Projection] = (),
) -> RecoveryReport:
    """Append and fold all there is in the spool of a database and nobody drains, of the dead and of the living.

    Of a living process what is synced at this moment. `projections` of one's own are kept up to date
    too. Raises as `Memory.open` does.
    """
    failures: dict[str, PycrormError] = {}
    lost: list[str] = []
    address = shared_address(url)
    settings = settings or Settings()
    place = Spool(spool or address.default_spool, settings.file_access)
    async with open_destination(
        address, place, clock=SYSTEM_CLOCK, projections=checked(projections), settings=settings
    ) as destination:
        with ExitStack() as held:
            living = list(_living_queues(place, failures, held))
            sources: Iterator[Source] = chain(living, dead_queues(place, failures, lost, settings=settings))
            done = await drain_once(sources, destination, settings=settings)
            for queue, state in zip(living, done.drained, strict=False):
                stopped = {each: why for each, why in done.stopped.items() if each in queue.episodes}
                queue.mark_visible(state.appended or queue.given, {**state.refused, **stopped})
    dead_letters = {each.refused: each.path for each in place.recorders() if each.refused is not None}
    return RecoveryReport(done, len(living), tuple(lost), {**done.failed, **failures}, dead_letters)


def shared_address(url: str) -> DatabaseAddress:
    """The address of a database that another process can open too. Raises `UnknownUrl`, `CallerError`."""
    address = DatabaseAddress.parse(url)
    if address.is_private:
        raise CallerError("sqlite:// is gone with its process: no other can write it or recover anything")
    return address


class _LivingQueue(LiveQueue):
    """Knows the ids of the `episodes` of which it gave something, for one round."""

    def __init__(self, *held: Any) -> None:
        super().__init__(*held)
        self.episodes: set[str] = set()

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        batch = await super().get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)
        self.episodes |= {episode_text(each) for each in {record.episode for record in batch} if each is not None}
        return batch


def _living_queues(spool: Spool, failures: dict[str, PycrormError], held: ExitStack) -> Iterator[_LivingQueue]:
    """What living recorders have synced by now and nobody drains; held until the stack is closed."""
    for folder in spool.recorders():
        try:
            queue = _LivingQueue.take(folder.path) if folder.alive else None
        except Exception as error:  # noqa: BLE001 - noted; the next folder may be in order
            failures[folder.name] = fault_in(folder.path, error)
            continue
        if queue is not None:
            held.callback(queue.release)
            queue.finish()
            yield queue


class Rebinding(NamedTuple):
    """What `rebind` did to a spool.

    Attributes:
        spool: the spool.
        before, after: ids of the logs it belonged to and belongs to now; `before` is None where nothing was stored yet.
        recorders, events: what it holds.
    """

    spool: Path
    before: str | None
    after: str
    recorders: int
    events: int


async def rebind(
    url: str, *, spool: Path | None = None, settings: Settings | None = None, say: Callable[[Rebinding], None]
) -> Rebinding:
    """Binds a spool to the database that is at this URL now, which is made if need be. `recover` then stores it there.

    `say` is called before anything is changed. Raises `SpoolTaken` where a process records into the spool or drains it.
    """
    address, settings = shared_address(url), settings or Settings()
    place = Spool(spool or address.default_spool, settings.file_access)
    report = inspect_spool(place.path)
    log = await EventLog.open(address, create=True, file_access=place.access)
    await log.close()
    events = sum(each.records for each in report.recorders)
    rebinding = Rebinding(place.path, place.log_id(), log.log_id, len(report.recorders), events)
    say(rebinding)
    place.rebind(log.log_id)
    return rebinding


class PendingRecorders(NamedTuple):
    """How many recorders of a spool are dead, with events that may not be in the database, and how many alive."""

    dead: int
    alive: int


def pending_recorders(url: str, spool: Path | None = None) -> PendingRecorders:
    """What a spool holds beside its database. Reads only. Raises `SpoolUnavailable`."""
    found = Spool(spool or DatabaseAddress.parse(url).default_spool).recorders()
    recorders = [each for each in found if each.refused is None]  # what was refused is no news: `status` tells it
    alive = sum(each.alive for each in recorders)
    return PendingRecorders(len(recorders) - alive, alive)
