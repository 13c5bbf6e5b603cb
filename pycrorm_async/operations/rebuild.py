"""`pycrorm rebuild`: one rebuild from its beginning to its end, by one process or several."""

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
from pycrorm_async.projections.rebuild import Rebuild, Share, claimed, clear, recorded
from pycrorm_async.projections.schema.generations import all_noted, projections_in
from pycrorm_async.projections.schema.user_views import UserView
from pycrorm_async.store.address import BUSY_TIMEOUT_S, DatabaseAddress
from pycrorm_async.store.log import EventLog

__all__ = ["RebuildSummary", "rebuild_memory", "rebuild_projection", "projections_of"]

ReportProgress: TypeAlias = Callable[[str, int, int], None]

_LOOK_S = 0.5
_ALONE_EVENTS_MAX = 500_000
"""Of 400,000 two processes took 0.8 times as long as one on SQLite and as long on PostgreSQL."""
_IDLE_CORES_MIN = 1.5
"""Beside four busy processes on two cores two were hardly faster than one, and who recorded waited twice as long."""
_WAIT_S = 20.0
"""For a turn to write on SQLite: what has run for an hour does not give up for a plan that is busy."""


class RebuildSummary(NamedTuple):
    """What a rebuild made.

    Attributes:
        generation: number of the tables that people see now.
        events, episodes: in the log at the end.
        seconds: it took.
        parked: by episode id, why not all of it could be folded.
        left: tables that are not shown any more and that somebody uses still.
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
    tell: ReportProgress = lambda _what, _done, _total: None,
    clock: Clock = SYSTEM_CLOCK,
) -> RebuildSummary:
    """Makes the tables of a memory anew from its log.

    Args:
        url: of a memory that is there; what is recorded meanwhile will be in the tables too.
        workers: processes that fold at once, each its share of the episodes. On SQLite one at a time writes, while
            another folds. More than one needs a core for each, and a second to begin; None: two for a large log, where
            two cores have nothing to do. They are spawned: a script that has more than one does so below
            `if __name__ == "__main__":`.
        views: questions with a name to keep beside the tables, with those that were registered before.
        tell: what is done now, how many events are done, and of how many.
        clock: what the time is taken from.

    Raises `DatabaseUnavailable`; `CallerError` if somebody else rebuilds this memory. Interrupted or killed, the next
    one takes up what was made.
    """
    return await _rebuilt(url, lambda log: Rebuild.begin(log, views=views), workers, tell, clock)


async def rebuild_projection(
    url: str,
    projection: Projection,
    *,
    tell: ReportProgress = lambda _what, _done, _total: None,
    clock: Clock = SYSTEM_CLOCK,
) -> RebuildSummary:
    """The same for the tables of one projection, of whatever version they are. Raises also `DatabaseForeign`."""
    return await _rebuilt(url, lambda log: Rebuild.begin(log, projection=projection), 1, tell, clock)


async def projections_of(url: str) -> list[str]:
    """The names of the projections that have tables in a memory, whether their code is here or not."""
    log = await EventLog.open(shared_address(url), create=False)
    try:
        async with log.reading() as connection:
            return [*projections_in(await all_noted(connection))]
    finally:
        await log.close()


async def _rebuilt(
    url: str, begin: Callable[[EventLog], Awaitable[Rebuild]], workers: int | None, tell: ReportProgress, clock: Clock
) -> RebuildSummary:
    address = shared_address(url)
    await (await EventLog.open(address, create=False)).close()  # it makes no memory where there is none
    log = await _opened(address)
    try:
        async with claimed(log):
            began = clock.monotonic_ns()
            await clear(log)
            rebuild = await begin(log)
            await _fold(log, rebuild, workers, tell)
            tell("showing", 1, 1)
            await rebuild.show()
            seconds = (clock.monotonic_ns() - began) / 1e9
            parked = await rebuild.parked()
            tell("clearing up", 1, 1)
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
    return await EventLog.open(address, create=True, busy_timeout_s=_WAIT_S if address.is_sqlite else BUSY_TIMEOUT_S)


async def _fold(log: EventLog, rebuild: Rebuild, workers: int | None, tell: ReportProgress) -> None:
    _, total = await recorded(log)
    if workers is None:
        idle = len(os.sched_getaffinity(0)) - os.getloadavg()[0]
        workers = 2 if idle >= _IDLE_CORES_MIN and await rebuild.left() > _ALONE_EVENTS_MAX else 1
    if workers > 1:
        await _share_out(log.address, rebuild, workers, lambda left: tell("rebuilding", max(total - left, 0), total))
    # All of it, or what came meanwhile and what a worker that failed has left: then it fails here too, and says why.
    done = total - await rebuild.left()
    while (count := await rebuild.fold_next_batch()) is not None:
        done += count
        tell("rebuilding", done, max(total, done))


async def _share_out(address: DatabaseAddress, rebuild: Rebuild, workers: int, look: Callable[[int], None]) -> None:
    """Returns when every worker has ended; leaves none behind."""
    context = multiprocessing.get_context("spawn")
    processes: list[BaseProcess] = []
    try:
        with _not_interrupted():
            for part in range(workers):
                process = context.Process(target=_work, args=(address, Share(part, workers)), daemon=True)
                process.start()
                processes.append(process)
        while working := [each.sentinel for each in processes if each.is_alive()]:
            look(await rebuild.left())
            await asyncio.to_thread(wait, working, _LOOK_S)
    finally:
        for each in processes:
            each.kill()  # nothing is lost: what it had not committed is folded again
            each.join()


@contextmanager
def _not_interrupted() -> Iterator[None]:
    """Processes that are started inside never hear of Ctrl-C, which a terminal sends to all: who began ends them."""
    resource_tracker.ensure_running()  # else the first start begins it, which lets Ctrl-C through again
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
