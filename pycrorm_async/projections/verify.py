"""Verify the log and compare the tables with it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DamageError, DatabaseForeign, DatabaseUnavailable, LogDamaged, TablesOutdated
from pycrorm_async.events.codec import DESCRIPTION_PREFIX, fingerprint
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, row_key
from pycrorm_async.events.order import OrderCheck
from pycrorm_async.events.types import EpisodeEnded, Happening, ObjectAdded, references_in
from pycrorm_async.projections import custom, custom_tables, findings, fold, pipeline
from pycrorm_async.projections import generations as table_generations
from pycrorm_async.projections.columns import OWN, Layout, unite
from pycrorm_async.projections.row_batch import STATUS, CannotFold, Designators, Rows
from pycrorm_async.store import schema, stored
from pycrorm_async.store.address import no_tables
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog

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
WHERE episode BETWEEN :first AND :last ORDER BY episode, sequence""")
_WITHOUT_EPISODE = text("""
SELECT DISTINCT episode FROM pycrorm_digest WHERE episode BETWEEN :first AND :last
AND NOT EXISTS (SELECT 1 FROM episode WHERE number = pycrorm_digest.episode) ORDER BY episode""")
_EVENTS_BEYOND = text("""
SELECT episode, head, max(sequence) FROM pycrorm_digest JOIN episode ON number = episode
WHERE episode BETWEEN :first AND :last AND sequence > head GROUP BY episode, head ORDER BY episode""")
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

    def __init__(self, episode: stored.EpisodeRow, result: findings.VerifyResult, *, certain: bool) -> None:
        self._number = episode.number
        self._result = result
        self._certain = certain
        self._running: stored.RunningDigest | None = stored.RunningDigest.at_start(episode.identity)
        tags = () if episode.ended_wall_ns is None else ("EpisodeTagged",)  # behind the end each has a digest
        self._last_types = ("EpisodeEnded", *tags)
        self._has_digest = False
        self._missing: int | None = None

    def read(
        self,
        span: stored.Span,
        head: int,
        events: Mapping[int, stored.StoredEvent],
        kept: Mapping[int, str],
        checked: EpisodeCheck,
    ) -> None:
        """Check the events of the next span, given by sequence, with the kept digests of the episode.

        `head` is the episode's last event in this snapshot; an episode that is being recorded grows meanwhile. If
        damage was reported for an event of a block, the digest of that block is not reported too.
        """
        done = span.after
        block_ends = range(done - done % stored.BLOCK_EVENTS + stored.BLOCK_EVENTS, span.last + 1, stored.BLOCK_EVENTS)
        ends = {each for each in kept if span.after < each <= span.last}
        for end in sorted({*ends, *block_ends, span.last} - {span.after}):
            present = [events[each] for each in range(done + 1, end + 1) if each in events]
            digest = self._digest_behind(present, end - done)
            block = (end - 1) // stored.BLOCK_EVENTS
            last = events.get(end)
            if end in kept:
                self._has_digest = True
                if digest not in (None, kept[end]) and block not in checked.damaged_blocks:
                    self._report(block * stored.BLOCK_EVENTS + 1, end)
            elif end % stored.BLOCK_EVENTS == 0 or (end == head and last is not None and last.type in self._last_types):
                self._missing = self._missing or end
            if end % stored.BLOCK_EVENTS == 0 and end in kept:
                self._running = _behind(kept[end], end)
            done = end
        if span.last == head and self._missing is not None:
            self._report_missing(self._missing, described=checked.described)

    def _digest_behind(self, events: Sequence[stored.StoredEvent], count: int) -> str | None:
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


def _behind(digest: str, sequence: int) -> stored.RunningDigest | None:
    try:
        return stored.RunningDigest(bytes.fromhex(digest), sequence)
    except ValueError:  # it was replaced by another text, which was reported, or is too long for the hash function
        return None


async def _has_digests(connection: AsyncConnection) -> bool:
    return (await dialect_of(connection).table_state(connection, schema.DIGEST)).readable


async def read_kept(connection: AsyncConnection, episodes: findings.EpisodeRange) -> dict[int, dict[int, str]]:
    """Read the digests kept of these episodes, by number and sequence."""
    if not await _has_digests(connection):
        return {}
    rows = await connection.execute(_KEPT, episodes.limits)
    by_number = groupby(rows, key=lambda each: int(each.episode))
    return {number: {each.sequence: each.digest for each in some} for number, some in by_number}


async def check_places(connection: AsyncConnection, limits: Mapping[str, int], result: findings.VerifyResult) -> None:
    """Report digests of events and of episodes that the log does not have: they were deleted."""
    if not await _has_digests(connection):
        return
    for (number,) in await connection.execute(_WITHOUT_EPISODE, limits):
        result.add_deleted(number, None, f"episode {number} was deleted: the log has its digests and not its events")
    for number, head, sequence in await connection.execute(_EVENTS_BEYOND, limits):
        reason = f"the events {head + 1} to {sequence} were deleted: a digest at event {sequence} exists"
        result.add_deleted(number, head + 1, reason)


async def check_outside(
    log: EventLog, digests: Iterable[OutsideDigest], result: findings.VerifyResult, episode: stored.EpisodeRow | None
) -> None:
    """Compare the kept digests with digests kept outside of the memory; with `episode`, those of it alone."""
    async with log.snapshot() as connection:
        readable = await _has_digests(connection)
        for each in digests:
            if episode is not None and episode.id != each.id:
                continue
            heads = await dialect_of(connection).rows(
                connection, stored.EpisodeRow, schema.SELECT_HEADS, ids=[(each.id,)]
            )
            row: stored.EpisodeRow | None = next(iter(heads), None)
            gone = await dialect_of(connection).removed(connection, schema.SELECT_REMOVED_BY_ID, ids=[(each.id,)])
            if gone and (gone[0].head, gone[0].digest) == (each.sequence, each.digest):
                continue  # it was the same when it was removed
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
# Check one episode of the log page by page: validate its events and fold them again.


@dataclass(slots=True)
class EpisodeCheck:
    """The check of one episode, up to the last page read. Adds its findings to the result, and its rows to the rows.

    Attributes:
        damaged_blocks: indexes of the blocks (`store.stored`) with an event for which damage was reported.
        described: whether an object added in the first block names its description.
    """

    _episode: stored.EpisodeRow
    _result: findings.VerifyResult
    _designators: Designators
    _rows: Rows
    _descriptions: Collection[str]
    damaged_blocks: set[int] = field(default_factory=set)
    described: bool = False
    _ended_wall_ns: int | None = None
    _order: OrderCheck | None = field(default_factory=OrderCheck)
    _in_gap: bool = False
    _lost: int | None = None
    _open_when_lost: set[int] = field(default_factory=set)

    @property
    def head(self) -> int:
        """The episode's last event."""
        return self._episode.head

    def read(
        self,
        span: stored.Span,
        events: Mapping[int, stored.StoredEvent],
        happenings: Mapping[int, Happening | Exception],
    ) -> None:
        """Check the events of the next span, given by sequence, and fold those that are visible."""
        episode = self._episode
        for sequence in range(span.after + 1, span.last + 1):
            event = events.get(sequence)
            if event is not None:
                self._in_gap = False
                self._one(event, happenings[sequence])
                if sequence == 1 and event.wall_ns != episode.started_wall_ns:
                    self._damaged(1, f"the episode's started_wall_ns is {episode.started_wall_ns}{_OTHER_TIME}")
            elif not self._in_gap:
                self._in_gap = True
                self._damaged(sequence, "is missing")
                self.lose(sequence)
        if span.last < episode.head or self._order is None:
            return
        if self._ended_wall_ns is None and episode.ended_wall_ns is not None:
            reason = "it and all behind it were deleted: the episode has an end, and no EpisodeEnded"
            self._result.add_deleted(episode.number, span.last + 1, reason)
        elif self._ended_wall_ns != episode.ended_wall_ns:
            self._damaged(span.last, f"the episode's ended_wall_ns is {episode.ended_wall_ns}{_OTHER_TIME}")

    def hides(self, difference: findings.TableDifference) -> bool:
        """Return whether to suppress a difference, because lost events make its expected row unknown."""
        if self._lost is None:
            return False
        open_then = difference.table == "task_tree_node" and difference.sequence in self._open_when_lost
        of_whole = difference.table in ("process_metadata", "simulated_episode")
        return difference.sequence >= self._lost or open_then or of_whole

    def _one(self, event: stored.StoredEvent, happening: Happening | Exception) -> None:
        shown = event.sequence <= self._episode.folded
        self._result.events += 1
        self._result.behind += not shown
        if event.type == EpisodeEnded.__name__:
            self._ended_wall_ns = event.wall_ns
        for reference in references_in(event.type, event.payload):
            self._result.blobs.setdefault(reference.hash, (self._episode.number, event.sequence))
        try:
            if isinstance(happening, Exception):
                raise happening  # noqa: TRY301  one that folding raises is reported alike
            described = happening.description if isinstance(happening, ObjectAdded) else None
            self.described = self.described or (described is not None and event.sequence <= stored.BLOCK_EVENTS)
            if described is not None and described not in self._descriptions:
                self._damaged(event.sequence, f"the description {described} was never declared")
            if self._order is not None:
                for finding in self._order.read(event.sequence, happening):
                    if finding.kind == "damage":
                        self._damaged(finding.sequence, finding.text)
                    else:
                        self._result.remarks += 1
            if shown and self._lost is None:
                fold.fold_happening(event, happening, self._designators, self._rows)
        except Exception as reason:  # noqa: BLE001  one event must not end the check of all others
            # An event that is in the tables could be folded once, so the log has changed since.
            if shown or isinstance(reason, fold.UndecodablePayload) or not isinstance(reason, CannotFold):
                self._damaged(
                    event.sequence,
                    f"is in the tables, and cannot be folded: {_named(reason)}" if shown else _named(reason),
                )
            self.lose(event.sequence)

    def lose(self, sequence: int) -> None:
        """Stop to check the order of the events and to fold them, because this one cannot be read or folded."""
        self._order = None
        if sequence <= self._episode.folded and self._lost is None:
            self._lost = sequence
            keys = (row_key(key) for key, row in self._rows.nodes.items() if row[STATUS] == "RUNNING")
            self._open_when_lost = {key.sequence for key in keys if key.number == self._episode.number}

    def _damaged(self, sequence: int, reason: str) -> None:
        self.damaged_blocks.add((sequence - 1) // stored.BLOCK_EVENTS)
        self._result.add_damage(self._episode.number, sequence, reason)


_OTHER_TIME = ", and the event has another time: one of them was changed after it was stored"


def _named(reason: Exception) -> str:
    return str(reason) if isinstance(reason, CannotFold) else f"{type(reason).__name__}: {reason}"


# === verify ===================================================================================================
#
# Verify a memory: check that the log is complete, fold it again and compare the tables.
#
# Writes nothing. A part consists of whole episodes and is read in one snapshot, so that recording and folding continue
# meanwhile. Its events are read once for all tables.

_PART_EVENTS = 4_000
"""The events of a part, unless one episode has more: the memory that verify uses grows with the longest episode."""
_PAGE_EVENTS = 4_000
"""Bounds the events that are read at once."""

_FINGERPRINTS = text("SELECT fingerprint FROM pycrorm_declaration ORDER BY ordinal")
_DESCRIPTIONS = text(
    f"SELECT fingerprint FROM pycrorm_declaration WHERE substr(fingerprint, 1, 5) = '{DESCRIPTION_PREFIX}'"  # noqa: S608
)
_TOTAL = text("SELECT coalesce(sum(head), 0) FROM episode WHERE number BETWEEN :first AND :last")
# Looks up the index once for each gap between two episodes, because reading every event would take minutes.
_GAPS = text("""
SELECT number, following FROM (
    SELECT number, lead(number, 1, CAST(:end AS BIGINT)) OVER (ORDER BY number) AS following
    FROM (SELECT number FROM episode UNION ALL SELECT CAST(:first AS BIGINT)) AS known
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
    FROM episode WHERE number BETWEEN :first AND :last
) AS each_episode WHERE first < 1 OR last > head ORDER BY number""")


async def verify(
    log: EventLog,
    *,
    episode: stored.EpisodeRow | None = None,
    projections: Sequence[custom.Projection] = (),
    digests: Iterable[OutsideDigest] = (),
    report_progress: ProgressCallback = lambda _done, _total, _what=None: None,
) -> findings.VerifyResult:
    """Verify a whole memory, or one episode.

    Args:
        log: may be open for reading only.
        episode: to verify; all of them if None.
        projections: custom projections whose tables are compared too.
        digests: kept outside of the memory, with which those in the log are compared.
        report_progress: called with the number of events checked and their total.

    Raises `DatabaseForeign` for tables of a newer version, `DatabaseUnavailable` for a memory without tables.
    """
    result = findings.VerifyResult()
    within = findings.EpisodeRange() if episode is None else findings.EpisodeRange(episode.number, episode.number + 1)
    with log.translated():
        if episode is None:
            removed = await log.all_removed()
            result.archived = sum(each.archived_in is not None for each in removed)
            result.erased = len(removed) - result.archived
            await _check_database(log, result)
            result.unmade = await table_generations.unmade_types(log)
            result.failed_views = await table_generations.failed_views(log)
        result.stopped = await _stopped(log, episode)
        await check_outside(log, digests, result, episode)
        total = await _check_heads(log, within, result)
        result.not_compared = await uncompared_projections(log, projections)
        compared = [each for each in projections if each.name not in result.not_compared]
        checks = [_TablesCheck(log, result), *(check_of(each, result) for each in compared)]
        left: findings.EpisodeRange | None = within
        while left is not None:
            left = await _check_part(log, left, checks, result)
            report_progress(result.events, max(total, result.events))
        await _check_blobs(log, result)
    return result


async def _check_part(
    log: EventLog, within: findings.EpisodeRange, checks: Sequence[findings.TableCheck], result: findings.VerifyResult
) -> findings.EpisodeRange | None:
    """Check the next whole episodes in one snapshot; return the range that is left. Raises `DatabaseForeign`."""
    async with log.snapshot() as connection:
        limits = {**within.limits, "limit": _PART_EVENTS}
        episodes = await dialect_of(connection).rows(connection, stored.EpisodeRow, schema.SELECT_EPISODES, **limits)
        episodes, left = _first_part(episodes, within)
        part = within if left is None else findings.EpisodeRange(within.first, left.first)
        for check in checks:
            if not await check.begin(connection, part, episodes):
                raise DatabaseForeign(f"{log.address}: {check.missing_table}")
        result.episodes += len(episodes)
        await _read_part(log, connection, episodes, checks, result)
        for check in checks:
            try:
                with log.translated():
                    async with connection.begin_nested():
                        await check.compare(connection)
            except DamageError as fault:
                result.add_damage(None, None, str(fault))
    return left


def _first_part(
    episodes: list[stored.EpisodeRow], within: findings.EpisodeRange
) -> tuple[list[stored.EpisodeRow], findings.EpisodeRange | None]:
    """Return the episodes of the next part, at least one if there is any, and the range behind them, if any."""
    events = 0
    for place, row in enumerate(episodes):
        events += row.head
        if place and events > _PART_EVENTS:
            return episodes[:place], within._replace(first=row.number)
    if len(episodes) < _PART_EVENTS or episodes[-1].number == EPISODE_NUMBER_MAX:
        return episodes, None
    return episodes, within._replace(first=episodes[-1].number + 1)


async def _read_part(
    log: EventLog,
    connection: AsyncConnection,
    episodes: Sequence[stored.EpisodeRow],
    checks: Sequence[findings.TableCheck],
    result: findings.VerifyResult,
) -> None:
    """Give the events of these episodes to the checks, page by page; report those that cannot be read."""
    unreadable: set[int] = set()
    for page in stored.pages_of([stored.Span(each.number, 0, each.head) for each in episodes], _PAGE_EVENTS):
        spans = [each for each in page if each.number not in unreadable]
        faults: list[findings.Unreadable] = []
        events = await _readable_events(log, connection, spans, faults)
        by_number: dict[int, tuple[Sequence[stored.StoredEvent], Sequence[Happening | Exception]]] = {}
        for number, each in groupby(events, key=attrgetter("number")):
            some = [*each]
            by_number[number] = some, [*map(_happening_or_fault, some)]
        ends = {each.number: each.sequence for each in faults}
        for span in spans:
            read = span._replace(last=ends.get(span.number, span.last + 1) - 1)
            for check in checks:
                check.read(read, *by_number.get(span.number, ((), ())))
        for fault in faults:
            unreadable.add(fault.number)
            result.add_damage(fault.number, fault.sequence, f"cannot be read: {fault}")
            for check in checks:
                check.lose(fault.number, fault.sequence)


def _happening_or_fault(event: stored.StoredEvent) -> Happening | Exception:
    try:
        return fold.happening_of(event)
    except Exception as fault:  # noqa: BLE001  reported by each check that reads the event
        return fault


async def _readable_events(
    log: EventLog, connection: AsyncConnection, spans: Sequence[stored.Span], faults: list[findings.Unreadable]
) -> list[stored.StoredEvent]:
    """Read the events of these spans; of an episode with an unreadable one, those before it, and add its fault."""
    try:
        with log.translated():
            async with connection.begin_nested():
                return await dialect_of(connection).spans(connection, spans)
    except DamageError as fault:
        if stored.size_of(spans) == 1:
            faults.append(findings.Unreadable(spans[0].number, spans[0].last, str(fault)))
            return []
    events: list[stored.StoredEvent] = []
    for half in stored.pages_of(spans, (stored.size_of(spans) + 1) // 2):
        lost = {each.number for each in faults}
        if left := [each for each in half if each.number not in lost]:
            events += await _readable_events(log, connection, left, faults)
    return events


async def _check_database(log: EventLog, result: findings.VerifyResult) -> None:
    """Check the database's pages, the declarations, and events that belong to no episode."""
    try:
        async with log.snapshot() as connection:
            dialect = dialect_of(connection)
            for reason in await dialect.faults_of_file(connection):
                result.add_damage(None, None, reason)
            for name in (await connection.execute(_FINGERPRINTS)).scalars().all():
                is_description = name.startswith(DESCRIPTION_PREFIX)
                kind = "DescriptionDeclared" if is_description else "DesignatorTypeDeclared"
                [payload] = await dialect.descriptions(connection, [name])  # by its name, which may be damaged too
                if fingerprint(payload, kind) != name:
                    noun = "description" if is_description else "declaration"
                    result.add_damage(None, None, f"the {noun} {name} does not match its fingerprint")
                for reference in references_in(kind, payload):
                    result.blobs.setdefault(reference.hash, (None, None))
            for number in await _numbers_without_episode(connection):
                result.add_damage(None, None, f"there are events of an episode {number}, which is not in the log")
    except DamageError as fault:
        result.add_damage(None, None, str(fault))


async def _check_blobs(log: EventLog, result: findings.VerifyResult) -> None:
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


async def _stopped(log: EventLog, episode: stored.EpisodeRow | None) -> list[findings.StoppedEpisode]:
    """Return the parked and refused episodes."""
    rows = [each for each in await log.stopped() if episode is None or each.number == episode.number]
    refused = [findings.StoppedEpisode(each.number, "refused", each.refused) for each in rows if each.refused]
    parked = [findings.StoppedEpisode(each.number, "parked", each.parked) for each in rows if each.parked]
    return sorted(refused + parked, key=lambda each: each.number)


async def _check_heads(log: EventLog, within: findings.EpisodeRange, result: findings.VerifyResult) -> int:
    """Return the number of events that the episodes must have; report events outside of that range."""
    async with log.snapshot() as connection:
        for number, head, lowest, highest in await connection.execute(_BEYOND, within.limits):
            for sequence in sorted({lowest, highest}):
                if not 1 <= sequence <= head:
                    result.add_damage(number, sequence, f"exists, but the episode must end with event {head}")
        await check_places(connection, within.limits, result)
        return int((await connection.execute(_TOTAL, within.limits)).scalar_one())


class _TablesCheck:
    """The check of the log and of the built-in tables. Implements `TableCheck`."""

    missing_table = "a table is missing: run `pycrorm rebuild`, or verify again if a rebuild has just ended"

    def __init__(self, log: EventLog, result: findings.VerifyResult) -> None:
        self._log = log
        self._result = result
        self._comparison: findings.Comparison | None = None
        self._part = findings.EpisodeRange()
        self._rows = Rows()
        self._episodes: dict[int, EpisodeCheck] = {}
        self._digests: dict[int, DigestCheck] = {}
        self._kept: dict[int, dict[int, str]] = {}

    async def begin(
        self, connection: AsyncConnection, part: findings.EpisodeRange, episodes: Sequence[stored.EpisodeRow]
    ) -> bool:
        try:
            generation = await table_generations.current_generation(connection)
        except TablesOutdated as fault:  # check the log alone
            self._result.outdated = str(fault)
            generation = table_generations.Generation(0, 0, Layout(), {})
        if generation is None:
            raise DatabaseUnavailable(no_tables(self._log.address))
        dialect = dialect_of(connection)
        if self._comparison is None or self._comparison.generation != generation:
            self._comparison = findings.Comparison(generation, dialect.stored_column)
        if self._result.outdated is None and not await dialect.keep(connection, self._comparison.tables):
            return False
        self._part, self._rows, self._episodes, self._digests = part, Rows(), {}, {}
        self._kept = await read_kept(connection, part)
        designators = Designators.of_union(unite(generation.layout, await dialect.declarations(connection)))
        descriptions = frozenset((await connection.execute(_DESCRIPTIONS)).scalars())
        for each in episodes:
            self._episodes[each.number] = EpisodeCheck(each, self._result, designators, self._rows, descriptions)
            try:
                certain = self._log.address.is_sqlite
                self._digests[each.number] = DigestCheck(each, self._result, certain=certain)
            except LogDamaged as fault:
                self._result.add_damage(each.number, fault.sequence, fault.reason)
        return True

    def read(
        self, span: stored.Span, events: Sequence[stored.StoredEvent], happenings: Sequence[Happening | Exception]
    ) -> None:
        by_sequence = {each.sequence: each for each in events}
        episode, digests = self._episodes[span.number], self._digests.get(span.number)
        episode.read(span, by_sequence, dict(zip(by_sequence, happenings, strict=True)))
        if digests is not None:
            digests.read(span, episode.head, by_sequence, self._kept.get(span.number, {}), episode)

    def lose(self, number: int, sequence: int) -> None:
        self._episodes[number].lose(sequence)

    async def compare(self, connection: AsyncConnection) -> None:
        comparison, rows = self._comparison, self._rows
        assert comparison is not None, "the check has begun"
        if self._result.outdated is not None:
            return
        if rows.episodes:
            fold.name_episodes(rows, await fold.uuids_of(connection, rows.episodes))
        differences = await comparison.differences(connection, rows.to_insert(), self._part)
        if rows.descriptions:
            boxes = await fold.boxes_of(connection, rows.descriptions)
            differences += await comparison.box_differences(connection, boxes)
        self._result.rows += comparison.count
        for each in sorted(differences, key=attrgetter("number", "sequence")):
            if each.number not in self._episodes or not self._episodes[each.number].hides(each):
                self._result.add_difference(each)
        self._check_superfluous([each for each in differences if each.is_superfluous and each.number])

    def _check_superfluous(self, rows: Iterable[findings.TableDifference]) -> None:
        """Report the events and episodes that the log does not have, although the tables have their rows."""
        last: dict[int, int] = {}
        read = self._episodes
        for each in rows:
            if each.number not in read or each.sequence > read[each.number].head:
                last[each.number] = max(each.sequence, last.get(each.number, 0))
                self._result.rows_without_event += 1
        for number, sequence in last.items():
            if number not in read:
                reason = f"episode {number} was deleted: the tables have rows of its events up to {sequence}"
                self._result.add_deleted(number, None, f"{reason}, and the log has none of them")
            else:
                first = read[number].head + 1
                reason = f"the events {first} to {sequence} were deleted: the tables have rows of event {sequence}"
                self._result.add_deleted(number, first, reason)


# === verify custom ============================================================================================
#
# Compare the tables of a custom projection with the log.


def check_of(projection: custom.Projection, result: findings.VerifyResult) -> findings.TableCheck:
    """Return the check of the tables of this projection."""
    return (
        projection.check(result)
        if isinstance(projection, custom.PackedProjection)
        else ProjectionCheck(projection, result)
    )


async def uncompared_projections(log: EventLog, projections: Sequence[custom.Projection]) -> dict[str, str]:
    """Return the projections of this memory that cannot be compared, by name, with the reasons."""
    async with log.snapshot() as connection:
        generations = table_generations.projections_in(await table_generations.read_generations(connection))
        dialect = connection.dialect
    reasons: dict[str, str | None] = dict.fromkeys(generations, "its code is not installed here")
    for each in projections:
        if (generation := generations.get(each.name)) is not None:
            layout = custom_tables.layout_of(each, dialect)
            reasons[each.name] = custom_tables.fault_in_version(each, generation, layout)
    return {name: reason for name, reason in reasons.items() if reason is not None}


class ProjectionCheck:
    """The check of the tables of one projection. Implements `TableCheck`."""

    def __init__(self, projection: custom.Projection, result: findings.VerifyResult) -> None:
        self._projection = projection
        self.result = result
        name = projection.name
        advice = f"run `pycrorm rebuild {name}`, or verify again if a rebuild has just ended"
        self.missing_table = f"a table of the projection {name} is missing: {advice}"
        self._comparison: findings.Comparison | None = None
        self._part = findings.EpisodeRange()
        self._folded: dict[int, int] = {}
        self._refused: dict[int, findings.TableDifference] = {}
        self._lost: set[int] = set()

    async def begin(
        self, connection: AsyncConnection, part: findings.EpisodeRange, _: Sequence[stored.EpisodeRow]
    ) -> bool:
        dialect, name = dialect_of(connection), self._projection.name
        generation = table_generations.projections_in(await table_generations.read_generations(connection)).get(name)
        self._comparison = None
        if generation is None or generation.version != self._projection.version:  # another program has rebuilt it
            return True
        comparison = findings.Comparison(generation, dialect.stored_column, {})
        place = pipeline.place_of(generation.number, name)
        if not await dialect.keep(connection, [*comparison.tables, place]):
            return False
        clauses = "WHERE id BETWEEN :first AND :last"
        checkpoints = await connection.execute(text(f"SELECT id, folded FROM {place} {clauses}"), part.limits)  # noqa: S608
        self._folded = {each.id: each.folded for each in checkpoints}
        learn = custom_tables.learner_of(self._projection)
        batch = learn(generation.layout, await dialect.declarations(connection))[1]
        self._comparison, self._part, self._rows = comparison, part, batch()
        self._refused, self._lost = {}, set()
        return True

    def read(
        self, span: stored.Span, events: Sequence[stored.StoredEvent], happenings: Sequence[Happening | Exception]
    ) -> None:
        number, after, last = span
        count = min(last, self._folded.get(number, 0)) - after
        if self._comparison is None or number in self._refused or count <= 0:
            return
        whole = stored.consecutive(events, after)[:count]
        decoded: list[Happening | None] = []
        fault: tuple[int, str] | None = None
        for event, each in zip(whole, happenings, strict=False):
            if not isinstance(each, Exception):
                decoded.append(each)
            elif self._rows.reads is None or event.type in self._rows.reads:
                fault = event.sequence, str(each)
                break
            else:
                decoded.append(None)
        refused = (self._rows.fold(whole[: len(decoded)], decoded) if decoded else None) or fault
        if refused is None and len(whole) < count:
            refused = after + len(whole) + 1, "it is missing in the log"
        if refused is not None:
            sequence, reason = refused
            self._refused[number] = findings.TableDifference(
                number, sequence, self._projection.name, "fold", "folded in the tables", f"parked: {reason}"
            )

    def lose(self, number: int, sequence: int) -> None:  # noqa: ARG002 - of the protocol
        self._lost.add(number)

    async def compare(self, connection: AsyncConnection) -> None:
        if self._comparison is None:
            return
        differences = await self.differences(connection, self._comparison, self._rows, self._part)
        hidden = self._lost | self._refused.keys()
        for each in (*self._refused.values(), *(each for each in differences if each.number not in hidden)):
            self.result.add_difference(each._replace(table=each.table.removeprefix(OWN)))

    async def differences(
        self,
        connection: AsyncConnection,
        comparison: findings.Comparison,
        rows: fold.Batch,
        episodes: findings.EpisodeRange,
    ) -> Sequence[findings.TableDifference]:
        """Compare the tables with the rows that the events of these episodes make; count the stored rows."""
        assert isinstance(rows, custom.CustomRows)
        differences = await comparison.differences(connection, rows.to_insert(), episodes)
        self.result.rows += comparison.count
        return differences
