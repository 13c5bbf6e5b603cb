"""Append records to mapped segments: assign position, sequence and times, and write the frame.

**Theory of operation.** Two kinds of actors use an appender. *Producers*, any threads, call `put`. The *sync thread*
(`sync_thread.py`) syncs, preallocates and trims segments. No consumer touches it: the consumer reads the files.

A segment is first *prepared* (allocated ahead, all zero), then *current* (producers write into it), then *sealed*
(full, but not covered by a sync yet), and finally closed. `begun` lists the segments with records that are not deleted,
`open` the open episodes with their last sequence and times.

One lock, `_gc_lock`, protects all of this state; `GcSafeLock` explains why the garbage collector is off while it is
held. Methods marked `locked` take it. Under the lock a producer takes the next position and sequence, reads the clocks
and copies the frame into the mapping, so that positions, sequences and times increase together and a refused event
leaves no gap. A producer makes no system call under the lock, with one exception: when it fills the current segment
before the sync thread has prepared the next one, it allocates that segment itself, or waits for the sync thread's
allocation. `_making` keeps both from allocating the same segment. The order is `_gc_lock`, then `_making`; the sync
thread takes only `_making` for its allocation, so that producers can go on, and pauses the garbage collector meanwhile,
because a finalizer that records would wait for `_making` in the same thread.

The compiled core (`pycrorm_async.core`) appends an event of an open episode that fits without `_gc_lock`: it holds the
interpreter lock from its first look at the state to its last write, and leaves the event to `put` while `owner` says
that a thread changes the state in several steps. A clock that runs Python is left to `put` too.

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
import mmap
import threading
from collections.abc import Callable, Sequence
from functools import partial
from gc import disable, enable, isenabled
from itertools import pairwise
from pathlib import Path
from threading import get_ident
from typing import Final, NamedTuple
from zlib import crc32

from pycrorm_async import core, errors
from pycrorm_async.clock import Clock
from pycrorm_async.events.codec import Heading
from pycrorm_async.events.ids import SEQUENCE_MAX, EpisodeId, episode_text
from pycrorm_async.queue import format as spool_format
from pycrorm_async.queue.format import frame_bytes
from pycrorm_async.queue.gc_safe_lock import GcSafeLock, locked
from pycrorm_async.settings import Settings

FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Errors of a full disk."""
OUT_OF_RESOURCES: Final = FULL | frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM})
"""Errors that may pass: a put that meets one is refused as if the spool were full, and the sync thread retries."""
_TOUCHED_BYTES_MAX: Final = 2**18
"""Bounds the bytes made writable ahead, during which the interpreter lock is held: 64 pages take 0.4 ms."""


# === appender ===============================================================================================


_ENDS: Final = frozenset({"NodeEnded", spool_format.EPISODE_ENDED})
"""The events that an episode takes beyond `events_max`, so that it can be ended."""


_FULL_EPISODE: Final = (
    "episode {} has {:,} events, as many as one can hold: only ends are still recorded in it; end it, and open another"
)


class SegmentStart(NamedTuple):
    """The beginning of a segment: `base` is the position of its first record."""

    number: int
    base: int
    path: Path


class SyncSpan(NamedTuple):
    """The records of one sync: those up to `position`, `records` of them new, and the files that hold them."""

    position: int
    records: int
    checksum: int
    segments: tuple[spool_format.Segment, ...]


class Appender(core.Tail):
    """An appender for any thread. Calls `wake` at the first record of a span and `hurry` after it began a segment.

    `make_room` frees a number of bytes on a full disk; it returns False if it has none to free.
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
    ) -> None:
        self._folder = folder
        self._recorder = recorder
        self._capacity = capacity
        self._events_max = capacity.events_max
        self._clock = clock
        self._has_atomic_clock = all(isinstance(each, core.ATOMIC) for each in clock)
        self._wall_ns, self._monotonic_ns = clock
        self._wake = wake
        self._hurry = hurry
        self._make_room = make_room
        self._gc_lock = GcSafeLock(self)
        self._making = threading.Lock()
        self._type_names: dict[str, bytes] = {}

        self.position = 0
        self.declarations = RepeatedDeclarations(capacity.descriptions_bytes_max)
        self.open = {}
        self.begun: list[SegmentStart] = []
        self._refusal = None
        self.stuck: str | None = None  # why no segment will be deleted any more
        self._span_count = 0
        self._span_checksum = 0
        self._quiet = True
        self._touched_from = 0
        self._refused_bytes = spool_format.HEADER_BYTES
        self.blob_bytes = 0
        """Bytes of the blobs beside the segments, which share their limit."""
        self._disk_refused: str | None = None
        self._sealed: list[spool_format.Segment] = []
        self._prepared: spool_format.Segment | None = None
        self._end = self._ordinary_end = capacity.end
        self._current = self._allocate(1)
        self._buffer, self._offset, self._salt = self._current.buffer, 0, 0
        self._begin(self._current)

    # --- putting -----------------------------------------------------------------------------------------------

    def put(
        self,
        heading: Heading,
        payload: bytes,
        reserved: bool,  # noqa: FBT001  # the hot path
        at: tuple[int, int] | None = None,
        after: int = 0,
    ) -> int:
        """Append one event of any kind, for `RecorderQueue.put_nowait`, which tries `append` first."""
        episode, type_name, version = heading
        name = self._type_names.get(type_name) or self._encode_type(type_name)
        body = spool_format.encode_body(name, payload)
        body_checksum = crc32(body)
        kind, owner, sequence, last = spool_format.EVENT, episode or spool_format.NO_EPISODE, 0, None
        gc_lock, thread = self._gc_lock, get_ident()
        if self.owner == thread:
            raise gc_lock.reentered()
        with gc_lock.lock:
            try:
                gc_lock.paused = paused = isenabled()
                disable()
                gc_lock.paused, self.owner = paused, thread
                if self._refusal is not None:
                    raise self._refusal()
                if episode is None:
                    kind = spool_format.DECLARATION
                    self._declare(body, name, version, payload)
                elif (last := self.open.get(episode)) is not None:
                    sequence = last[0] + 1
                    if sequence > self._events_max and type_name not in _ENDS:
                        raise errors.EpisodeFull(_FULL_EPISODE.format(episode_text(episode), sequence - 1))
                else:
                    sequence = self._first_sequence(episode, type_name, after)
                end = self._offset + spool_format.HEADER_BYTES + len(body)
                if end > (self._end if reserved else self._ordinary_end):
                    self._find_room(spool_format.HEADER_BYTES + len(body), reserved=reserved)
                    end = self._offset + spool_format.HEADER_BYTES + len(body)
                offset = self._offset
                position = self.position + 1
                if at is None:
                    wall_ns, monotonic_ns = self._wall_ns(), self._monotonic_ns()
                else:
                    wall_ns, monotonic_ns = at[0], at[1] if last is None else max(at[1], last[2])
                header = spool_format.encode_frame_header(
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
                span_checksum = crc32(header[spool_format.CHECKSUM_START :], self._span_checksum)
                buffer = self._buffer
                # No calls from here to the blank line, so that a KeyboardInterrupt cannot separate the record from
                # the bookkeeping. The header comes last, because a body alone does not decode.
                buffer[offset + spool_format.HEADER_BYTES : end] = body
                buffer[offset : offset + spool_format.HEADER_BYTES] = header
                self._offset = end
                self.position = position
                self._span_count += 1
                self._span_checksum = span_checksum
                if episode is not None:
                    self.open[episode] = (sequence, wall_ns, monotonic_ns)
                    if type_name == spool_format.EPISODE_ENDED:
                        del self.open[episode]

                if self._quiet:
                    self._wake()
                    self._quiet = False
            finally:
                self.owner = 0
                if gc_lock.paused:
                    gc_lock.paused = False
                    enable()
        return sequence

    def _first_sequence(self, episode: EpisodeId, type_name: str, after: int) -> int:
        """Return the sequence of the first event of an episode that is not open. Needs the lock."""
        if type_name != spool_format.EPISODE_STARTED and not after:
            raise errors.InternalError(f"episode {episode_text(episode)} is not open: it cannot take {type_name}")
        # The list of open episodes in a header must leave space for the largest record.
        if not self._capacity.takes_episode(episodes=len(self.open), declared=self.declarations.bytes):
            raise errors.EpisodeRefused(
                f"{len(self.open):,} episodes are open: no more fit into a segment (segment_bytes)"
            )
        return after + 1

    def _declare(self, body: bytes, name: bytes, version: int, payload: bytes) -> None:
        """Repeat this declaration at the beginning of every later segment, if it fits."""
        room = self._capacity.room_to_declare(episodes=len(self.open), declared=self.declarations.bytes)
        self.declarations.add(body, name=name, version=version, payload=payload, room=room)

    def _encode_type(self, type_name: str) -> bytes:
        name = type_name.encode()
        if not 0 < len(name) <= spool_format.TYPE_BYTES_MAX:
            raise errors.InternalError(f"the name of an event type takes 1 to 255 bytes, not {len(name)}")
        self._type_names[type_name] = name
        return name

    def _find_room(self, frame_bytes: int, *, reserved: bool) -> None:
        """Make a frame of this size fit at `_offset`, in a new segment if necessary. Needs the lock."""
        largest = self._capacity.frame_bytes_max(episodes=len(self.open), declared=self.declarations.bytes)
        if frame_bytes > largest:
            raise errors.InternalError(f"a record of {frame_bytes:,} bytes does not fit into a segment ({largest:,})")
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
                    reason = error.strerror or str(error)
                    if error.errno not in OUT_OF_RESOURCES:
                        raise errors.SpoolUnavailable(self._folder, reason) from error
                    self._disk_refused = reason
                    self._set_limits()
                    self._hurry()  # the sync thread retries until the disk has space
                    raise self.full_error(reason) from error
                self._prepared = segment
            self._begin(segment)
        self._hurry()

    def _begin(self, segment: spool_format.Segment) -> None:
        """Make this segment the current one. Needs the lock."""
        base = self.position + 1
        open_before = {episode: spool_format.LastRecord(*last) for episode, last in self.open.items()}
        offset = segment.begin(spool_format.SegmentHeader(self._recorder, segment.number, base, open_before))
        salt = spool_format.salt_of(self._recorder, segment.number)
        before = AppendState(offset, self.position, self._span_count, self._span_checksum)
        repeated = self.declarations.write(segment.buffer, before, salt=salt, clock=self._clock)
        begun = [*self.begun, SegmentStart(segment.number, base, segment.path)]
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
        frame_bytes = self._refused_bytes
        if self._offset + frame_bytes <= (self._end if reserved else self._ordinary_end):
            return True
        return self._gc_lock.run(partial(self._admits, frame_bytes, reserved=reserved))

    @property
    def end(self) -> int:
        """Offset of the end of the last frame in the current segment."""
        return self._offset

    @property
    @locked
    def bytes_held(self) -> int:
        """Bytes of the segments with records; the current one counts up to its last frame."""
        return (len(self.begun) - 1) * self._capacity.segment_bytes + self._offset

    @property
    @locked
    def segments(self) -> tuple[spool_format.Segment, ...]:
        """The mapped segments: full ones that no sync covers yet, and the current one."""
        return (*self._sealed, self._current)

    def full_error(self, reason: str) -> errors.PycrormError:
        """Return the error that a put into a full spool raises."""
        if self.stuck is None:
            return errors.SpoolFull(f"spool {self._folder} is full: {reason}")
        return errors.SpoolStuck(f"spool {self._folder} is full ({reason}) and cannot be emptied: {self.stuck}")

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
            self._refused_bytes = spool_format.HEADER_BYTES

    def _spare(self) -> int:
        if self._disk_refused is not None:
            return int(self._prepared is not None)
        return self._segments_left()

    def _segments_left(self) -> int:
        blobs = -(-self.blob_bytes // self._capacity.segment_bytes)
        return max(0, self._capacity.segments_max - len(self.begun) - blobs)

    @locked
    def reserve_blob(self, size: int) -> bool:
        """Take this many bytes for a blob, or return them if negative; False if records would find no space then."""
        if size > 0 and self._refusal is not None:
            raise self._refusal()
        before, self.blob_bytes = self.blob_bytes, max(0, self.blob_bytes + size)
        if size > 0 and not self._admits(spool_format.HEADER_BYTES, reserved=False):
            self.blob_bytes = before
            return False
        self._set_limits()
        return True

    def _set_limits(self) -> None:
        self._ordinary_end = self._capacity.ordinary_end(
            spare=self._spare(), episodes=len(self.open), declared=self.declarations.bytes
        )

    def _allocate(self, number: int) -> spool_format.Segment:
        while True:
            try:
                return spool_format.Segment.allocate(self._folder, number=number, size=self._capacity.segment_bytes)
            except OSError as error:
                if error.errno not in FULL or not self._make_room(self._capacity.segment_bytes):
                    raise

    # --- the sync thread ---------------------------------------------------------------------------------------

    @locked
    def begin_sync(self) -> SyncSpan:
        """Return the span since the last call; the next record begins a new span and wakes the sync thread."""
        span = SyncSpan(self.position, self._span_count, self._span_checksum, (*self._sealed, self._current))
        self._span_count = self._span_checksum = 0
        self._quiet = True
        return span

    @locked
    def append_commit(self, span: SyncSpan) -> spool_format.Segment:
        """Append the commit frame of a synced span; return the segment that holds it, which the caller must sync."""
        frame = spool_format.encode_commit(
            position=span.position,
            count=span.records,
            checksum=span.checksum,
            wall_ns=self._wall_ns(),
            monotonic_ns=self._monotonic_ns(),
            salt=self._salt,
        )
        end = self._offset + spool_format.COMMIT_BYTES
        assert end <= self._capacity.segment_bytes, "space for commit frames is reserved"
        self._buffer[self._offset : end] = frame
        self._offset = end
        return self._current

    def touch_ahead(self) -> None:
        """Make the pages of the next records writable, as many as the last span took; a sync made all read-only.

        A page fault takes three times as long as a put. More pages than that would be written at each sync for nothing.
        """
        segment, offset = self._current, self._offset  # without the lock: a page too few or too many does no harm
        taken = min(max(1, offset - self._touched_from), _TOUCHED_BYTES_MAX)
        self._touched_from = offset
        segment.touch(offset, offset + taken)

    def end_sync(self, span: SyncSpan) -> None:
        """Close the segments that were full when the span was taken: they are complete and on the disk."""
        sealed = span.segments[:-1]
        self._gc_lock.run(partial(self._forget_sealed, sealed))
        for segment in sealed:
            segment.close()

    def _forget_sealed(self, done: Sequence[spool_format.Segment]) -> None:
        self._sealed = [segment for segment in self._sealed if segment not in done]

    def prepare(self) -> bool:
        """Allocate the next segment ahead if there is none; True if the disk has no space. Raises `OSError`."""
        if self._prepared is not None or not self._segments_left():
            return False
        refused: str | None = None
        try:
            # Holding `_gc_lock` during the allocation would block producers. Without it a finalizer could record in
            # this thread and wait for `_making`, which the thread holds: so only pause the garbage collector.
            self._gc_lock.pause_gc()
            with self._making:
                if self._prepared is None:
                    self._prepared = self._allocate(self._current.number + 1)
        except OSError as error:
            if error.errno not in OUT_OF_RESOURCES:
                raise
            refused = error.strerror
        finally:
            self._gc_lock.resume_gc()
        self._note_preparation(refused)
        return refused is not None

    @locked
    def _note_preparation(self, refused: str | None) -> None:
        if refused is not None or self._prepared is not None:  # else a put has used it, and may have met a full disk
            self._disk_refused = refused
        self._set_limits()
        self._forget_refused()

    def trimmable(self, *, stored: int, safe_number: int) -> list[SegmentStart]:
        """List the segments that may be deleted: their records are stored, and the next header is on the disk."""
        begun = self.begun
        return [
            segment
            for segment, following in pairwise(begun)
            if following.base - 1 <= stored and following.number <= safe_number
        ]

    @locked
    def trimmed(self, deleted: list[SegmentStart]) -> None:
        """Note that these segments are deleted."""
        self.begun = [segment for segment in self.begun if segment not in deleted]
        self._set_limits()
        self._forget_refused()

    # --- ending ------------------------------------------------------------------------------------------------

    @locked
    def refuse(self, refusal: Callable[[], errors.PycrormError]) -> None:
        """Refuse every record from now on; the first refusal stays."""
        self._refusal = self._refusal or refusal

    @locked
    def close(self) -> None:
        """Close mappings and files; call `refuse` first."""
        self._buffer = None  # a mapping in use cannot be closed
        for segment in (*self._sealed, self._current, self._prepared):
            if segment is not None:
                segment.close()

    def abandon(self, refusal: Callable[[], errors.PycrormError]) -> None:
        """Detach in a forked child: replace the locks, whose holders may be threads that the child does not have."""
        self._gc_lock.abandon()
        self.owner = 0
        self._gc_lock, self._making = GcSafeLock(self), threading.Lock()
        self._refusal = refusal
        self.close()


# === capacity =================================================================================================
#
# Decide whether a frame may be put: limit one recorder's bytes, and reserve space for ends and observations. Pure.
#
# Space is assigned in whole segments, so the files never exceed `spool_bytes_max`. Each segment reserves space for two
# commit frames at its end: that of a sync that began before the last record, and that of the sync that covers it.

_COMMITS_BYTES = 2 * spool_format.COMMIT_BYTES
_EPISODES_MIN = 16
"""Open episodes that every segment's header has space for beside the largest record."""


_ENDS_MAX = 2**20
"""Bounds the sequences that an episode keeps for ends: more open nodes than fit into a process' memory."""


class Capacity(NamedTuple):
    """The limits of one recorder; `events_max` are those of an episode beside the ends of its nodes and its own.

    Every segment begins with a header that lists the open episodes, and with the declarations in use. With up to
    `episodes_max` open episodes the largest record still fits into a segment; declarations use part of that space.

    In the methods `spare` is the number of segments that may still begin, `episodes` the number of open episodes, and
    `declared` the bytes of the declarations in use.
    """

    segment_bytes: int
    segments_max: int
    reserve_bytes: int
    episodes_max: int
    events_max: int = SEQUENCE_MAX

    @classmethod
    def of(cls, settings: Settings) -> Capacity:
        """Derive the limits. Raises `CallerError` for settings that could block the queue for ever or lose a record."""
        if settings.spool_bytes_max - settings.spool_reserve_bytes < 3 * settings.segment_bytes:
            raise errors.CallerError(
                f"spool_bytes_max ({settings.spool_bytes_max:,}) must hold the reserve"
                f" ({settings.spool_reserve_bytes:,}) and three segments ({settings.segment_bytes:,} each)"
            )
        if settings.segment_bytes > spool_format.SEGMENT_BYTES_MAX:
            raise errors.CallerError(
                f"segment_bytes ({settings.segment_bytes:,}) must be at most {spool_format.SEGMENT_BYTES_MAX:,}"
            )
        needed = (
            spool_format.header_bytes(_EPISODES_MIN)
            + frame_bytes(spool_format.TYPE_BYTES_MAX, settings.record_bytes_max)
            + _COMMITS_BYTES
        )
        left = settings.segment_bytes - needed
        if left < 0:
            raise errors.CallerError(
                f"segment_bytes ({settings.segment_bytes:,}) must hold a record of record_bytes_max"
                f" ({settings.record_bytes_max:,}) and {_EPISODES_MIN} open episodes: {needed:,} at least"
            )
        return cls(
            settings.segment_bytes,
            settings.spool_bytes_max // settings.segment_bytes,
            settings.spool_reserve_bytes,
            _EPISODES_MIN + left // (spool_format.header_bytes(1) - spool_format.header_bytes(0)),
            settings.episode_events_max - min(settings.episode_events_max // 8, _ENDS_MAX),
        )

    @property
    def end(self) -> int:
        """The largest offset at which a segment's records may end."""
        return self.segment_bytes - _COMMITS_BYTES

    @property
    def descriptions_bytes_max(self) -> int:
        """Bounds the bytes of descriptions that a segment repeats: an eighth; by default 1 MiB, written in 0.4 ms."""
        return self.segment_bytes // 8

    def room_to_declare(self, *, episodes: int, declared: int) -> int:
        """Return the largest size of a further declaration that segments can repeat.

        Behind the declarations and the open episodes, at least sixteen, the largest record must still fit.
        """
        return (
            spool_format.header_bytes(self.episodes_max)
            - spool_format.header_bytes(max(episodes, _EPISODES_MIN))
            - declared
        )

    def takes_episode(self, *, episodes: int, declared: int) -> bool:
        """Return whether one more episode may be open."""
        return spool_format.header_bytes(episodes + 1) + declared <= spool_format.header_bytes(self.episodes_max)

    def frame_bytes_max(self, *, episodes: int, declared: int = 0) -> int:
        """Return the largest frame that fits into a segment behind its header and declarations."""
        return self.end - spool_format.header_bytes(episodes) - declared

    def ordinary_end(self, *, spare: int, episodes: int, declared: int = 0) -> int:
        """Return the offset at which ordinary records of the current segment must end to keep the reserve free."""
        return min(
            self.end, self.end + spare * self.frame_bytes_max(episodes=episodes, declared=declared) - self.reserve_bytes
        )

    def admits(
        self, frame_bytes: int, *, offset: int, spare: int, episodes: int, reserved: bool, declared: int = 0
    ) -> bool:
        """Return whether a frame may be put when the current segment is filled up to `offset`."""
        empty = self.frame_bytes_max(episodes=episodes, declared=declared)
        free = spare * empty - frame_bytes
        if offset + frame_bytes <= self.end:
            free += self.end - offset
        elif spare == 0 or frame_bytes > empty:
            return False
        return free >= (0 if reserved else self.reserve_bytes)


# === declarations =============================================================================================
#
# Repeat a recorder's declarations at the beginning of every segment, so that each segment can be read alone.
#
# The repeated declarations are ordinary records with positions of their own. The log stores equal declarations once.
#
# A plan may make any number of objects with descriptions of their own, so only the latest descriptions are repeated, an
# eighth of a segment. The hooks put a description again before they use one that they put long ago, see
# `record.geometry`. So a segment with an object has the object's description too.

_DESCRIPTION = b"DescriptionDeclared"


class AppendState(NamedTuple):
    """An appender's state behind some frames: offset, last position, count and checksum of the unsynced records."""

    offset: int
    position: int
    records: int
    checksum: int


class RepeatedDeclarations:
    """The declarations in use. `bytes` is their size in each segment; `unrepeated` counts those that did not fit.

    `descriptions_bytes_max` bounds the bytes of the descriptions among them.
    """

    def __init__(self, descriptions_bytes_max: int) -> None:
        self.bytes = 0
        self.unrepeated = 0
        self._frames: dict[bytes, spool_format.Frame] = {}
        self._descriptions_bytes_max = descriptions_bytes_max
        self._descriptions: dict[bytes, int] = {}
        self._descriptions_bytes = 0

    def add(self, body: bytes, *, name: bytes, version: int, payload: bytes, room: int) -> None:
        """Add a declaration. Does not repeat one larger than `room` bytes, and drops the oldest descriptions."""
        size = spool_format.HEADER_BYTES + len(body)
        if body in self._frames:
            if body in self._descriptions:  # the latest ones are kept
                self._descriptions[body] = self._descriptions.pop(body)
            return
        if name == _DESCRIPTION:
            room = min(room, self._descriptions_bytes_max)
        if size > room:
            self.unrepeated += 1
            return
        self._frames[body] = spool_format.Frame(
            spool_format.DECLARATION, version, 0, 0, 0, 0, spool_format.NO_EPISODE, name, payload
        )
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
            encoded = spool_format.encode(frame, salt)
            buffer[offset : offset + len(encoded)] = encoded
            offset += len(encoded)
            checksum = crc32(encoded[spool_format.CHECKSUM_START : spool_format.HEADER_BYTES], checksum)
        return AppendState(offset, position, records, checksum)
