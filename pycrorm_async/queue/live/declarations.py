"""Repeat a recorder's declarations at the beginning of every segment, so that each segment can be read alone.

The repeated declarations are ordinary records with positions of their own. The log stores equal declarations once.

A plan may make any number of objects with descriptions of their own, so only the latest descriptions are repeated, an
eighth of a segment. The hooks put a description again before they use one that they put long ago, see
`recording.declarations.descriptions`. So a segment with an object has the object's description too.
"""

from __future__ import annotations

import mmap
from typing import NamedTuple
from zlib import crc32

from pycrorm_async.clock import Clock
from pycrorm_async.queue.files.frame import CHECKSUM_START, DECLARATION, HEADER_BYTES, NO_EPISODE, Frame, encode

_DESCRIPTION = b"DescriptionDeclared"


class AppendState(NamedTuple):
    """An appender's state behind some frames: offset, last position, count and checksum of the unsynced records."""

    offset: int
    position: int
    records: int
    checksum: int


class Declarations:
    """The declarations in use. `bytes` is their size in each segment; `unrepeated` counts those that did not fit.

    `descriptions_bytes_max` bounds the bytes of the descriptions among them.
    """

    def __init__(self, descriptions_bytes_max: int) -> None:
        self.bytes = 0
        self.unrepeated = 0
        self._frames: dict[bytes, Frame] = {}
        self._descriptions_bytes_max = descriptions_bytes_max
        self._descriptions: dict[bytes, int] = {}
        self._descriptions_bytes = 0

    def add(self, body: bytes, *, name: bytes, version: int, payload: bytes, room: int) -> None:
        """Add a declaration. Does not repeat one larger than `room` bytes, and drops the oldest descriptions."""
        size = HEADER_BYTES + len(body)
        if body in self._frames:
            if body in self._descriptions:  # the latest ones are kept
                self._descriptions[body] = self._descriptions.pop(body)
            return
        if name == _DESCRIPTION:
            room = min(room, self._descriptions_bytes_max)
        if size > room:
            self.unrepeated += 1
            return
        self._frames[body] = Frame(DECLARATION, version, 0, 0, 0, 0, NO_EPISODE, name, payload)
        self.bytes += size
        if name == _DESCRIPTION:
            self._descriptions[body] = size
            self._descriptions_bytes += size
            while self._descriptions_bytes > self._descriptions_bytes_max:
                self._drop(next(iter(self._descriptions)))

    def _drop(self, body: bytes) -> None:
        del self._frames[body]
        size = self._descriptions.pop(body)
        self._descriptions_bytes -= size
        self.bytes -= size

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
