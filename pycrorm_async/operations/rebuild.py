"""`pycrorm rebuild`: run one rebuild from start to end, by one process or several."""

import asyncio
import logging
import multiprocessing
import os
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import DatabaseError, DatabaseForeign, DatabaseUnavailable, PycrormError
from pycrorm_async.events.ids import is_episode_id
from pycrorm_async.operations.workers import Assignment, FoldWorker, FoldWorkerLost, FoldWorkers
from pycrorm_async.progress_bar import ProgressCallback, progress_bar
from pycrorm_async.projections.custom import Projection
from pycrorm_async.projections.generations import PROJECTION_VERSION, SHOWN, projections_in, read_generations
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.pipeline import Share
from pycrorm_async.projections.rebuild import Rebuild, claimed, clear, recorded
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import BUSY_TIMEOUT_S, DatabaseAddress, shared_address
from pycrorm_async.store.log import EventLog

_log = logging.getLogger("pycrorm_async")

_RESTARTS_MAX = 2
"""Bounds the restarts of a worker that dies again and again, such as for want of memory."""
SMALL_EVENTS_MAX = 50_000
"""The largest log whose outdated tables are rebuilt at open: it takes one process about two seconds."""
_ALONE_EVENTS_MAX = 500_000
"""The largest log that one process folds by default. For 400,000 events two processes took 0.8 times as long as one on
SQLite, and as long on PostgreSQL."""
_SHARE_EVENTS_MIN = 125_000
"""The events for which a process is worth its start, of about two seconds, in which one that runs folds as many. With
smaller shares two processes take longer than one: half as long again for one episode of 100,000 events."""
_IDLE_CORES_MIN = 1.5
"""The idle cores that two processes need by default. Beside four busy processes on two cores they were hardly faster
than one, and recorders waited twice as long."""
_BUSY_TIMEOUT_S = 20.0
"""The wait for SQLite's write lock, long because a rebuild of an hour must not fail for a busy plan."""


class RebuildSummary(NamedTuple):
    """The result of a rebuild.

    Attributes:
        generation: number of the generation that is visible now.
        events, episodes: the number of each in the log at the end.
        seconds: its duration.
        parked: the parked episodes by id, with the reasons.
        left: replaced tables that could not be dropped, because queries still use them.
        damaged: the damaged ids of episodes, by number.
    """

    generation: int
    events: int
    episodes: int
    seconds: float
    parked: Mapping[str, str]
    left: Sequence[str]
    damaged: Mapping[int, str]


async def rebuild_memory(
    url: str | DatabaseAddress,
    *,
    workers: int | None = 1,
    views: Sequence[UserView] = (),
    report_progress: ProgressCallback = lambda _done, _total, _what=None: None,
    clock: Clock = SYSTEM_CLOCK,
) -> RebuildSummary:
    """Rebuild the tables of a memory from its log.

    Args:
        url: of an existing memory; events that are recorded during the rebuild are included.
        workers: the most processes that fold, each a share of the episodes. On SQLite one of them writes at a time,
            while the others fold. Each needs a core, and as its start takes longer than folding a small log, there is
            none for less than 125,000 events or one episode. None: two for a large log if two cores are idle,
            otherwise one. Workers are spawned, so a script must call this with more than one below
            `if __name__ == "__main__":`.
        views: named queries to create beside the tables, in addition to the registered ones.
        report_progress: called with the number of events done, their total and the current step.
        clock: the time source.

    Raises `DatabaseUnavailable`; `CallerError` if another rebuild of this memory is running. After an interruption or
    a kill, the next rebuild resumes this one.
    """
    return await _run(url, lambda log: Rebuild.begin(log, views=views), workers, report_progress, clock)


async def rebuild_outdated(address: DatabaseAddress, *, clock: Clock = SYSTEM_CLOCK) -> None:
    """Rebuild the tables of a small memory that an older fold made; do nothing for any other memory.

    Opening a larger one logs a warning instead, because a plan must not wait for a rebuild of unknown length.
    """
    try:
        async with await EventLog.open(address, create=False) as log:
            async with log.reading() as connection:
                made = (await read_generations(connection)).get(SHOWN)
            _, events = await recorded(log)
            if made is None or made.version >= PROJECTION_VERSION or events > SMALL_EVENTS_MAX:
                return
            versions = f"version {made.version} of the fold, this is version {PROJECTION_VERSION}"
            _log.warning("the tables were made by %s: rebuilding them from %s events", versions, f"{events:,}")
        with progress_bar("rebuilding") as report_progress:
            await rebuild_memory(address, report_progress=report_progress, clock=clock)
    except (DatabaseUnavailable, DatabaseForeign):
        return  # there is no memory yet, or opening it for writing raises the reason
    except PycrormError as error:
        _log.warning("the tables could not be rebuilt: %s", error)


async def rebuild_projection(
    url: str,
    projection: Projection,
    *,
    report_progress: ProgressCallback = lambda _done, _total, _what=None: None,
    clock: Clock = SYSTEM_CLOCK,
) -> RebuildSummary:
    """Rebuild the tables of one custom projection. Raises the errors of `rebuild_memory`, and `DatabaseForeign`."""
    return await _run(url, lambda log: Rebuild.begin(log, projection=projection), 1, report_progress, clock)


async def projections_of(url: str) -> list[str]:
    """Return the names of the projections that have tables in a memory, also of those whose code is not installed."""
    async with await EventLog.open(shared_address(url), create=False) as log, log.reading() as connection:
        return [*projections_in(await read_generations(connection))]


async def _run(
    url: str | DatabaseAddress,
    begin: Callable[[EventLog], Awaitable[Rebuild]],
    workers: int | None,
    report_progress: ProgressCallback,
    clock: Clock,
) -> RebuildSummary:
    address = shared_address(url)
    await (await EventLog.open(address, create=False)).close()  # raises where no memory exists, instead of creating one
    async with await EventLog.open(address, create=True, busy_timeout_s=_busy_timeout_s(address)) as log:
        async with claimed(log):
            began = clock.monotonic_ns()
            await clear(log)
            rebuild = await begin(log)
            await _fold(log, rebuild, workers, report_progress)
            report_progress(1, 1, "showing")
            await rebuild.show()
            seconds = (clock.monotonic_ns() - began) / 1e9
            parked = await rebuild.parked()
            report_progress(1, 1, "clearing up")
            left = await clear(log)
        episodes, events = await recorded(log)
        ids = {each.number: each.id for each in await log.episodes()}
        return RebuildSummary(
            generation=rebuild.number,
            events=events,
            episodes=episodes,
            seconds=seconds,
            parked={ids[number]: reason for number, reason in parked.items()},
            left=left,
            damaged={number: each for number, each in ids.items() if not is_episode_id(each)},
        )


def _busy_timeout_s(address: DatabaseAddress) -> float:
    return _BUSY_TIMEOUT_S if address.is_sqlite else BUSY_TIMEOUT_S


async def _fold(log: EventLog, rebuild: Rebuild, workers: int | None, report_progress: ProgressCallback) -> None:
    episodes, total = await recorded(log)
    left = await rebuild.left()
    if workers is None:
        idle = len(os.sched_getaffinity(0)) - os.getloadavg()[0]
        workers = 2 if idle >= _IDLE_CORES_MIN and left > _ALONE_EVENTS_MAX else 1
    workers = min(workers, episodes, left // _SHARE_EVENTS_MIN)
    while workers > 1:
        if min([await rebuild.left(Share(part, workers)) for part in range(workers)]) >= _SHARE_EVENTS_MIN:
            break
        workers -= 1  # one long episode leaves too little for the others
    done = total - left

    def report(count: int) -> None:
        nonlocal done
        done += count
        report_progress(done, max(total, done), "rebuilding")

    if workers > 1 and multiprocessing.current_process().daemon:
        _log.warning("a daemonic process of multiprocessing cannot start fold workers; it folds without them")
        workers = 1
    if workers > 1:
        assignment = Assignment(log.address, log.log_id, busy_timeout_s=_busy_timeout_s(log.address))
        await _run_workers(assignment, workers, report)
    # Fold the events that are left: all without workers, otherwise new ones and those of a worker that failed. Its
    # fault is raised here, in the process that reports it.
    while (count := await rebuild.fold_next_batch()) is not None:
        report(count)


async def _run_workers(assignment: Assignment, count: int, report: Callable[[int], None]) -> None:
    """Fold with worker processes, a share each; return when all shares are folded or have failed."""
    async with (
        FoldWorkers(count, assignment, settings=Settings(), report=_log.warning, note=lambda _: None) as workers,
        asyncio.TaskGroup() as group,
    ):
        for part, worker in enumerate(workers):
            share = Share(part, count)
            group.create_task(_fold_share(worker, share, report), name=f"pycrorm share {part}")


async def _fold_share(worker: FoldWorker, share: Share, report: Callable[[int], None]) -> None:
    """Fold a share until nothing is left or the worker has failed; then the caller folds the rest and raises."""
    while await worker.started(restarts_max=_RESTARTS_MAX):
        with suppress(FoldWorkerLost):
            with suppress(DatabaseError):
                while (count := await worker.fold_share(share)) is not None:
                    report(count)
            return
