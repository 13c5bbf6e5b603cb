"""How a batch gets into the log: five statements in one transaction, however many records it has."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import Any

import msgspec
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import LogDamaged
from pycrorm_async.events.codec import fingerprint
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.store.batch import NoNumber, Sorted, Step, differing, new_episode, sort, step
from pycrorm_async.store.rows import EpisodeRow, StoredEvent
from pycrorm_async.store.sqlite import statements as sql

__all__ = ["append_batch"]


async def append_batch(connection: AsyncConnection, records: Sequence[Record]) -> dict[EpisodeId, str]:
    """Appends within the caller's transaction; the reasons of the episodes that refused records.

    Raises `LogDamaged` when something else is stored under a record's key: then nothing of the batch may be committed.
    """
    batch = sort(records)
    if batch.declarations:
        named = [(fingerprint(payload), payload.decode()) for payload in batch.declarations]
        await connection.exec_driver_sql(sql.INSERT_DECLARATIONS, (_json(named),))
    if not batch.episodes:
        return {}
    known, refusals = await _known(connection, batch)
    steps = {each: step(batch.episodes[each], row) for each, row in known.items()}
    await _insert_events(connection, steps.values())
    changed = [each.after for identity, each in steps.items() if each.after != known[identity]]
    if changed:
        await connection.exec_driver_sql(sql.UPSERT_EPISODES, (_json([_columns(row) for row in changed]),))
    await _compare(connection, [each for each in steps.values() if each.again])
    stopped = {each: done.after.refused for each, done in steps.items() if _left_out(batch, each, done)}
    return refusals | {each: reason for each, reason in stopped.items() if reason is not None}


def _left_out(batch: Sorted, episode: EpisodeId, done: Step) -> bool:
    return len(done.fresh) + len(done.again) < len(batch.episodes[episode])


async def _known(
    connection: AsyncConnection, batch: Sorted
) -> tuple[dict[EpisodeId, EpisodeRow], dict[EpisodeId, str]]:
    """The row of every episode in the batch, made where there is none yet, and those that cannot have one."""
    names = {episode_text(each): each for each in batch.episodes}
    answer = await connection.exec_driver_sql(sql.SELECT_EPISODES_BY_ID, (_json(list(names)),))
    found = {names[row.id]: EpisodeRow._make(row) for row in answer}
    refusals: dict[EpisodeId, str] = {}
    missing = [each for each in batch.episodes if each not in found]
    if missing:
        taken = (await connection.exec_driver_sql(sql.SELECT_NUMBER_MAX)).scalar_one()
        for number, each in enumerate(missing, start=taken + 1):
            try:
                found[each] = new_episode(each, batch.episodes[each][0], number)
            except NoNumber as refusal:
                refusals[each] = str(refusal)
    return found, refusals


async def _insert_events(connection: AsyncConnection, steps: Iterable[Step]) -> None:
    rows: list[tuple[Any, ...]] = []
    payloads: list[bytes] = []
    for each in steps:
        number = each.after.number
        rows += [(number, *record[2:7]) for record in each.fresh]
        payloads += [record.payload for record in each.fresh]
    if not rows:
        return
    lengths = [len(payload) for payload in payloads]
    cuts = zip(accumulate(lengths, initial=1), lengths, strict=False)  # SQL counts from 1
    placed = [row + cut for row, cut in zip(rows, cuts, strict=True)]
    await connection.exec_driver_sql(sql.INSERT_EVENTS, (b"".join(payloads), _json(placed)))


async def _compare(connection: AsyncConnection, steps: Sequence[Step]) -> None:
    if not steps:
        return
    keys = [(each.after.number, record.sequence) for each in steps for record in each.again]
    answer = await connection.exec_driver_sql(sql.SELECT_STORED_AGAIN, (_json(keys),))
    stored: dict[int, dict[int, StoredEvent]] = {}
    for row in answer:
        event = StoredEvent._make(row)
        stored.setdefault(event.number, {})[event.sequence] = event
    for each in steps:
        sequence = differing(each.again, stored.get(each.after.number, {}))
        if sequence is not None:
            raise LogDamaged(each.after.id, sequence, "another event is stored under this number already")


def _columns(row: EpisodeRow) -> tuple[Any, ...]:
    return (row.number, row.id, row.head, row.started_wall_ns, row.ended_wall_ns, row.refused)


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()
