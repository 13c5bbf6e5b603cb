"""Carry an appender's records to a successor in another folder, while threads keep putting.

`relocation.py` describes the whole move.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final
from zlib import crc32

from pycrorm_async.errors import InternalError, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue.files.frame import (
    CHECKSUM_START,
    COMMIT,
    EVENT,
    HEADER_BYTES,
    Fields,
    Frame,
    decode_each,
    encode,
)
from pycrorm_async.queue.files.segment import EPISODE_ENDED, Segment
from pycrorm_async.queue.live.syncable_appender import SyncableAppender

_EPISODE_ENDED: Final = EPISODE_ENDED.encode()
_LATE_BYTES: Final = 2**16
"""Bounds the bytes carried while the lock is held and producers wait: half a millisecond of work."""


class AppenderRelocated(InternalError):
    """This appender has handed over to its successor. Never leaves the queue, which retries the put there."""


class RelocatableAppender(SyncableAppender):
    """An appender that can succeed another one and hand over to a successor."""

    @property
    def segments(self) -> tuple[Segment, ...]:
        """The mapped segments: full ones that no sync covers yet, and the current one."""
        return self._gc_lock.run(lambda: (*self._sealed, self._current))

    def carry(self, record: Fields) -> None:
        """Append a record of another appender; it keeps its position, sequence and times."""
        self._gc_lock.run(partial(self._carry, record))

    def hand_over(
        self, successor: RelocatableAppender, segment: Segment, offset: int, *, switch: Callable[[], None]
    ) -> bool:
        """Carry the records behind `offset` of this segment, refuse later puts (`AppenderRelocated`), call `switch`.

        Holds the lock, so producers see one step. Returns False without effect if too many bytes are left for that.
        Raises `SpoolUnavailable` if the mapping does not contain the records that were put.
        """
        return self._gc_lock.run(partial(self._hand_over, successor, segment, offset, switch))

    def settle(self, folder: Path) -> None:
        """Note that the folder was renamed to this path."""
        self._gc_lock.run(partial(self._settle, folder))

    def _carry(self, record: Fields) -> None:
        kind, _, position, sequence, wall_ns, monotonic_ns, episode, name, _, _, size = record
        if position != self.position + 1:
            raise SpoolUnavailable(self._folder, f"position {self.position + 1} cannot be read in the old folder")
        if self._offset + size > self._end:
            self._roll()
        frame = encode(Frame(*record), self._salt)
        self._buffer[self._offset : self._offset + size] = frame
        self._offset += size
        self.position = position
        self._span_count += 1
        self._span_checksum = crc32(frame[CHECKSUM_START:HEADER_BYTES], self._span_checksum)
        if kind == EVENT:
            self.open[EpisodeId(episode)] = (sequence, wall_ns, monotonic_ns)
            if name == _EPISODE_ENDED:
                del self.open[EpisodeId(episode)]

    def _hand_over(
        self, successor: RelocatableAppender, segment: Segment, offset: int, switch: Callable[[], None]
    ) -> bool:
        late_bytes = self._offset - offset
        if segment is not self._current or late_bytes > min(_LATE_BYTES, successor._end - successor._offset):
            return False
        for record in decode_each(self._buffer, offset, self._salt):
            if record[0] != COMMIT:
                successor.carry(record)
        if successor.position != self.position:
            raise SpoolUnavailable(
                segment.path, f"contains records only up to position {successor.position} of {self.position}"
            )
        successor.stuck = self.stuck
        # Only now: repeating declarations before would shift the positions of carried records.
        successor.declarations = self.declarations
        if self._refusal is not None:
            successor.refuse(self._refusal)
        self._refusal = lambda: AppenderRelocated("the queue has moved to another folder")
        switch()
        return True

    def _settle(self, folder: Path) -> None:
        self._folder = folder
        for segment in (*self._sealed, self._current, self._prepared):
            if segment is not None:
                segment.path = folder / segment.path.name
        self.begun = [each._replace(path=folder / each.path.name) for each in self.begun]
