"""How a batch gets into the log: a handful of statements in one transaction, however many records it has.

    appending = Appending(dialect, records)
    await appending.prepare(reading)
    stored = await appending.write(writing)

Where one writes at a time everybody waits for a transaction to end. So what can be made before is: it is made for the
episodes as they are then, and made again if they are not so any more when nobody else can change them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import LogDamaged, LogWentBack
from pycrorm_async.events.codec import fingerprint
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.store.append_rules import NoNumber, Sorted, Step, differing, new_episode, sort, step
from pycrorm_async.store.dialect import Dialect, Insertion
from pycrorm_async.store.limits import warnings_of
from pycrorm_async.store.stored import NOTHING_KNOWN, Basis, EpisodeRow, Stored, StoredEvent

__all__ = ["Appending"]


class _Made(NamedTuple):
    """What the batch does to episodes that are as `known`."""

    known: Mapping[EpisodeId, EpisodeRow]
    steps: Mapping[EpisodeId, Step]
    insertion: Insertion


class Appending:
    """A batch on its way into the log."""

    def __init__(self, dialect: Dialect, records: Sequence[Record], basis: Basis = NOTHING_KNOWN) -> None:
        self._dialect = dialect
        self._basis = basis
        self._batch = sort(records)
        self._made: _Made | None = None
        self.warnings: dict[str, str] = {}
        """Which limits the batch came near, by what they limit: "numbers", or an episode's id."""

    async def prepare(self, connection: AsyncConnection) -> None:
        """Looks how the episodes are, in a transaction that only reads, and makes what is to be written then."""
        self._made = await self._make(await self._found(connection))

    async def write(self, connection: AsyncConnection) -> Stored:
        """Appends within the caller's transaction.

        Raises `LogWentBack` when the log holds less than the basis says, with nothing written, and `LogDamaged` when
        something else is stored under a record's key: then nothing of the batch may be committed.
        """
        batch, dialect = self._batch, self._dialect
        if batch.declarations:
            named = {fingerprint(payload): payload.decode() for payload in batch.declarations}
            await dialect.insert_declarations(connection, list(named.items()))
        if not batch.episodes:
            await dialect.note_again(connection)  # they may all have been there already
            return Stored({}, {})
        known, refusals = await self._known(connection)
        made = self._made
        if made is None or made.known != known:
            made = await self._make(known)
        changed = [each.after for identity, each in made.steps.items() if each.after != known[identity]]
        if changed:
            await dialect.upsert_episodes(connection, changed)
            self.warnings = warnings_of(changed)
        if any(each.fresh for each in made.steps.values()):
            await dialect.insert_events(connection, made.insertion)
        else:
            await dialect.note_again(connection)
        await _compare(dialect, connection, [each for each in made.steps.values() if each.again])
        stopped = {each: done.after.refused for each, done in made.steps.items() if _left_out(batch, each, done)}
        refusals |= {each: reason for each, reason in stopped.items() if reason is not None}
        return Stored(refusals, {each: done.after for each, done in made.steps.items()})

    async def _make(self, known: Mapping[EpisodeId, EpisodeRow]) -> _Made:
        steps = {each: step(self._batch.episodes[each], row) for each, row in known.items()}
        rows = [row for each in steps.values() for row in _rows(each)]
        return _Made(known, steps, await self._dialect.event_insertion(rows))

    async def _found(self, connection: AsyncConnection) -> dict[EpisodeId, EpisodeRow]:
        """The row of every episode in the batch that has one; how far it is in the tables is others' business."""
        names = {episode_text(each): each for each in self._batch.episodes}
        witness, confirmed = self._basis.witness or (None, 0)
        witness_name = None if witness is None else episode_text(witness)
        found = await self._dialect.episodes_by_id(connection, list(names), witness=witness_name)
        if witness_name is not None:
            head = max((row.head for row in found if row.id == witness_name), default=0)
            if head < confirmed:
                raise LogWentBack(witness_name, confirmed, head)
        return {names[row.id]: row._replace(folded=0, parked=None) for row in found if row.id in names}

    async def _known(self, connection: AsyncConnection) -> tuple[dict[EpisodeId, EpisodeRow], dict[EpisodeId, str]]:
        """The same, made where there is none yet; and why some cannot have one."""
        found = await self._found(connection)
        refusals: dict[EpisodeId, str] = {}
        missing = [each for each in self._batch.episodes if each not in found]
        if missing:
            for each, number in (await self._numbers(connection, missing)).items():
                try:
                    found[each] = new_episode(each, self._batch.episodes[each][0], number)
                except NoNumber as refusal:
                    refusals[each] = str(refusal)
        return found, refusals

    async def _numbers(self, connection: AsyncConnection, missing: Sequence[EpisodeId]) -> dict[EpisodeId, int]:
        """The number each had before, where no other has it now, or a new one."""
        own = {each: number for each in missing if (number := self._basis.number_of(each)) is not None}
        taken = await self._dialect.numbers_taken(connection, list(own.values())) if own else set()
        numbers = {each: number for each, number in own.items() if number not in taken}
        new = [each for each in missing if each not in numbers]
        if new:
            above = max(self._basis.above, *numbers.values(), 0)
            numbers |= zip(new, await self._dialect.new_numbers(connection, len(new), above=above), strict=True)
        return numbers


def _rows(done: Step) -> list[tuple[Any, ...]]:
    number = done.after.number
    return [
        (number, sequence, type_name, version, wall_ns, monotonic_ns, payload.decode())
        for _, _, sequence, type_name, version, wall_ns, monotonic_ns, payload in done.fresh
    ]


def _left_out(batch: Sorted, episode: EpisodeId, done: Step) -> bool:
    return len(done.fresh) + len(done.again) + done.known_better < len(batch.episodes[episode])


async def _compare(dialect: Dialect, connection: AsyncConnection, steps: Sequence[Step]) -> None:
    if not steps:
        return
    keys = [(each.after.number, record.sequence) for each in steps for record in each.again]
    stored: dict[int, dict[int, StoredEvent]] = {}
    for event in await dialect.stored_again(connection, keys):
        stored.setdefault(event.number, {})[event.sequence] = event
    for each in steps:
        sequence = differing(each.again, stored.get(each.after.number, {}))
        if sequence is not None:
            raise LogDamaged(each.after.id, sequence, "another event is stored under this number already")
