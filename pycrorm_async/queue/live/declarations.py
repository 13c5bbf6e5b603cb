"""Repeat a recorder's declarations at the beginning of every segment, so that each segment can be read alone.

The repeated declarations are ordinary records with positions of their own. The log stores equal declarations once.
"""

from __future__ import annotations

import mmap
from typing import NamedTuple
from zlib import crc32

from pycrorm_async.clock import Clock
from pycrorm_async.queue.files.frame import CHECKSUM_START, DECLARATION, HEADER_BYTES, NO_EPISODE, Frame, encode

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
        self._frames: dict[bytes, Frame] = {}

    def add(self, body: bytes, *, name: bytes, version: int, payload: bytes, room: int) -> None:
        """Add a declaration. Ignores one in use already; does not repeat one larger than `room` bytes."""
        if body in self._frames:
            return
        size = HEADER_BYTES + len(body)
        if size > room:
            self.unrepeated += 1
            return
        self._frames[body] = Frame(DECLARATION, version, 0, 0, 0, 0, NO_EPISODE, name, payload)
        self.bytes += size

    def write(self, buffer: mmap.mmap, state: AppendState, *, salt: int, clock: Clock) -> AppendState:
        """Write the declarations' frames from `state` on; return the state behind them."""
        offset, position, records, checksum = state
        for frame in self._frames.values():
            position += 1
            records += 1
            frame = frame._replace(position=position, wall_ns=clock.wall_ns(), monotonic_ns=clock.monotonic_ns())
            encoded = encode(frame, salt)
            buffer[offset : offset + len(encoded)] = encoded
            offset += len(encoded)
            checksum = crc32(encoded[CHECKSUM_START:HEADER_BYTES], checksum)
        return AppendState(offset, position, records, checksum)
