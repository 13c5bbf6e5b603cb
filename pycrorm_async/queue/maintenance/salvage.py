"""Copy a damaged folder's whole records to a new one: those before the damage, and those that can be kept behind it.

An episode's records are kept up to its first missing record, because the log accepts no episode with a gap. The records
behind the damage get new positions, because positions have no gaps either.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue.blobs.blob_files import carry_blobs
from pycrorm_async.queue.files.frame import COMMIT, EVENT, Frame, encode_span
from pycrorm_async.queue.files.recorder_folder import parse_folder_name, write_durably
from pycrorm_async.queue.files.scan import Survey, check_record, whole_frames
from pycrorm_async.queue.files.segment import (
    EPISODE_ENDED,
    LastRecord,
    SegmentHeader,
    decode_header,
    encode_header,
    header_bytes,
    read_segment,
    salt_of,
    segment_path,
)

Range: TypeAlias = tuple[int, int]
"""The first and the last of consecutive numbers."""


class Salvage:
    """One copy of the whole records of a damaged folder to a new folder.

    `position` is that of the last record written, `saved` the number of records from behind the damage, `unreadable`
    the positions in the damaged folder for which no frame decodes.
    """

    def __init__(self, damaged: Path, repaired: Path, result: Survey) -> None:
        self._damaged = damaged
        self._repaired = repaired
        self._recorder = parse_folder_name(damaged.name).recorder
        self._survey = result
        prefix = result.prefix
        self.headless = not prefix.bases and bool(prefix.numbers) and prefix.numbers[0] > 1
        self._open = dict(prefix.open)
        self._number = prefix.cut.number
        self.position = self._last_position = prefix.cut.position
        self.saved = 0
        self.unreadable: list[Range] = []
        self._dropped: dict[EpisodeId, list[Frame]] = {}

    def run(self) -> None:
        """Write the new folder's blobs and segments. Raises `OSError`."""
        prefix = self._survey.prefix
        carry_blobs(self._damaged, self._repaired)
        if self.headless:
            self._begin_without_header()
        for number in sorted(prefix.bases):
            self._copy(number)
        if not prefix.bases:
            self._number -= 1  # the first one written replaces the one with the unreadable header
        safe = 0
        for number in (each for each in self._survey.prefix.numbers if each >= self._survey.prefix.cut.number):
            frames = list(self._frames(number))
            safe = max([safe, *(frame.position for frame in frames if frame.kind == COMMIT)])
            before = dict(self._open)
            self._write(before, [frame for frame in frames if frame.kind != COMMIT and self._keep(frame)])
        if safe > self._last_position:
            self.unreadable.append((self._last_position + 1, safe))

    @property
    def dropped(self) -> dict[EpisodeId, list[Frame]]:
        """Whole records behind a gap in their episode."""
        return self._dropped

    def kept_to(self, episode: EpisodeId) -> int:
        """Return the sequence of an open episode's last kept record; 0 if none is kept."""
        last = self._open.get(episode)
        return last.sequence if last is not None else 0

    def _frames(self, number: int) -> Iterator[Frame]:
        """Decode the whole frames of a segment behind the damage."""
        prefix = self._survey.prefix
        content = read_segment(segment_path(self._damaged, number))
        start = prefix.cut.offset if number == prefix.cut.number and prefix.bases else header_bytes(0)
        path = segment_path(self._damaged, number)
        for offset, frame in whole_frames(content, start, salt_of(self._recorder, number)):
            if frame.kind != COMMIT:
                try:
                    check_record(path, offset, frame)
                except SpoolDamaged:  # the gap it leaves is reported
                    continue
            yield frame

    def _begin_without_header(self) -> None:
        """Reconstruct the open episodes of a lost header from later headers and each episode's first record."""
        numbers = self._survey.prefix.numbers
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
                    self.position = self._last_position = frame.position - 1
        for episode, frame in first.items():
            if frame.sequence > 1:
                self._open[episode] = LastRecord(frame.sequence - 1, frame.wall_ns, frame.monotonic_ns)
        self._number = numbers[0]

    def _keep(self, frame: Frame) -> bool:
        """Return whether this record can be kept; note a dropped record, and the positions missing before it."""
        if frame.position <= self._last_position:
            return False
        if frame.position > self._last_position + 1:
            self.unreadable.append((self._last_position + 1, frame.position - 1))
        self._last_position = frame.position
        if frame.kind != EVENT:
            return True
        episode = EpisodeId(frame.episode)
        before = self._open.get(episode)
        if frame.sequence != (before.sequence if before else 0) + 1:
            self._dropped.setdefault(episode, []).append(frame)
            return False
        self._open[episode] = LastRecord(frame.sequence, frame.wall_ns, frame.monotonic_ns)
        if frame.type == EPISODE_ENDED.encode():
            del self._open[episode]
        return True

    def _copy(self, number: int) -> None:
        """Copy a segment from before the damage; end the last one at the cut and commit its records."""
        source, target = segment_path(self._damaged, number), segment_path(self._repaired, number)
        cut = self._survey.prefix.cut
        if number < cut.number:
            try:
                os.link(source, target)
            except OSError:  # the file system has no hard links
                write_durably(target, read_segment(source))
            return
        content, uncommitted = read_segment(source)[: cut.offset], self._survey.uncommitted
        if uncommitted:
            content += encode_span(
                [], after=self.position, salt=salt_of(self._recorder, number), uncommitted=uncommitted
            )[1]
        write_durably(target, content)

    def _write(self, before: dict[EpisodeId, LastRecord], records: list[Frame]) -> None:
        """Write the next segment, unless there are no records."""
        if not records:
            return
        self._number += 1
        header = encode_header(SegmentHeader(self._recorder, self._number, self.position + 1, before))
        span = encode_span(records, after=self.position, salt=salt_of(self._recorder, self._number))
        self.position += len(records)
        self.saved += len(records)
        write_durably(segment_path(self._repaired, self._number), b"".join((header, *span)))


def ranges(numbers: Iterable[int]) -> tuple[Range, ...]:
    """Group consecutive numbers: 1, 2, 3, 7 becomes (1, 3), (7, 7)."""
    grouped: list[Range] = []
    for number in numbers:
        if grouped and grouped[-1][1] == number - 1:
            grouped[-1] = (grouped[-1][0], number)
        else:
            grouped.append((number, number))
    return tuple(grouped)
