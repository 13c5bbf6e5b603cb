"""Append a batch to the log in a handful of statements and one transaction, however many records it has.

    appending = Appending(dialect, records)
    await appending.prepare(reading)
    stored = await appending.write(writing)

**Theory of operation.** SQLite admits one writing transaction at a time, so the time inside it delays every other
writer. `prepare` therefore reads the episodes' rows in a reading transaction and builds the insert statements from
them. Between `prepare` and `write` another process may append to the same episodes. `write` reads the rows again under
the write lock (on PostgreSQL under row locks), where no process can change them, and builds the statements again if a
row differs. So `prepare` affects only the speed, never the result.

`write` stores the batch whole or not at all: the caller commits its transaction. It stores declarations first, then the
episode rows, then the new events. Events at or below an episode's head are repeats; `write` compares them with the
stored bytes and raises `LogDamaged` if one differs. A transaction that stores no event still writes a record, so that
its COMMIT is as durable as the one that stored the repeats.

A caller may name a witness, an episode with the head that the log confirmed. If the log now holds less of it, the log
went back, and `write` raises `LogWentBack` before it stores an event.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import InitVar, dataclass, field
from hashlib import sha256
from itertools import pairwise
from typing import Final, NamedTuple, Protocol

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import DamageError, InternalError, LogDamaged, LogWentBack
from pycrorm_async.events.codec import DECLARATION_TYPES, Record, fingerprint, is_computed_end
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX, EpisodeId, episode_text
from pycrorm_async.events.types import REFERRING, Blob, BlobReference, references_in
from pycrorm_async.store import schema
from pycrorm_async.store import stored as storeds
from pycrorm_async.store.dialect import DECLARATIONS, Dialect, Insertion, RowRefused

# === append rules =============================================================================================
#
# Decide about each record of a batch: new, repeated or refused, and why. Pure.
#
# An episode's events are stored without a gap: the next accepted sequence is always `head + 1`. A record at or below
# the head is a repeat, to be compared with the stored event. The first record that cannot be accepted stops the episode
# for this batch: the records before it are stored, the reason is kept, and other episodes are not affected.
#
# An end that recovery computed is not a repeat, because a folder that was damaged or restored from a backup may lack
# events that the log holds. Such an end follows the log's last event; it is left out if the log holds an end already or
# waits for missing events.

_CHECKED_AT_ONCE: Final = 256
"""Bounds the payloads that are joined to be checked by one call, so that they stay in the processor's cache: joining
10,000 takes five times as long."""


@dataclass(frozen=True, slots=True)
class EpisodeStep:
    """The effect of a batch on one episode: the row afterwards, the records to insert, and the repeats to compare.

    `skipped_ends` counts the computed ends that are left out.
    """

    after: storeds.EpisodeRow
    fresh: list[Record]
    again: list[Record] = field(default_factory=list)
    skipped_ends: int = 0


def sort(records: Iterable[Record]) -> tuple[dict[str, bytes], dict[EpisodeId, list[Record]]]:
    """Split a batch into declarations, by fingerprint, and episodes, each in the order of arrival.

    Raises `DamageError` for a record without an episode that is not a declaration.
    """
    declarations: dict[str, bytes] = {}
    episodes: dict[EpisodeId, list[Record]] = {}
    for record in records:
        episode = record.episode
        if episode is None:
            declared = _declaration(record)
            declarations[fingerprint(declared, record.type)] = declared
        elif episode in episodes:
            episodes[episode].append(record)
        else:
            episodes[episode] = [record]
    return declarations, episodes


def step(records: Sequence[Record], row: storeds.EpisodeRow) -> EpisodeStep:
    """Compute the effect of these records, all of one episode, on its row."""
    first = records[0].sequence
    if first == row.head + 1 and _is_whole(records):
        return EpisodeStep(_advanced(row, records, refused=None), list(records))
    return _careful_step(records, row)


def _careful_step(records: Sequence[Record], row: storeds.EpisodeRow) -> EpisodeStep:
    fresh: list[Record] = []
    again: list[Record] = []
    refused: str | None = None
    skipped_ends = 0
    expected = row.head + 1
    for record in records:
        if record.sequence < expected:
            if not is_computed_end(record):
                again.append(record)
                continue
            if row.ended_wall_ns is not None or row.refused is not None:
                skipped_ends += 1
                continue
            record = record._replace(sequence=expected)
        refused = _refusal(record, expected)
        if refused is not None:
            break
        fresh.append(record)
        expected += 1
    return EpisodeStep(_advanced(row, fresh, refused=refused), fresh, again, skipped_ends)


def _refusal(record: Record, expected: int) -> str | None:
    if record.sequence > expected:
        missing = (
            f"event {expected}" if record.sequence == expected + 1 else f"events {expected} to {record.sequence - 1}"
        )
        return f"{missing} did not arrive before event {record.sequence}"
    if record.sequence > SEQUENCE_MAX:
        return f"event {record.sequence}: an episode holds at most {SEQUENCE_MAX:,} events"
    if not _is_text(record.payload):
        return f"event {record.sequence}: its payload is not text that a database can hold"
    return None


def _advanced(row: storeds.EpisodeRow, fresh: Sequence[Record], *, refused: str | None) -> storeds.EpisodeRow:
    if not fresh:  # repeats alone do not end an earlier refusal
        return row._replace(refused=row.refused or refused)
    last = fresh[-1]
    end = next((each for each in reversed(fresh) if each.type != "EpisodeTagged"), last)  # tags may follow the end
    ended = end.wall_ns if end.type == "EpisodeEnded" else row.ended_wall_ns
    return row._replace(head=last.sequence, ended_wall_ns=ended, refused=refused)


def _is_whole(records: Sequence[Record]) -> bool:
    """Return whether nothing is missing between these records, and the log can hold all of them."""
    for start in range(0, len(records), _CHECKED_AT_ONCE):
        part, first = records[start : start + _CHECKED_AT_ONCE], records[0].sequence + start
        if [each.sequence for each in part] != list(range(first, first + len(part))):
            return False
        if not _is_text(b"\n".join([each.payload for each in part])):
            return False
    return records[-1].sequence <= SEQUENCE_MAX


def _is_text(payload: bytes) -> bool:
    if b"\0" in payload:
        return False
    try:
        payload.decode()
    except UnicodeDecodeError:
        return False
    return True


def _declaration(record: Record) -> bytes:
    if record.type not in DECLARATION_TYPES:
        raise DamageError(f"record {record.position} belongs to no episode and is a {record.type}, not a declaration")
    if not _is_text(record.payload):
        raise DamageError(f"record {record.position}: the declaration is not text that a database can hold")
    return record.payload


# === digest table =============================================================================================
#
# Keep the digests of episodes in the table `pycrorm_digest`, in the transactions that append their events.
#
# Theory of operation. `RunningDigests` keeps a running digest for each episode that this process appends to. An append
# copies it into an `Extension`, adds the events while their rows are made, inserts the digests of completed blocks in
# the same transaction, and replaces the running digest by the copy after the commit. A running digest counts only if it
# is at the head that the transaction sees under its lock; otherwise, as after a restart or when another process has
# appended, it is computed again from the kept digest before the current block and the block's events in the log. So a
# process that restarts takes over the events of an incomplete block as the log holds them.
#
# The table only grows: a digest is inserted once and never changed, like an event. It is not part of the log's format:
# older programs still use the log, and the episodes that they append get no digests. If the digest before the current
# block is missing, the episode gets no further ones. On PostgreSQL a login that may not insert digests, because the
# owner has not run `GRANTS` again, appends without them.

_EPISODES_MAX: Final = 1_000
"""Bounds the running digests that a process keeps, half a kilobyte each; without one, a block is read again."""


class Extension:
    """The digests after an append: rows to insert, and running digests by number; None: the episode gets no digests."""

    def __init__(self, running: Mapping[int, storeds.RunningDigest | None]) -> None:
        self.rows: list[storeds.DigestRow] = []
        self.running = running

    def add(self, number: int, events: Sequence[Record], *, last: bool = False) -> None:
        """Add the next events of an episode; with `last`, keep the digest behind them also inside a block."""
        digest = self.running[number]
        if digest is None:
            return
        self.rows += [storeds.DigestRow(number, *each) for each in digest.add(events)]
        if last and digest.sequence % storeds.BLOCK_EVENTS:
            self.rows.append(storeds.DigestRow(number, digest.sequence, digest.digest()))


class RunningDigests:
    """The running digests of the episodes that a process appends to one log."""

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self._insertable: bool | None = None
        self._running: dict[int, storeds.RunningDigest | None] = {}

    async def begin(self, connection: AsyncConnection, rows: Iterable[storeds.EpisodeRow]) -> Extension | None:
        """Begin an append to the episodes of these rows; None if digests cannot be stored."""
        if self._insertable is None:
            self._insertable = (await self._dialect.table_state(connection, schema.DIGEST)).insertable
        if not self._insertable:
            return None
        return Extension({each.number: await self._at_head(connection, each) for each in rows})

    async def insert(self, connection: AsyncConnection, extension: Extension) -> None:
        """Insert the digests in the transaction that appends the events."""
        if not extension.rows:
            return
        try:
            await self._dialect.execute(connection, schema.INSERT_DIGESTS, digests=extension.rows)
        except BaseException:
            self._insertable = None  # a database that was restored meanwhile may lack the table
            raise

    def keep(self, extension: Extension) -> None:
        """Keep the running digests of an append that was committed."""
        self._running |= extension.running
        while len(self._running) > _EPISODES_MAX:
            del self._running[next(iter(self._running))]

    async def _at_head(self, connection: AsyncConnection, row: storeds.EpisodeRow) -> storeds.RunningDigest | None:
        """Return a running digest at the episode's head, to be changed by the caller; None if it cannot continue."""
        if row.number in self._running:
            kept = self._running[row.number]
            if kept is None or kept.sequence == row.head:
                return kept and kept.copy()
        start = row.head - row.head % storeds.BLOCK_EVENTS
        if start == 0:
            running = storeds.RunningDigest.at_start(row.identity)
        else:
            at = {"number": row.number, "sequence": start}
            at_start = (await self._dialect.execute(connection, schema.SELECT_DIGEST, **at)).scalar()
            if at_start is None:
                return None
            running = storeds.RunningDigest(bytes.fromhex(at_start), start)
        if row.head > start:
            running.add(await self._dialect.spans(connection, [storeds.Span(row.number, start, row.head)]))
        return running if running.sequence == row.head else None  # else events are missing, which `verify` reports


# === append ===================================================================================================

_PART_EVENTS: Final = 1_024
"""Bounds the events whose digests and rows are computed at once. PostgreSQL stores the rows of one part while those of
the next are computed."""


class StoredAhead(InternalError):
    """The log has events behind the head of their episode: on a shard a crash leaves them, elsewhere a defect did."""


class _Plan(NamedTuple):
    """The changes that the batch makes to episodes whose rows are `known_rows`."""

    known_rows: Mapping[EpisodeId, storeds.EpisodeRow]
    steps: Mapping[EpisodeId, EpisodeStep]
    insertion: Insertion
    digests: Extension | None


@dataclass(slots=True)
class Appending:
    """One batch and its append; use it once. What was erased or archived is not stored again.

    Attributes:
        digests: of the episodes that this process appends to; None stores none.
        on_wait: called when the database begins to store the events.
        witness: an episode and its confirmed head.
        numbers: of new episodes, unless another has them.
        restoring: whether archived episodes are stored, under their numbers.
        are_stored: whether the events are in the log already, behind the heads of their episodes, which `write`
            advances.
        episodes: the records by episode.
        warnings: of limits that the batch came near, by "numbers" or an episode's id.
        discarded: the episodes of the batch that were removed from the log, and whose events are not stored again.
        extension: the digests that `write` inserted, to be kept after the commit.
    """

    dialect: Dialect
    records: InitVar[Sequence[Record]]
    digests: RunningDigests | None = None
    on_wait: Callable[[], None] = lambda: None
    witness: tuple[EpisodeId, int] | None = None
    numbers: Mapping[EpisodeId, int] = field(default_factory=dict)
    restoring: bool = False
    are_stored: bool = False
    episodes: dict[EpisodeId, list[Record]] = field(init=False)
    warnings: dict[str, str] = field(default_factory=dict)
    discarded: dict[EpisodeId, storeds.RemovedEpisode] = field(default_factory=dict)
    extension: Extension | None = None
    _declarations: dict[str, bytes] = field(init=False)
    _plan: _Plan | None = None

    def __post_init__(self, records: Sequence[Record]) -> None:
        self._declarations, self.episodes = sort(records)

    async def prepare(self, connection: AsyncConnection) -> None:
        """Read the episodes in a reading transaction and build the statements for them. Optional."""
        self._plan = await self._make_plan(connection, await self._read_rows(connection))

    async def write(self, connection: AsyncConnection) -> storeds.Stored:
        """Append the batch in the caller's transaction.

        Raises `LogWentBack` if the log holds less of the witness than it had confirmed, and `LogDamaged` if another
        event is stored under a record's key; the caller must then roll back.
        """
        dialect = self.dialect
        if self._declarations:
            await _insert_declarations(dialect, connection, self._declarations)
        if not self.episodes:
            await dialect.force_durable_commit(connection)  # all declarations may be repeats
            return storeds.Stored({}, {})
        known_rows, refusals = await self._read_or_create_rows(connection)
        plan = self._plan
        if plan is None or plan.known_rows != known_rows:
            plan = await self._make_plan(connection, known_rows)
        changed = [each.after for identity, each in plan.steps.items() if each.after != known_rows[identity]]
        if changed:
            rows = [(*row[:3], row.started_wall_ns, row.ended_wall_ns, row.refused) for row in sorted(changed)]
            await dialect.execute(connection, schema.UPSERT_EPISODES, rows=rows)
            self.warnings = warnings_of(changed)
        if any(each.fresh for each in plan.steps.values()):
            if self.are_stored:
                [parts] = plan.insertion.values()
                deque(parts, 0)  # computes the digests
            else:
                self.on_wait()
                try:
                    await dialect.insert(connection, plan.insertion)
                except RowRefused as error:
                    raise StoredAhead(f"events behind the head of their episode are stored already: {error}") from error
            if self.digests is not None and plan.digests is not None:
                await self.digests.insert(connection, plan.digests)
                self.extension = plan.digests
        else:
            await dialect.force_durable_commit(connection)
        await _compare(dialect, connection, [each for each in plan.steps.values() if each.again])
        for each, change in plan.steps.items():
            count = len(change.fresh) + len(change.again) + change.skipped_ends
            if count < len(self.episodes[each]) and change.after.refused is not None:
                refusals[each] = change.after.refused
        return storeds.Stored(refusals, {each: change.after for each, change in plan.steps.items()})

    async def create_rows(self, connection: AsyncConnection) -> None:
        """Create the rows of the batch's new episodes, without events."""
        present = await self._read_rows(connection)
        if self.episodes.keys() <= present.keys():
            return
        rows, _ = await self._read_or_create_rows(connection)
        new = [(*row[:3], row.started_wall_ns, None, None) for each, row in rows.items() if each not in present]
        await self.dialect.execute(connection, schema.UPSERT_EPISODES, rows=new)

    async def _make_plan(
        self, connection: AsyncConnection, known_rows: Mapping[EpisodeId, storeds.EpisodeRow]
    ) -> _Plan:
        steps = {each: step(self.episodes[each], row) for each, row in known_rows.items()}
        extending = [known_rows[each] for each, change in steps.items() if change.fresh]
        digests = None if self.digests is None else await self.digests.begin(connection, extending)
        insertion = await self.dialect.event_insertion(_parts_of(steps.values(), digests))
        return _Plan(known_rows, steps, insertion, digests)

    async def _read_rows(self, connection: AsyncConnection) -> dict[EpisodeId, storeds.EpisodeRow]:
        """Read the rows of the batch's episodes, without `folded` and `parked`, which folding changes meanwhile."""
        names = {episode_text(each): each for each in self.episodes}
        witness, confirmed = self.witness or (None, 0)
        ids = [(each,) for each in names]
        if witness is None:
            rows = await self.dialect.rows(connection, storeds.EpisodeRow, schema.LOCK_EPISODES, ids=ids)
        else:
            name, statement = episode_text(witness), schema.LOCK_EPISODES_AND_READ_WITNESS
            rows = await self.dialect.rows(connection, storeds.EpisodeRow, statement, ids=ids, witness=name)
            head = max((row.head for row in rows if row.id == name), default=0)
            if head < confirmed and not await removed_of(self.dialect, connection, [witness]):
                raise LogWentBack(name, confirmed, head)
        return {names[row.id]: row._replace(folded=0, parked=None) for row in rows if row.id in names}

    async def _read_or_create_rows(
        self, connection: AsyncConnection
    ) -> tuple[dict[EpisodeId, storeds.EpisodeRow], dict[EpisodeId, str]]:
        """Read the rows, and create those of new episodes; return also why some episodes cannot get one."""
        rows = await self._read_rows(connection)
        refusals: dict[EpisodeId, str] = {}
        missing = [each for each in self.episodes if each not in rows]
        restored: dict[EpisodeId, int] = {}
        for each, removed in (await removed_of(self.dialect, connection, missing)).items() if missing else ():
            missing.remove(each)
            if self.restoring and removed.archived_in is not None:
                restored[each] = removed.number
            elif removed.archived_in is None or self.episodes[each][-1].sequence <= removed.head:
                self.discarded[each] = removed
            else:
                refusals[each] = str(removed)
        if restored:
            now_ns, numbers = SYSTEM_CLOCK.wall_ns(), [(number,) for number in restored.values()]
            await self.dialect.execute(connection, schema.UPDATE_RESTORED, now_ns=now_ns, numbers=numbers)
        assigned = restored | (await self._assign_numbers(connection, missing) if missing else {})
        for each, number in assigned.items():
            if number > EPISODE_NUMBER_MAX:
                refusals[each] = f"all {EPISODE_NUMBER_MAX:,} episode numbers of this memory are used: {_MOVE}"
            else:
                started_ns = self.episodes[each][0].wall_ns
                rows[each] = storeds.EpisodeRow(
                    number, episode_text(each), head=0, folded=0, started_wall_ns=started_ns
                )
        return rows, refusals

    async def _assign_numbers(self, connection: AsyncConnection, missing: Sequence[EpisodeId]) -> dict[EpisodeId, int]:
        own = {each: self.numbers[each] for each in missing if each in self.numbers}
        taken: set[int] = set()
        if own:
            asked = [(number,) for number in own.values()]
            taken.update((await self.dialect.execute(connection, schema.SELECT_NUMBERS, numbers=asked)).scalars())
        numbers = {each: number for each, number in own.items() if number not in taken}
        new = [each for each in missing if each not in numbers]
        if new:
            above = max(numbers.values(), default=0)
            numbers |= zip(new, await self.dialect.new_numbers(connection, len(new), above=above), strict=True)
        return numbers


async def removed_of(
    dialect: Dialect, connection: AsyncConnection, episodes: Iterable[EpisodeId]
) -> dict[EpisodeId, storeds.RemovedEpisode]:
    """Return those of these episodes that were erased or archived."""
    names = {episode_text(each): each for each in episodes}
    rows = await dialect.removed(connection, schema.SELECT_REMOVED_BY_ID, ids=[(each,) for each in names])
    return {names[each.id]: each for each in rows}


def _parts_of(steps: Iterable[EpisodeStep], digests: Extension | None) -> Iterator[tuple[int, list[Record]]]:
    """Yield the new events in parts, each with its episode's number, and add these to the digests.

    An episode's end, and each tag behind it, is a part of its own, because it gets a digest.
    """
    for each in steps:
        number, events = each.after.number, each.fresh
        last = len(events)
        if each.after.ended_wall_ns is not None:
            last = next((at for at in reversed(range(last)) if events[at].type == "EpisodeEnded"), 0)
        starts = [*range(0, last, _PART_EVENTS), *range(last, len(events)), len(events)]
        for start, end in pairwise(starts):
            if digests is not None:
                digests.add(number, events[start:end], last=start >= last)
            yield number, events[start:end]


async def _insert_declarations(
    dialect: Dialect, connection: AsyncConnection, declarations: Mapping[str, bytes]
) -> None:
    """Insert the declarations that are not stored yet.

    Transactions with new declarations take turns, so that their order by `ordinal` is that of their commits. Otherwise
    a fold could read the second before the first, and name contradicting fields otherwise than a rebuild.
    """
    names = [(each,) for each in declarations]
    stored = set((await dialect.execute(connection, schema.SELECT_DECLARED, fingerprints=names)).scalars())
    if new := [(name, payload.decode()) for name, payload in declarations.items() if name not in stored]:
        await dialect.lock_log_changes(connection, DECLARATIONS)
        await dialect.execute(connection, schema.INSERT_DECLARATIONS, named=new)


async def _compare(dialect: Dialect, connection: AsyncConnection, steps: Sequence[EpisodeStep]) -> None:
    if not steps:
        return
    keys = [(each.after.number, record.sequence) for each in steps for record in each.again]
    rows = await dialect.rows(connection, storeds.StoredEvent, schema.SELECT_EVENTS_BY_KEY, keys=keys)
    # From the type on, a record and a stored event have the same fields in the same order.
    stored = {(each.number, each.sequence): each[2:] for each in rows}
    for each in steps:
        number = each.after.number
        differing = [one.sequence for one in each.again if stored.get((number, one.sequence)) != one[3:]]
        if differing:
            raise LogDamaged(each.after.id, min(differing), "another event is stored under this number already")


# === limits ===================================================================================================
#
# Warn before an episode or a memory has used up its numbers.
#
# Row ids have 31 bits for the episode's number and 26 for the event's sequence. Both limits are distant (a thousand
# robots with an episode a minute for four years, a week of a hundred events a second). From nine tenths of a limit on,
# `status` warns and the process that stores the events logs one line, so that a user has time to act.

_MOVE = "move its spool to a new memory with `pycrorm spool rebind`"

EVENTS_MANY = SEQUENCE_MAX * 9 // 10 + 1
"""Sequence from which an episode counts as nearly full: 60,397,977, nine tenths of the limit."""


def number_warning(number: int) -> str | None:
    """Return the warning for a memory's latest episode number; None below nine tenths of the last.

    >>> number_warning(2_000_000_000)
    '2,000,000,000 of 2,147,483,647 episode numbers are used (93 %): record into a new database before none is left'
    """
    most = EPISODE_NUMBER_MAX
    if number <= most * 9 // 10:
        return None
    if number >= most:
        kept = "new episodes are kept in the spool until it belongs to a new database"
        return f"all {most:,} episode numbers are used: {kept}"
    used = f"{number:,} of {most:,} episode numbers are used ({number * 100 // most} %)"
    return f"{used}: record into a new database before none is left"


def events_warning(episode: storeds.EpisodeRow) -> str | None:
    """Return the warning for an episode that has not ended; None below nine tenths."""
    if episode.head < EVENTS_MANY or episode.ended_wall_ns is not None:
        return None
    share = episode.head * 100 // SEQUENCE_MAX
    return (
        f"episode {episode.number} ({episode.id}) has {episode.head:,} of {SEQUENCE_MAX:,} events ({share} %): it"
        " records nothing but ends beyond the last of these: end it, and open another"
    )


def warnings_of(episodes: Sequence[storeds.EpisodeRow]) -> dict[str, str]:
    """Return the warnings for these rows, by "numbers" or an episode's id."""
    last = max((each.number for each in episodes), default=0)
    warnings = {"numbers": number_warning(last)} | {each.id: events_warning(each) for each in episodes}
    return {subject: warning for subject, warning in warnings.items() if warning is not None}


# === blobs ====================================================================================================
#
# Store blobs beside the log: contents too large for an event, named by their SHA-256.
#
# A large blob is divided into parts, each a row and a transaction of its own, so that no other writer waits long. The
# parts are inserted in order and never changed, so several processes may store the same blob at once, and one continues
# where another was killed. The last part makes a blob complete. A blob is stored before the events that refer to it.

PART_BYTES: Final = 4 * 2**20
"""Bounds one row and transaction: SQLite's write lock is held for some ten milliseconds."""
_log = logging.getLogger("pycrorm_async")


class BlobSource(Protocol):
    """The place from which the blobs of appended records come: the files of a spool, or another log."""

    async def read_blob(self, name: str) -> bytes | None:
        """Return the content with this SHA-256; None if it is missing or has other bytes."""
        ...


class Blobs:
    """The blobs of one log; `reading` and `writing` open its transactions."""

    def __init__(
        self,
        dialect: Dialect,
        reading: Callable[[], AbstractAsyncContextManager[AsyncConnection]],
        writing: Callable[[], AbstractAsyncContextManager[AsyncConnection]],
    ) -> None:
        self._dialect = dialect
        self._reading = reading
        self._writing = writing
        self.source: BlobSource | None = None
        self.restores = False
        """Whether to store blobs of archived episodes too."""

    async def store_for(self, records: Sequence[Record]) -> None:
        """Store the blobs that these records refer to and that are not stored yet, durable on return.

        A blob that the source no longer has is reported and left out: waiting would not bring it back.
        """
        referring = [each for each in records if each.type in REFERRING and references_in(each.type, each.payload)]
        if referring and self.source is not None:
            async with self._reading() as connection:
                removed = await removed_of(self._dialect, connection, {e.episode for e in referring if e.episode})
            referring = [each for each in referring if each.episode not in removed or self.restores]
        wanted = {each.hash: each for record in referring for each in references_in(record.type, record.payload)}
        if not wanted or self.source is None:
            return
        for name in wanted.keys() - await self.complete(wanted):
            content = await self.source.read_blob(name)
            if content is None:
                _log.error("blob %s is missing: `pycrorm verify` names the event that refers to it", name)
            else:
                await self.add(wanted[name], content)

    async def add(self, reference: BlobReference, content: bytes) -> None:
        """Store a blob; its parts that are stored already stay unchanged."""
        parts = max(1, -(-len(content) // PART_BYTES))
        for part in range(parts):
            async with self._writing() as connection:
                if part == 0:
                    await self._dialect.create_if_missing(connection, schema.BLOB)
                await self._dialect.execute(
                    connection,
                    schema.INSERT_BLOB,
                    hash=reference.hash,
                    part=part,
                    parts=parts,
                    media_type=reference.media_type.replace("\0", ""),
                    size=len(content),
                    content=content[part * PART_BYTES : (part + 1) * PART_BYTES],
                )

    async def complete(self, hashes: Iterable[str]) -> set[str]:
        """Return those of these blobs that are stored completely."""
        asked, query = [(each,) for each in hashes], schema.SELECT_COMPLETE_BLOBS
        async with self._reading() as connection:
            rows = await self._dialect.rows_if_created(connection, schema.BLOB, tuple, query, hashes=asked)
        return {name for (name,) in rows}

    async def read(self, name: str) -> Blob | None:
        """Return a stored blob; None if it is missing or incomplete."""
        parts = [each async for each in self._parts(name)]
        if not parts or len(parts) < parts[0].parts:
            return None
        return Blob(b"".join(each.content for each in parts), parts[0].media_type)

    async def read_blob(self, name: str) -> bytes | None:
        """Implement `BlobSource`, for a copy of this log."""
        blob = await self.read(name)
        if blob is None or sha256(blob.content).hexdigest() != name:
            return None
        return blob.content

    async def fault(self, name: str) -> str | None:
        """Return the fault of a stored blob; None if its content has this SHA-256."""
        digest, count, parts = sha256(), 0, 1
        async for each in self._parts(name):
            count, parts = count + 1, each.parts
            await asyncio.to_thread(digest.update, each.content)
        if count < parts:
            return "is missing" if not count else f"is incomplete: {count} of {parts} parts are stored"
        return None if digest.hexdigest() == name else "has a content that does not match its hash"

    async def _parts(self, name: str) -> AsyncIterator[_Part]:
        part, parts = 0, 1
        while part < parts:
            asked = {"hash": name, "part": part}
            async with self._reading() as connection:
                rows = await self._dialect.rows_if_created(connection, schema.BLOB, _Part, schema.SELECT_BLOB, **asked)
            if not rows:
                return
            parts, part = rows[0].parts, part + 1
            yield rows[0]


class _Part(NamedTuple):
    parts: int
    media_type: str
    content: bytes
