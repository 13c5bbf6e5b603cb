"""Repeat a recorder's declarations at the beginning of every segment, so that each segment can be read alone.

The repeated declarations are ordinary records with positions of their own. The log stores equal declarations once.
"""

from __future__ import annotations

import mmap
from typing import NamedTuple
from zlib import crc32

from pycrorm_async.clock import Clock
from pycrorm_async.queue.files.frame import CHECKSUM_START, DECLARATION, HEADER_BYTES, NO_EPISODE, encode_header

__all__ = ["Declarations", "AppendState"]


class AppendState(NamedTuple):
    """An appender's state behind some frames: offset, last position, count and checksum of the unsynced records."""

    offset: int
    position: int
    records: int
    checksum: int


class Declarations:
    """The declarations in use. `bytes` is their size in each segment; `unrepeated` counts those that did not fit."""

    def __init__(self) -> None:
        self.bytes = 0
        self.unrepeated = 0
        self._bodies: dict[bytes, tuple[int, int, int]] = {}

    def add(self, body: bytes, *, name_bytes: int, version: int, payload_bytes: int, room: int) -> None:
        """Add a declaration. Ignores one in use already; does not repeat one larger than `room` bytes."""
        if body in self._bodies:
            return
        size = HEADER_BYTES + len(body)
        if size > room:
            self.unrepeated += 1
            return
        self._bodies[body] = name_bytes, version, payload_bytes
        self.bytes += size

    def write(self, buffer: mmap.mmap, state: AppendState, *, salt: int, clock: Clock) -> AppendState:
        """Write the declarations' frames from `state` on; return the state behind them."""
        offset, position, records, checksum = state
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
