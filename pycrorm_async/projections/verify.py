"""Verify the log and compare the tables with it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DamageError, DatabaseUnavailable, LogDamaged, TablesOutdated
from pycrorm_async.events.codec import DESCRIPTION_PREFIX, fingerprint
from pycrorm_async.events.ids import row_id, row_id_min, row_key
from pycrorm_async.events.order import OrderCheck
from pycrorm_async.events.types import EpisodeEnded, ObjectAdded, references_in
from pycrorm_async.projections import pipeline
from pycrorm_async.projections.columns import OWN, Layout, unite
from pycrorm_async.projections.custom import (
    CustomRows,
    PackedProjection,
    Projection,
    fault_in_version,
    layout_of,
    learner_of,
)
from pycrorm_async.projections.findings import (
    Comparison,
    Difference,
    EpisodeRange,
    PartCheck,
    Place,
    Range,
    StoppedEpisode,
    Unreadable,
    VerifyResult,
)
from pycrorm_async.projections.fold import (
    UndecodablePayload,
    boxes_of,
    fold_happening,
    happening_of,
    name_episodes,
    uuids_of,
)
from pycrorm_async.projections.generations import (
    Generation,
    current_generation,
    failed_views,
    projections_in,
    read_generations,
    unmade_types,
)
from pycrorm_async.projections.node_row import STATUS
from pycrorm_async.projections.pipeline import Batch
from pycrorm_async.projections.row_batch import CannotFold, Designators, Rows
from pycrorm_async.store.address import no_tables
from pycrorm_async.store.append import has_digests
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog, read_episodes
from pycrorm_async.store.stored import BLOCK_EVENTS, EpisodeRow, RunningDigest, Span, StoredEvent, consecutive

if TYPE_CHECKING:
    from pycrorm_async.progress_bar import ProgressCallback


# === digest check =============================================================================================
#
# Check the kept digests of episodes against their events, and against digests kept outside of the memory.
#
# Each block is computed from the digest that the log keeps for the block before, so that a change is reported for its
# own block alone. The blocks are those of `store.stored`.

_KEPT = text("""
SELECT episode, sequence, digest FROM pycrorm_digest
WHERE episode >= :first AND episode <= :last AND (episode > :first OR sequence > :after)
AND (episode < :last OR sequence <= :end) ORDER BY episode, sequence""")
_WITHOUT_EPISODE = text("""
SELECT DISTINCT episode FROM pycrorm_digest
WHERE episode >= :first AND episode < :end AND episode NOT IN (SELECT number FROM episode) ORDER BY episode""")
_EVENTS_BEYOND = text("""
SELECT episode, head, max(sequence) FROM pycrorm_digest JOIN episode ON number = episode
WHERE episode >= :first AND episode < :end AND sequence > head GROUP BY episode, head ORDER BY episode""")
_AT = text("SELECT digest FROM pycrorm_digest WHERE episode = :number AND sequence = :sequence")


class OutsideDigest(NamedTuple):
    """A digest kept outside of the memory: of the events 1 to `sequence` of the episode with this UUID."""

    id: str
    sequence: int
    digest: str


class DigestCheck:
    """The check of one episode's digests, up to the last part read. Adds its findings to `result`.

    With `certain`, every writer of a version with digests stores them. On PostgreSQL a login may lack the right to.
    """

    def __init__(self, episode: EpisodeRow, result: VerifyResult, *, certain: bool) -> None:
        self._number = episode.number
        self._result = result
        self._certain = certain
        self._running: RunningDigest | None = RunningDigest.at_start(episode.identity)
        tags = () if episode.ended_wall_ns is None else ("EpisodeTagged",)  # behind the end each has a digest
        self._last_types = ("EpisodeEnded", *tags)
        self._has_digest = False
        self._missing: int | None = None

    def read(
        self,
        span: Span,
        head: int,
        events: Mapping[int, StoredEvent],
        kept: Mapping[int, str],
        checked: EpisodeCheck,
    ) -> None:
        """Check the events of the next span, given by sequence, with the digests kept inside it.

        `head` is the episode's last event in this snapshot; an episode that is being recorded grows meanwhile. If
        damage was reported for an event of a block, the digest of that block is not reported too.
        """
        done = span.after
        block_ends = range(done - done % BLOCK_EVENTS + BLOCK_EVENTS, span.last + 1, BLOCK_EVENTS)
        for end in sorted({*kept, *block_ends, span.last} - {span.after}):
            present = [events[each] for each in range(done + 1, end + 1) if each in events]
            digest = self._digest_behind(present, end - done)
            block = (end - 1) // BLOCK_EVENTS
            last = events.get(end)
            if end in kept:
                self._has_digest = True
                if digest not in (None, kept[end]) and block not in checked.damaged_blocks:
                    self._report(block * BLOCK_EVENTS + 1, end)
            elif end % BLOCK_EVENTS == 0 or (end == head and last is not None and last.type in self._last_types):
                self._missing = self._missing or end
            if end % BLOCK_EVENTS == 0 and end in kept:
                self._running = _behind(kept[end], end)
            done = end
        if span.last == head and self._missing is not None:
            self._report_missing(self._missing, described=checked.described)

    def _digest_behind(self, events: Sequence[StoredEvent], count: int) -> str | None:
        """Add the next `count` events and return the digest; None if one of them is missing, or one before them."""
        if self._running is None or len(events) < count:
            self._running = None
            return None
        completed = self._running.add(events)
        return completed[-1][1] if completed else self._running.digest()

    def _report(self, first: int, last: int) -> None:
        which = f"one of the events {first} to {last}" if last > first else f"event {last}"
        reason = f"{which}, or their digest, was changed after it was stored: the digest does not match"
        self._result.add_damage(self._number, first, reason)

    def _report_missing(self, sequence: int, *, described: bool) -> None:
        if self._has_digest:
            reason = "its digest is missing, although other digests of the episode exist"
            self._result.add_damage(self._number, sequence, reason)
        elif described and self._certain:  # version 0.1.0, which has no digests, cannot store descriptions
            reason = "its digest is missing, although the version that stored the episode keeps digests"
            self._result.add_damage(self._number, sequence, reason)
        else:
            self._result.add_without_digest(self._number)


def _behind(digest: str, sequence: int) -> RunningDigest | None:
    try:
        return RunningDigest(bytes.fromhex(digest), sequence)
    except ValueError:  # it was replaced by another text, which was reported, or is too long for the hash function
        return None


async def read_kept(connection: AsyncConnection, spans: Sequence[Span]) -> dict[int, dict[int, str]]:
    """Read the digests kept in these spans of consecutive episodes, by number and sequence."""
    if not spans or not await has_digests(dialect_of(connection), connection):
        return {}
    first, last = spans[0], spans[-1]
    places = {"first": first.number, "after": first.after, "last": last.number, "end": last.last}
    rows = await connection.execute(_KEPT, places)
    by_number = groupby(rows, key=lambda each: int(each.episode))
    return {number: {each.sequence: each.digest for each in some} for number, some in by_number}


async def check_places(connection: AsyncConnection, limits: Mapping[str, int], result: VerifyResult) -> None:
    """Report digests of events and of episodes that the log does not have: they were deleted."""
    if not await has_digests(dialect_of(connection), connection):
        return
    for (number,) in await connection.execute(_WITHOUT_EPISODE, limits):
        result.add_deleted(number, None, f"episode {number} was deleted: the log has its digests and not its events")
    for number, head, sequence in await connection.execute(_EVENTS_BEYOND, limits):
        reason = f"the events {head + 1} to {sequence} were deleted: a digest at event {sequence} exists"
        result.add_deleted(number, head + 1, reason)


async def check_outside(
    log: EventLog, digests: Iterable[OutsideDigest], result: VerifyResult, episode: EpisodeRow | None
) -> None:
    """Compare the kept digests with digests kept outside of the memory; with `episode`, those of it alone."""
    async with log.snapshot() as connection:
        dialect = dialect_of(connection)
        readable = await has_digests(dialect, connection)
        for each in digests:
            if episode is not None and episode.id != each.id:
                continue
            row = await dialect.episode(connection, each.id)
            if row is None:
                result.add_damage(
                    None, None, f"episode {each.id} is missing: a digest at event {each.sequence} is given"
                )
            elif row.head < each.sequence:
                reason = f"the events {row.head + 1} to {each.sequence} are missing: a digest at the last one is given"
                result.add_damage(row.number, row.head + 1, reason)
            else:
                at = {"number": row.number, "sequence": each.sequence}
                kept = (await connection.execute(_AT, at)).scalar() if readable else None
                if kept != each.digest:
                    fault = "is missing" if kept is None else "differs from the given one"
                    reason = f"the digest at this event {fault}: one of the events 1 to {each.sequence} was changed"
                    result.add_damage(row.number, each.sequence, reason)


# === episode check ============================================================================================
#
# Check one episode of the log part by part: validate its events and fold them again.
#
# Nodes that still run where a part ends, and the episode's row, are carried to the next part. So a part may be any
# piece of an episode, and the memory used does not depend on the episode's length.


class EpisodeCheck:
    """The check of the episode with this number, up to the last part read. Adds its findings to `result`.

    Attributes:
        compared: whether the rows are compared completely, because the tables ended before the last part did.
        carried: ids of the running nodes, which a later part compares.
        descriptions: fingerprints of the stored descriptions.
        damaged_blocks: indexes of the blocks (`store.digests`) with an event for which damage was reported.
        described: whether an object added in the first block names its description.
        head: the episode's last event in the snapshot of the last part read.
    """

    def __init__(self, number: int, result: VerifyResult) -> None:
        self.number = number
        self._result = result
        self.compared = False
        self.carried: frozenset[int] = frozenset()
        self.descriptions: frozenset[str] = frozenset()
        self.damaged_blocks: set[int] = set()
        self.described = False
        self.head = 0
        self._ended_wall_ns: int | None = None
        self._nodes: dict[int, list[Any]] = {}
        self._row: dict[str, Any] | None = None
        self._order: OrderCheck | None = OrderCheck()
        self._in_gap = False
        self._lost: int | None = None
        self._open_when_lost: set[int] = set()

    def resume(self, rows: Rows, after: int, folded: int) -> None:
        """Add the carried rows to those of this part, which follows `after`."""
        if folded < after:  # a rebuild made the tables shorter, so the carried rows are ahead of them
            self.compared = True
            return
        rows.nodes |= self._nodes
        if self._row is not None:
            rows.episodes[self.number] = self._row
            if self._row["simulated"]:
                rows.inserts["simulated_episode"].append((self.number,))

    def read(
        self,
        span: Span,
        events: Mapping[int, StoredEvent],
        episode: EpisodeRow,
        designators: Designators,
        rows: Rows,
    ) -> None:
        """Check the events of a span, given by sequence, and fold those that are visible into `rows`."""
        self.head = episode.head
        folded = 0 if self.compared else episode.folded
        for sequence in range(span.after + 1, span.last + 1):
            event = events.get(sequence)
            if event is not None:
                self._in_gap = False
                self._one(event, folded, designators, rows)
                if sequence == 1 and event.wall_ns != episode.started_wall_ns:
                    self._damaged(1, f"the episode's started_wall_ns is {episode.started_wall_ns}{_OTHER_TIME}")
            elif not self._in_gap:
                self._in_gap = True
                self._damaged(sequence, "is missing")
                self._lose(sequence, folded, rows)
        if span.last < episode.head or self._order is None:
            return
        if self._ended_wall_ns is None and episode.ended_wall_ns is not None:
            evidence = "the episode has an end, and no EpisodeEnded"
            self._result.add_deleted(self.number, span.last + 1, f"it and all behind it were deleted: {evidence}")
        elif self._ended_wall_ns != episode.ended_wall_ns:
            self._damaged(span.last, f"the episode's ended_wall_ns is {episode.ended_wall_ns}{_OTHER_TIME}")

    def leave(self, rows: Rows, after: int, folded: int) -> None:
        """End a part after event `after` of an episode that continues: take the rows to carry out of `rows`."""
        self._nodes, self._row, self.carried = {}, None, frozenset()
        # Tables that end inside this part are compared to their end now, because the next snapshot may have more rows
        # than this part folded.
        self.compared = self.compared or folded < after
        if self.compared:
            return
        first = row_id(self.number, 0, 0)
        self._nodes = {key: row for key, row in rows.nodes.items() if key >= first and row[STATUS] == "RUNNING"}
        self.carried = frozenset(self._nodes)
        self._row = rows.episodes.pop(self.number, None)
        simulated = rows.inserts["simulated_episode"]
        if (self.number,) in simulated:
            simulated.remove((self.number,))

    def hides(self, difference: Difference) -> bool:
        """Return whether to suppress a difference, because lost events make its expected row unknown."""
        if self._lost is None:
            return False
        open_then = difference.table == "task_tree_node" and difference.sequence in self._open_when_lost
        of_whole = difference.table in ("process_metadata", "simulated_episode")
        return difference.sequence >= self._lost or open_then or of_whole

    def _one(self, event: StoredEvent, folded: int, designators: Designators, rows: Rows) -> None:
        shown = event.sequence <= folded
        self._result.events += 1
        self._result.behind += not shown
        if event.type == EpisodeEnded.__name__:
            self._ended_wall_ns = event.wall_ns
        for reference in references_in(event.type, event.payload):
            self._result.blobs.setdefault(reference.hash, (self.number, event.sequence))
        try:
            happening = happening_of(event)
            described = happening.description if isinstance(happening, ObjectAdded) else None
            self.described = self.described or (described is not None and event.sequence <= BLOCK_EVENTS)
            if described is not None and described not in self.descriptions:
                self._damaged(event.sequence, f"the description {described} was never declared")
            if self._order is not None:
                for finding in self._order.read(event.sequence, happening):
                    if finding.kind == "damage":
                        self._damaged(finding.sequence, finding.text)
                    else:
                        self._result.remarks += 1
            if shown and self._lost is None:
                fold_happening(event, happening, designators, rows)
        except Exception as reason:  # noqa: BLE001  one event must not end the check of all others
            # An event that is in the tables could be folded once, so the log has changed since.
            if shown or isinstance(reason, UndecodablePayload) or not isinstance(reason, CannotFold):
                self._damaged(
                    event.sequence,
                    f"is in the tables, and cannot be folded: {_named(reason)}" if shown else _named(reason),
                )
            self._lose(event.sequence, folded, rows)

    def _lose(self, sequence: int, folded: int, rows: Rows) -> None:
        self._order = None
        if sequence <= folded and self._lost is None:
            self._lost = sequence
            keys = (row_key(key) for key, row in rows.nodes.items() if row[STATUS] == "RUNNING")
            self._open_when_lost = {key.sequence for key in keys if key.number == self.number}

    def _damaged(self, sequence: int, reason: str) -> None:
        self.damaged_blocks.add((sequence - 1) // BLOCK_EVENTS)
        self._result.add_damage(self.number, sequence, reason)


_OTHER_TIME = ", and the event has another time: one of them was changed after it was stored"


def _named(reason: Exception) -> str:
    return str(reason) if isinstance(reason, CannotFold) else f"{type(reason).__name__}: {reason}"


# === verify ===================================================================================================
#
# Verify a memory: check that the log is complete, fold it again and compare the tables.
#
# Writes nothing. Each part is read in one snapshot, so that recording and folding continue in the meantime.

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
        await check_outside(log, digests, result, episode)
        total = await _check_heads(log, within, result)
        await within.check(log, _TablesCheck(log, result, total, report_progress))
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
            for name in (await connection.execute(_FINGERPRINTS)).scalars().all():
                [payload] = await dialect.descriptions(connection, [name])  # by its name, which may be damaged too
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
        try:
            generation = await current_generation(connection)
        except TablesOutdated as fault:  # check the log alone
            self.result.outdated = str(fault)
            generation = Generation(0, 0, Layout(), {})
        if generation is None:
            raise DatabaseUnavailable(no_tables(self._log.address))
        if self._comparison is None or self._comparison.generation != generation:
            self._comparison = Comparison(generation, self._dialect.stored_column)
            if self.result.outdated is not None:
                self._comparison.tables.clear()
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
                try:
                    certain = self._log.address.is_sqlite
                    self._digests = DigestCheck(by_number[span.number], self.result, certain=certain)
                except LogDamaged as fault:
                    self._digests = None
                    self.result.add_damage(span.number, fault.sequence, fault.reason)
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
        if self.result.outdated is not None:
            return
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
    clauses = "WHERE number >= :first AND number < :end ORDER BY number LIMIT :limit"
    return await read_episodes(connection, clauses, **within.limits, limit=limit)


async def _designators(connection: AsyncConnection, generation: Generation) -> Designators:
    payloads = await dialect_of(connection).declarations(connection)
    return Designators.of_union(unite(generation.layout, payloads))


# === verify custom ============================================================================================
#
# Fold the log again for a custom projection and compare its tables, in parts of whole episodes.


def check_of(projection: Projection, result: VerifyResult) -> PartCheck:
    """Return the check of the tables of this projection."""
    return projection.check(result) if isinstance(projection, PackedProjection) else ProjectionCheck(projection, result)


async def uncompared_projections(log: EventLog, projections: Sequence[Projection]) -> dict[str, str]:
    """Return the projections of this memory that cannot be compared, by name, with the reasons."""
    by_name = {each.name: each for each in projections}
    async with log.snapshot() as connection:
        generations = projections_in(await read_generations(connection))
        dialect = connection.dialect
    reasons: dict[str, str] = {}
    for name, each in generations.items():
        fault = "its code is not installed here"
        if name in by_name:
            fault = fault_in_version(by_name[name], each, layout_of(by_name[name], dialect)) or ""
        if fault:
            reasons[name] = fault
    return reasons


class ProjectionCheck:
    """The check of the tables of one projection. Implements `PartCheck`; a part consists of whole episodes."""

    def __init__(self, projection: Projection, result: VerifyResult) -> None:
        self._projection = projection
        self.result = result
        name = projection.name
        self.missing_table = f"a table of the projection {name} is missing: run `pycrorm rebuild {name}`"

    async def comparison(self, connection: AsyncConnection) -> Comparison | None:
        generation = projections_in(await read_generations(connection)).get(self._projection.name)
        if generation is None or generation.version != self._projection.version:
            return None
        comparison = Comparison(generation, dialect_of(connection).stored_column, {})
        comparison.tables.append(self._place(generation))
        return comparison

    async def check(
        self, connection: AsyncConnection, comparison: Comparison, at: Place, within: EpisodeRange, limit: int
    ) -> Place | None:
        place = self._place(comparison.generation)
        folded = await _folded(connection, place, within._replace(first=at.number), limit)
        payloads = await dialect_of(connection).declarations(connection)
        _, batch = learner_of(self._projection)(comparison.generation.layout, payloads)
        rows = batch()
        findings: list[Difference] = []
        count = 0
        following = within.end
        for number, last in folded:
            if count >= limit:
                following = number
                break
            fault = await _fold_again(connection, rows, Span(number, 0, last), limit)
            count += last
            if fault is not None:
                sequence, reason = fault
                stored = "folded in the tables"
                findings.append(
                    Difference(number, sequence, self._projection.name, "fold", stored, f"parked: {reason}")
                )
        else:
            if len(folded) == limit:
                following = folded[-1][0] + 1
        lost = {each.number for each in findings}
        differences = await self.differences(connection, comparison, rows, EpisodeRange(at.number, following))
        for each in (*findings, *(each for each in differences if each.number not in lost)):
            self.result.add_difference(each._replace(table=each.table.removeprefix(OWN)))
        return None if following is None or following == within.end else Place(following)

    async def differences(
        self, connection: AsyncConnection, comparison: Comparison, rows: Batch, episodes: EpisodeRange
    ) -> Sequence[Difference]:
        """Compare the tables with the rows that the events of these episodes make; count the stored rows."""
        assert isinstance(rows, CustomRows)
        last = None if episodes.end is None else row_id_min(episodes.end)
        within = Range(row_id_min(episodes.first) or None, last, None, None)
        differences = await comparison.differences(connection, rows, within, carried=(), settled=())
        self.result.rows += comparison.count
        return differences

    def _place(self, generation: Generation) -> str:
        return pipeline.place_of(generation.number, self._projection.name)


async def _folded(connection: AsyncConnection, place: str, within: EpisodeRange, limit: int) -> list[tuple[int, int]]:
    """Return number and checkpoint of each episode."""
    rows = await connection.execute(
        text(f"SELECT id, folded FROM {place} WHERE id >= :first AND id < :end ORDER BY id LIMIT :limit"),  # noqa: S608
        {**within.limits, "limit": limit},
    )
    return [(each.id, each.folded) for each in rows]


async def _fold_again(connection: AsyncConnection, rows: Batch, span: Span, limit: int) -> tuple[int, str] | None:
    """Fold an episode again; return the first event that cannot be folded, with the reason."""
    for after in range(0, span.last, limit):
        page = Span(span.number, after, min(after + limit, span.last))
        whole = consecutive(await dialect_of(connection).spans(connection, [page]), after)
        if whole and (refused := rows.fold(whole)) is not None:
            return refused
        if after + len(whole) < page.last:
            return after + len(whole) + 1, "it is missing in the log"
    return None
