"""Verify a memory: check that the log is complete, fold it again and compare the tables.

Writes nothing. Each part is read in one snapshot, so that recording and folding continue in the meantime.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from typing import NamedTuple

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DamageError, DatabaseForeign, DatabaseUnavailable, TablesOutdated
from pycrorm_async.events.codec import fingerprint
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.fold.parameters import Designators
from pycrorm_async.projections.fold.row_batch import Rows
from pycrorm_async.projections.schema.generations import Generation, current_generation
from pycrorm_async.projections.schema.layout import unite
from pycrorm_async.projections.schema.unmade_types import unmade_types
from pycrorm_async.projections.verify.episode_check import EpisodeCheck
from pycrorm_async.projections.verify.findings import Damage, StoppedEpisode, VerifyResult
from pycrorm_async.projections.verify.row_comparison import Comparison, Difference, Range
from pycrorm_async.projections.verify.verify_custom import compare_projection, uncompared_projections
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow, Span, StoredEvent

__all__ = ["VerifyResult", "Damage", "StoppedEpisode", "verify"]

_PART_EVENTS = 4_000
"""Bounds the events of one part, and so the memory used."""
_FINDINGS_MAX = 100
"""Bounds the findings of each kind that are kept; all are counted."""
_ATTEMPTS = 10
"""Bounds the snapshots for one part while rebuilds replace the tables."""

_FINGERPRINTS = text("SELECT fingerprint FROM pycrorm_declaration ORDER BY ordinal")
_TOTAL = text("SELECT coalesce(sum(head), 0) FROM episode WHERE number >= :first_number AND number < :end")
# Jumps from one number to the next in the index, because reading every event would take minutes in a large log.
_NUMBERS_WITHOUT_EPISODE = text("""
WITH RECURSIVE there (number) AS (
    SELECT min(episode) FROM event
    UNION ALL SELECT (SELECT min(episode) FROM event WHERE episode > number) FROM there WHERE number IS NOT NULL
) SELECT number FROM there WHERE number IS NOT NULL AND number NOT IN (SELECT number FROM episode) ORDER BY number""")
_BEYOND = text("""
SELECT number, head, first, last FROM (
    SELECT number, head, (SELECT min(sequence) FROM event WHERE episode = number) AS first,
        (SELECT max(sequence) FROM event WHERE episode = number) AS last
    FROM episode WHERE number >= :first_number AND number < :end
) AS each_episode WHERE first < 1 OR last > head ORDER BY number""")


async def verify(
    log: EventLog,
    *,
    episode: EpisodeRow | None = None,
    projections: Sequence[Projection] = (),
    report_progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> VerifyResult:
    """Verify a whole memory, or one episode.

    Args:
        log: may be open for reading only.
        episode: to verify; all of them if None.
        projections: custom projections whose tables are compared too.
        report_progress: called with the number of events checked and their total.

    Raises `DatabaseForeign` for tables of a newer version, `DatabaseUnavailable` for a memory without tables.
    """
    check = _Check(log, report_progress)
    with log.translated():
        if episode is None:
            await check.whole()
        await check.stopped(episode)
        try:
            if episode is None:
                await check.episodes(_Place(0, 0), None)
            else:
                await check.episodes(_Place(episode.number, 0), episode.number + 1)
        except TablesOutdated as fault:
            check.outdated = str(fault)
        await check.projections(projections, episode)
    return check.result()


class _Check:
    """One verification of a memory, and its findings so far."""

    def __init__(self, log: EventLog, report_progress: Callable[[int, int], None]) -> None:
        self._log = log
        self._dialect = dialect_of(log.engine)
        self._report_progress = report_progress
        self._damages: list[Damage] = []
        self._differences: list[Difference] = []
        self._damage = self._drift = self._remarks = 0
        self._episodes = self._events = self._rows = self._behind = 0
        self._not_compared: dict[str, str] = {}
        self._stopped: list[StoppedEpisode] = []
        self._unmade: dict[str, str] = {}
        self.outdated: str | None = None
        self._unfinished = EpisodeCheck(0)
        self._comparison: Comparison | None = None

    def result(self) -> VerifyResult:
        return VerifyResult(
            episodes=self._episodes,
            events=self._events,
            rows=self._rows,
            behind=self._behind,
            damage=self._damage,
            drift=self._drift,
            damages=self._damages,
            differences=self._differences,
            remarks=self._remarks,
            not_compared=self._not_compared,
            stopped=self._stopped,
            unmade=self._unmade,
            outdated=self.outdated,
        )

    async def whole(self) -> None:
        """Check the database's pages, the declarations, and events that belong to no episode."""
        try:
            async with self._log.snapshot() as connection:
                for reason in await self._dialect.faults_of_file(connection):
                    self._damaged(None, None, reason)
                names = (await connection.execute(_FINGERPRINTS)).scalars()
                for name, payload in zip(names, await self._dialect.declarations(connection), strict=True):
                    if fingerprint(payload) != name:
                        self._damaged(None, None, f"the declaration {name} does not match its fingerprint")
                for (number,) in await connection.execute(_NUMBERS_WITHOUT_EPISODE):
                    self._damaged(None, None, f"there are events of an episode {number}, which is not in the log")
        except DamageError as fault:
            self._damaged(None, None, str(fault))

    async def stopped(self, episode: EpisodeRow | None) -> None:
        """Collect the parked and refused episodes, and the types without tables, which park their episodes."""
        for each in await self._log.stopped():
            if episode is None or each.number == episode.number:
                if each.refused is not None:
                    self._stopped.append(StoppedEpisode(each.number, "refused", each.refused))
                if each.parked is not None:
                    self._stopped.append(StoppedEpisode(each.number, "parked", each.parked))
        if episode is None:
            self._unmade = await unmade_types(self._log)

    async def episodes(self, at: _Place, end: int | None) -> None:
        """Check the episodes from this place up to but not including number `end`; None is the end of the memory."""
        async with self._log.snapshot() as connection:
            total = await self._heads(connection, at.number, end)
        limit = _PART_EVENTS
        after: _Place | None = at
        while after is not None:
            try:
                after = await self._part(after, end, limit)
                limit = min(limit * 8, _PART_EVENTS)
            except _Unreadable as fault:
                if limit > 1:  # halve the part until the unreadable event is alone
                    limit = max(limit // 8, 1)
                else:
                    self._damaged(fault.span.number, fault.span.last, f"cannot be read: {fault}")
                    after = _Place(fault.span.number + 1, 0)
            self._report_progress(self._events, max(total, self._events))

    async def projections(self, projections: Sequence[Projection], episode: EpisodeRow | None) -> None:
        """Compare the tables of these projections, for all episodes or for one."""
        self._not_compared = await uncompared_projections(self._log, projections)
        first, end = (0, None) if episode is None else (episode.number, episode.number + 1)
        for each in projections:
            if each.name in self._not_compared:
                continue
            try:
                async for part in compare_projection(self._log, each, first=first, end=end):
                    self._rows += part.rows
                    for difference in part.differences:
                        self._differs(difference)
            except DamageError as fault:
                self._damaged(None, None, str(fault))

    async def _heads(self, connection: AsyncConnection, first: int, end: int | None) -> int:
        """Return the number of events that the episodes must have; report events outside of that range."""
        numbers = {"first_number": first, "end": EPISODE_NUMBER_MAX + 1 if end is None else end}
        for number, head, lowest, highest in await connection.execute(_BEYOND, numbers):
            for sequence in sorted({lowest, highest}):
                if not 1 <= sequence <= head:
                    self._damaged(number, sequence, f"exists, but the episode must end with event {head}")
        return int((await connection.execute(_TOTAL, numbers)).scalar_one())

    async def _part(self, at: _Place, end: int | None, limit: int) -> _Place | None:
        """Check up to `limit` events after this place in one snapshot; return the next place, None at the end.

        Raises `_Unreadable`, and then has reported nothing.
        """
        for _ in range(_ATTEMPTS):
            async with self._log.snapshot() as connection:
                generation = await current_generation(connection)
                if generation is None:
                    raise DatabaseUnavailable(f"{self._log.address} has no tables yet: run `pycrorm writer --once`")
                comparison = self._comparison
                if comparison is None or comparison.generation != generation:
                    self._comparison = comparison = Comparison(generation, self._dialect.stored_column)
                if await self._dialect.keep(connection, comparison.tables):
                    return await self._look(connection, comparison, at, end, limit)
            # A rebuild replaced and dropped the tables between two statements: read the generation again.
        raise DatabaseForeign(f"{self._log.address}: a table is missing: run `pycrorm rebuild`")

    async def _look(
        self, connection: AsyncConnection, comparison: Comparison, at: _Place, end: int | None, limit: int
    ) -> _Place | None:
        episodes = await _episodes(connection, at.number, end, limit)
        spans, place = _cut(episodes, at, limit)
        events = await self._events_of(connection, spans)
        designators = await _designators(connection, comparison.generation)
        folded = {each.number: each.folded for each in episodes}
        rows = Rows()
        low, high = at, place or (None if end is None else _Place(end, 0))
        settled: frozenset[int] = frozenset()
        if at.after:
            self._unfinished.resume(rows, at.after, folded.get(at.number, 0))
            settled = self._unfinished.carried.intersection(rows.nodes)
            if self._unfinished.compared:
                low = _Place(at.number + 1, 0)
        read: dict[int, EpisodeCheck] = {}
        for span in spans:
            if span.after == 0:
                self._unfinished = EpisodeCheck(span.number)
                self._episodes += 1
            read[span.number] = self._unfinished
            self._unfinished.read(span, events.get(span.number, {}), folded[span.number], designators, rows)
        carried: frozenset[int] = frozenset()
        if place is not None and place.after:
            self._unfinished.leave(rows, place.after, folded[place.number])
            carried = self._unfinished.carried
            if self._unfinished.compared:
                high = _Place(place.number + 1, 0)
        self._take_over(read.values())
        within = Range(low.row or None, high and high.row, low.number or None, high and high.number)
        await self._compare(connection, comparison, rows, within, carried, settled - carried, read)
        return place

    async def _events_of(self, connection: AsyncConnection, spans: Sequence[Span]) -> dict[int, dict[int, StoredEvent]]:
        """Read the events of these spans, by number and sequence."""
        try:
            with self._log.translated():
                events = await self._dialect.spans(connection, spans)
        except DamageError as fault:
            for span in spans:
                if span.last > span.after:
                    raise _Unreadable(span, str(fault)) from fault
            raise
        by_number = groupby(events, key=attrgetter("number"))
        return {number: {event.sequence: event for event in each} for number, each in by_number}

    async def _compare(
        self,
        connection: AsyncConnection,
        comparison: Comparison,
        rows: Rows,
        within: Range,
        carried: Collection[int],
        settled: Collection[int],
        read: Mapping[int, EpisodeCheck],
    ) -> None:
        try:
            with self._log.translated():
                differences = await comparison.differences(connection, rows, within, carried=carried, settled=settled)
        except DamageError as fault:
            self._damaged(None, None, str(fault))
            return
        self._rows += comparison.count
        for each in sorted(differences, key=attrgetter("number", "sequence")):
            if each.number not in read or not read[each.number].hides(each):
                self._differs(each)

    # --- findings -----------------------------------------------------------------------------------------------

    def _take_over(self, episodes: Iterable[EpisodeCheck]) -> None:
        """Move the findings of this part from the episodes' checks to the result."""
        for each in episodes:
            for sequence, reason in each.damages:
                self._damaged(each.number, sequence, reason)
            self._events += each.events
            self._behind += each.behind
            self._remarks += each.remarks
            each.events = each.behind = each.remarks = 0
            each.damages.clear()

    def _differs(self, difference: Difference) -> None:
        self._drift += 1
        if len(self._differences) < _FINDINGS_MAX:
            self._differences.append(difference)

    def _damaged(self, number: int | None, sequence: int | None, reason: str) -> None:
        self._damage += 1
        if len(self._damages) < _FINDINGS_MAX:
            self._damages.append(Damage(number, sequence, " ".join(reason.split())))


class _Unreadable(Exception):
    """The database cannot read the first event of this span, or a later one."""

    def __init__(self, span: Span, reason: str) -> None:
        super().__init__(reason)
        self.span = span


class _Place(NamedTuple):
    """The place in the log behind event `after` of episode `number`."""

    number: int
    after: int

    @property
    def row(self) -> int:
        """The smallest id of a row made by an event behind this place."""
        return self.number << 31 | (self.after + 1 if self.after else 0) << 5


def _cut(episodes: Sequence[EpisodeRow], at: _Place, limit: int) -> tuple[list[Span], _Place | None]:
    """Return the spans of the next part of these episodes, and the place behind it; None at the end of the memory."""
    spans: list[Span] = []
    left = limit
    for each in episodes:
        after = at.after if each.number == at.number else 0
        last = min(each.head, after + left)
        spans.append(Span(each.number, after, last))
        left -= last - after
        if last < each.head:
            return spans, _Place(each.number, last)
        if left <= 0:
            return spans, _Place(each.number + 1, 0)
    if len(episodes) < limit:
        return spans, None
    return spans, _Place(episodes[-1].number + 1, 0)


async def _episodes(connection: AsyncConnection, first: int, end: int | None, limit: int) -> list[EpisodeRow]:
    rows = await connection.execute(
        text(
            "SELECT number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked FROM episode"
            " WHERE number >= :first AND number < :end ORDER BY number LIMIT :limit"
        ),
        {"first": first, "end": EPISODE_NUMBER_MAX + 1 if end is None else end, "limit": limit},
    )
    return [EpisodeRow(*row) for row in rows]


async def _designators(connection: AsyncConnection, generation: Generation) -> Designators:
    payloads = await dialect_of(connection).declarations(connection)
    _, accepted, refused = unite(generation.layout, payloads)
    return Designators(accepted, refused)
