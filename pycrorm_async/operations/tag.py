"""`pycrorm tag`: append a change of tags to an episode that has ended, and fold it.

The change is an event behind the episode's last one. It is appended on the condition that this is still the last one:
if another process appended a change first, the log refuses the event, and the change is decided again from the new
tags.
"""

from __future__ import annotations

from dataclasses import dataclass

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import CallerError, DatabaseError, DatabaseUnavailable, LogDamaged
from pycrorm_async.events.codec import encode
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.events.tags import changed_tags
from pycrorm_async.events.types import EpisodeTagged
from pycrorm_async.operations.destination import LogAndTables
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.episode_lookup import episode_named, tags_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow
from pycrorm_async.writer.retry import BRIEF, retry

_ATTEMPTS = 20
"""Bounds the attempts while other processes tag the same episode; each of them fails only if another succeeded."""


@dataclass(frozen=True)
class TaggedEpisode:
    """An episode and its tags after a change. `visible`: the tables show them; else the next fold does."""

    number: int
    id: str
    tags: tuple[str, ...]
    visible: bool


async def tag_episode(
    address: DatabaseAddress,
    name: str,
    added: tuple[str, ...],
    removed: tuple[str, ...],
    *,
    clock: Clock = SYSTEM_CLOCK,
) -> TaggedEpisode:
    """Add and remove tags of an episode, given by number, id, first digits of it, or `last`.

    Raises `CallerError` for an episode that has not ended or does not have a removed tag, and `UnknownEpisode`.
    """
    existing = await EventLog.open(address, create=False)
    await existing.close()
    log = await EventLog.open(address, create=True, belongs_to=existing.log_id)
    try:
        row = await episode_named(log, name)
        for _ in range(_ATTEMPTS):
            before = await tags_of(log, row)
            tags = changed_tags(before, added, removed)
            if sorted(tags) == sorted(before):
                return TaggedEpisode(row.number, row.id, tuple(sorted(tags)), visible=True)
            if await _append(log, row, EpisodeTagged(added, removed), clock):
                visible = await _fold(log, row)
                return TaggedEpisode(row.number, row.id, tuple(sorted(tags)), visible)
            row = await episode_named(log, row.id)
        raise DatabaseUnavailable(f"{address}: other processes tag episode {row.number} all the time; try again")
    finally:
        await log.close()


async def _append(log: EventLog, row: EpisodeRow, event: EpisodeTagged, clock: Clock) -> bool:
    """Append behind the episode's last event; False if another process did so first."""
    if row.ended_wall_ns is None:
        raise CallerError(
            f"episode {row.number} has not ended: tag it in the process that records it (`memory.tag`);"
            " if that died, run `pycrorm writer --once` first"
        )
    if row.refused is not None:
        raise CallerError(f"episode {row.number} cannot be tagged, because events of it are missing: {row.refused}")
    (last,) = await log.events(row.number, after=row.head - 1, limit=1)
    wall_ns = clock.wall_ns()
    # The monotonic clock of this process may have started later than that of the recorder.
    monotonic_ns = last.monotonic_ns + max(0, wall_ns - last.wall_ns)
    episode, kind = parse_episode_id(row.id), type(event)
    record = Record(0, episode, row.head + 1, kind.__name__, kind.version, wall_ns, monotonic_ns, encode(event))
    try:
        refusals = await log.append([record])
    except LogDamaged:
        now = await log.episode(episode)
        if now is None or now.head == row.head:
            raise
        return False
    if refusals:
        raise DatabaseUnavailable(f"{log.address}: episode {row.number}: {refusals[episode]}")
    return True


async def _fold(log: EventLog, row: EpisodeRow) -> bool:
    """Fold the episode to its end; False if this process cannot, or the episode is parked."""
    destination = LogAndTables(log, projector := Projector(log))
    try:
        await retry(projector.open, backoff=BRIEF)
        while row.id in await destination.behind():
            await retry(destination.fold_next_batch, backoff=BRIEF)
    except DatabaseError:
        return False
    return row.id not in await destination.stopped()
