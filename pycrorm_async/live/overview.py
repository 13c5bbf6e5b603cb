"""Keep the list of episodes up to date: those that had ended from the tables, the others from their events."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Any

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX
from pycrorm_async.live.activity import Activity
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.query.reading import Reading
from pycrorm_async.report.overview_data import newest_episodes, overview_document
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.episode_lookup import grown_episodes
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow

_LISTED_MAX = 2_000
"""Bounds the episodes of the list that are read from the tables."""
_ENDED_MAX = 500
"""Bounds the activities that are kept of episodes that have ended meanwhile."""
_PAGE_EVENTS = 2_000
"""Bounds the events that are read at once."""


class LiveOverview:
    """The present activity of each running episode.

    Attributes:
        listeners: number of pages that follow it.
    """

    def __init__(self, address: DatabaseAddress) -> None:
        self.listeners = 0
        self._reading = Reading(address)
        self._activities: dict[int, Activity] = {}
        self._changed_at: dict[int, int] = {}
        """The turn in which an episode's entry changed last, by its number."""
        self._turn = 0
        self._folding = asyncio.Lock()

    async def close(self) -> None:
        await self._reading.close()

    @property
    def turn(self) -> int:
        """Counts the turns in which an entry changed."""
        return self._turn

    async def catch_up(self, log: EventLog, rows: Iterable[EpisodeRow]) -> bool:
        """Fold the new events of these episodes; return whether any entry changed."""
        async with self._folding:
            grown = [each for each in rows if self._is_behind(each)]
            if not grown:
                return False
            self._turn += 1
            designators = await log.dtypes()
            for row in grown:
                activity = self._activities.setdefault(row.number, Activity(row))
                activity.row = row
                await self._read(activity, log, designators)
                self._changed_at[row.number] = self._turn
            self._forget()
            return True

    def _is_behind(self, row: EpisodeRow) -> bool:
        activity = self._activities.get(row.number)
        if activity is None:
            return row.head > 0
        return activity.fault is None and (row.head > activity.last or row.refused != activity.row.refused)

    async def _read(self, activity: Activity, log: EventLog, designators: dict[str, str]) -> None:
        while activity.last < activity.row.head:
            page = await log.events(activity.row.number, after=activity.last, limit=_PAGE_EVENTS)
            if not page:
                return
            for event in page:
                try:
                    activity.read(event, designators)
                except CannotFold as reason:
                    activity.fault = f"event {event.sequence}: {reason}"
                    return

    def _forget(self) -> None:
        ended = [number for number, each in self._activities.items() if each.has_ended]
        for number in ended[:-_ENDED_MAX]:
            del self._activities[number], self._changed_at[number]

    def entries(self, since: int) -> list[dict[str, Any]]:
        """Return the entries that changed behind a turn, without those of simulations."""
        numbers = sorted(number for number, turn in self._changed_at.items() if turn > since)
        return [self._activities[each].entry() for each in numbers if not self._activities[each].simulated]

    async def document(self, log: EventLog) -> dict[str, Any]:
        """Return the document of the list: the newest episodes of the tables, running ones, and those not folded."""
        unended = [number for number, each in self._activities.items() if not each.has_ended]
        running = await grown_episodes(log, above=EPISODE_NUMBER_MAX, numbers=unended)
        await self.catch_up(log, {each.number: each for each in [*await log.behind(), *running]}.values())
        try:
            episodes, total = await newest_episodes(self._reading)
            episodes = episodes[-_LISTED_MAX:]
            pages = {each.number: f"episode/{each.number}" for each in episodes}
            document = await overview_document(self._reading, "Episodes", episodes, total, pages, {})
        except DatabaseUnavailable:  # it has no tables yet
            document = {"title": "Episodes", "total": 0, "episodes": []}
        entries = {each["number"]: each for each in document["episodes"]}
        entries |= {each["number"]: each for each in self.entries(0)}
        total = max(document["total"], len(entries))
        return {**document, "total": total, "episodes": [entries[each] for each in sorted(entries)]}
