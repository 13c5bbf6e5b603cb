"""Writes what is whole in a damaged folder into a new one: all before the damage, and what can be kept behind it.

An episode's records are kept as long as none of its own is missing: the log takes no episode with a gap. They get new
positions, for positions have no gaps either.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue.files.frame import COMMIT, EVENT, Frame, encode_span
from pycrorm_async.queue.files.recorder_folder import held_by, write_safely
from pycrorm_async.queue.files.scan import Survey, ValidPrefix, check_record, whole_frames
from pycrorm_async.queue.files.segment import (
    CLOSES,
    Last,
    SegmentHeader,
    decode_header,
    encode_header,
    header_bytes,
    read_segment,
    salt_of,
    segment_path,
)

__all__ = ["Range", "Rescue", "ranges"]

Range: TypeAlias = tuple[int, int]
"""The first and the last of consecutive numbers."""


class Rescue:
    """Writes what is whole in one folder into another.

    `position` is that of the last record written, `saved` how many stood behind the damage, `unreadable` the positions
    in the damaged folder that no frame says anything about.
    """

    def __init__(self, damaged: Path, mended: Path, found: Survey) -> None:
        self._damaged = damaged
        self._mended = mended
        self._recorder = held_by(damaged.name).recorder
        self._found = found
        self.headless = _is_headless(found.kept)
        self._open = dict(found.kept.open)
        self._number = found.kept.cut.number
        self.position = self._seen = found.kept.cut.position
        self.saved = 0
        self.unreadable: list[Range] = []
        self._left: dict[EpisodeId, list[Frame]] = {}

    def run(self) -> None:
        kept = self._found.kept
        if self.headless:
            self._begin_without_header()
        for number in sorted(kept.bases):
            self._copy(number)
        if not kept.bases:
            self._number -= 1  # the first one written takes the place of the one whose header is unreadable
        safe = 0
        for number in self._behind():
            frames = list(self._frames(number))
            safe = max([safe, *(frame.position for frame in frames if frame.kind == COMMIT)])
            before = dict(self._open)
            self._write(before, [frame for frame in frames if frame.kind != COMMIT and self._takes(frame)])
        if safe > self._seen:
            self.unreadable.append((self._seen + 1, safe))

    @property
    def given_up(self) -> dict[EpisodeId, list[Frame]]:
        """Whole records that stand behind a gap in their episode."""
        return self._left

    def kept_to(self, episode: EpisodeId) -> int:
        """Sequence of the last record of an open episode that is kept; 0 if there is none."""
        last = self._open.get(episode)
        return last.sequence if last is not None else 0

    def _behind(self) -> list[int]:
        return [number for number in self._found.kept.numbers if number >= self._found.kept.cut.number]

    def _frames(self, number: int) -> Iterator[Frame]:
        """The whole frames of a segment that stand behind the damage."""
        kept = self._found.kept
        content = read_segment(segment_path(self._damaged, number))
        start = kept.cut.offset if number == kept.cut.number and kept.bases else header_bytes(0)
        path = segment_path(self._damaged, number)
        for offset, frame in whole_frames(content, start, salt_of(self._recorder, number)):
            if frame.kind != COMMIT:
                try:
                    check_record(path, offset, frame)
                except SpoolDamaged:  # the gap that it leaves is reported
                    continue
            yield frame

    def _begin_without_header(self) -> None:
        """What the header would have said, as far as later headers and the first record of each episode know it."""
        numbers = self._found.kept.numbers
        first: dict[EpisodeId, Frame] = {}
        for number in numbers:
            header = decode_header(read_segment(segment_path(self._damaged, number)))
            for episode, last in header.open.items() if header is not None else ():
                if episode not in first:
                    self._open.setdefault(episode, last)
            for frame in self._frames(number):
                if frame.kind == EVENT:
                    first.setdefault(EpisodeId(frame.episode), frame)
                if not self.position and frame.kind != COMMIT:
                    self.position = self._seen = frame.position - 1
        for episode, frame in first.items():
            if frame.sequence > 1:
                self._open[episode] = Last(frame.sequence - 1, frame.wall_ns, frame.monotonic_ns)
        self._number = numbers[0]

    def _takes(self, frame: Frame) -> bool:
        """Whether this record can be kept; notes it if not, and what is missing before it."""
        if frame.position <= self._seen:
            return False
        if frame.position > self._seen + 1:
            self.unreadable.append((self._seen + 1, frame.position - 1))
        self._seen = frame.position
        if frame.kind != EVENT:
            return True
        episode = EpisodeId(frame.episode)
        before = self._open.get(episode)
        if frame.sequence != (before.sequence if before else 0) + 1:
            self._left.setdefault(episode, []).append(frame)
            return False
        self._open[episode] = Last(frame.sequence, frame.wall_ns, frame.monotonic_ns)
        if frame.type == CLOSES.encode():
            del self._open[episode]
        return True

    def _copy(self, number: int) -> None:
        """A segment from before the damage; the last one ends there, with a commit frame for what had none."""
        source, target = segment_path(self._damaged, number), segment_path(self._mended, number)
        cut = self._found.kept.cut
        if number < cut.number:
            try:
                os.link(source, target)
            except OSError:  # a file system without links
                write_safely(target, read_segment(source))
            return
        content, unsaid = read_segment(source)[: cut.offset], self._found.unsaid
        if unsaid:
            content += encode_span([], after=self.position, salt=salt_of(self._recorder, number), unsaid=unsaid)[1]
        write_safely(target, content)

    def _write(self, before: dict[EpisodeId, Last], records: list[Frame]) -> None:
        """The next segment; none for no records."""
        if not records:
            return
        self._number += 1
        header = encode_header(SegmentHeader(self._recorder, self._number, self.position + 1, before))
        span = encode_span(records, after=self.position, salt=salt_of(self._recorder, self._number))
        self.position += len(records)
        self.saved += len(records)
        write_safely(segment_path(self._mended, self._number), b"".join((header, *span)))


def _is_headless(kept: ValidPrefix) -> bool:
    return not kept.bases and bool(kept.numbers) and kept.numbers[0] > 1


def ranges(numbers: Iterable[int]) -> tuple[Range, ...]:
    """Consecutive numbers as one: 1, 2, 3, 7 are 1 to 3 and 7 to 7."""
    found: list[Range] = []
    for number in numbers:
        if found and found[-1][1] == number - 1:
            found[-1] = (found[-1][0], number)
        else:
            found.append((number, number))
    return tuple(found)
