"""Read what a memory's log has of one episode, for a recording that continues it (`record.recorded_before`).

A recording has no event loop of its own and may be called inside one, so each question runs in a thread of its own.
"""

import asyncio
import time
from collections.abc import Collection, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from pycrorm_async.errors import EpisodeRefused, FlushTimeout
from pycrorm_async.events.ids import EpisodeId, is_named
from pycrorm_async.queue.format import segments_in
from pycrorm_async.queue.recorder_queue import RecorderQueue
from pycrorm_async.queue.spool import Spool
from pycrorm_async.queue.stored_segments import files_with
from pycrorm_async.record.recorded_before import StoredEpisode, StoredPayload
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog

_PAGE_EVENTS: Final = 5_000
"""Bounds the events of one page: each costs a connection, and few are larger than a kilobyte."""
_PAUSE_S: Final = 0.01
"""The pause between two looks whether all that was recorded before is stored."""
T = TypeVar("T")


class LogEpisodes:
    """The episodes of the log at one address. Implements `record.recorded_before.StoredEpisodes`.

    Args:
        queue: the memory's own queue, all of whose records must be stored before the log is read.
        unrecoverable: the names of folders of dead recorders that nobody can drain.
        timeout_s: bounds the wait for the queue, and for the folders of other recorders.
    """

    def __init__(
        self,
        address: DatabaseAddress,
        spool: Spool,
        queue: RecorderQueue,
        unrecoverable: Collection[str],
        *,
        timeout_s: float,
    ) -> None:
        self._address = address
        self._spool = spool
        self._queue = queue
        self._unrecoverable = unrecoverable
        self._timeout_s = timeout_s
        self._asked: set[EpisodeId] = set()

    def find(self, episode: EpisodeId) -> StoredEpisode | None:
        """Implement `StoredEpisodes.find`.

        Raises `FlushTimeout` if another recorder keeps events of the episode, `EpisodeRefused` for one that was erased
        or archived.
        """
        self._wait_until_stored(episode)
        row = _run(self._row(episode))
        if row is None:
            return None
        number, head, ended_wall_ns = row
        return StoredEpisode(
            head,
            ended_wall_ns is not None,
            lambda after: _run(self._page(number, after, min(head, after + _PAGE_EVENTS))),
        )

    def _wait_until_stored(self, episode: EpisodeId) -> None:
        # The queue has no records of a named episode that was not asked for before, so an import of many need not wait.
        is_new = is_named(episode) and episode not in self._asked
        self._asked.add(episode)
        position, deadline = 0 if is_new else self._queue.written, time.monotonic() + self._timeout_s
        others = [
            each.path
            for each in self._spool.recorders()  # without dead letters, which the log refuses again and again
            if each.path != self._queue.folder and each.refused is None and each.name not in self._unrecoverable
        ]
        while self._queue.stored < position or (others := [each for each in others if _holds(each, episode)]):
            if time.monotonic() > deadline:
                holders = ", ".join(each.name for each in others)
                reason = f"another process records this episode: recorder {holders}" if others else None
                raise FlushTimeout(self._timeout_s, reason)
            time.sleep(_PAUSE_S)

    async def _row(self, episode: EpisodeId) -> tuple[int, int, int | None] | None:
        async with await EventLog.open(self._address, create=False) as log:
            row = await log.episode(episode)
            removed = {} if row is not None else await log.removed([episode])
        if removed:
            raise EpisodeRefused(f"nothing is recorded of it: {removed[episode]}")
        return None if row is None else (row.number, row.head, row.ended_wall_ns)

    async def _page(self, number: int, after: int, last: int) -> Sequence[StoredPayload]:
        async with await EventLog.open(self._address, create=False) as log:
            events = await log.events(number, after=after, limit=last - after)
        return [StoredPayload(each.sequence, each.type, each.version, each.payload) for each in events]


def _holds(folder: Path, episode: EpisodeId) -> bool:
    """Return whether a recorder's folder has events of an episode.

    Its locks do not answer that, because a writer that drains the folder of a dead recorder holds them too.
    """
    with suppress(FileNotFoundError):
        return next(files_with(segments_in(folder).values(), episode), None) is not None
    return False


def _run(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine in a loop and a thread of its own, and return its result."""
    with ThreadPoolExecutor(1, "pycrorm stored episodes") as thread:
        return thread.submit(asyncio.run, coroutine).result()
