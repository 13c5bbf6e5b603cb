"""`pycrorm writer --once`: store the events that recorders left in a spool, and bind a spool to another database.

The folders of dead recorders are drained into the log, folded and deleted. Those of living recorders that no daemon
drains are drained as far as they are synced, and stay.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import PycrormError
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.operations.destination import open_destination, shared_address
from pycrorm_async.projections.custom.discovery import validate_projections
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.queue.files.recorder_folder import folder_error
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
    "dead_queues",
    "RecoveryReport",
    "recover",
    "Rebinding",
    "rebind",
    "PendingRecorders",
    "pending_recorders",
]

_log = logging.getLogger("pycrorm_async")


def dead_queues(
    spool: Spool,
    failures: dict[str, PycrormError],
    lost: list[str] | None = None,
    *,
    settings: Settings | None = None,
) -> Iterator[RecoveredQueue]:
    """Yield the queue of each dead recorder, one at a time, and delete its folder once all of it is stored.

    A folder that cannot be recovered is added to `failures`; the others are recovered. The ids of episodes that the
    process left open are added to `lost`. With `settings`, stored segments are kept for as long as those require.
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
            if recovered.damage is not None:  # not logged here: the caller that drained this queue reports the damage
                failures[folder.name] = recovered.damage
        except Exception as error:  # noqa: BLE001 - kept in `failures`; the next folder may be readable
            failures[folder.name] = folder_error(folder.path, error)
            _log.warning("%s", failures[folder.name])


class RecoveryReport(NamedTuple):
    """The result of `recover`.

    Attributes:
        drained: the sources that were drained, and the events that were folded.
        living: the number of drained sources that belong to living processes; they come first.
        lost: ids of the episodes that were left open and ended LOST.
        failed: by the folder's name, the error that prevented its recovery.
        dead_letters: by episode id, the folder that keeps the records the database refused, now or earlier.
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
    """Append and fold everything in a database's spool that no other process drains.

    Of a living recorder, only the records that are synced at this moment. Folds custom `projections` too. Raises as
    `Memory.open` does.
    """
    failures: dict[str, PycrormError] = {}
    lost: list[str] = []
    address = shared_address(url)
    settings = settings or Settings()
    place = Spool(spool or address.default_spool, settings.file_access)
    async with open_destination(
        address, place, clock=SYSTEM_CLOCK, projections=validate_projections(projections), settings=settings
    ) as destination:
        with ExitStack() as stack:
            living = list(_living_queues(place, failures, stack))
            sources: Iterator[Source] = chain(living, dead_queues(place, failures, lost, settings=settings))
            done = await drain_once(sources, destination, settings=settings)
            for queue, state in zip(living, done.drained, strict=False):
                stopped = {each: why for each, why in done.stopped.items() if each in queue.episodes}
                queue.mark_visible(state.appended or queue.supplied, {**state.refused, **stopped})
    dead_letters = {each.refused: each.path for each in place.recorders() if each.refused is not None}
    return RecoveryReport(done, len(living), tuple(lost), {**done.failed, **failures}, dead_letters)


class _LivingQueue(LiveQueue):
    """The queue of a living recorder, drained once. `episodes` are the ids of the episodes in its batches."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.episodes: set[str] = set()

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        batch = await super().get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)
        self.episodes |= {episode_text(each) for each in {record.episode for record in batch} if each is not None}
        return batch


def _living_queues(spool: Spool, failures: dict[str, PycrormError], stack: ExitStack) -> Iterator[_LivingQueue]:
    """Yield the synced records of each living recorder that no other process drains. `stack` releases the folders."""
    for folder in spool.recorders():
        try:
            queue = _LivingQueue.take(folder.path) if folder.alive else None
        except Exception as error:  # noqa: BLE001 - kept in `failures`; the next folder may be readable
            failures[folder.name] = folder_error(folder.path, error)
            continue
        if queue is not None:
            stack.callback(queue.release)
            queue.finish()
            yield queue


class Rebinding(NamedTuple):
    """The change that `rebind` makes to a spool.

    Attributes:
        spool: its folder.
        before, after: ids of the logs it belonged to and belongs to now; `before` is None where nothing was stored yet.
        recorders, events: the number of each that it contains.
    """

    spool: Path
    before: str | None
    after: str
    recorders: int
    events: int


async def rebind(
    url: str, *, spool: Path | None = None, settings: Settings | None = None, say: Callable[[Rebinding], None]
) -> Rebinding:
    """Bind a spool to the database that is at this URL now, creating it if it is missing; `recover` then stores it.

    Calls `say` before it changes anything. Raises `SpoolTaken` where a process records into the spool or drains it.
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
    """The number of dead recorders, whose events may not be in the database yet, and of living recorders in a spool."""

    dead: int
    alive: int


def pending_recorders(url: str, spool: Path | None = None) -> PendingRecorders:
    """Count the recorders in a database's spool. Writes nothing. Raises `SpoolUnavailable`."""
    folders = Spool(spool or DatabaseAddress.parse(url).default_spool).recorders()
    recorders = [each for each in folders if each.refused is None]  # `pycrorm status` reports dead letters
    alive = sum(each.alive for each in recorders)
    return PendingRecorders(len(recorders) - alive, alive)
