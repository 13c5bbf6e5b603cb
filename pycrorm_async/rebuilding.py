"""`pycrorm rebuild`: one rebuild from its beginning to its end, by one process or several."""

from __future__ import annotations

import asyncio
import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from typing import NamedTuple

from pycrorm_async.adoption import shared_address
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.projections.rebuild import Rebuild, Share, claimed, clear
from pycrorm_async.projections.views import UserView
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog

__all__ = ["Rebuilt", "rebuild_memory"]

_LOOK_S = 0.5


class Rebuilt(NamedTuple):
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
    workers: int = 1,
    views: Sequence[UserView] = (),
    tell: Callable[[str, int, int], None] = lambda _what, _done, _total: None,
    clock: Clock = SYSTEM_CLOCK,
) -> Rebuilt:
    """Makes the tables of a memory anew from its log.

    Args:
        url: of a memory that is there; what is recorded meanwhile will be in the tables too.
        workers: processes that fold at once, each its share of the episodes. On SQLite one at a time writes.
        views: questions with a name to keep beside the tables, with those that were registered before.
        tell: what is done now, how many events are done, and of how many.
        clock: what the time is taken from.

    Raises `DatabaseUnavailable`; `CallerError` if somebody else rebuilds this memory. Interrupted or killed, the next
    one takes up what was made.
    """
    address = shared_address(url)
    await (await EventLog.open(address, create=False)).close()  # it makes no memory where there is none
    log = await EventLog.open(address, create=True)
    try:
        async with claimed(log):
            began = clock.monotonic_ns()
            await clear(log)
            rebuild = await Rebuild.begin(log, views=views)
            await _fold(log, rebuild, workers, tell)
            tell("showing", 1, 1)
            await rebuild.show()
            seconds = (clock.monotonic_ns() - began) / 1e9
            tell("clearing up", 1, 1)
            left = await clear(log)
        episodes = await log.episodes()
        return Rebuilt(
            generation=rebuild.number,
            events=sum(each.head for each in episodes),
            episodes=len(episodes),
            seconds=seconds,
            parked={each.id: each.parked for each in episodes if each.parked is not None},
            left=left,
        )
    finally:
        await log.close()


async def _fold(log: EventLog, rebuild: Rebuild, workers: int, tell: Callable[[str, int, int], None]) -> None:
    total = sum(each.head for each in await log.episodes())
    done = total - await rebuild.left()
    if workers == 1:
        while (count := await rebuild.fold_some()) is not None:
            done += count
            tell("rebuilding", done, max(total, done))
        return
    looking = asyncio.create_task(_look(rebuild, total, tell))
    try:
        with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            loop = asyncio.get_running_loop()
            shares = [loop.run_in_executor(pool, _work, log.address, Share(part, workers)) for part in range(workers)]
            await asyncio.gather(*shares)
    finally:
        looking.cancel()
        with suppress(asyncio.CancelledError):
            await looking


async def _look(rebuild: Rebuild, total: int, tell: Callable[[str, int, int], None]) -> None:
    while True:
        tell("rebuilding", max(total - await rebuild.left(), 0), total)
        await asyncio.sleep(_LOOK_S)


def _work(address: DatabaseAddress, share: Share) -> None:
    asyncio.run(_work_on(address, share))


async def _work_on(address: DatabaseAddress, share: Share) -> None:
    log = await EventLog.open(address, create=True)
    try:
        rebuild = await Rebuild.join(log, share)
        parent = multiprocessing.parent_process()
        while parent is not None and parent.is_alive() and await rebuild.fold_some() is not None:
            pass
    finally:
        await log.close()
