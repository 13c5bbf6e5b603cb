"""How a batch gets into the log: a handful of statements in one transaction, however many records it has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import LogDamaged
from pycrorm_async.events.codec import fingerprint
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.store.batch import NoNumber, Sorted, Step, differing, new_episode, sort, step
from pycrorm_async.store.dialect import Dialect
from pycrorm_async.store.rows import EpisodeRow, StoredEvent

__all__ = ["append_batch"]


async def append_batch(
    dialect: Dialect, connection: AsyncConnection, records: Sequence[Record]
) -> dict[EpisodeId, str]:
    """Appends within the caller's transaction; the reasons of the episodes that refused records.

    Raises `LogDamaged` when something else is stored under a record's key: then nothing of the batch may be committed.
    """
    batch = sort(records)
    if batch.declarations:
        named = {fingerprint(payload): payload.decode() for payload in batch.declarations}
        await dialect.insert_declarations(connection, list(named.items()))
    if not batch.episodes:
        return {}
    known, refusals = await _known(dialect, connection, batch)
    steps = {each: step(batch.episodes[each], row) for each, row in known.items()}
    changed = [each.after for identity, each in steps.items() if each.after != known[identity]]
    if changed:
        await dialect.upsert_episodes(connection, changed)
    fresh = [row for each in steps.values() for row in _rows(each)]
    if fresh:
        await dialect.insert_events(connection, fresh)
    await _compare(dialect, connection, [each for each in steps.values() if each.again])
    stopped = {each: done.after.refused for each, done in steps.items() if _left_out(batch, each, done)}
    return refusals | {each: reason for each, reason in stopped.items() if reason is not None}


def _rows(done: Step) -> list[tuple[Any, ...]]:
    number = done.after.number
    return [
        (number, sequence, type_name, version, wall_ns, monotonic_ns, payload.decode())
        for _, _, sequence, type_name, version, wall_ns, monotonic_ns, payload in done.fresh
    ]


def _left_out(batch: Sorted, episode: EpisodeId, done: Step) -> bool:
    return len(done.fresh) + len(done.again) + done.known_better < len(batch.episodes[episode])


async def _known(
    dialect: Dialect, connection: AsyncConnection, batch: Sorted
) -> tuple[dict[EpisodeId, EpisodeRow], dict[EpisodeId, str]]:
    """The row of every episode in the batch, made where there is none yet, and those that cannot have one."""
    names = {episode_text(each): each for each in batch.episodes}
    found = {names[row.id]: row for row in await dialect.episodes_by_id(connection, list(names))}
    refusals: dict[EpisodeId, str] = {}
    missing = [each for each in batch.episodes if each not in found]
    if missing:
        numbers = await dialect.new_numbers(connection, len(missing))
        for number, each in zip(numbers, missing, strict=True):
            try:
                found[each] = new_episode(each, batch.episodes[each][0], number)
            except NoNumber as refusal:
                refusals[each] = str(refusal)
    return found, refusals


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
