"""Fakes for the ends of a writer: a source in memory, and the real log with a fold that only counts."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import partial
from typing import Any

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog, advance_folded
from pycrorm_async.writer.drain import Destination, Source

__all__ = ["KeptSource", "CountingFold", "ForwardingDestination", "LosesReplies", "opener"]


class KeptSource(Source):
    """A source in memory that keeps records until they are acknowledged; one thread fills it, another's loop drains it.

    `aside` holds the dead letters, or is None where refused records stay in the source.
    """

    def __init__(
        self, records: Iterable[Record] = (), *, closed: bool = False, name: str = "robot", stays: bool = False
    ) -> None:
        self._name = name
        self.aside: list[Record] | None = None if stays else []
        self._kept = list(records)
        self._given = 0  # the number of supplied records
        self._closed = closed
        self._lock = threading.Lock()
        self._wake: Callable[[], object] = lambda: None
        self.acknowledgements: list[int] = []
        self.given_up: list[str] = []

    @property
    def name(self) -> str:
        return self._name

    def put(self, records: Iterable[Record]) -> None:
        with self._lock:
            self._kept += records
            self._wake()

    def close(self) -> None:
        with self._lock:
            self._closed = True
            self._wake()

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
        del age_s_max  # records that are present are supplied at once
        while True:
            arrived = asyncio.Event()
            with self._lock:
                batch = self._next(events_max, bytes_max)
                if batch or self._closed:
                    self._given += len(batch)
                    return batch
                self._wake = partial(asyncio.get_running_loop().call_soon_threadsafe, arrived.set)
            try:
                await arrived.wait()
            finally:
                with self._lock:
                    self._wake = lambda: None

    async def acknowledge(self, position: int) -> None:
        await asyncio.sleep(0)
        with self._lock:
            forgotten = [each for each in self._kept if each.position <= position]
            self._kept = self._kept[len(forgotten) :]
            self._given -= len(forgotten)
            self.acknowledgements.append(position)

    def dead_letter(self, records: Sequence[Record]) -> bool:
        if self.aside is None:
            return False
        self.aside += records
        return True

    def fail(self, reason: str) -> None:
        self.given_up.append(reason)

    def reopened(self) -> KeptSource:
        """Return the source that the next process opens: everything that was not acknowledged, closed."""
        with self._lock:
            return KeptSource(self._kept, closed=True, name=self._name, stays=self.aside is None)

    @property
    def kept(self) -> list[int]:
        """The positions that it still holds."""
        with self._lock:
            return [each.position for each in self._kept]

    def _next(self, events_max: int, bytes_max: int) -> list[Record]:
        batch: list[Record] = []
        size = 0
        for each in self._kept[self._given : self._given + events_max]:
            size += len(each.payload)
            if batch and size > bytes_max:
                break
            batch.append(each)
        return batch


class CountingFold(Destination):
    """The real log, with a fold that only notes the position up to which it was called."""

    def __init__(self, log: EventLog) -> None:
        self.log = log

    async def append(self, *batch: Any, **options: Any) -> Mapping[EpisodeId, str]:
        return await self.log.append(*batch, **options)

    async def confirm(self) -> None:
        """Nothing has to be confirmed."""

    async def fold(self) -> int:
        behind = await self.log.behind()
        if behind:
            with self.log.translated():
                async with self.log.engine.begin() as connection:
                    assert await advance_folded(connection, [(row.number, row.folded, row.head) for row in behind])
        return sum(row.head - row.folded for row in behind)

    async def stopped(self) -> Mapping[str, str]:
        return {row.id: row.refused or row.parked or "" for row in await self.log.stopped()}


class ForwardingDestination(Destination):
    """Forward every call to another destination; subclasses override one method."""

    def __init__(self, destination: Destination) -> None:
        self._destination = destination

    async def append(self, *batch: Any, **options: Any) -> Mapping[EpisodeId, str]:
        return await self._destination.append(*batch, **options)

    async def confirm(self) -> None:
        await self._destination.confirm()

    async def fold(self) -> int:
        return await self._destination.fold()

    async def stopped(self) -> Mapping[str, str]:
        return await self._destination.stopped()


class LosesReplies(ForwardingDestination):
    """Commit, and raise that the database is unavailable, the first time for every batch."""

    lost = False

    async def append(self, *batch: Any, **options: Any) -> Mapping[EpisodeId, str]:
        refusals = await super().append(*batch, **options)
        self.lost = not self.lost
        if self.lost:
            raise DatabaseUnavailable("the connection was closed before the reply came")
        return refusals


def opener(
    address: DatabaseAddress,
    *,
    around: Callable[[Destination], Destination] = lambda destination: destination,
    busy_timeout_s: float = 5.0,
    closed: Callable[[], None] = lambda: None,
) -> Callable[[], AbstractAsyncContextManager[Destination]]:
    """Return a function that opens the log of this address in the loop that enters it."""

    @asynccontextmanager
    async def opened() -> AsyncIterator[Destination]:
        async with await EventLog.open(address, create=True, busy_timeout_s=busy_timeout_s) as log:
            yield around(CountingFold(log))
        closed()

    return opened
