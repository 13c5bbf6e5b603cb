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

`Basis` carries the facts that the log confirmed before. If the log now holds less of the witness episode, it went back,
and `write` raises `LogWentBack` before it stores an event. An episode that the log lost gets its former number again if
no other episode has it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import LogDamaged, LogWentBack
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.store.append_rules import (
    EpisodeStep,
    NumbersExhausted,
    SortedBatch,
    differing,
    new_episode,
    sort,
    step,
)
from pycrorm_async.store.dialect import Dialect, Insertion
from pycrorm_async.store.digests.digest_table import Extension, RunningDigests
from pycrorm_async.store.limits import warnings_of
from pycrorm_async.store.stored import NOTHING_KNOWN, Basis, EpisodeRow, Stored, StoredEvent

_PART_EVENTS: Final = 1_024
"""Bounds the events whose digests and rows are computed at once. PostgreSQL stores the rows of one part while those of
the next are computed."""


class _Plan(NamedTuple):
    """The changes that the batch makes to episodes whose rows are `known_rows`."""

    known_rows: Mapping[EpisodeId, EpisodeRow]
    steps: Mapping[EpisodeId, EpisodeStep]
    insertion: Insertion
    digests: Extension | None


class Appending:
    """One batch and its append; use it once. Digests are stored only if `digests` is given."""

    def __init__(
        self,
        dialect: Dialect,
        records: Sequence[Record],
        basis: Basis = NOTHING_KNOWN,
        digests: RunningDigests | None = None,
    ) -> None:
        self._dialect = dialect
        self._basis = basis
        self._digests = digests
        self._batch = sort(records)
        self._plan: _Plan | None = None
        self.warnings: dict[str, str] = {}
        """Warnings of limits that the batch came near, by "numbers" or an episode's id."""
        self.extension: Extension | None = None
        """The digests that `write` inserted, to be kept after the commit."""

    async def prepare(self, connection: AsyncConnection) -> None:
        """Read the episodes in a reading transaction and build the statements for them. Optional."""
        self._plan = await self._make_plan(connection, await self._read_rows(connection))

    async def write(self, connection: AsyncConnection) -> Stored:
        """Append the batch in the caller's transaction.

        Raises `LogWentBack` if the log holds less than `basis` states, and `LogDamaged` if another event is stored
        under a record's key; the caller must then roll back.
        """
        batch, dialect = self._batch, self._dialect
        if batch.declarations:
            named = [(name, payload.decode()) for name, payload in batch.declarations.items()]
            await dialect.insert_declarations(connection, named)
        if not batch.episodes:
            await dialect.force_durable_commit(connection)  # all declarations may be repeats
            return Stored({}, {})
        known_rows, refusals = await self._read_or_create_rows(connection)
        plan = self._plan
        if plan is None or plan.known_rows != known_rows:
            plan = await self._make_plan(connection, known_rows)
        changed = [each.after for identity, each in plan.steps.items() if each.after != known_rows[identity]]
        if changed:
            await dialect.upsert_episodes(connection, changed)
            self.warnings = warnings_of(changed)
        if any(each.fresh for each in plan.steps.values()):
            await dialect.insert_events(connection, plan.insertion)
            if self._digests is not None and plan.digests is not None:
                await self._digests.insert(connection, plan.digests)
                self.extension = plan.digests
        else:
            await dialect.force_durable_commit(connection)
        await _compare(dialect, connection, [each for each in plan.steps.values() if each.again])
        stopped = {
            each: change.after.refused for each, change in plan.steps.items() if _has_unstored(batch, each, change)
        }
        refusals |= {each: reason for each, reason in stopped.items() if reason is not None}
        return Stored(refusals, {each: change.after for each, change in plan.steps.items()})

    async def _make_plan(self, connection: AsyncConnection, known_rows: Mapping[EpisodeId, EpisodeRow]) -> _Plan:
        steps = {each: step(self._batch.episodes[each], row) for each, row in known_rows.items()}
        extending = [known_rows[each] for each, change in steps.items() if change.fresh]
        digests = None if self._digests is None else await self._digests.begin(connection, extending)
        insertion = await self._dialect.event_insertion(_rows(steps.values(), digests))
        return _Plan(known_rows, steps, insertion, digests)

    async def _read_rows(self, connection: AsyncConnection) -> dict[EpisodeId, EpisodeRow]:
        """Read the rows of the batch's episodes, without `folded` and `parked`, which folding changes meanwhile."""
        names = {episode_text(each): each for each in self._batch.episodes}
        witness, confirmed = self._basis.witness or (None, 0)
        witness_name = None if witness is None else episode_text(witness)
        rows = await self._dialect.episodes_by_id(connection, list(names), witness=witness_name)
        if witness_name is not None:
            head = max((row.head for row in rows if row.id == witness_name), default=0)
            if head < confirmed:
                raise LogWentBack(witness_name, confirmed, head)
        return {names[row.id]: row._replace(folded=0, parked=None) for row in rows if row.id in names}

    async def _read_or_create_rows(
        self, connection: AsyncConnection
    ) -> tuple[dict[EpisodeId, EpisodeRow], dict[EpisodeId, str]]:
        """Read the rows, and create those of new episodes; return also why some episodes cannot get one."""
        rows = await self._read_rows(connection)
        refusals: dict[EpisodeId, str] = {}
        missing = [each for each in self._batch.episodes if each not in rows]
        if missing:
            for each, number in (await self._numbers(connection, missing)).items():
                try:
                    rows[each] = new_episode(each, self._batch.episodes[each][0], number)
                except NumbersExhausted as refusal:
                    refusals[each] = str(refusal)
        return rows, refusals

    async def _numbers(self, connection: AsyncConnection, missing: Sequence[EpisodeId]) -> dict[EpisodeId, int]:
        """Assign each episode its former number if that is free, else a new one."""
        own = {each: number for each in missing if (number := self._basis.number_of(each)) is not None}
        taken = await self._dialect.numbers_taken(connection, list(own.values())) if own else set()
        numbers = {each: number for each, number in own.items() if number not in taken}
        new = [each for each in missing if each not in numbers]
        if new:
            above = max(self._basis.above, *numbers.values(), 0)
            numbers |= zip(new, await self._dialect.new_numbers(connection, len(new), above=above), strict=True)
        return numbers


def _rows(steps: Iterable[EpisodeStep], digests: Extension | None) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of the new events, and add these to the digests."""
    for each in steps:
        number = each.after.number
        for part, last in _parts(each):
            if digests is not None:
                digests.add(number, part, last=last)
            yield from [
                (number, sequence, type_name, version, wall_ns, monotonic_ns, payload.decode())
                for _, _, sequence, type_name, version, wall_ns, monotonic_ns, payload in part
            ]


def _parts(change: EpisodeStep) -> Iterator[tuple[Sequence[Record], bool]]:
    """Split an episode's new events; yield each part, and whether it is the episode's end or a tag behind the end."""
    events = change.fresh
    last = len(events)
    if change.after.ended_wall_ns is not None:
        last = next((at for at in reversed(range(last)) if events[at].type == "EpisodeEnded"), 0)
    for start in range(0, last, _PART_EVENTS):
        yield events[start : min(start + _PART_EVENTS, last)], False
    for at in range(last, len(events)):
        yield events[at : at + 1], True


def _has_unstored(batch: SortedBatch, episode: EpisodeId, change: EpisodeStep) -> bool:
    return len(change.fresh) + len(change.again) + change.skipped_ends < len(batch.episodes[episode])


async def _compare(dialect: Dialect, connection: AsyncConnection, steps: Sequence[EpisodeStep]) -> None:
    if not steps:
        return
    keys = [(each.after.number, record.sequence) for each in steps for record in each.again]
    stored: dict[int, dict[int, StoredEvent]] = {}
    for event in await dialect.events_by_key(connection, keys):
        stored.setdefault(event.number, {})[event.sequence] = event
    for each in steps:
        sequence = differing(each.again, stored.get(each.after.number, {}))
        if sequence is not None:
            raise LogDamaged(each.after.id, sequence, "another event is stored under this number already")
