"""Verify a memory: check that the log is complete, fold it again and compare the tables.

Writes nothing. Each part is read in one snapshot, so that recording and folding continue in the meantime.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from typing import TYPE_CHECKING

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DamageError, DatabaseUnavailable, TablesOutdated
from pycrorm_async.events.blobs import references_in
from pycrorm_async.events.codec import DESCRIPTION_PREFIX, fingerprint
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.fold.link_boxes import boxes_of
from pycrorm_async.projections.fold.parameters import Designators
from pycrorm_async.projections.fold.row_batch import Rows
from pycrorm_async.projections.fold.row_writer import name_episodes, uuids_of
from pycrorm_async.projections.schema.generations import Generation, current_generation
from pycrorm_async.projections.schema.union import unite
from pycrorm_async.projections.unmade_types import failed_views, unmade_types
from pycrorm_async.projections.verify.digest_check import (
    DigestCheck,
    OutsideDigest,
    check_outside,
    check_places,
    read_kept,
)
from pycrorm_async.projections.verify.episode_check import EpisodeCheck
from pycrorm_async.projections.verify.findings import StoppedEpisode, VerifyResult
from pycrorm_async.projections.verify.parts import EpisodeRange, Place, Unreadable
from pycrorm_async.projections.verify.row_comparison import Comparison, Difference, Range
from pycrorm_async.projections.verify.verify_custom import check_of, uncompared_projections
from pycrorm_async.store.address import no_tables
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow, Span, StoredEvent

if TYPE_CHECKING:
    from pycrorm_async.progress_bar import ProgressCallback

_BY_PREFIX = "SELECT fingerprint FROM pycrorm_declaration WHERE substr(fingerprint, 1, 5)"
_FINGERPRINTS = text(f"{_BY_PREFIX} <> '{DESCRIPTION_PREFIX}' ORDER BY ordinal")
_DESCRIPTIONS = text(f"{_BY_PREFIX} = '{DESCRIPTION_PREFIX}'")
_DESCRIPTIONS_READ = 100
"""Bounds the descriptions read at once: each takes up to `record_bytes_max`."""
_TOTAL = text("SELECT coalesce(sum(head), 0) FROM episode WHERE number >= :first AND number < :end")
# Looks up the index once for each gap between two episodes, because reading every event would take minutes.
_GAPS = text("""
SELECT number, following FROM (
    SELECT number, lead(number, 1, CAST(:end AS BIGINT)) OVER (ORDER BY number) AS following
    FROM (SELECT number FROM episode UNION ALL SELECT :first) AS known
) AS gap WHERE following > number + 1
AND EXISTS (SELECT 1 FROM event WHERE episode > number AND episode < following) ORDER BY number""")
_FIRST_IN_GAP = text(
    "SELECT min(episode) FROM event WHERE episode > CAST(:number AS BIGINT) AND episode < CAST(:following AS BIGINT)"
)
_NUMBERS_END = 2**62
_BEYOND = text("""
SELECT number, head, first, last FROM (
    SELECT number, head, (SELECT min(sequence) FROM event WHERE episode = number) AS first,
        (SELECT max(sequence) FROM event WHERE episode = number) AS last
    FROM episode WHERE number >= :first AND number < :end
) AS each_episode WHERE first < 1 OR last > head ORDER BY number""")


async def verify(
    log: EventLog,
    *,
    episode: EpisodeRow | None = None,
    projections: Sequence[Projection] = (),
    digests: Iterable[OutsideDigest] = (),
    report_progress: ProgressCallback = lambda _done, _total, _what=None: None,
) -> VerifyResult:
    """Verify a whole memory, or one episode.

    Args:
        log: may be open for reading only.
        episode: to verify; all of them if None.
        projections: custom projections whose tables are compared too.
        digests: kept outside of the memory, with which those in the log are compared.
        report_progress: called with the number of events checked and their total.

    Raises `DatabaseForeign` for tables of a newer version, `DatabaseUnavailable` for a memory without tables.
    """
    result = VerifyResult()
    within = EpisodeRange() if episode is None else EpisodeRange(episode.number, episode.number + 1)
    with log.translated():
        if episode is None:
            await _check_database(log, result)
            result.unmade = await unmade_types(log)
            result.failed_views = await failed_views(log)
        result.stopped = await _stopped(log, episode)
        try:
            await check_outside(log, digests, result, episode)
            total = await _check_heads(log, within, result)
            await within.check(log, _TablesCheck(log, result, total, report_progress))
        except TablesOutdated as fault:
            result.outdated = str(fault)
        await _check_blobs(log, result)
        result.not_compared = await uncompared_projections(log, projections)
        for each in projections:
            if each.name not in result.not_compared:
                try:
                    await within.check(log, check_of(each, result))
                except DamageError as fault:
                    result.add_damage(None, None, str(fault))
    return result


async def _check_database(log: EventLog, result: VerifyResult) -> None:
    """Check the database's pages, the declarations, and events that belong to no episode."""
    try:
        async with log.snapshot() as connection:
            dialect = dialect_of(connection)
            for reason in await dialect.faults_of_file(connection):
                result.add_damage(None, None, reason)
            names = (await connection.execute(_FINGERPRINTS)).scalars()
            for name, payload in zip(names, await dialect.declarations(connection), strict=True):
                if fingerprint(payload) != name:
                    result.add_damage(None, None, f"the declaration {name} does not match its fingerprint")
            described = sorted((await connection.execute(_DESCRIPTIONS)).scalars())
            for first in range(0, len(described), _DESCRIPTIONS_READ):
                part = described[first : first + _DESCRIPTIONS_READ]
                payloads = await dialect.descriptions(connection, part)
                matching = {fingerprint(payload, "DescriptionDeclared") for payload in payloads}
                for payload in payloads:
                    for reference in references_in("DescriptionDeclared", payload):
                        result.blobs.setdefault(reference.hash, (None, None))
                for name in part:
                    if name not in matching:
                        result.add_damage(None, None, f"the description {name} does not match its fingerprint")
            for number in await _numbers_without_episode(connection):
                result.add_damage(None, None, f"there are events of an episode {number}, which is not in the log")
    except DamageError as fault:
        result.add_damage(None, None, str(fault))


async def _check_blobs(log: EventLog, result: VerifyResult) -> None:
    """Compare the content of each blob that an event refers to with its hash."""
    for name, (number, sequence) in result.blobs.items():
        fault = await log.blobs.fault(name)
        if fault is not None:
            subject = "a declaration " if number is None else ""
            result.add_damage(number, sequence, f"{subject}refers to blob {name}, which {fault}")


async def _numbers_without_episode(connection: AsyncConnection) -> list[int]:
    numbers: list[int] = []
    gaps = await connection.execute(_GAPS, {"first": -_NUMBERS_END, "end": _NUMBERS_END})
    for number, following in gaps.all():
        while number is not None:
            within = {"number": number, "following": following}
            number = (await connection.execute(_FIRST_IN_GAP, within)).scalar_one()
            if number is not None:
                numbers.append(number)
    return numbers


async def _stopped(log: EventLog, episode: EpisodeRow | None) -> list[StoppedEpisode]:
    """Return the parked and refused episodes."""
    stopped: list[StoppedEpisode] = []
    for each in await log.stopped():
        if episode is None or each.number == episode.number:
            if each.refused is not None:
                stopped.append(StoppedEpisode(each.number, "refused", each.refused))
            if each.parked is not None:
                stopped.append(StoppedEpisode(each.number, "parked", each.parked))
    return stopped


async def _check_heads(log: EventLog, within: EpisodeRange, result: VerifyResult) -> int:
    """Return the number of events that the episodes must have; report events outside of that range."""
    async with log.snapshot() as connection:
        for number, head, lowest, highest in await connection.execute(_BEYOND, within.limits):
            for sequence in sorted({lowest, highest}):
                if not 1 <= sequence <= head:
                    result.add_damage(number, sequence, f"exists, but the episode must end with event {head}")
        await check_places(connection, within.limits, result)
        return int((await connection.execute(_TOTAL, within.limits)).scalar_one())


class _TablesCheck:
    """The check of the log and of the built-in tables. Implements `PartCheck`."""

    missing_table = "a table is missing: run `pycrorm rebuild`"

    def __init__(self, log: EventLog, result: VerifyResult, total: int, report_progress: ProgressCallback) -> None:
        self._log = log
        self._dialect = dialect_of(log.engine)
        self.result = result
        self._total = total
        self._report_progress = report_progress
        self._unfinished = EpisodeCheck(0, result)
        self._digests: DigestCheck | None = None
        self._comparison: Comparison | None = None

    async def comparison(self, connection: AsyncConnection) -> Comparison:
        generation = await current_generation(connection)
        if generation is None:
            raise DatabaseUnavailable(no_tables(self._log.address))
        if self._comparison is None or self._comparison.generation != generation:
            self._comparison = Comparison(generation, self._dialect.stored_column)
        return self._comparison

    async def check(
        self, connection: AsyncConnection, comparison: Comparison, at: Place, within: EpisodeRange, limit: int
    ) -> Place | None:
        episodes = await _episodes(connection, within._replace(first=at.number), limit)
        spans, place = _cut(episodes, at, limit)
        events = await self._events_of(connection, spans)
        kept = await read_kept(connection, spans)
        designators = await _designators(connection, comparison.generation)
        descriptions = frozenset((await connection.execute(_DESCRIPTIONS)).scalars())
        folded = {each.number: each.folded for each in episodes}
        by_number = {each.number: each for each in episodes}
        rows = Rows()
        low, high = at, place or (None if within.end is None else Place(within.end))
        settled: frozenset[int] = frozenset()
        if at.after:
            self._unfinished.resume(rows, at.after, folded.get(at.number, 0))
            settled = self._unfinished.carried.intersection(rows.nodes)
            if self._unfinished.compared:
                low = Place(at.number + 1)
        read: dict[int, EpisodeCheck] = {}
        for span in spans:
            if span.after == 0:
                self._unfinished = EpisodeCheck(span.number, self.result)
                self._digests = DigestCheck(by_number[span.number], self.result, certain=self._log.address.is_sqlite)
                self.result.episodes += 1
            read[span.number] = self._unfinished
            self._unfinished.descriptions = descriptions
            self._unfinished.read(span, events.get(span.number, {}), by_number[span.number], designators, rows)
            if self._digests is not None:
                self._digests.read(
                    span,
                    by_number[span.number].head,
                    events.get(span.number, {}),
                    kept.get(span.number, {}),
                    self._unfinished,
                )
        carried: frozenset[int] = frozenset()
        if place is not None and place.after:
            self._unfinished.leave(rows, place.after, folded[place.number])
            carried = self._unfinished.carried
            if self._unfinished.compared:
                high = Place(place.number + 1)
        if rows.episodes:
            name_episodes(rows, await uuids_of(connection, rows.episodes))
        folded_range = Range(low.row or None, high and high.row, low.number or None, high and high.number)
        await self._compare(connection, comparison, rows, folded_range, carried, settled - carried, read)
        self._report_progress(self.result.events, max(self._total, self.result.events))
        return place

    async def _events_of(self, connection: AsyncConnection, spans: Sequence[Span]) -> dict[int, dict[int, StoredEvent]]:
        """Read the events of these spans, by number and sequence."""
        try:
            with self._log.translated():
                events = await self._dialect.spans(connection, spans)
        except DamageError as fault:
            for span in spans:
                if span.last > span.after:
                    raise Unreadable(span, str(fault)) from fault
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
                if rows.descriptions:
                    boxes = await boxes_of(connection, rows.descriptions)
                    differences += await comparison.box_differences(connection, boxes)
        except DamageError as fault:
            self.result.add_damage(None, None, str(fault))
            return
        self.result.rows += comparison.count
        for each in sorted(differences, key=attrgetter("number", "sequence")):
            if each.number not in read or not read[each.number].hides(each):
                self.result.add_difference(each)
        self._check_superfluous([each for each in differences if each.is_superfluous and each.number], read)

    def _check_superfluous(self, rows: Iterable[Difference], read: Mapping[int, EpisodeCheck]) -> None:
        """Report the events and episodes that the log does not have, although the tables have their rows."""
        last: dict[int, int] = {}
        for each in rows:
            if each.number not in read or each.sequence > read[each.number].head:
                last[each.number] = max(each.sequence, last.get(each.number, 0))
                self.result.rows_without_event += 1
        for number, sequence in last.items():
            if number not in read:
                reason = f"episode {number} was deleted: the tables have rows of its events up to {sequence}"
                self.result.add_deleted(number, None, f"{reason}, and the log has none of them")
            else:
                first = read[number].head + 1
                reason = f"the events {first} to {sequence} were deleted: the tables have rows of event {sequence}"
                self.result.add_deleted(number, first, reason)


def _cut(episodes: Sequence[EpisodeRow], at: Place, limit: int) -> tuple[list[Span], Place | None]:
    """Return the spans of the next part of these episodes, and the place behind it; None at the end of the memory."""
    spans: list[Span] = []
    left = limit
    for each in episodes:
        after = at.after if each.number == at.number else 0
        last = min(each.head, after + left)
        spans.append(Span(each.number, after, last))
        left -= last - after
        if last < each.head:
            return spans, Place(each.number, last)
        if left <= 0:
            return spans, Place(each.number + 1)
    if len(episodes) < limit:
        return spans, None
    return spans, Place(episodes[-1].number + 1)


async def _episodes(connection: AsyncConnection, within: EpisodeRange, limit: int) -> list[EpisodeRow]:
    rows = await connection.execute(
        text(
            "SELECT number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked FROM episode"
            " WHERE number >= :first AND number < :end ORDER BY number LIMIT :limit"
        ),
        {**within.limits, "limit": limit},
    )
    return [EpisodeRow(*row) for row in rows]


async def _designators(connection: AsyncConnection, generation: Generation) -> Designators:
    payloads = await dialect_of(connection).declarations(connection)
    return Designators.of_union(unite(generation.layout, payloads))
