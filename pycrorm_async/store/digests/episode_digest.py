"""Compute the digests of an episode. Pure.

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

from collections.abc import Sequence
from hashlib import sha256
from typing import Final, NamedTuple

import msgspec

from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.store.stored import StoredEvent

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
