"""Let the sync thread sync, preallocate and trim the segments that an `Appender` fills.

The theory of operation is in `appender.py`. Only the sync thread calls these methods.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Final, NamedTuple

from pycrorm_async.queue.files.frame import COMMIT_BYTES, encode_commit
from pycrorm_async.queue.files.segment import Segment
from pycrorm_async.queue.live.appender import OUT_OF_RESOURCES, Appender, SegmentStart

_TOUCHED_BYTES_MAX: Final = 2**18
"""Bounds the bytes made writable ahead, during which the interpreter lock is held: 64 pages take 0.4 ms."""


class Span(NamedTuple):
    """The records of one sync: those up to `position`, `records` of them new, and the files that hold them."""

    position: int
    records: int
    checksum: int
    segments: tuple[Segment, ...]


class SyncableAppender(Appender):
    """An appender with the operations of the sync thread."""

    _touched_from = 0

    def begin_sync(self) -> Span:
        """Return the span since the last call; the next record begins a new span and wakes the sync thread."""
        return self._gc_lock.run(self._begin_sync)

    def _begin_sync(self) -> Span:
        span = Span(self.position, self._span_count, self._span_checksum, (*self._sealed, self._current))
        self._span_count = self._span_checksum = 0
        self._quiet = True
        return span

    def append_commit(self, span: Span) -> Segment:
        """Append the commit frame of a synced span; return the segment that holds it, which the caller must sync."""
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

    def end_sync(self, span: Span) -> None:
        """Close the segments that were full when the span was taken: they are complete and on the disk."""
        for segment in self._gc_lock.run(partial(self._end_sync, span)):
            segment.close()

    def _end_sync(self, span: Span) -> list[Segment]:
        done = [segment for segment in self._sealed if segment in span.segments[:-1]]
        self._sealed = [segment for segment in self._sealed if segment not in done]
        return done

    def prepare(self) -> bool:
        """Allocate the next segment ahead if there is none; True if the disk has no space. Raises `OSError`."""
        if self._prepared is not None or not self._segments_left():
            return False
        try:
            # Holding `_gc_lock` during the allocation would block producers. Without it a finalizer could record in
            # this thread and wait for `_making`, which the thread holds: so only pause the garbage collector.
            self._gc_lock.pause_gc()
            with self._making:
                refused = self._prepare()
        finally:
            self._gc_lock.resume_gc()
        self._gc_lock.run(partial(self._note_preparation, refused))
        return refused is not None

    def _prepare(self) -> str | None:
        if self._prepared is not None:
            return None
        try:
            self._prepared = self._allocate(self._current.number + 1)
        except OSError as error:
            if error.errno not in OUT_OF_RESOURCES:
                raise
            return error.strerror
        return None

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

    def trimmed(self, deleted: list[SegmentStart]) -> None:
        """Note that these segments are deleted."""
        self._gc_lock.run(partial(self._trimmed, deleted))

    def _trimmed(self, deleted: list[SegmentStart]) -> None:
        self.begun = [segment for segment in self.begun if segment not in deleted]
        self._set_limits()
        self._forget_refused()
