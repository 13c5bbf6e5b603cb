"""`pycrorm rebuild`: run one rebuild from start to end, by one process or several."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import NamedTuple, TypeAlias

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import PycrormError
from pycrorm_async.operations.destination import shared_address
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.rebuild import Rebuild, Share, claimed, recorded
from pycrorm_async.projections.replaced_tables import clear
from pycrorm_async.projections.schema.generations import projections_in, read_generations
from pycrorm_async.projections.schema.user_views import UserView
from pycrorm_async.store.address import BUSY_TIMEOUT_S, DatabaseAddress
from pycrorm_async.store.log import EventLog

__all__ = ["RebuildSummary", "rebuild_memory", "rebuild_projection", "projections_of"]

ReportProgress: TypeAlias = Callable[[str, int, int], None]

_REPORT_S = 0.5
"""The interval between two progress reports while workers fold."""
_ALONE_EVENTS_MAX = 500_000
"""The largest log that one process folds by default. For 400,000 events two processes took 0.8 times as long as one on
SQLite, and as long on PostgreSQL."""
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
    """

    generation: int
    events: int
    episodes: int
    seconds: float
    parked: Mapping[str, str]
    left: Sequence[str]


async def rebuild_memory(
    url: str,
    *,
    workers: int | None = 1,
    views: Sequence[UserView] = (),
    report_progress: ReportProgress = lambda _step, _done, _total: None,
    clock: Clock = SYSTEM_CLOCK,
) -> RebuildSummary:
    """Rebuild the tables of a memory from its log.

    Args:
        url: of an existing memory; events that are recorded during the rebuild are included.
        workers: the number of processes that fold, each a share of the episodes. On SQLite one of them writes at a
            time, while the others fold. Each needs a core, and a second to start. None: two for a large log if two
            cores are idle, otherwise one. Workers are spawned, so a script must call this with more than one below
            `if __name__ == "__main__":`.
        views: named queries to create beside the tables, in addition to the registered ones.
        report_progress: called with the current step, the number of events done and their total.
        clock: the time source.

    Raises `DatabaseUnavailable`; `CallerError` if another rebuild of this memory is running. After an interruption or
    a kill, the next rebuild resumes this one.
    """
    return await _run(url, lambda log: Rebuild.begin(log, views=views), workers, report_progress, clock)


async def rebuild_projection(
    url: str,
    projection: Projection,
    *,
    report_progress: ReportProgress = lambda _step, _done, _total: None,
    clock: Clock = SYSTEM_CLOCK,
) -> RebuildSummary:
    """Rebuild the tables of one custom projection, as `rebuild_memory` does. Raises also `DatabaseForeign`."""
    return await _run(url, lambda log: Rebuild.begin(log, projection=projection), 1, report_progress, clock)


async def projections_of(url: str) -> list[str]:
    """Return the names of the projections that have tables in a memory, also of those whose code is not installed."""
    log = await EventLog.open(shared_address(url), create=False)
    try:
        async with log.reading() as connection:
            return [*projections_in(await read_generations(connection))]
    finally:
        await log.close()


async def _run(
    url: str,
    begin: Callable[[EventLog], Awaitable[Rebuild]],
    workers: int | None,
    report_progress: ReportProgress,
    clock: Clock,
) -> RebuildSummary:
    address = shared_address(url)
    await (await EventLog.open(address, create=False)).close()  # raises where no memory exists, instead of creating one
    log = await _opened(address)
    try:
        async with claimed(log):
            began = clock.monotonic_ns()
            await clear(log)
            rebuild = await begin(log)
            await _fold(log, rebuild, workers, report_progress)
            report_progress("showing", 1, 1)
            await rebuild.show()
            seconds = (clock.monotonic_ns() - began) / 1e9
            parked = await rebuild.parked()
            report_progress("clearing up", 1, 1)
            left = await clear(log)
        episodes, events = await recorded(log)
        ids = {each.number: each.id for each in await log.episodes()} if parked else {}
        return RebuildSummary(
            generation=rebuild.number,
            events=events,
            episodes=episodes,
            seconds=seconds,
            parked={ids[number]: reason for number, reason in parked.items()},
            left=left,
        )
    finally:
        await log.close()


async def _opened(address: DatabaseAddress) -> EventLog:
    timeout_s = _BUSY_TIMEOUT_S if address.is_sqlite else BUSY_TIMEOUT_S
    return await EventLog.open(address, create=True, busy_timeout_s=timeout_s)


async def _fold(log: EventLog, rebuild: Rebuild, workers: int | None, report_progress: ReportProgress) -> None:
    _, total = await recorded(log)
    if workers is None:
        idle = len(os.sched_getaffinity(0)) - os.getloadavg()[0]
        workers = 2 if idle >= _IDLE_CORES_MIN and await rebuild.left() > _ALONE_EVENTS_MAX else 1
    if workers > 1:
        await _run_workers(
            log.address, rebuild, workers, lambda left: report_progress("rebuilding", max(total - left, 0), total)
        )
    # Fold the events that are left: all without workers, otherwise new ones and those of a worker that failed. Its
    # fault is raised here, in the process that reports it.
    done = total - await rebuild.left()
    while (count := await rebuild.fold_next_batch()) is not None:
        done += count
        report_progress("rebuilding", done, max(total, done))


async def _run_workers(
    address: DatabaseAddress, rebuild: Rebuild, workers: int, report_left: Callable[[int], None]
) -> None:
    """Fold with spawned processes; return when all have ended. Kills them when it is cancelled."""
    context = multiprocessing.get_context("spawn")
    processes: list[BaseProcess] = []
    try:
        with _interrupts_blocked():
            for part in range(workers):
                process = context.Process(target=_work, args=(address, Share(part, workers)), daemon=True)
                process.start()
                processes.append(process)
        while working := [each.sentinel for each in processes if each.is_alive()]:
            report_left(await rebuild.left())
            await asyncio.to_thread(wait, working, _REPORT_S)
    finally:
        for each in processes:
            each.kill()  # loses nothing: its uncommitted events are folded again
            each.join()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT in processes started inside. A terminal sends Ctrl-C to all of them; their parent ends them."""
    resource_tracker.ensure_running()  # starting it unblocks SIGINT, so it must not be started by the first process
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(address: DatabaseAddress, share: Share) -> None:
    collect_seldom()
    with suppress(PycrormError):
        asyncio.run(_work_on(address, share))


async def _work_on(address: DatabaseAddress, share: Share) -> None:
    log = await _opened(address)
    try:
        rebuild = await Rebuild.join(log, share)
        parent = multiprocessing.parent_process()
        while parent is not None and parent.is_alive() and await rebuild.fold_next_batch() is not None:
            pass
    finally:
        await log.close()
