"""Read new events of the log as they are stored, for any number of pages that follow one episode or all of them.

Theory of operation. One task, `LogFollower.run`, asks the log every 50 ms (150 ms if nothing happens) which episodes
have grown, as long as a page listens, and folds the new events of those that are followed: each `EpisodeFeed` once,
however many pages show it. After each turn it wakes the listeners, and each takes the part of the document behind the
event that it has sent last. A feed has a lock, because a part must not be taken while events are folded. The log is
only read. If the database does not exist yet or does not answer, `fault` has the reason and the task tries again; if
it was replaced, the feeds are thrown away and `epoch` counts it, and the pages load again.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable, LogDamaged
from pycrorm_async.live.overview import LiveOverview
from pycrorm_async.report.episode_data import document_behind, read_into
from pycrorm_async.report.episode_fold import EpisodeFold
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.episode_lookup import episode_named, grown_episodes, is_simulated
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow

_INTERVAL_S = 0.05
"""The pause in s between two reads of the log."""
_IDLE_INTERVAL_S = 0.15
"""The pause in s between two reads of a log that did not change for `_IDLE_TURNS` reads."""
_IDLE_TURNS = 40
"""The turns without a change after which the log is queried less often, to spare the robot's processor."""
_RETRY_S = 0.5
"""Delays the next attempt if the database does not answer."""
_FEEDS_MAX = 8
"""Bounds the folded episodes that are kept for pages without a listener, which load again or come back."""


class EpisodeFeed:
    """An episode, folded as far as it was read, from event `first` on.

    Attributes:
        listeners: number of pages that follow it.
        fault: why its events cannot be read any further, or None.
    """

    def __init__(self, row: EpisodeRow, first: int) -> None:
        self._fold = EpisodeFold(row, first)
        self._reading = asyncio.Lock()
        self.listeners = 0
        self.fault: str | None = row.refused

    @property
    def id(self) -> str:
        return self._fold.row.id

    @property
    def number(self) -> int:
        return self._fold.row.number

    @property
    def last(self) -> int:
        """The sequence of the last event that was folded."""
        return self._fold.last

    async def catch_up(self, log: EventLog, row: EpisodeRow) -> None:
        """Fold the events that were stored since the last call."""
        async with self._reading:
            fold = self._fold
            fold.row = row
            self.fault = row.refused or self.fault
            if fold.is_full or row.head <= fold.last or self.fault is not None:
                return
            try:
                await read_into(fold, log, log.pages(row, after=fold.last))
            except (LogDamaged, DatabaseForeign) as error:
                self.fault = str(error)

    async def document(self, log: EventLog, after: int = 0) -> dict[str, Any]:
        """Return the document, or the part of it behind event `after`."""
        async with self._reading:
            return await document_behind(self._fold, log, after)


class LogFollower:
    """Follows the log at an address.

    Attributes:
        fault: why the log cannot be read at the moment, or None.
        turn: counts the turns in which something changed.
        epoch: counts how often the database was replaced.
        began: number of the newest episode, except simulations, that began while the log was followed; 0 without one.
        overview: the present activity of each episode.
    """

    def __init__(self, address: DatabaseAddress) -> None:
        self.address = address
        self.fault: str | None = None
        self.turn = 0
        self.epoch = 0
        self.began = 0
        self.overview = LiveOverview(address)
        self._log: EventLog | None = None
        self._file: tuple[int, int] | None = None
        self._newest: int | None = None
        """Number of the newest episode, simulations included; None before the first turn."""
        self._feeds: dict[tuple[int, int], EpisodeFeed] = {}
        self._growing: set[int] = set()
        self._listeners = 0
        self._wanted = asyncio.Event()
        self._changed = asyncio.Condition()
        self._opening = asyncio.Lock()

    async def run(self) -> None:
        """Follow the log until cancelled; rest while nothing listens."""
        unchanged = 0
        try:
            while True:
                await self._wanted.wait()
                fault = self.fault
                try:
                    changed = await self._take_turn()
                    self.fault = None
                except (DatabaseUnavailable, DatabaseForeign) as error:
                    changed, self.fault = False, str(error)
                unchanged = 0 if changed else unchanged + 1
                if changed or fault != self.fault:
                    await self._wake()
                interval_s = _INTERVAL_S if unchanged < _IDLE_TURNS else _IDLE_INTERVAL_S
                await asyncio.sleep(interval_s if self.fault is None else _RETRY_S)
        finally:
            await self.close()

    async def close(self) -> None:
        """Close the connections to the database."""
        log, self._log = self._log, None
        await _close(self.overview, log)

    async def log(self) -> EventLog:
        """Return the open log. Raises `DatabaseUnavailable`, `DatabaseForeign`."""
        async with self._opening:
            file = self._identity()
            if self._log is not None and file == self._file:
                return self._log
            opened = await EventLog.open(self.address, create=False)  # fails as long as there is none
            former, self._log, self._file = self._log, opened, file  # before a wait, which may be cancelled
            if former is not None:
                overview, self.overview = self.overview, LiveOverview(self.address)
                self._feeds.clear()
                self._growing.clear()
                self.began, self._newest = 0, None
                self.epoch += 1
                await _close(overview, former)
            return opened

    def _identity(self) -> tuple[int, int] | None:
        """Return device and inode of a SQLite file, by which a file that replaces it differs."""
        if not self.address.is_sqlite:
            return None
        try:
            status = self.address.path.stat()
        except OSError:
            return None
        return status.st_dev, status.st_ino

    async def feed(self, name: str, first: int = 1) -> EpisodeFeed:
        """Return the feed of an episode, folded up to its last stored event. Raises `UnknownEpisode`."""
        log = await self.log()
        row = await episode_named(log, name)
        key = (row.number, first)
        feed = self._feeds.pop(key, None)
        if feed is None or feed.id != row.id or row.head < feed.last:
            feed = EpisodeFeed(row, first)
        self._feeds[key] = feed
        for idle in [each for each, other in self._feeds.items() if not other.listeners][:-_FEEDS_MAX]:
            del self._feeds[idle]
        await feed.catch_up(log, row)
        return feed

    @asynccontextmanager
    async def listening(self, followed: EpisodeFeed | LiveOverview) -> AsyncIterator[None]:
        """Keep the feed or the overview up to date inside the context."""
        followed.listeners += 1
        self._listeners += 1
        self._wanted.set()
        try:
            yield
        finally:
            followed.listeners -= 1
            self._listeners -= 1
            if self._listeners == 0:
                self._wanted.clear()

    async def changed_since(self, turn: int, timeout_s: float) -> bool:
        """Wait until a turn behind this one has changed something; return False after the timeout."""
        try:
            async with asyncio.timeout(timeout_s), self._changed:
                await self._changed.wait_for(lambda: self.turn > turn)
        except TimeoutError:
            return False
        return True

    async def _wake(self) -> None:
        async with self._changed:
            self.turn += 1
            self._changed.notify_all()

    async def _take_turn(self) -> bool:
        """Fold the events stored since the last turn; return whether there were any."""
        epoch, log = self.epoch, await self.log()
        if self._newest is None:
            self._newest = max([each.number for each in await log.episodes()], default=0)
        rows = {each.number: each for each in await grown_episodes(log, above=self._newest, numbers=self._growing)}
        self._growing = {each.number for each in rows.values() if each.ended_wall_ns is None}
        added = [each for each in rows.values() if each.number > self._newest]
        for row in added:
            self._newest = row.number
            if not await is_simulated(log, row):
                self.began = row.number
        changed = epoch != self.epoch or bool(added)
        for feed in [each for each in self._feeds.values() if each.listeners]:
            if (grown := rows.get(feed.number)) is not None:
                before = feed.last, feed.fault
                await feed.catch_up(log, grown)
                changed = changed or before != (feed.last, feed.fault)
        if self.overview.listeners:
            changed = await self.overview.catch_up(log, rows.values()) or changed
        return changed


async def _close(overview: LiveOverview, log: EventLog | None) -> None:
    try:
        await overview.close()
    finally:
        if log is not None:
            await log.close()
