"""The end of the queue that grows: gives every record its place, sequence and time, and writes it into the mapping.

All of it under one lock that is never held during a system call, but for the one case where records come faster than
the sync thread can make the next segment ahead. While it is held nothing is collected (`alone.py` says why).
"""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Mapping
from functools import partial
from gc import disable, enable, isenabled
from itertools import pairwise
from pathlib import Path
from threading import get_ident
from types import MappingProxyType
from typing import Final, NamedTuple
from zlib import crc32

from pycrorm_async.clock import Clock
from pycrorm_async.errors import EpisodeRefused, InternalError, PycrormError, SpoolFull, SpoolStuck, SpoolUnavailable
from pycrorm_async.events.envelope import Heading
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.files.frame import (
    CHECKSUM_START,
    COMMIT_BYTES,
    DECLARATION,
    EVENT,
    HEADER_BYTES,
    NO_EPISODE,
    TYPE_BYTES_MAX,
    encode_body,
    encode_commit,
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

__all__ = ["Appender", "Span", "SegmentStart"]

NOTHING_OPEN: Final[Mapping[EpisodeId, LastRecord]] = MappingProxyType({})
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
_NOT_NOW = _FULL | frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM})


class Span(NamedTuple):
    """What one sync covers: the records up to `position`, `records` of them new, and the files they are in."""

    position: int
    records: int
    checksum: int
    segments: tuple[Segment, ...]


class SegmentStart(NamedTuple):
    """A segment that holds records from position `base` on; `opened` are the episodes open before them."""

    number: int
    base: int
    path: Path
    opened: Mapping[EpisodeId, LastRecord]


class Appender:
    """Appends from any thread. `wake` is called at the first record of a span, `hurry` when a segment was begun.

    `make_room` frees so many bytes of a disk that is full; False if there is nothing to free. The first record follows
    position `after`, where these episodes are `opened`.
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
        self.declarations = Declarations()
        self.open: dict[EpisodeId, tuple[int, int, int]] = dict(opened)
        self.begun: list[SegmentStart] = []
        self._refusal: Callable[[], PycrormError] | None = None
        self.stuck: str | None = None  # why nothing will be trimmed any more
        self._span_count = 0
        self._span_checksum = 0
        self._quiet = True
        self._refused_bytes = 0
        self._disk_refused: str | None = None
        self._sealed: list[Segment] = []
        self._prepared: Segment | None = None
        self._end = self._ordinary_end = capacity.end
        self._current = self._allocate(1)
        self._buffer, self._offset, self._salt = self._current.buffer, 0, 0
        self._begin(self._current)

    # --- putting -----------------------------------------------------------------------------------------------

    def put(self, heading: Heading, payload: bytes, reserved: bool) -> int:  # noqa: FBT001  # the hot path
        """`RecorderQueue.put_nowait`. Not from a signal handler: the lock may be this thread's own."""
        episode, type_name, version = heading
        name = self._type_names.get(type_name) or self._encode_type(type_name)
        body = encode_body(name, payload)
        body_checksum = crc32(body)
        kind, owner, sequence = EVENT, episode or NO_EPISODE, 0
        alone, me = self._gc_lock, get_ident()
        if alone.owner == me:
            raise alone.reentered()
        try:
            with alone.lock:
                try:
                    alone.owner = me
                    alone.paused = isenabled()
                    disable()
                    if self._refusal is not None:
                        raise self._refusal()
                    if episode is None:
                        kind = DECLARATION
                        self._declare(body, len(name), version, len(payload))
                    elif (last := self.open.get(episode)) is not None:
                        sequence = last[0] + 1
                    elif type_name == EPISODE_STARTED:
                        self._refuse_one_too_many()
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
                    # From here to the blank line nothing is called, so no KeyboardInterrupt can come between the
                    # steps: the record and the bookkeeping are both there or both not. The header goes last: a body
                    # alone is no frame.
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

                    if self._quiet:
                        self._wake()
                        self._quiet = False
                finally:
                    if alone.paused:
                        enable()
        finally:
            if alone.owner == me:
                alone.owner = 0
        return sequence

    def _refuse_one_too_many(self) -> None:
        """Every segment's header names the open episodes: with more, the largest record would not fit beside them."""
        if not self._capacity.takes_episode(episodes=len(self.open), declared=self.declarations.bytes):
            raise EpisodeRefused(f"{len(self.open):,} episodes are open: no more fit into a segment (segment_bytes)")

    def _declare(self, body: bytes, name_bytes: int, version: int, payload_bytes: int) -> None:
        """Every segment begins with it from now on."""
        room = self._capacity.room_to_declare(episodes=len(self.open), declared=self.declarations.bytes)
        self.declarations.add(body, name_bytes=name_bytes, version=version, payload_bytes=payload_bytes, room=room)

    def _encode_type(self, type_name: str) -> bytes:
        name = type_name.encode()
        if not 0 < len(name) <= TYPE_BYTES_MAX:
            raise InternalError(f"the name of an event type takes 1 to 255 bytes, not {len(name)}")
        self._type_names[type_name] = name
        return name

    def _find_room(self, frame_bytes: int, *, reserved: bool) -> None:
        """A frame of this size fits at `_offset` afterwards, in a new segment if need be. Under the lock."""
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
        """This segment is the current one from now on."""
        base = self.position + 1
        open_before = {episode: LastRecord(*last) for episode, last in self.open.items()}
        offset = segment.begin(SegmentHeader(self._recorder, segment.number, base, open_before))
        salt = salt_of(self._recorder, segment.number)
        before = AppendState(offset, self.position, self._span_count, self._span_checksum)
        repeated = self.declarations.write(segment.buffer, before, salt=salt, clock=self._clock)
        begun = [*self.begun, SegmentStart(segment.number, base, segment.path, open_before)]
        sealed = [*self._sealed, self._current] if self.begun else []
        # As in `put`: nothing is called between these steps.
        self._current = segment
        self._buffer = segment.buffer
        self._offset, self.position, self._span_count, self._span_checksum = repeated
        self._salt = salt
        self._sealed = sealed
        self._prepared = None
        self.begun = begun

        self._set_limits()

    # --- syncing -----------------------------------------------------------------------------------------------

    def begin_sync(self) -> Span:
        """What is there now; the next record begins a new span and wakes the sync thread again."""
        return self._gc_lock.run(self._begin_sync)

    def _begin_sync(self) -> Span:
        span = Span(self.position, self._span_count, self._span_checksum, (*self._sealed, self._current))
        self._span_count = self._span_checksum = 0
        self._quiet = True
        return span

    def append_commit(self, span: Span) -> Segment:
        """Appends the frame that says the span is on the disk; returns the segment that holds it, to be synced."""
        return self._gc_lock.run(partial(self._append_commit, span))

    def _append_commit(self, span: Span) -> Segment:
        frame = encode_commit(
            position=span.position,
            count=span.records,
            checksum=span.checksum,
            wall_ns=self._wall_ns(),
            monotonic_ns=self._monotonic_ns(),
            salt=self._salt,
        )
        end = self._offset + COMMIT_BYTES
        assert end <= self._capacity.segment_bytes, "room for commit frames is kept free"
        self._buffer[self._offset : end] = frame
        self._offset = end
        return self._current

    def end_sync(self, span: Span) -> None:
        """The files that were full when the span was taken are safe, whole, and need not be open any more."""
        for segment in self._gc_lock.run(partial(self._end_sync, span)):
            segment.close()

    def _end_sync(self, span: Span) -> list[Segment]:
        done = [segment for segment in self._sealed if segment in span.segments[:-1]]
        self._sealed = [segment for segment in self._sealed if segment not in done]
        return done

    # --- room --------------------------------------------------------------------------------------------------

    def prepare(self) -> bool:
        """Makes the next segment ahead if there is none; True if the disk has no room for it. Raises `OSError`."""
        if self._prepared is not None or len(self.begun) >= self._capacity.segments_max:
            return False
        try:
            # Nothing may be put in this thread while it holds `_making`, and it must not hold the other lock so long.
            self._gc_lock.hold_off()
            with self._making:
                refused = self._prepare()
        finally:
            self._gc_lock.go_on()
        self._gc_lock.run(partial(self._prepared_or, refused))
        return refused is not None

    def _prepare(self) -> str | None:
        if self._prepared is not None:
            return None
        try:
            self._prepared = self._allocate(self._current.number + 1)
        except OSError as error:
            if error.errno not in _NOT_NOW:
                raise
            return error.strerror
        return None

    def _prepared_or(self, refused: str | None) -> None:
        self._disk_refused = refused
        self._set_limits()
        self._forget_refused()

    def trimmable(self, *, stored: int, safe_number: int) -> list[SegmentStart]:
        """The segments that may go: all in them is stored, and the header after them is safe on the disk."""
        begun = self.begun
        return [
            segment
            for segment, following in pairwise(begun)
            if following.base - 1 <= stored and following.number <= safe_number
        ]

    def trimmed(self, gone: list[SegmentStart]) -> None:
        """These segments are deleted."""
        self._gc_lock.run(partial(self._trimmed, gone))

    def _trimmed(self, gone: list[SegmentStart]) -> None:
        self.begun = [segment for segment in self.begun if segment not in gone]
        self._set_limits()
        self._forget_refused()

    def admits_again(self, *, reserved: bool) -> bool:
        """Whether a record as large as the largest that was refused would be taken now."""
        frame_bytes = max(self._refused_bytes, HEADER_BYTES)
        if self._offset + frame_bytes <= (self._end if reserved else self._ordinary_end):
            return True
        return self._gc_lock.run(partial(self._admits, frame_bytes, reserved=reserved))

    @property
    def end(self) -> int:
        """Where the last record or commit frame ends in its segment."""
        return self._offset

    @property
    def bytes_held(self) -> int:
        """Bytes of segments with records in them; the last one counts as far as it is written."""
        return self._gc_lock.run(lambda: (len(self.begun) - 1) * self._capacity.segment_bytes + self._offset)

    def full_error(self, reason: str) -> PycrormError:
        """What a put into a full spool raises."""
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
        return self._capacity.segments_max - len(self.begun)

    def _set_limits(self) -> None:
        self._ordinary_end = self._capacity.ordinary_end(
            spare=self._spare(), episodes=len(self.open), declared=self.declarations.bytes
        )

    def _allocate(self, number: int) -> Segment:
        while True:
            try:
                return Segment.allocate(self._folder, number=number, size=self._capacity.segment_bytes)
            except OSError as error:
                if error.errno not in _FULL or not self._make_room(self._capacity.segment_bytes):
                    raise

    def _allocation_refused(self, error: OSError) -> PycrormError:
        reason = error.strerror or str(error)
        if error.errno not in _NOT_NOW:
            return SpoolUnavailable(self._folder, reason)
        self._disk_refused = reason
        self._set_limits()
        self._hurry()  # the sync thread tries again until there is room
        return self.full_error(reason)

    # --- ending ------------------------------------------------------------------------------------------------

    def refuse(self, refusal: Callable[[], PycrormError]) -> None:
        """No record is taken from now on; the first reason stays."""
        self._gc_lock.run(partial(self._refuse, refusal))

    def _refuse(self, refusal: Callable[[], PycrormError]) -> None:
        self._refusal = self._refusal or refusal

    def close(self) -> None:
        """Gives up mappings and files, when refusing already."""
        self._gc_lock.run(self._close)

    def _close(self) -> None:
        for segment in (*self._sealed, self._current, self._prepared):
            if segment is not None:
                segment.close()

    def abandon(self, refusal: Callable[[], PycrormError]) -> None:
        """In a forked child: nothing here is this process's; the locks may be held by threads it does not have."""
        self._gc_lock.abandon()
        self._gc_lock, self._making = GcSafeLock(), threading.Lock()
        self._refusal = refusal
        self.close()
