"""Read records of a living recorder from its segments, in order, with payloads untouched.

A hole raises an error here, because the caller asks only for records that are synced. Recovery, which expects holes,
uses `scan.py`.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.bulk_records import make
from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.envelope import Record
from pycrorm_async.queue.files.frame import COMMIT, EVENT, Buffer, decode_each
from pycrorm_async.queue.files.segment import decode_header, header_bytes, map_segment, salt_of, segment_path


class Cursor(NamedTuple):
    """A place between two records: segment and offset of the next frame, and position of the record before it."""

    number: int
    offset: int
    position: int


class Place(NamedTuple):
    """A recorder's folder, the recorder's id, and the cursor from which its segments are read."""

    folder: Path
    recorder: bytes
    start: Cursor


class Batch(NamedTuple):
    """Records, the size of their payloads, and the cursor behind them. `complete`: one more would exceed a limit."""

    records: list[Record]
    payload_bytes: int
    after: Cursor
    complete: bool


def check_type(path: Path, offset: int, name: bytes) -> str:
    """Decode an event type's name. Raises `SpoolDamaged` for a name that no recorder writes."""
    try:
        type_name = name.decode()
    except UnicodeDecodeError:
        raise SpoolDamaged(path, offset, f"the name of the event's type, {name!r}, is not UTF-8") from None
    if not type_name or "\0" in type_name:
        raise SpoolDamaged(path, offset, f"the name of the event's type, {name!r}, is empty or contains NUL")
    return type_name


class Reader:
    """Read one recorder's segments."""

    def __init__(self, place: Place) -> None:
        self.cursor = place.start
        self._folder = place.folder
        self._recorder = place.recorder
        self._number = 0
        self._path = Path()
        self._buffer: Buffer = b""
        self._types: dict[bytes, str] = {}

    def read(self, *, last: int, events_max: int, bytes_max: int, partial: Batch | None = None) -> Batch:
        """Extend `partial`, or a batch that begins at the cursor, by the records up to position `last`.

        The batch holds at most `events_max` records, and payloads of at most `bytes_max` bytes unless its first record
        is larger. The cursor stays; set it to `after` when the batch is handed out. Raises `SpoolDamaged`; and
        `FileNotFoundError` if the segments at the cursor were deleted.
        """
        records, total, (number, offset, position), _ = partial or Batch([], 0, self.cursor, complete=False)
        types = self._types
        if number != self._number:
            self._open_segment(number)
        until = min(last, position + events_max - len(records))
        full = False
        while position < until and not full:
            for frame in decode_each(self._buffer, offset, salt_of(self._recorder, number)):
                kind, version, at, sequence, wall_ns, monotonic_ns, episode, name, payload, _, size = frame
                if kind != COMMIT:
                    total += len(payload)
                    if total > bytes_max and records:
                        total -= len(payload)
                        full = True
                        break
                    if at != position + 1:
                        raise SpoolDamaged(self._path, offset, f"holds position {at} where {position + 1} belongs")
                    position = at
                    type_name = types.get(name)
                    if type_name is None:
                        type_name = types[name] = check_type(self._path, offset, name)
                    owner = episode if kind == EVENT else None
                    values = (position, owner, sequence, type_name, version, wall_ns, monotonic_ns, payload)
                    records.append(make(Record, values))
                offset += size
                if position == until:
                    break
            else:
                number, offset = number + 1, self._next_segment(number + 1, offset, position)
                if not records:  # the finished segment may be deleted before the next read
                    self.cursor = Cursor(number, offset, position)
        complete = full or len(records) >= events_max or total >= bytes_max
        return Batch(records, total, Cursor(number, offset, position), complete)

    def skip_to(self, position: int, *, on_records: Callable[[Sequence[Record]], None] = lambda _: None) -> None:
        """Move the cursor behind this position; the records up to it must be readable. Raises as `read` does."""
        while self.cursor.position < position:
            batch = self.read(last=position, events_max=10_000, bytes_max=2**22)
            on_records(batch.records)
            self.cursor = batch.after

    def close(self) -> None:
        """Close the current segment."""
        if isinstance(self._buffer, mmap.mmap):
            self._buffer.close()
        self._number, self._buffer = 0, b""

    def _open_segment(self, number: int) -> None:
        self.close()
        self._path = segment_path(self._folder, number)
        self._buffer = map_segment(self._path)
        self._number = number

    def _next_segment(self, number: int, offset: int, position: int) -> int:
        """Open the segment that continues the current one; return the offset of its first frame.

        Raises `FileNotFoundError` if both were deleted: the recorder deletes the oldest first. Otherwise a missing one
        is damage.
        """
        before = self._path
        try:
            self._open_segment(number)
        except FileNotFoundError:
            if not before.exists():
                raise
            raise SpoolDamaged(before, offset, f"position {position + 1} is missing") from None
        header = decode_header(self._buffer)
        if header is None or header.base != position + 1:
            raise SpoolDamaged(before, offset, f"position {position + 1} is missing")
        return header_bytes(len(header.open))
