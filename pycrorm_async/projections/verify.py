"""Folds the log again and compares with the tables; and looks whether the log itself is whole.

Reads only. Each part is read in one snapshot, so recording and folding go on meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from operator import attrgetter
from typing import Any, NamedTuple

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.codec import fingerprint
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, row_id
from pycrorm_async.events.order import OrderCheck
from pycrorm_async.projections.comparing import Comparison, Difference, Range
from pycrorm_async.projections.fold import CannotFold, fold, happening_of
from pycrorm_async.projections.generations import Generation, current_generation
from pycrorm_async.projections.parameters import Designators
from pycrorm_async.projections.rows import Rows
from pycrorm_async.projections.tables import COLUMNS
from pycrorm_async.projections.union import unite
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.rows import EpisodeRow, Span, StoredEvent

__all__ = ["Verified", "Damage", "verify"]

_PART_EVENTS = 20_000
_TOLD_MAX = 100
"""So many findings of each kind are kept; all are counted."""
_STATUS = COLUMNS["task_tree_node"].index("status")


class Damage(NamedTuple):
    """Where the log contradicts itself. Without an episode it is the database as a whole."""

    number: int | None
    sequence: int | None
    reason: str

    def __str__(self) -> str:
        if self.number is None:
            return self.reason
        return f"episode {self.number}, event {self.sequence}: {self.reason}"


class Verified(NamedTuple):
    """What was found.

    Attributes:
        episodes, events, rows: that were looked at.
        behind: events that the tables do not show yet, which is no fault.
        damage, drift: how many findings of each kind there are.
        damages, differences: the first hundred of each.
        remarks: what is unusual in the order of events and happens in honest plans.
    """

    episodes: int
    events: int
    rows: int
    behind: int
    damage: int
    drift: int
    damages: list[Damage]
    differences: list[Difference]
    remarks: int


async def verify(
    log: EventLog,
    *,
    episode: EpisodeRow | None = None,
    tell: Callable[[int, int], None] = lambda _done, _total: None,
) -> Verified:
    """Looks at all of a memory, or at one episode.

    Args:
        log: may be open for reading only.
        episode: to look at; all of them if None.
        tell: how many events were looked at, of how many.

    Raises `DatabaseForeign` for tables of another version, `DatabaseUnavailable` for a memory without tables.
    """
    check = _Check(log, tell)
    with log.translated():
        if episode is None:
            await check.whole()
            await check.episodes(0, EPISODE_NUMBER_MAX + 1)  # there is none of number 0, and no row may be of it
        else:
            await check.episodes(episode.number, episode.number + 1)
    return check.found()


class _Check:
    """One look at a memory, and how far it is."""

    def __init__(self, log: EventLog, tell: Callable[[int, int], None]) -> None:
        self._log = log
        self._tell = tell
        self._damages: list[Damage] = []
        self._differences: list[Difference] = []
        self._damage = self._drift = self._remarks = 0
        self._episodes = self._events = self._rows = self._behind = 0
        # Of the episode that is looked at in several parts:
        self._order = OrderCheck()
        self._open_nodes: dict[int, list[Any]] = {}
        self._open_episode: dict[int, list[Any]] = {}
        self._untold: int | None = None  # number of an episode of which no row can be told any more, after a finding

    def found(self) -> Verified:
        return Verified(
            episodes=self._episodes,
            events=self._events,
            rows=self._rows,
            behind=self._behind,
            damage=self._damage,
            drift=self._drift,
            damages=self._damages,
            differences=self._differences,
            remarks=self._remarks,
        )

    async def whole(self) -> None:
        """The database's own pages, the declarations, and events of no episode."""
        async with self._log.snapshot() as connection:
            for reason in await dialect_of(connection).faults_of_file(connection):
                self._damaged(None, None, reason)
            declared = await connection.execute(text("SELECT fingerprint, payload FROM pycrorm_declaration"))
            for name, payload in declared:
                if fingerprint(payload.encode()) != name:
                    self._damaged(None, None, f"the declaration {name} is not what was declared")
            orphans = await connection.execute(
                text("SELECT DISTINCT episode FROM event EXCEPT SELECT number FROM episode ORDER BY 1")
            )
            for (number,) in orphans:
                self._damaged(None, None, f"there are events of an episode {number}, which is not in the log")

    async def episodes(self, first: int, end: int) -> None:
        """Those from number `first` on and below `end`."""
        total = sum(each.head for each in await self._log.episodes() if first <= each.number < end)
        at: _Place | None = _Place(first, 0)
        while at is not None:
            at = await self._part(at, end)
            self._tell(self._events, max(total, self._events))

    async def _part(self, at: _Place, end: int) -> _Place | None:
        """Looks at what follows this place, some of it, in one snapshot; where to go on, None at the end."""
        async with self._log.snapshot() as connection:
            generation = await current_generation(connection)
            if generation is None:
                raise DatabaseUnavailable(f"{self._log.address} has no tables yet: `pycrorm writer --once` makes them")
            comparison = Comparison(generation)
            await dialect_of(connection).keep(connection, comparison.tables)
            episodes = await _episodes(connection, at.number, end)
            spans, place = _cut(episodes, at)
            rows = Rows()
            rows.nodes |= self._open_nodes
            rows.episodes |= self._open_episode
            designators = await _designators(connection, generation)
            folded_to = {each.number: each.folded for each in episodes}
            events = await dialect_of(connection).spans(connection, spans)
            for span, read in _by_span(spans, events):
                self._read(span, read, folded_to[span.number], designators, rows)
            next_number = end if place is None else place.number
            await self._count(connection, [each for each in episodes if each.number < next_number])
            carried = self._carry(rows, place)
            low, high = at.row, end << 31 if place is None else place.row
            found = await comparison.differences(
                connection,
                rows,
                Range(low, high, at.number, next_number),
                carried=[*carried],
                settled=[each for each in self._open_nodes if each not in carried],
            )
            self._open_nodes = carried
        self._rows += comparison.count
        for each in found:
            if each.number != self._untold:
                self._differs(each)
        return place

    def _read(self, span: Span, events: list[StoredEvent], folded: int, designators: Designators, rows: Rows) -> None:
        """The events of one span, in order: are they whole, and what do they make."""
        if span.after == 0:
            self._episodes += 1
            self._order = OrderCheck()
        for sequence, event in enumerate(events, span.after + 1):
            if event.sequence != sequence or span.number == self._untold:
                break
            self._events += 1
            try:
                happening = happening_of(event)
            except CannotFold as reason:
                if event.sequence <= folded:
                    self._lost_track(span.number, event.sequence, str(reason))
                continue
            for finding in self._order.read(event.sequence, happening):
                if finding.kind == "damage":
                    self._damaged(span.number, finding.sequence, finding.text)
                else:
                    self._remarks += 1
            if event.sequence > folded:
                self._behind += 1
                continue
            try:
                fold(event, designators, rows)
            except CannotFold as reason:
                self._lost_track(span.number, event.sequence, str(reason))
        there = {event.sequence for event in events}
        missing = next((each for each in range(span.after + 1, span.last + 1) if each not in there), None)
        if missing is not None and span.number != self._untold:
            self._damaged(span.number, missing, "is missing")
            self._untold = span.number

    def _carry(self, rows: Rows, place: _Place | None) -> dict[int, list[Any]]:
        """What the next part needs to know of the episode that is not at its end."""
        if place is None or place.after == 0:
            self._open_episode = {}
            return {}
        row = rows.episodes.pop(place.number, None)
        self._open_episode = {} if row is None else {place.number: row}
        first = row_id(place.number, 0, 0)
        return {key: row for key, row in rows.nodes.items() if key >= first and row[_STATUS] == "RUNNING"}

    async def _count(self, connection: AsyncConnection, episodes: list[EpisodeRow]) -> None:
        """Whether each of these episodes has as many events as it says."""
        if not episodes:
            return
        counted = await connection.execute(
            text(
                "SELECT episode, max(sequence) FROM event WHERE episode >= :first AND episode <= :last GROUP BY episode"
            ),
            {"first": episodes[0].number, "last": episodes[-1].number},
        )
        last: dict[int, int] = {row[0]: row[1] for row in counted}
        for each in episodes:
            if last.get(each.number, 0) > each.head:
                self._damaged(each.number, each.head + 1, f"is there, and the episode is said to end with {each.head}")

    # --- findings -----------------------------------------------------------------------------------------------

    def _lost_track(self, number: int, sequence: int, reason: str) -> None:
        """An event that the tables show and that cannot be folded: nothing more can be told of its episode."""
        self._differs(Difference(number, sequence, "event", "payload", "shown in the tables", f"parked: {reason}"))
        self._untold = number

    def _damaged(self, number: int | None, sequence: int | None, reason: str) -> None:
        self._damage += 1
        if len(self._damages) < _TOLD_MAX:
            self._damages.append(Damage(number, sequence, reason))

    def _differs(self, difference: Difference) -> None:
        self._drift += 1
        if len(self._differences) < _TOLD_MAX:
            self._differences.append(difference)


class _Place(NamedTuple):
    """After this event of this episode."""

    number: int
    after: int

    @property
    def row(self) -> int:
        """The smallest id a row can have that is made after it."""
        return row_id(self.number, self.after + 1 if self.after else 0, 0)


def _cut(episodes: Sequence[EpisodeRow], at: _Place) -> tuple[list[Span], _Place | None]:
    """The next part of these episodes, and where the one after it begins; None if that is the end of all."""
    spans: list[Span] = []
    left = _PART_EVENTS
    for each in episodes:
        after = at.after if each.number == at.number else 0
        last = min(each.head, after + left)
        spans.append(Span(each.number, after, last))
        left -= last - after
        if last < each.head:
            return spans, _Place(each.number, last)
        if left <= 0:
            return spans, _Place(each.number + 1, 0)
    if len(episodes) < _PART_EVENTS:
        return spans, None
    return spans, _Place(episodes[-1].number + 1, 0)


def _by_span(spans: Sequence[Span], events: Sequence[StoredEvent]) -> Iterator[tuple[Span, list[StoredEvent]]]:
    read = {number: list(each) for number, each in groupby(events, key=attrgetter("number"))}
    return ((span, read.get(span.number, [])) for span in spans)


async def _episodes(connection: AsyncConnection, first: int, end: int) -> list[EpisodeRow]:
    found = await connection.execute(
        text(
            "SELECT number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked FROM episode"
            " WHERE number >= :first AND number < :end ORDER BY number LIMIT :limit"
        ),
        {"first": first, "end": end, "limit": _PART_EVENTS},
    )
    return [EpisodeRow(*row) for row in found]


async def _designators(connection: AsyncConnection, generation: Generation) -> Designators:
    payloads = await dialect_of(connection).declarations(connection)
    _, accepted, refused = unite(generation.layout, payloads)
    return Designators(accepted, refused)
