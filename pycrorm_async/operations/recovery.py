"""`pycrorm writer --once`: store the events that recorders left in a spool, and bind a spool to another database.

The folders of dead recorders are drained into the log, folded and deleted. Those of living recorders that no daemon
drains are drained as far as they are synced, and stay.
"""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import PycrormError
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.operations.destination import open_destination
from pycrorm_async.projections.custom import Projection, validate_projections
from pycrorm_async.queue.maintenance import inspect_spool
from pycrorm_async.queue.sources import DeadSource, LiveSource, open_dead
from pycrorm_async.queue.spool import Spool, folder_error
from pycrorm_async.queue.stored_segments import StoredSegments
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import shared_address
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import DrainSummary, Source, drain_once

_log = logging.getLogger("pycrorm_async")


def dead_queues(
    spool: Spool,
    failures: dict[str, PycrormError],
    lost: list[str] | None = None,
    *,
    settings: Settings | None = None,
) -> Iterator[DeadSource]:
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
    episodes: dict[str, set[EpisodeId]] = {}  # by living recorder, those in its batches

    def note_batch(source: Source, batch: Sequence[Record]) -> None:
        if source.name in episodes:
            episodes[source.name].update(each.episode for each in batch if each.episode is not None)

    from pycrorm_async.operations.rebuild import rebuild_outdated  # here, because every memory imports this module

    await rebuild_outdated(address)
    async with open_destination(
        address, place, clock=SYSTEM_CLOCK, projections=validate_projections(projections), settings=settings
    ) as destination:
        with ExitStack() as stack:
            living = list(_living_sources(place, failures, stack))
            episodes.update((each.name, set()) for each in living)
            sources: Iterator[Source] = chain(living, dead_queues(place, failures, lost, settings=settings))
            done = await drain_once(sources, destination, settings=settings, on_append=note_batch)
            for source, state in zip(living, done.drained, strict=False):
                ids = map(episode_text, episodes[source.name])
                stopped = {each: done.stopped[each] for each in ids if each in done.stopped}
                if done.pending is None:
                    source.mark_visible(state.appended or source.supplied, stopped)
                else:
                    source.mark_pending(done.pending)
    dead_letters = {each.refused: each.path for each in place.recorders() if each.refused is not None}
    return RecoveryReport(done, len(living), tuple(lost), {**done.failed, **failures}, dead_letters)


def _living_sources(spool: Spool, failures: dict[str, PycrormError], stack: ExitStack) -> Iterator[LiveSource]:
    """Yield the synced records of each living recorder that no other process drains. `stack` releases the folders."""
    for folder in spool.recorders():
        try:
            source = LiveSource.take(folder.path) if folder.alive else None
        except Exception as error:  # noqa: BLE001 - kept in `failures`; the next folder may be readable
            failures[folder.name] = folder_error(folder.path, error)
            continue
        if source is not None:
            stack.callback(source.release)
            source.finish()
            yield source


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
    url: str, *, spool: Path | None = None, settings: Settings | None = None, on_rebinding: Callable[[Rebinding], None]
) -> Rebinding:
    """Bind a spool to the database that is at this URL now, creating it if it is missing; `recover` then stores it.

    Calls `on_rebinding` before it changes the spool. Raises `SpoolTaken` where a process records into the spool or
    drains it.
    """
    address, settings = shared_address(url), settings or Settings()
    place = Spool(spool or address.default_spool, settings.file_access)
    report = inspect_spool(place.path)
    log = await EventLog.open(address, create=True, file_access=place.access)
    await log.close()
    events = sum(each.records for each in report.recorders)
    rebinding = Rebinding(place.path, place.log_id(), log.log_id, len(report.recorders), events)
    on_rebinding(rebinding)
    place.rebind(log.log_id)
    return rebinding
