"""Scan a dead recorder's segments: keep every record up to the first hole, and distinguish a torn tail from damage.

**Theory of operation.** The scanning process holds `alive` and `drain`, so no segment changes during a scan, except
where a report examines a living recorder. `SegmentScanner` reads one segment per step, the oldest first, and checks
every frame: salt and checksum (`decode_each`), the next position, the next sequence of its episode, and for a commit
frame the checksum of the records it covers. The scanner stops at the first byte where no next record decodes, the
*cut*. The records before the cut are the `ValidPrefix`.

A sync appends its commit frame only after its records are on the disk. So a commit frame behind the cut that covers a
position behind the cut proves that a synced record is missing: the folder is damaged and the scanner raises
`SpoolDamaged`. Ordinary records behind the cut prove nothing, because pages reach the disk in any order: they belong to
a torn tail that no sync covered. Therefore the last step searches the rest of the files for commit frames.

Until the scan has finished, only the records that a commit frame covers are certain to be kept (`confirmed`): if damage
follows, a repair decides about the others. A caller that passes records on during the scan must stop at `confirmed`.

Scanning changes no file. `seal` truncates the files at the cut and first copies the tail to `<segment>.tail`;
`sync_segments` makes the kept segments durable before their records are passed on.
"""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from pycrorm_async import core
from pycrorm_async.bulk_records import make
from pycrorm_async.errors import PycrormError, SpoolDamaged, SpoolForeign
from pycrorm_async.events.codec import DECLARATION_TYPES, Record
from pycrorm_async.events.ids import EpisodeId, episode_text, is_named
from pycrorm_async.events.types import references_in
from pycrorm_async.queue import format as spool_format
from pycrorm_async.queue.blobs import is_whole
from pycrorm_async.queue.locks import TAIL
from pycrorm_async.queue.spool import write_durably

_SALT_OFFSET = spool_format.HEADER_BYTES - 8
_EPISODE_ENDED = spool_format.EPISODE_ENDED.encode()


class ValidPrefix(NamedTuple):
    """The records of a folder up to the first hole.

    Attributes:
        start: before the first record.
        cut: behind the last record; the files' content from here on is not kept. Number 0 if there is no segment.
        bases: position of the first record of each kept segment, by segment number.
        open: the episodes without an end, and the last record of each.
        numbers: numbers of all segment files, including those behind the cut.
    """

    start: spool_format.ReadCursor
    cut: spool_format.ReadCursor
    bases: dict[int, int]
    open: dict[EpisodeId, spool_format.LastRecord]
    numbers: list[int]


class Survey(NamedTuple):
    """The result of a scan that returns damage instead of raising it.

    Attributes:
        prefix: the records before the damage.
        damage: file, offset and reason of the damage, or None.
        uncommitted: checksums of the last records of the prefix, which no commit frame covers.
    """

    prefix: ValidPrefix
    damage: SpoolDamaged | None
    uncommitted: tuple[int, ...]


def scan(folder: Path, recorder: bytes) -> ValidPrefix:
    """Scan the segments of a folder, each byte once.

    Raises `SpoolDamaged` with file and offset, `SpoolForeign` for a segment of a newer format or another recorder, and
    `OSError`.
    """
    prefix, damage, _ = survey(folder, recorder)
    if damage is not None:
        raise damage
    return prefix


def survey(
    folder: Path,
    recorder: bytes,
    *,
    on_frame: Callable[[spool_format.ReadCursor, spool_format.Frame], None] | None = None,
) -> Survey:
    """Scan a folder, and return damage instead of raising it.

    Calls `on_frame` with each kept frame and the cursor behind it.
    """
    scanner = SegmentScanner(folder, recorder, on_frame=on_frame)
    damage: SpoolDamaged | None = None
    try:
        while scanner.step():
            pass
    except SpoolDamaged as error:
        damage = error
    return Survey(scanner.prefix, damage, scanner.uncommitted)


class SegmentScanner:
    """Scan from the oldest segment to the first hole, one segment per step.

    Calls `on_frame` with each kept frame and the cursor behind it, and appends each kept record to `records`. With
    `segments`, paths by number in any folders, the scan ends at the first hole without searching for commit frames.
    """

    def __init__(
        self,
        folder: Path,
        recorder: bytes,
        *,
        on_frame: Callable[[spool_format.ReadCursor, spool_format.Frame], None] | None = None,
        records: list[Record] | None = None,
        segments: Mapping[int, Path] | None = None,
    ) -> None:
        self._folder = folder
        self._recorder = recorder
        self._on_frame = on_frame
        self._records = records
        self._types: dict[bytes, str] = {}
        self._is_whole_folder = segments is None
        self._paths = spool_format.segments_in(folder) if segments is None else segments
        self._numbers = sorted(self._paths)
        self._steps = 0
        self._start = self._cut = spool_format.ReadCursor(0, 0, 0)
        self._bases: dict[int, int] = {}
        self._open: dict[bytes, tuple[int, int, int]] = {}
        self._uncommitted: list[int] = []  # checksums of the records that no commit frame has covered yet
        self.damage: SpoolDamaged | None = None
        self.finished = False

    def step(self) -> bool:
        """Scan one more segment; False when the scan has finished and no synced record is missing.

        Raises what `scan` raises.
        """
        deque(self.parts(), 0)
        return not self.finished

    def parts(self) -> Iterator[None]:
        """Do a step in parts, so that other tasks of a loop can run in between."""
        if self.damage is not None:
            raise self.damage
        if self.finished:
            return
        try:
            if self._steps < len(self._numbers) and (yield from self._scan_segment(self._numbers[self._steps])):
                self._steps += 1
                return
            if self._is_whole_folder:
                _refuse_damage(self._folder, self._recorder, self.prefix)
        except SpoolDamaged as damage:
            self.damage = damage
            raise
        except (PycrormError, OSError):
            raise
        except Exception as error:  # an unforeseen content must fail this folder alone, as damage
            path = spool_format.segment_path(self._folder, self._cut.number)
            self.damage = SpoolDamaged(path, self._cut.offset, f"{type(error).__name__}: {error}")
            raise self.damage from error
        self.finished = True

    @property
    def prefix(self) -> ValidPrefix:
        """The records scanned so far."""
        opened = {EpisodeId(episode): spool_format.LastRecord(*last) for episode, last in self._open.items()}
        return ValidPrefix(self._start, self._cut, self._bases, opened, self._numbers)

    @property
    def number(self) -> int:
        """The number of the segment with the cut."""
        return self._cut.number

    @property
    def confirmed(self) -> int:
        """The position up to which records are kept even if damage follows, because a commit frame covers them."""
        return self._cut.position - (0 if self.finished else len(self._uncommitted))

    @property
    def uncommitted(self) -> tuple[int, ...]:
        return tuple(self._uncommitted)

    def _scan_segment(self, number: int) -> Generator[None, None, bool]:
        """Scan one segment in parts; return False if it does not continue the one before."""
        path = self._paths[number]
        buffer = spool_format.read_segment(path)
        header = read_header(path, buffer, recorder=self._recorder, number=number)
        if not self._bases:
            if header is None and number > 1:
                raise SpoolDamaged(path, 0, "its header is unreadable, and the segments before it are deleted")
            base = 1 if header is None else header.base
            self._start = self._cut = spool_format.ReadCursor(number, spool_format.header_bytes(0), base - 1)
        if header is None or number != self._cut.number + bool(self._bases) or header.base != self._cut.position + 1:
            return False
        first = spool_format.header_bytes(len(header.open))
        if not self._bases:
            self._start = spool_format.ReadCursor(number, first, header.base - 1)
            self._open = dict(header.open.items())
        self._bases[number] = header.base
        self._cut = spool_format.ReadCursor(number, first, header.base - 1)
        yield from self._scan_records(path, buffer, number)
        return True

    def _scan_records(self, path: Path, buffer: spool_format.Buffer, number: int) -> Iterator[None]:
        """Keep a segment's records from the cut to the first hole or damage, and move the cut there."""
        _, offset, position = self._cut
        salt = spool_format.salt_of(self._recorder, number)
        in_steps = core.IS_COMPILED and self._on_frame is None
        try:
            while True:
                if in_steps:
                    until = position + spool_format.RECORDS_AT_ONCE
                    offset, position = self._take(buffer, offset, salt, position, until)
                    if position == until:
                        self._cut = spool_format.ReadCursor(number, offset, position)
                        yield
                        continue
                for frame in spool_format.decode_each(buffer, offset, salt):
                    if frame[0] == spool_format.COMMIT:
                        self._cut = spool_format.ReadCursor(number, offset, position)
                        self._check_commit(path, make(spool_format.Frame, frame))
                    elif frame[2] == position + 1:
                        self._keep(path, offset, frame)
                        position += 1
                    else:
                        return
                    offset += frame[-1]
                    if self._on_frame is not None:
                        self._on_frame(
                            spool_format.ReadCursor(number, offset, position), make(spool_format.Frame, frame)
                        )
                    if in_steps:
                        break
                    if position % spool_format.RECORDS_AT_ONCE == 0:
                        self._cut = spool_format.ReadCursor(number, offset, position)
                        yield
                else:
                    return
        finally:
            self._cut = spool_format.ReadCursor(number, offset, position)

    def _take(self, buffer: spool_format.Buffer, offset: int, salt: int, position: int, until: int) -> tuple[int, int]:
        """Keep the records that need no decision; return offset and position behind them."""
        limits = (position, until, 0, spool_format.SEGMENT_BYTES_MAX)
        kept = (self._types, Record, self._records, self._open, self._uncommitted)
        offset, position, _ = core.take_records(buffer, offset, salt, *limits, *kept)
        return offset, position

    def _keep(self, path: Path, offset: int, frame: spool_format.Fields) -> None:
        """Keep the next record. Raises `SpoolDamaged` if no recorder writes it."""
        kind, version, at, sequence, wall_ns, monotonic_ns, episode, name, payload, checksum, _ = frame
        type_name = self._types.get(name)
        if type_name is None:
            type_name = self._types[name] = spool_format.check_type(path, offset, name)
        if kind == spool_format.EVENT:
            before = self._open.get(episode)
            if sequence != (before[0] if before else 0) + 1 and (before or not is_named(episode)):
                raise _not_next(path, offset, episode, sequence, before)
            self._open[episode] = (sequence, wall_ns, monotonic_ns)
            if name == _EPISODE_ENDED:
                del self._open[episode]
        else:
            _check_declaration(path, offset, type_name, payload)
        self._uncommitted.append(checksum)
        if self._records is not None:
            owner = episode if kind == spool_format.EVENT else None
            values = (at, owner, sequence, type_name, version, wall_ns, monotonic_ns, payload)
            self._records.append(make(Record, values))

    def _check_commit(self, path: Path, frame: spool_format.Frame) -> None:
        """Check that the records a commit frame covers are present and unchanged."""
        later = self._cut.position - frame.position
        if later < 0:
            raise SpoolDamaged(path, self._cut.offset, f"position {self._cut.position + 1} was synced and is missing")
        covered = self._uncommitted[: max(0, len(self._uncommitted) - later)]
        deleted = frame.sequence - len(covered)  # records it covers in segments that are stored and deleted
        if deleted < 0 or (
            deleted == 0 and frame.payload != spool_format.CHECKSUM.pack(spool_format.span_checksum(covered))
        ):
            raise SpoolDamaged(path, self._cut.offset, "the records before it differ from those that were synced")
        del self._uncommitted[: len(covered)]


def _not_next(
    path: Path, offset: int, episode: bytes, sequence: int, before: tuple[int, int, int] | None
) -> SpoolDamaged:
    name = episode_text(EpisodeId(episode))
    return SpoolDamaged(path, offset, f"event {sequence} of episode {name} follows {before and before[0]}")


def check_record(path: Path, offset: int, frame: spool_format.Frame) -> None:
    """Raise `SpoolDamaged` for a frame that no recorder writes although its checksum is right."""
    type_name = spool_format.check_type(path, offset, frame.type)
    if frame.kind != spool_format.EVENT:
        _check_declaration(path, offset, type_name, frame.payload)


def _check_declaration(path: Path, offset: int, type_name: str, payload: bytes) -> None:
    """Check a record without an episode: dead-lettering cannot skip it, so a bad one would block the whole folder."""
    if type_name not in DECLARATION_TYPES:
        raise SpoolDamaged(path, offset, f"holds a {type_name} that belongs to no episode")
    try:
        is_text = "\0" not in payload.decode()
    except UnicodeDecodeError:
        is_text = False
    if not is_text:
        raise SpoolDamaged(path, offset, "the declaration is not valid UTF-8 without NUL, so no database can store it")


def read_header(
    path: Path, buffer: spool_format.Buffer, *, recorder: bytes, number: int
) -> spool_format.SegmentHeader | None:
    """Decode a segment's header; None if it is preallocated or torn. Raises `SpoolForeign` for another recorder's."""
    format_number = spool_format.format_of(buffer)
    if format_number is not None and format_number > spool_format.FORMAT:
        raise SpoolForeign(
            f"{path} is in format {format_number} of a newer program; this one reads format {spool_format.FORMAT}"
        )
    header = spool_format.decode_header(buffer)
    if header is not None and (header.recorder, header.number) != (recorder, number):
        raise SpoolForeign(f"{path} is segment {header.number} of recorder {episode_text(EpisodeId(header.recorder))}")
    return header


def whole_frames(buffer: spool_format.Buffer, start: int, salt: int) -> Iterator[tuple[int, spool_format.Frame]]:
    """Find every frame from `start` on, with its offset, whatever bytes lie between them."""
    salted = spool_format.CHECKSUM.pack(salt)
    end = start
    index = buffer.find(salted, start)
    while index >= 0:
        offset = index - _SALT_OFFSET
        if offset >= end and offset % 8 == 0 and (frame := spool_format.decode(buffer, offset, salt)) is not None:
            yield offset, frame
            end = offset + frame.size
        index = buffer.find(salted, max(index + 1, end))


def last_event(buffer: spool_format.Buffer, salt: int) -> spool_format.Frame | None:
    """Return the segment's last whole frame with an event; None if it has no event."""
    return next((each for each in _last_frames(buffer, salt) if each.kind == spool_format.EVENT), None)


def _last_frames(buffer: spool_format.Buffer, salt: int) -> Iterator[spool_format.Frame]:
    """Find every frame of a segment, the last one first."""
    salted = spool_format.CHECKSUM.pack(salt)
    index = buffer.rfind(salted)
    while index >= 0:
        frame = spool_format.decode(buffer, index - _SALT_OFFSET, salt) if index >= _SALT_OFFSET else None
        if frame is not None:
            yield frame
        index = buffer.rfind(salted, 0, index + len(salted) - 1)


def _refuse_damage(folder: Path, recorder: bytes, prefix: ValidPrefix) -> None:
    """Raise `SpoolDamaged` if a commit frame behind the cut covers a record that is missing."""
    for number in prefix.numbers:
        if number < prefix.cut.number:
            continue
        path = spool_format.segment_path(folder, number)
        start = prefix.cut.offset if number == prefix.cut.number else 0
        for offset, frame in whole_frames(
            spool_format.read_segment(path), start, spool_format.salt_of(recorder, number)
        ):
            if frame.kind == spool_format.COMMIT and frame.position > prefix.cut.position:
                raise SpoolDamaged(
                    spool_format.segment_path(folder, prefix.cut.number),
                    prefix.cut.offset,
                    f"position {prefix.cut.position + 1} is missing, although the commit frame at byte {offset} of"
                    f" {path.name} covers all records up to position {frame.position}",
                )


def seal(folder: Path, prefix: ValidPrefix) -> None:
    """Truncate the files at the cut; first copy the bytes behind it to `<segment>.tail`.

    Idempotent, and can be repeated after a kill at any point. Raises `OSError`.
    """
    for path, tail in tails(folder, prefix):
        if tail:
            write_durably(path.with_name(f"{path.name}{TAIL}"), tail)
    for number in prefix.numbers:
        path = spool_format.segment_path(folder, number)
        if number > prefix.cut.number:
            path.unlink(missing_ok=True)
        elif number == prefix.cut.number:
            with path.open("rb+") as file:
                file.truncate(prefix.cut.offset)
                os.fsync(file.fileno())
    spool_format.sync_path(folder)


def sync_segments(folder: Path, numbers: Iterable[int]) -> None:
    """Sync these segments to the disk, in this order. Raises `OSError`.

    The last records of a killed process are readable but may exist only in the page cache. If such records were stored
    and then lost in a power cut, the next recovery would compute ends with the sequences of events in the log.
    """
    for number in numbers:
        descriptor = os.open(spool_format.segment_path(folder, number), os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)
    spool_format.sync_path(folder)


def tails(folder: Path, prefix: ValidPrefix) -> list[tuple[Path, bytes]]:
    """Return each file that extends behind the cut and its bytes there, without trailing zeros. Raises `OSError`."""
    cut = prefix.cut
    return [
        (path, spool_format.read_segment(path)[cut.offset if number == cut.number else 0 :].rstrip(b"\0"))
        for number in prefix.numbers
        if number >= cut.number and (path := spool_format.segment_path(folder, number)).exists()
    ]


# === lost blobs ===============================================================================================
#
# Truncate a dead recorder's folder before the first unsynced record whose blob a power cut took.
#
# A sync makes blobs durable before it appends the commit frame of the records that refer to them. So only a record that
# no commit frame covers can be on the disk without its blob. Such a record counts as a hole, like one whose bytes are
# missing: it and all later records belong to the torn tail.


def truncate_at_lost_blob(folder: Path, recorder: bytes) -> None:
    """Truncate the segments of a locked folder; copies the tail aside first. Raises `OSError` and `SpoolForeign`.

    Leaves a damaged folder as it is, because a repair decides about its records.
    """
    if _all_committed(folder, recorder):
        return
    prefix, damage, uncommitted = survey(folder, recorder)
    if damage is not None or not uncommitted:
        return
    committed = prefix.cut.position - len(uncommitted)
    first = max(number for number, base in prefix.bases.items() if base <= committed + 1)
    segments = {number: spool_format.segment_path(folder, number) for number in prefix.bases if number >= first}
    frames: list[tuple[spool_format.ReadCursor, spool_format.Frame]] = []
    scanner = SegmentScanner(folder, recorder, segments=segments, on_frame=lambda *each: frames.append(each))
    while scanner.step():
        pass
    for (number, offset, position), frame in frames:
        if frame.kind == spool_format.COMMIT or position <= committed:
            continue
        references = references_in(frame.type.decode(), frame.payload)
        if not all(is_whole(folder, each.hash) for each in references):
            seal(folder, prefix._replace(cut=spool_format.ReadCursor(number, offset - frame.size, position - 1)))
            return


def _all_committed(folder: Path, recorder: bytes) -> bool:
    """Return whether a commit frame covers the last whole record, so that the folder need not be surveyed."""
    committed = 0
    for number, path in reversed(spool_format.segments_in(folder).items()):
        if not spool_format.is_begun(path):
            continue
        buffer = spool_format.read_segment(path)
        for frame in _last_frames(buffer, spool_format.salt_of(recorder, number)):
            if frame.kind != spool_format.COMMIT:
                return frame.position <= committed
            committed = max(committed, frame.position)
    return True
