"""The declarations a recorder has put, which every segment begins with: so that each can be read without those before.

They are ordinary records with positions of their own. The log keeps a declaration once, by its content.
"""

from __future__ import annotations

import mmap
from typing import NamedTuple
from zlib import crc32

from pycrorm_async.clock import Clock
from pycrorm_async.queue.files.frame import CHECKSUM_START, DECLARATION, HEADER_BYTES, NO_EPISODE, encode_header

__all__ = ["Declarations", "AppendState"]


class AppendState(NamedTuple):
    """What the frames of a segment's beginning come to: where they end, the last position, and of the span that is
    not synced yet how many records it has and their checksum."""

    offset: int
    position: int
    records: int
    checksum: int


class Declarations:
    """Those in use. `bytes` is what they take in each segment, `unrepeated` counts those there was no room for."""

    def __init__(self) -> None:
        self.bytes = 0
        self.unrepeated = 0
        self._bodies: dict[bytes, tuple[int, int, int]] = {}

    def add(self, body: bytes, *, name_bytes: int, version: int, payload_bytes: int, room: int) -> None:
        """One more; one that is in use already counts once, one that is larger than `room` is not repeated."""
        if body in self._bodies:
            return
        size = HEADER_BYTES + len(body)
        if size > room:
            self.unrepeated += 1
            return
        self._bodies[body] = name_bytes, version, payload_bytes
        self.bytes += size

    def write(self, buffer: mmap.mmap, begun: AppendState, *, salt: int, clock: Clock) -> AppendState:
        """Writes their frames from `begun` on, which stands before the first."""
        offset, position, records, checksum = begun
        for body, (name_bytes, version, payload_bytes) in self._bodies.items():
            position += 1
            records += 1
            header = encode_header(
                DECLARATION,
                name_bytes,
                version,
                payload_bytes,
                position,
                0,
                clock.wall_ns(),
                clock.monotonic_ns(),
                NO_EPISODE,
                salt,
                crc32(body),
            )
            end = offset + HEADER_BYTES + len(body)
            buffer[offset : offset + HEADER_BYTES] = header
            buffer[offset + HEADER_BYTES : end] = body
            offset = end
            checksum = crc32(header[CHECKSUM_START:], checksum)
        return AppendState(offset, position, records, checksum)
