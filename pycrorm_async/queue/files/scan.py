"""What of a dead recorder's folder is kept: everything up to the first hole. Reads, and changes nothing.

Behind the hole is a torn tail that no sync ever covered, unless a commit frame says that something in the hole was safe
once: that is damage and raises. Ordinary records behind the hole prove nothing, for pages reach a disk in any order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.bulk_records import make
from pycrorm_async.errors import PycrormError, SpoolDamaged, SpoolForeign
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.files.frame import (
    CHECKSUM,
    COMMIT,
    EVENT,
    HEADER_BYTES,
    Buffer,
    Frame,
    decode,
    decode_each,
    span_checksum,
)
from pycrorm_async.queue.files.names import TAIL
from pycrorm_async.queue.files.reader import Cursor, checked_type
from pycrorm_async.queue.files.recorder_folder import write_safely
from pycrorm_async.queue.files.segment import (
    CLOSES,
    FORMAT,
    Last,
    SegmentHeader,
    decode_header,
    format_of,
    header_bytes,
    read_segment,
    salt_of,
    segment_numbers,
    segment_path,
    sync_folder,
)

__all__ = [
    "ValidPrefix",
    "Survey",
    "SegmentScanner",
    "scan",
    "survey",
    "whole_frames",
    "checked_header",
    "check_record",
    "seal",
    "make_safe",
    "tails",
]

_SALT_OFFSET = HEADER_BYTES - 8
_CLOSES = CLOSES.encode()
_DECLARES = "DesignatorTypeDeclared"


class ValidPrefix(NamedTuple):
    """What of a folder is kept.

    Attributes:
        start: before the first record.
        cut: behind the last one; what the files hold from here on is not kept. Number 0 if there is nothing at all.
        bases: by number, the position of each kept segment's first record.
        open: the episodes without an end, and the last record of each.
        numbers: of all segment files, also those behind the cut.
    """

    start: Cursor
    cut: Cursor
    bases: dict[int, int]
    open: dict[EpisodeId, Last]
    numbers: list[int]


class Survey(NamedTuple):
    """What is whole before the damage, if there is any.

    Attributes:
        kept: all that stands before the damage.
        damage: where it begins and what it is, or None.
        unsaid: the checksums of the last kept records, those that no commit frame covers.
    """

    kept: ValidPrefix
    damage: SpoolDamaged | None
    unsaid: tuple[int, ...]


def scan(folder: Path, recorder: bytes) -> ValidPrefix:
    """Looks at every byte of the folder's segments once.

    Raises `SpoolDamaged` with file and offset, `SpoolForeign` for a segment of a newer format or another recorder, and
    `OSError`.
    """
    kept, damage, _ = survey(folder, recorder)
    if damage is not None:
        raise damage
    return kept


def survey(folder: Path, recorder: bytes, *, seen: Callable[[int, Frame], None] | None = None) -> Survey:
    """What `scan` looks at, with damage as an answer. `seen` is told of each kept frame and its segment's number."""
    walk = SegmentScanner(folder, recorder, seen=seen)
    damage: SpoolDamaged | None = None
    try:
        while walk.step():
            pass
    except SpoolDamaged as found:
        damage = found
    return Survey(walk.kept, damage, walk.unsaid)


class SegmentScanner:
    """Goes from the oldest segment to the first hole, a segment at each step.

    `seen` is told of each kept frame and its segment's number, `found` is given each kept record.
    With `segments`, files by number wherever they lie, nothing behind the first hole is looked at.
    """

    def __init__(
        self,
        folder: Path,
        recorder: bytes,
        *,
        seen: Callable[[int, Frame], None] | None = None,
        found: Callable[[Record], None] | None = None,
        segments: Mapping[int, Path] | None = None,
    ) -> None:
        self._folder = folder
        self._recorder = recorder
        self._seen = seen
        self._found = found
        self._types: dict[bytes, str] = {}
        self._paths = segments
        self._numbers = segment_numbers(folder) if segments is None else sorted(segments)
        self._steps = 0
        self._start = self._cut = Cursor(0, 0, 0)
        self._bases: dict[int, int] = {}
        self._open: dict[bytes, tuple[int, int, int]] = {}
        self._unsaid: list[int] = []  # checksums of the records that no commit frame has covered yet
        self.damage: SpoolDamaged | None = None
        self.over = False

    def step(self) -> bool:
        """Looks at one more segment; False when there is no more to look at: then nothing that was safe is missing.

        Raises as `scan` does.
        """
        if self.damage is not None:
            raise self.damage
        if self.over:
            return False
        try:
            if self._steps < len(self._numbers) and self._enter(self._numbers[self._steps]):
                self._steps += 1
                return True
            if self._paths is None:
                _refuse_damage(self._folder, self._recorder, self.kept)
        except SpoolDamaged as damage:
            self.damage = damage
            raise
        except (PycrormError, OSError):
            raise
        except Exception as error:  # bytes that this code does not foresee concern this folder alone
            place = segment_path(self._folder, self._cut.number)
            self.damage = SpoolDamaged(place, self._cut.offset, f"{type(error).__name__}: {error}")
            raise self.damage from error
        self.over = True
        return False

    @property
    def kept(self) -> ValidPrefix:
        """All before the cut, as far as it has gone."""
        opened = {EpisodeId(episode): Last(*last) for episode, last in self._open.items()}
        return ValidPrefix(self._start, self._cut, self._bases, opened, self._numbers)

    @property
    def settled(self) -> int:
        """The position up to which all is kept whatever is found further on: a commit frame says that it was safe."""
        return self._cut.position - (0 if self.over else len(self._unsaid))

    @property
    def unsaid(self) -> tuple[int, ...]:
        return tuple(self._unsaid)

    def _enter(self, number: int) -> bool:
        """Goes through one segment; False if it does not go on where the one before ended."""
        path = segment_path(self._folder, number) if self._paths is None else self._paths[number]
        buffer = read_segment(path)
        header = checked_header(path, buffer, recorder=self._recorder, number=number)
        if not self._bases:
            if header is None and number > 1:
                raise SpoolDamaged(path, 0, "its header is unreadable, and the segments before it are gone")
            base = 1 if header is None else header.base
            self._start = self._cut = Cursor(number, header_bytes(0), base - 1)
        if header is None or number != self._cut.number + bool(self._bases) or header.base != self._cut.position + 1:
            return False
        first = header_bytes(len(header.open))
        if not self._bases:
            self._start = Cursor(number, first, header.base - 1)
            self._open = dict(header.open.items())
        self._bases[number] = header.base
        self._cut = Cursor(number, first, header.base - 1)
        self._go_through(path, buffer, number)
        return True

    def _go_through(self, path: Path, buffer: Buffer, number: int) -> None:
        """Keeps a segment's records from the cut on, up to the first hole or damage; there is the cut then."""
        opened, unsaid, seen, found, types = self._open, self._unsaid, self._seen, self._found, self._types
        _, offset, position = self._cut
        try:
            for frame in decode_each(buffer, offset, salt_of(self._recorder, number)):
                kind, version, at, sequence, wall_ns, monotonic_ns, episode, name, payload, checksum, size = frame
                if kind == COMMIT:
                    self._cut = Cursor(number, offset, position)
                    self._check_commit(path, make(Frame, frame))
                elif at == position + 1:
                    type_name = types.get(name)
                    if type_name is None:
                        type_name = types[name] = checked_type(path, offset, name)
                    if kind == EVENT:
                        before = opened.get(episode)
                        if sequence != (before[0] if before else 0) + 1:
                            raise _not_next(path, offset, episode, sequence, before)
                        opened[episode] = (sequence, wall_ns, monotonic_ns)
                        if name == _CLOSES:
                            del opened[episode]
                    else:
                        _check_declaration(path, offset, type_name, payload)
                    unsaid.append(checksum)
                    position = at
                    if found is not None:
                        owner = episode if kind == EVENT else None
                        values = (at, owner, sequence, type_name, version, wall_ns, monotonic_ns, payload)
                        found(make(Record, values))
                else:
                    break
                offset += size
                if seen is not None:
                    seen(number, make(Frame, frame))
        finally:
            self._cut = Cursor(number, offset, position)

    def _check_commit(self, path: Path, frame: Frame) -> None:
        """The records it covers are all here and are those it was written for."""
        later = self._cut.position - frame.position
        if later < 0:
            raise SpoolDamaged(path, self._cut.offset, f"position {self._cut.position + 1} was safe and is missing")
        covered = self._unsaid[: max(0, len(self._unsaid) - later)]
        gone = frame.sequence - len(covered)  # more than 0: segments with records it covers are stored and deleted
        if gone < 0 or (gone == 0 and frame.payload != CHECKSUM.pack(span_checksum(covered))):
            raise SpoolDamaged(path, self._cut.offset, "the records before are not those that were safe here")
        del self._unsaid[: len(covered)]


def _not_next(
    path: Path, offset: int, episode: bytes, sequence: int, before: tuple[int, int, int] | None
) -> SpoolDamaged:
    name = episode_text(EpisodeId(episode))
    return SpoolDamaged(path, offset, f"event {sequence} of episode {name} follows {before and before[0]}")


def check_record(path: Path, offset: int, frame: Frame) -> None:
    """Raises `SpoolDamaged` for the frame of a record that no recorder writes, though its checksum is right."""
    type_name = checked_type(path, offset, frame.type)
    if frame.kind != EVENT:
        _check_declaration(path, offset, type_name, frame.payload)


def _check_declaration(path: Path, offset: int, type_name: str, payload: bytes) -> None:
    """The database refuses one episode alone, but what belongs to none would keep all that follows from it."""
    if type_name != _DECLARES:
        raise SpoolDamaged(path, offset, f"holds a {type_name} that belongs to no episode")
    if b"\0" in payload or not _is_utf8(payload):
        raise SpoolDamaged(path, offset, "the declaration is not text that a database can hold")


def _is_utf8(payload: bytes) -> bool:
    try:
        payload.decode()
    except UnicodeDecodeError:
        return False
    return True


def checked_header(path: Path, buffer: Buffer, *, recorder: bytes, number: int) -> SegmentHeader | None:
    """The header of a segment; None if it was never begun, or torn. Raises `SpoolForeign` for one that is not ours."""
    written_in = format_of(buffer)
    if written_in is not None and written_in > FORMAT:
        raise SpoolForeign(f"{path} is in format {written_in} of a newer program; this one reads format {FORMAT}")
    header = decode_header(buffer)
    if header is not None and (header.recorder, header.number) != (recorder, number):
        raise SpoolForeign(f"{path} is segment {header.number} of recorder {episode_text(EpisodeId(header.recorder))}")
    return header


def whole_frames(buffer: Buffer, start: int, salt: int) -> Iterator[tuple[int, Frame]]:
    """Every frame from `start` on and its offset, whatever lies between them."""
    salted = CHECKSUM.pack(salt)
    end = start
    found = buffer.find(salted, start)
    while found >= 0:
        offset = found - _SALT_OFFSET
        if offset >= end and offset % 8 == 0 and (frame := decode(buffer, offset, salt)) is not None:
            yield offset, frame
            end = offset + frame.size
        found = buffer.find(salted, max(found + 1, end))


def _refuse_damage(folder: Path, recorder: bytes, kept: ValidPrefix) -> None:
    """Raises if anything behind the cut says that something in the hole was safe."""
    for number in kept.numbers:
        if number < kept.cut.number:
            continue
        path = segment_path(folder, number)
        start = kept.cut.offset if number == kept.cut.number else 0
        for offset, frame in whole_frames(read_segment(path), start, salt_of(recorder, number)):
            if frame.kind == COMMIT and frame.position > kept.cut.position:
                raise SpoolDamaged(
                    segment_path(folder, kept.cut.number),
                    kept.cut.offset,
                    f"position {kept.cut.position + 1} is missing, and {path.name} says at byte {offset} that all up"
                    f" to position {frame.position} was safe",
                )


def seal(folder: Path, kept: ValidPrefix) -> None:
    """Cuts the files where the records end; what is cut off is copied aside first, to `<segment>.tail`.

    Twice is once, and killed at any point it can be done again. Raises `OSError`.
    """
    for path, tail in tails(folder, kept):
        if tail:
            write_safely(path.with_name(f"{path.name}{TAIL}"), tail)
    for number in kept.numbers:
        path = segment_path(folder, number)
        if number > kept.cut.number:
            path.unlink(missing_ok=True)
        elif number == kept.cut.number:
            with path.open("rb+") as file:
                file.truncate(kept.cut.offset)
                os.fsync(file.fileno())
    sync_folder(folder)


def make_safe(folder: Path, numbers: Iterable[int]) -> None:
    """These segments are on the disk, the first of them first. Raises `OSError`.

    A killed process' last records are there for all who read, and yet may be nowhere but in the page cache. If they
    were given away like this and lost in a power cut, the log would hold events that the next computed ends replace.
    """
    for number in numbers:
        descriptor = os.open(segment_path(folder, number), os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)
    sync_folder(folder)


def tails(folder: Path, kept: ValidPrefix) -> list[tuple[Path, bytes]]:
    """For each file that reaches behind the cut what is there, without the zeros at its end. Raises `OSError`."""
    cut = kept.cut
    return [
        (path, read_segment(path)[cut.offset if number == cut.number else 0 :].rstrip(b"\0"))
        for number in kept.numbers
        if number >= cut.number and (path := segment_path(folder, number)).exists()
    ]
