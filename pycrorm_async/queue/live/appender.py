"""Append records to mapped segments: assign position, sequence and times, and write the frame.

**Theory of operation.** Two kinds of actors use an appender. *Producers*, any threads, call `put`. The *sync thread*
(`sync_thread.py`) syncs, preallocates and trims segments (`syncable_appender.py`). No consumer touches it: the consumer
reads the files.

A segment is first *prepared* (allocated ahead, all zero), then *current* (producers write into it), then *sealed*
(full, but not covered by a sync yet), and finally closed. `begun` lists the segments with records that are not deleted,
`open` the open episodes with their last sequence and times.

One lock, `_gc_lock`, protects all of this state; `gc_safe_lock.py` explains why the garbage collector is off while it
is held. Under the lock a producer takes the next position and sequence, reads the clocks and copies the frame into the
mapping, so that positions, sequences and times increase together and a refused event leaves no gap. A producer makes no
system call under the lock, with one exception: when it fills the current segment before the sync thread has prepared
the next one, it allocates that segment itself, or waits for the sync thread's allocation. `_making` keeps both from
allocating the same segment. The order is `_gc_lock`, then `_making`; the sync thread takes only `_making` for its
allocation, so that producers can go on, and pauses the garbage collector meanwhile, because a finalizer that records
would wait for `_making` in the same thread.

A KeyboardInterrupt can arrive at any call. The steps that write a record and update the bookkeeping make no calls, so
either all or none of them happen. The header is written after the body: a body without a header does not decode. A kill
between the two leaves a torn frame, which recovery truncates.

A sync takes a span (`begin_sync`): the records since the previous one, their checksum and their segments. The first
record of the next span finds `_quiet` set and wakes the sync thread, so one sync covers all records of an interval. A
segment may be deleted only after the database stored its records and the next segment's header is on the disk, because
that header lists the episodes open before it.
"""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Mapping
from functools import partial
from gc import disable, enable, isenabled
from pathlib import Path
from threading import get_ident
from types import MappingProxyType
from typing import Final, NamedTuple
from zlib import crc32

from pycrorm_async.clock import Clock
from pycrorm_async.errors import EpisodeRefused, InternalError, PycrormError, SpoolFull, SpoolStuck, SpoolUnavailable
from pycrorm_async.events.envelope import Heading, Receipt
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.files.frame import (
    CHECKSUM_START,
    DECLARATION,
    EVENT,
    HEADER_BYTES,
    NO_EPISODE,
    TYPE_BYTES_MAX,
    encode_body,
    encode_header,
)
from pycrorm_async.queue.files.segment import (
    EPISODE_ENDED,
    EPISODE_STARTED,
    LastRecord,
    Segment,
    SegmentHeader,
    salt_of,
)
from pycrorm_async.queue.live.capacity import Capacity
from pycrorm_async.queue.live.declarations import AppendState, Declarations
from pycrorm_async.queue.live.gc_safe_lock import GcSafeLock

NOTHING_OPEN: Final[Mapping[EpisodeId, LastRecord]] = MappingProxyType({})
FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Errors of a full disk."""
OUT_OF_RESOURCES: Final = FULL | frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM})
"""Errors that may pass: a put that meets one is refused as if the spool were full, and the sync thread retries."""


class SegmentStart(NamedTuple):
    """The beginning of a segment: `base` is the position of its first record, `opened` the episodes open before it."""

    number: int
    base: int
    path: Path
    opened: Mapping[EpisodeId, LastRecord]


class Appender:
    """An appender for any thread. Calls `wake` at the first record of a span and `hurry` after it began a segment.

    `make_room` frees a number of bytes on a full disk; it returns False if it has none to free. The first record gets
    position `after` + 1; `opened` are the episodes open before it.
    """

    def __init__(
        self,
        *,
        folder: Path,
        recorder: bytes,
        capacity: Capacity,
        clock: Clock,
        wake: Callable[[], None],
        hurry: Callable[[], None],
        make_room: Callable[[int], bool],
        after: int = 0,
        opened: Mapping[EpisodeId, LastRecord] = NOTHING_OPEN,
    ) -> None:
        self._folder = folder
        self._recorder = recorder
        self._capacity = capacity
        self._clock = clock
        self._wall_ns, self._monotonic_ns = clock
        self._wake = wake
        self._hurry = hurry
        self._make_room = make_room
        self._gc_lock = GcSafeLock()
        self._making = threading.Lock()
        self._type_names: dict[str, bytes] = {}

        self.position = after
        self.declarations = Declarations(capacity.descriptions_bytes_max)
        self.open: dict[EpisodeId, tuple[int, int, int]] = dict(opened)
        self.begun: list[SegmentStart] = []
        self._refusal: Callable[[], PycrormError] | None = None
        self.stuck: str | None = None  # why no segment will be deleted any more
        self._span_count = 0
        self._span_checksum = 0
        self._quiet = True
        self._refused_bytes = 0
        self.blob_bytes = 0
        """Bytes of the blobs beside the segments, which share their limit."""
        self._disk_refused: str | None = None
        self._sealed: list[Segment] = []
        self._prepared: Segment | None = None
        self._end = self._ordinary_end = capacity.end
        self._current = self._allocate(1)
        self._buffer, self._offset, self._salt = self._current.buffer, 0, 0
        self._begin(self._current)

    # --- putting -----------------------------------------------------------------------------------------------

    def put(self, heading: Heading, payload: bytes, reserved: bool, receipt: Receipt | None = None) -> int:  # noqa: FBT001  # the hot path
        """Append one event as `RecorderQueue.put_nowait` does."""
        episode, type_name, version = heading
        name = self._type_names.get(type_name) or self._encode_type(type_name)
        body = encode_body(name, payload)
        body_checksum = crc32(body)
        kind, owner, sequence = EVENT, episode or NO_EPISODE, 0
        gc_lock, thread = self._gc_lock, get_ident()
        if gc_lock.owner == thread:
            raise gc_lock.reentered()
        with gc_lock.lock:
            try:
                gc_lock.paused = paused = isenabled()
                disable()
                gc_lock.paused, gc_lock.owner = paused, thread
                if self._refusal is not None:
                    raise self._refusal()
                if episode is None:
                    kind = DECLARATION
                    self._declare(body, name, version, payload)
                elif (last := self.open.get(episode)) is not None:
                    sequence = last[0] + 1
                elif type_name == EPISODE_STARTED:
                    self._check_open_episodes()
                    sequence = 1
                else:
                    raise InternalError(f"episode {episode_text(episode)} is not open: it cannot take {type_name}")
                end = self._offset + HEADER_BYTES + len(body)
                if end > (self._end if reserved else self._ordinary_end):
                    self._find_room(HEADER_BYTES + len(body), reserved=reserved)
                    end = self._offset + HEADER_BYTES + len(body)
                offset = self._offset
                position = self.position + 1
                wall_ns, monotonic_ns = self._wall_ns(), self._monotonic_ns()
                header = encode_header(
                    kind,
                    len(name),
                    version,
                    len(payload),
                    position,
                    sequence,
                    wall_ns,
                    monotonic_ns,
                    owner,
                    self._salt,
                    body_checksum,
                )
                span_checksum = crc32(header[CHECKSUM_START:], self._span_checksum)
                buffer = self._buffer
                # No calls from here to the blank line, so that a KeyboardInterrupt cannot separate the record from
                # the bookkeeping. The header comes last, because a body alone does not decode.
                buffer[offset + HEADER_BYTES : end] = body
                buffer[offset : offset + HEADER_BYTES] = header
                self._offset = end
                self.position = position
                self._span_count += 1
                self._span_checksum = span_checksum
                if episode is not None:
                    self.open[episode] = (sequence, wall_ns, monotonic_ns)
                    if type_name == EPISODE_ENDED:
                        del self.open[episode]
                if receipt is not None:
                    receipt.sequence = sequence

                if self._quiet:
                    self._wake()
                    self._quiet = False
            finally:
                gc_lock.owner = 0
                if gc_lock.paused:
                    gc_lock.paused = False
                    enable()
        return sequence

    def _check_open_episodes(self) -> None:
        """Refuse an episode if the list of open episodes in a header would leave no space for the largest record."""
        if not self._capacity.takes_episode(episodes=len(self.open), declared=self.declarations.bytes):
            raise EpisodeRefused(f"{len(self.open):,} episodes are open: no more fit into a segment (segment_bytes)")

    def _declare(self, body: bytes, name: bytes, version: int, payload: bytes) -> None:
        """Repeat this declaration at the beginning of every later segment, if it fits."""
        room = self._capacity.room_to_declare(episodes=len(self.open), declared=self.declarations.bytes)
        self.declarations.add(body, name=name, version=version, payload=payload, room=room)

    def _encode_type(self, type_name: str) -> bytes:
        name = type_name.encode()
        if not 0 < len(name) <= TYPE_BYTES_MAX:
            raise InternalError(f"the name of an event type takes 1 to 255 bytes, not {len(name)}")
        self._type_names[type_name] = name
        return name

    def _find_room(self, frame_bytes: int, *, reserved: bool) -> None:
        """Make a frame of this size fit at `_offset`, in a new segment if necessary. Needs the lock."""
        largest = self._capacity.frame_bytes_max(episodes=len(self.open), declared=self.declarations.bytes)
        if frame_bytes > largest:
            raise InternalError(f"a record of {frame_bytes:,} bytes does not fit into a segment ({largest:,})")
        if not self._admits(frame_bytes, reserved=reserved):
            self._refused_bytes = max(self._refused_bytes, frame_bytes)
            raise self.full_error(self._disk_refused or "spool_bytes_max is reached")
        if self._offset + frame_bytes > self._end:
            self._roll()

    def _roll(self) -> None:
        with self._making:
            segment = self._prepared
            if segment is None:
                try:
                    segment = self._allocate(self._current.number + 1)
                except OSError as error:
                    raise self._allocation_refused(error) from error
                self._prepared = segment
            self._begin(segment)
        self._hurry()

    def _begin(self, segment: Segment) -> None:
        """Make this segment the current one. Needs the lock."""
        base = self.position + 1
        open_before = {episode: LastRecord(*last) for episode, last in self.open.items()}
        offset = segment.begin(SegmentHeader(self._recorder, segment.number, base, open_before))
        salt = salt_of(self._recorder, segment.number)
        before = AppendState(offset, self.position, self._span_count, self._span_checksum)
        repeated = self.declarations.write(segment.buffer, before, salt=salt, clock=self._clock)
        begun = [*self.begun, SegmentStart(segment.number, base, segment.path, open_before)]
        sealed = [*self._sealed, self._current] if self.begun else []
        # As in `put`: no calls between these steps.
        self._current = segment
        self._buffer = segment.buffer
        self._offset, self.position, self._span_count, self._span_checksum = repeated
        self._salt = salt
        self._sealed = sealed
        self._prepared = None
        self.begun = begun

        self._set_limits()

    # --- space --------------------------------------------------------------------------------------------------

    def admits_again(self, *, reserved: bool) -> bool:
        """Return whether a record as large as the largest refused one would be accepted now."""
        frame_bytes = max(self._refused_bytes, HEADER_BYTES)
        if self._offset + frame_bytes <= (self._end if reserved else self._ordinary_end):
            return True
        return self._gc_lock.run(partial(self._admits, frame_bytes, reserved=reserved))

    @property
    def end(self) -> int:
        """Offset of the end of the last frame in the current segment."""
        return self._offset

    @property
    def bytes_held(self) -> int:
        """Bytes of the segments with records; the current one counts up to its last frame."""
        return self._gc_lock.run(lambda: (len(self.begun) - 1) * self._capacity.segment_bytes + self._offset)

    def full_error(self, reason: str) -> PycrormError:
        """Return the error that a put into a full spool raises."""
        if self.stuck is None:
            return SpoolFull(f"spool {self._folder} is full: {reason}")
        return SpoolStuck(f"spool {self._folder} is full ({reason}) and cannot be emptied: {self.stuck}")

    def _admits(self, frame_bytes: int, *, reserved: bool) -> bool:
        return self._capacity.admits(
            frame_bytes,
            offset=self._offset,
            spare=self._spare(),
            episodes=len(self.open),
            declared=self.declarations.bytes,
            reserved=reserved,
        )

    def _forget_refused(self) -> None:
        if self._admits(self._refused_bytes, reserved=False):
            self._refused_bytes = 0

    def _spare(self) -> int:
        if self._disk_refused is not None:
            return int(self._prepared is not None)
        return self._segments_left()

    def _segments_left(self) -> int:
        blobs = -(-self.blob_bytes // self._capacity.segment_bytes)
        return max(0, self._capacity.segments_max - len(self.begun) - blobs)

    def reserve_blob(self, size: int) -> bool:
        """Take this many bytes for a blob, or return them if negative; False if records would find no space then."""
        return self._gc_lock.run(partial(self._reserve_blob, size))

    def _reserve_blob(self, size: int) -> bool:
        if size > 0 and self._refusal is not None:
            raise self._refusal()
        before, self.blob_bytes = self.blob_bytes, max(0, self.blob_bytes + size)
        if size > 0 and not self._admits(HEADER_BYTES, reserved=False):
            self.blob_bytes = before
            return False
        self._set_limits()
        return True

    def _set_limits(self) -> None:
        self._ordinary_end = self._capacity.ordinary_end(
            spare=self._spare(), episodes=len(self.open), declared=self.declarations.bytes
        )

    def _allocate(self, number: int) -> Segment:
        while True:
            try:
                return Segment.allocate(self._folder, number=number, size=self._capacity.segment_bytes)
            except OSError as error:
                if error.errno not in FULL or not self._make_room(self._capacity.segment_bytes):
                    raise

    def _allocation_refused(self, error: OSError) -> PycrormError:
        reason = error.strerror or str(error)
        if error.errno not in OUT_OF_RESOURCES:
            return SpoolUnavailable(self._folder, reason)
        self._disk_refused = reason
        self._set_limits()
        self._hurry()  # the sync thread retries until the disk has space
        return self.full_error(reason)

    # --- ending ------------------------------------------------------------------------------------------------

    def refuse(self, refusal: Callable[[], PycrormError]) -> None:
        """Refuse every record from now on; the first refusal stays."""
        self._gc_lock.run(partial(self._refuse, refusal))

    def _refuse(self, refusal: Callable[[], PycrormError]) -> None:
        self._refusal = self._refusal or refusal

    def close(self) -> None:
        """Close mappings and files; call `refuse` first."""
        self._gc_lock.run(self._close)

    def _close(self) -> None:
        for segment in (*self._sealed, self._current, self._prepared):
            if segment is not None:
                segment.close()

    def abandon(self, refusal: Callable[[], PycrormError]) -> None:
        """Detach in a forked child: replace the locks, whose holders may be threads that the child does not have."""
        self._gc_lock.abandon()
        self._gc_lock, self._making = GcSafeLock(), threading.Lock()
        self._refusal = refusal
        self.close()
