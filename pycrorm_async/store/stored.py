"""Define the values that the log returns: stored events, the state of episodes, and spans of events to read.

**Episode digest.** Compute the digests of an episode. Pure.

    running = RunningDigest.at_start(episode)
    rows = running.add(events)

Theory of operation. The events of an episode form blocks of `BLOCK_EVENTS`: the first block has the sequences 1 to 256,
the second 257 to 512. The digest at event n is the SHA-256 of `SCHEME`, the digest at the end of the block before, and
the events of n's block up to n; for the first block, of `SCHEME`, the episode's 16-byte id, and its events. So each
digest depends on the id and on every event from the first one on, and on nothing else: the number of the episode, the
sizes of batches and the database make no difference.

An event is encoded as a MessagePack array of sequence, type, version, both times and payload, in the shortest forms.
The encoding of an event contains its own length, so no two lists of events have the same encoding.

The log keeps the digest at the end of each block, at the end of the episode, and at each tag behind its end. The events
behind the last kept digest, at most 255 of an episode that has not ended, are not covered yet. A kept digest is 64
characters for 256 events, and a changed event is found in a range of that size.

One chain with a digest for each event would need no blocks, and would find the very event, but one call of the hash
function for each event costs a fifth of the append rate. Here an append encodes and hashes a block at a time. SHA-256
takes half the time of BLAKE2b where the processor has instructions for it, as most have that were built since 2019.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from hashlib import sha256
from typing import Final, NamedTuple

import msgspec

from pycrorm_async.errors import LogDamaged
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId, is_episode_id, parse_episode_id


class StoredEvent(NamedTuple):
    """One event of the log. `payload` is the appended bytes, unchanged."""

    number: int
    sequence: int
    type: str
    version: int
    wall_ns: int
    monotonic_ns: int
    payload: bytes


def consecutive(events: Sequence[StoredEvent], after: int) -> Sequence[StoredEvent]:
    """Return the events of an episode behind sequence `after`, up to the first that is missing."""
    if not events or events[-1].sequence == after + len(events):
        return events
    return [each for sequence, each in enumerate(events, after + 1) if each.sequence == sequence]


class EpisodeRow(NamedTuple):
    """The state of an episode.

    Attributes:
        number: in this database.
        id: the UUID as text.
        head: last stored sequence; events 1 to `head` are all stored.
        folded: last sequence visible in the tables.
        started_wall_ns: wall time of the first stored event.
        ended_wall_ns: wall time of EpisodeEnded; None until it is stored.
        refused: why the log refused events of the episode, or None.
        parked: why folding the episode stopped, or None.
    """

    number: int
    id: str
    head: int
    folded: int
    started_wall_ns: int
    ended_wall_ns: int | None = None
    refused: str | None = None
    parked: str | None = None

    @property
    def identity(self) -> EpisodeId:
        """The id in 16 bytes. Raises `LogDamaged` if the text is not an id."""
        if not is_episode_id(self.id):
            reason = f"its id {self.id!r:.100} was changed after it was stored: it is not a UUID"
            raise LogDamaged(str(self.number), 1, reason)
        return parse_episode_id(self.id)


class RemovedEpisode(NamedTuple):
    """An episode whose events have left the log; its number is never given to another one.

    Attributes:
        number, id, head, started_wall_ns, ended_wall_ns: as its `EpisodeRow` had them.
        digest: of its events up to `head`; None for an episode without one.
        removed_wall_ns, reason: the time and the reason of the removal.
        archived_in: the lake that holds its events; None if it was erased.
        finished_wall_ns: the time at which nothing was left of it elsewhere; None until then.
        restored_wall_ns: the time at which its events came back from the lake, which has them still; else None.
    """

    number: int
    id: str
    head: int
    started_wall_ns: int
    ended_wall_ns: int | None
    digest: str | None
    removed_wall_ns: int
    reason: str
    archived_in: str | None = None
    finished_wall_ns: int | None = None
    restored_wall_ns: int | None = None

    def __str__(self) -> str:
        when = when_and_why(self.removed_wall_ns, self.reason)
        if self.archived_in is None:
            return f"episode {self.number} ({self.id}) was erased on {when}"
        return (
            f"episode {self.number} ({self.id}) was archived on {when}:"
            f" `pycrorm restore {self.id} --from {self.archived_in}` brings it back"
        )


def when_and_why(wall_ns: int, reason: str | None) -> str:
    """Return the time of a removal, and its reason if it is known.

    >>> when_and_why(1_700_000_000_000_000_000, "asked")
    '2023-11-14 22:13 UTC (asked)'
    """
    return f"{datetime.fromtimestamp(wall_ns // 10**9, UTC):%Y-%m-%d %H:%M} UTC" + (f" ({reason})" if reason else "")


class Stored(NamedTuple):
    """The result of an append: reasons of refusals by episode, and the current row of each episode in the batch."""

    refusals: Mapping[EpisodeId, str]
    rows: Mapping[EpisodeId, EpisodeRow]


class Incarnation(NamedTuple):
    """One time the log went back: when and from which spool that was noticed, and the outcome."""

    noticed_wall_ns: int
    noticed_by: str
    reason: str


class Span(NamedTuple):
    """The events of an episode behind sequence `after`, up to sequence `last`."""

    number: int
    after: int
    last: int


def size_of(spans: Sequence[Span]) -> int:
    """Return the number of events in these spans.

    >>> size_of([Span(1, 0, 7), Span(2, 3, 4)])
    8
    """
    return sum(each.last - each.after for each in spans)


def pages_of(spans: Sequence[Span], limit: int) -> Iterator[list[Span]]:
    """Divide spans into pages of at most `limit` events, in their order.

    >>> [*pages_of([Span(1, 0, 7), Span(2, 3, 4)], 5)]
    [[Span(number=1, after=0, last=5)], [Span(number=1, after=5, last=7), Span(number=2, after=3, last=4)]]
    """
    page: list[Span] = []
    left = limit
    for number, first, last in spans:
        after = first
        while after < last:
            part = Span(number, after, min(last, after + left))
            page.append(part)
            left -= part.last - after
            after = part.last
            if not left:
                yield page
                page, left = [], limit
    if page:
        yield page


def beyond(behind: Sequence[EpisodeRow], reached: Mapping[int, int]) -> list[EpisodeRow]:
    """Return the episodes that will still be behind after a running fold; `reached` is its last sequence by number.

    >>> beyond([EpisodeRow(1, "", head=9, folded=0, started_wall_ns=0)], {1: 7})[0].folded
    7
    """
    return [
        each._replace(folded=max(each.folded, reached.get(each.number, 0)))
        for each in behind
        if each.head > reached.get(each.number, 0)
    ]


_SHARE_MIN = 1_000
"""Smallest share of an episode, in events, because adjacent rows are read and written together."""


def share_out(behind: Sequence[EpisodeRow], limit: int) -> list[Span]:
    """Divide the next `limit` events among these episodes, so that none waits for long.

    An episode gets its rest whole, if that is at most twice its share: a projection that has a state for each episode
    reads all its events again where a later batch, of another process, has the last few.

    >>> share_out([EpisodeRow(1, "", head=90_000, folded=0, started_wall_ns=0)], 100)
    [Span(number=1, after=0, last=100)]
    >>> behind = [EpisodeRow(each, "", head=1_002, folded=0, started_wall_ns=0) for each in range(1, 11)]
    >>> [each.last for each in share_out(behind, 10_000)]
    [1002, 1002, 1002, 1002, 1002, 1002, 1002, 1002, 1002]
    """
    share = max(limit // len(behind), _SHARE_MIN) if behind else 0
    spans: list[Span] = []
    for each in behind:
        rest = each.head - each.folded
        count = rest if rest <= 2 * share else share
        if count > limit and spans:
            break  # the next batch begins with this episode
        count = min(count, limit)
        spans.append(Span(each.number, each.folded, each.folded + count))
        limit -= count
    return spans


# === episode digest ===========================================================================================

BLOCK_EVENTS: Final = 256
"""Events of a block. Fewer would find a changed event more closely, and cost more time and space for their digests."""
SCHEME: Final = b"pycrorm episode\0"
"""Makes the digests differ from those of other programs over the same bytes; the version of the scheme."""
_PIECE_BYTES: Final = 2_047
"""Bounds the bytes hashed by one call. For more, hashlib releases the interpreter lock, and beside a busy plan a thread
waits up to 5 ms to get it back."""
_ARRAY_HEADER_BYTES: Final = (1, 3)
"""Bytes before the items of a MessagePack array of up to 15, and of up to 65,535 items."""

_FIELDS: Final = 6
"""The fields from the sequence to the payload, with which both `Record` and `StoredEvent` end."""

_encode = msgspec.msgpack.Encoder().encode


class DigestRow(NamedTuple):
    """A kept digest: of the events 1 to `sequence` of the episode with this number, in hexadecimal digits."""

    number: int
    sequence: int
    digest: str


class RunningDigest:
    """The digest of the events 1 to `sequence` of one episode, to which the next events are added.

    Attributes:
        hasher: has hashed the digest of the block before and the events of the current block.
    """

    __slots__ = ("hasher", "sequence")

    def __init__(self, before: bytes, sequence: int) -> None:
        """Begin behind the block that ends with event `sequence`, whose digest is `before`."""
        assert sequence % BLOCK_EVENTS == 0, sequence
        self.sequence = sequence
        self.hasher = sha256(SCHEME + before)

    @classmethod
    def at_start(cls, episode: EpisodeId) -> RunningDigest:
        """Begin before the first event."""
        return cls(episode, 0)

    def copy(self) -> RunningDigest:
        """Return a copy, so that events can be added before it is certain that they are stored."""
        other = RunningDigest(b"", 0)
        other.sequence = self.sequence
        other.hasher = self.hasher.copy()
        return other

    def digest(self) -> str:
        """Return the digest of the events added so far, as hexadecimal digits."""
        return self.hasher.hexdigest()

    def add(self, events: Sequence[Record] | Sequence[StoredEvent]) -> list[tuple[int, str]]:
        """Add the next events; return sequence and digest of each block that they complete."""
        hashed = slice(-_FIELDS, None)
        ends: list[tuple[int, str]] = []
        done = 0
        while done < len(events):
            block = events[done : done + BLOCK_EVENTS - self.sequence % BLOCK_EVENTS]
            # One block at a time, so that the new tuples stay in the processor's cache.
            encoded = memoryview(_encode([each[hashed] for each in block]))[_ARRAY_HEADER_BYTES[len(block) > 15] :]
            for start in range(0, len(encoded), _PIECE_BYTES):
                self.hasher.update(encoded[start : start + _PIECE_BYTES])
            done += len(block)
            self.sequence += len(block)
            if self.sequence % BLOCK_EVENTS == 0:
                ends.append((self.sequence, self.digest()))
                self.hasher = sha256(SCHEME + self.hasher.digest())
        return ends
