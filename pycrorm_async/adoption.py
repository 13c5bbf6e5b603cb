"""Where queues end, and what becomes of those whose process died: drained into the log, folded, deleted.

With `memory.py` this is where the parts are wired: no other module sees a queue and a database.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import ExitStack, asynccontextmanager
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.config import Settings
from pycrorm_async.errors import CallerError, PycrormError, TablesOutdated
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.projections.own import Projection
from pycrorm_async.projections.own_found import checked, installed_besides
from pycrorm_async.projections.projector import Helper, Projector
from pycrorm_async.projections.views import UserView
from pycrorm_async.queue.living import LiveQueue
from pycrorm_async.queue.recovery import RecoveredQueue, open_dead
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.once import Recovered, drain_once
from pycrorm_async.writer.ports import Source

__all__ = [
    "LogAndTables",
    "open_destination",
    "shared_address",
    "dead_queues",
    "RecoveryReport",
    "recover",
    "Waiting",
    "waiting",
]

_APPENDS_AT_ONCE = 4
"""On a server, however many recorders a daemon drains: as many as its pool has connections for, and one to fold."""

_log = logging.getLogger("pycrorm_async")


class LogAndTables:
    """The writer's far end: the log, and the tables behind it. Implements the writer's `Destination` and `Shown`.

    While the tables are those of an older version events are appended, and folding raises `TablesOutdated`.
    """

    def __init__(self, log: EventLog, projector: Projector) -> None:
        self.log_id = log.log_id
        self._log = log
        self._projector = projector
        self._outdated = False
        # SQLite has one writer at a time, and whoever waits for it sleeps and tries again: better to wait in turn here.
        self._appending = asyncio.Semaphore(1 if log.address.is_sqlite else _APPENDS_AT_ONCE)

    async def open_tables(self) -> None:
        """Raises as `Projector.open`, but for `TablesOutdated`: then this is tried again before each fold."""
        try:
            await self._projector.open()
        except TablesOutdated as error:
            self._outdated = True
            _log.warning("%s; events are recorded meanwhile", error)

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        async with self._appending:
            return await self._log.append(records)

    async def fold(self) -> int:
        await self._await_rebuild()
        return await self._projector.fold_behind()

    async def fold_some(self) -> bool:
        await self._await_rebuild()
        return await self._projector.fold_some()

    async def _await_rebuild(self) -> None:
        if self._outdated:
            await self._projector.open()
            self._outdated = False

    async def behind(self) -> Mapping[str, int]:
        return {each.id: each.folded for each in await self._log.behind()}

    async def stopped(self) -> Mapping[str, str]:
        return {each.id: each.refused or each.parked or "" for each in await self._log.stopped()}


@asynccontextmanager
async def open_destination(
    address: DatabaseAddress,
    spool: Spool,
    *,
    clock: Clock,
    views: Sequence[UserView] = (),
    projections: Sequence[Projection] = (),
    helper: Helper | None = None,
) -> AsyncIterator[LogAndTables]:
    """Opens log and tables for writing, in the running loop, and binds the spool to them. Raises `SpoolForeign`.

    Keeps up to date these projections and those that are installed; `helper` folds with it.
    """
    log = await EventLog.open(address, create=True, clock=clock)
    try:
        spool.bind(log.log_id)
        found = installed_besides(projections)
        projector = Projector(log, views=views, projections=projections, found=found, helper=helper)
        destination = LogAndTables(log, projector)
        await destination.open_tables()
        yield destination
    finally:
        await log.close()


def dead_queues(
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
        except PycrormError as error:
            failures[folder.name] = error
            _log.warning("%s", error)


class RecoveryReport(NamedTuple):
    """What `recover` did.

    Attributes:
        drained: what was drained and folded.
        living: how many of the sources drained, the first ones, belong to living processes.
        lost: ids of the episodes that were left open and ended LOST.
        failed: by the folder's name, why it could not be recovered.
    """

    drained: Recovered
    living: int
    lost: tuple[str, ...]
    failed: Mapping[str, PycrormError]


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
    place = Spool(spool or address.default_spool)
    async with open_destination(address, place, clock=SYSTEM_CLOCK, projections=checked(projections)) as destination:
        with ExitStack() as held:
            living = list(_living_queues(place, failures, held))
            sources: Iterator[Source] = chain(living, dead_queues(place, failures, lost))
            done = await drain_once(sources, destination, settings=settings or Settings())
            for queue, state in zip(living, done.drained, strict=False):
                stopped = {each: why for each, why in done.stopped.items() if each in queue.episodes}
                queue.note_shown(state.appended or queue.given, {**state.refused, **stopped})
    return RecoveryReport(done, len(living), tuple(lost), {**done.failed, **failures})


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
        except PycrormError as error:
            failures[folder.name] = error
            continue
        if queue is not None:
            held.callback(queue.release)
            queue.finish()
            yield queue


class Waiting(NamedTuple):
    """How many recorders of a spool are dead, with events that may not be in the database, and how many alive."""

    dead: int
    alive: int


def waiting(url: str, spool: Path | None = None) -> Waiting:
    """What a spool holds beside its database. Reads only. Raises `SpoolUnavailable`."""
    found = Spool(spool or DatabaseAddress.parse(url).default_spool).recorders()
    recorders = [each for each in found if each.refused is None]  # what was refused is no news: `status` tells it
    alive = sum(each.alive for each in recorders)
    return Waiting(len(recorders) - alive, alive)
