"""Check the kept digests of episodes against their events, and against digests kept outside of the memory.

Each block is computed from the digest that the log keeps for the block before, so that a change is reported for its own
block alone. The blocks are those of `store.digests.episode_digest`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.projections.verify.episode_check import EpisodeCheck
from pycrorm_async.projections.verify.findings import VerifyResult
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.digests.digest_table import has_digests
from pycrorm_async.store.digests.episode_digest import BLOCK_EVENTS, RunningDigest
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow, Span, StoredEvent

_KEPT = text("""
SELECT episode, sequence, digest FROM pycrorm_digest
WHERE episode >= :first AND episode <= :last AND (episode > :first OR sequence > :after)
AND (episode < :last OR sequence <= :end) ORDER BY episode, sequence""")
_WITHOUT_EPISODE = text("""
SELECT DISTINCT episode FROM pycrorm_digest
WHERE episode >= :first AND episode < :end AND episode NOT IN (SELECT number FROM episode) ORDER BY episode""")
_BEYOND = text("""
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
        self._running: RunningDigest | None = RunningDigest.at_start(parse_episode_id(episode.id))
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
            self._result.without_digest += 1


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
    for number, head, sequence in await connection.execute(_BEYOND, limits):
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
