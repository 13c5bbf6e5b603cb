"""Encode and decode frames and segments, and read the records of segment files."""

from __future__ import annotations

import errno
import mmap
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from struct import Struct, pack
from typing import Final, NamedTuple, TypeAlias
from zlib import crc32

from pycrorm_async import core
from pycrorm_async.bulk_records import make
from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import SEQUENCE_MAX, EpisodeId
from pycrorm_async.queue.locks import FileIdentity, open_file

#
# Encode and decode a segment's header; allocate, map and sync the segment file.
#
# A file gets all its blocks before it is mapped, so that a full disk raises `OSError` during allocation and never a
# SIGBUS during a write. It gets its name only after its allocation is on the disk.

MAGIC: Final = b"PYCRQSEG"
FORMAT: Final = 1
SUFFIX: Final = ".segment"
EPISODE_STARTED: Final = "EpisodeStarted"
EPISODE_ENDED: Final = "EpisodeEnded"
SEGMENT_BYTES_MAX: Final = 2**30
"""Bounds the memory needed to read a segment: 128 times the default size."""
_SEGMENT_HEADER: Final = Struct("<8sII16sQQI")
_CHECKSUM: Final = Struct("<I")
_MADV_POPULATE_WRITE: Final = 23
"""Linux's number for this advice to `madvise`; Python's `mmap` has no name for it."""
_POSITION_MAX: Final = 2**62
"""Bounds the position in a header: no recorder reaches it, so a header above it was changed."""
_FIXED: Final = _SEGMENT_HEADER.size + _CHECKSUM.size
_OPEN: Final = Struct("<16sQqq")


class LastRecord(NamedTuple):
    """The last record of an open episode."""

    sequence: int
    wall_ns: int
    monotonic_ns: int


class SegmentHeader(NamedTuple):
    """The header: `base` is the position of the segment's first record, `open` the episodes open before it."""

    recorder: bytes
    number: int
    base: int
    open: Mapping[EpisodeId, LastRecord]


def header_bytes(episodes: int) -> int:
    """Return the size of a header that lists this many open episodes."""
    return _FIXED + episodes * _OPEN.size


def salt_of(recorder: bytes, number: int) -> int:
    """Return the salt of a segment: each of its frames carries it, and no frame of another segment does."""
    return crc32(number.to_bytes(8, "little"), crc32(recorder))


def encode_segment_header(header: SegmentHeader) -> bytes:
    """Encode a segment's header."""
    episodes = b"".join(_OPEN.pack(episode, *last) for episode, last in header.open.items())
    fixed = _SEGMENT_HEADER.pack(
        MAGIC,
        FORMAT,
        salt_of(header.recorder, header.number),
        header.recorder,
        header.number,
        header.base,
        len(header.open),
    )
    return fixed + _CHECKSUM.pack(crc32(fixed, crc32(episodes))) + episodes


def format_of(buffer: Buffer) -> int | None:
    """Return the format in the header, or None if the buffer begins with no header of any format."""
    if len(buffer) < _FIXED or buffer[: len(MAGIC)] != MAGIC:
        return None
    return int.from_bytes(buffer[8:12], "little")


def decode_header(buffer: Buffer) -> SegmentHeader | None:
    """Decode the header; None for a preallocated segment and for a torn or changed header."""
    if format_of(buffer) != FORMAT:
        return None
    fixed = buffer[: _SEGMENT_HEADER.size]
    _, _, salt, recorder, number, base, count = _SEGMENT_HEADER.unpack(fixed)
    end = header_bytes(count)
    if end > len(buffer):
        return None
    episodes = buffer[_FIXED:end]
    (checksum,) = _CHECKSUM.unpack_from(buffer, _SEGMENT_HEADER.size)
    if crc32(fixed, crc32(episodes)) != checksum or salt != salt_of(recorder, number):
        return None
    opened = {EpisodeId(episode): LastRecord(*last) for episode, *last in _OPEN.iter_unpack(episodes)}
    if not 0 < base <= _POSITION_MAX or any(not 0 < last.sequence <= SEQUENCE_MAX for last in opened.values()):
        return None
    return SegmentHeader(recorder, number, base, opened)


def segment_path(folder: Path, number: int) -> Path:
    """Return the path of a segment; names sort as numbers do up to 10⁸ segments."""
    return folder / f"{number:08d}{SUFFIX}"


def segments_in(folder: Path) -> dict[int, Path]:
    """Return the segments in this folder by number, in order. Files of other names are ignored."""
    stems = (path.name.removesuffix(SUFFIX) for path in folder.iterdir() if path.suffix == SUFFIX)
    numbers = ((stem, int(stem)) for stem in stems if stem.isascii() and stem.isdigit())
    ours = sorted(number for stem, number in numbers if 0 < number < 2**64 and stem == f"{number:08d}")
    return {number: segment_path(folder, number) for number in ours}


def read_segment(path: Path) -> bytes:
    """Read a segment that no process writes any more.

    Raises `SpoolDamaged` for a file larger than any segment, and `OSError`.
    """
    descriptor, size = _open_segment(path)
    with os.fdopen(descriptor, "rb") as file:
        return file.read(size)


def is_begun(path: Path) -> bool:
    """Return whether a segment has a header: most folders have one that was made ahead, which takes 10 ms to search.

    Raises what `read_segment` raises.
    """
    descriptor, _ = _open_segment(path)
    with os.fdopen(descriptor, "rb") as file:
        return format_of(file.read(_FIXED)) is not None


def map_segment(path: Path) -> mmap.mmap:
    """Map a segment read-only, shared with the process that writes it. Raises what `read_segment` raises."""
    descriptor, size = _open_segment(path)
    try:
        if size == 0:
            raise SpoolDamaged(path, 0, "it is empty")
        return mmap.mmap(descriptor, size, access=mmap.ACCESS_READ)
    finally:
        os.close(descriptor)


def _open_segment(path: Path) -> tuple[int, int]:
    """Open a regular file; return descriptor and size. O_NONBLOCK keeps a FIFO from blocking the caller."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    status = os.fstat(descriptor)
    if stat.S_ISREG(status.st_mode) and status.st_size <= SEGMENT_BYTES_MAX:
        return descriptor, status.st_size
    os.close(descriptor)
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    raise SpoolDamaged(
        path, SEGMENT_BYTES_MAX, f"it has {status.st_size:,} bytes; a segment has at most {SEGMENT_BYTES_MAX:,}"
    )


def sync_path(path: Path) -> None:
    """Sync a file, or the directory entries of a folder. Raises `OSError`."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class Segment:
    """A segment that this process writes: `buffer` is its mapping."""

    __slots__ = ("buffer", "descriptor", "identity", "number", "path")

    def __init__(self, *, number: int, path: Path, descriptor: int, buffer: mmap.mmap) -> None:
        self.number = number
        self.path = path
        self.descriptor = descriptor
        self.identity = FileIdentity.of(os.fstat(descriptor))
        self.buffer = buffer

    @classmethod
    def allocate(cls, folder: Path, *, number: int, size: int) -> Segment:
        """Create a file of zeros, synced together with its name. Raises `OSError` and then leaves no file behind."""
        path = segment_path(folder, number)
        unfinished = path.with_suffix(".making")
        descriptor = open_file(unfinished, os.O_RDWR | os.O_TRUNC)
        try:
            os.posix_fallocate(descriptor, 0, size)
            os.fsync(descriptor)
            unfinished.rename(path)
            sync_path(folder)
            buffer = mmap.mmap(descriptor, size)
        except BaseException:
            os.close(descriptor)
            unfinished.unlink(missing_ok=True)
            path.unlink(missing_ok=True)
            raise
        return cls(number=number, path=path, descriptor=descriptor, buffer=buffer)

    def begin(self, header: SegmentHeader) -> int:
        """Write the header; return the offset of the first frame."""
        encoded = encode_segment_header(header)
        self.buffer[: len(encoded)] = encoded
        return len(encoded)

    def sync(self) -> None:
        """Write the mapping to the disk. Raises `OSError`; then the content on the disk is unknown."""
        os.fdatasync(self.descriptor)

    def touch(self, start: int, end: int) -> None:
        """Have the kernel make the pages of these bytes writable, so that the first write into one takes no page fault.

        Changes no byte. Without effect before Linux 5.14.
        """
        page, end = start // mmap.PAGESIZE * mmap.PAGESIZE, min(end, len(self.buffer))
        if page < end:
            with suppress(OSError):
                self.buffer.madvise(_MADV_POPULATE_WRITE, page, end - page)

    @property
    def is_in_place(self) -> bool:
        """Return whether the file still has its name; a sync does not show it, because a deleted file syncs too."""
        return self.identity.is_at(self.path)

    def close(self) -> None:
        """Close the mapping and the file. Idempotent. An error of the disk concerns nothing that was synced."""
        if self.descriptor >= 0:
            self.buffer.close()
            with suppress(OSError):
                os.close(self.descriptor)
            self.descriptor = -1


# === frame ====================================================================================================
#
# Encode and decode one frame; pure. The docstring of `pycrorm_async.queue` specifies the layout.
#
# A frame decodes complete and unchanged or not at all, because its checksum covers every bit.

Buffer: TypeAlias = bytes | mmap.mmap

EVENT: Final = 1
DECLARATION: Final = 2
COMMIT: Final = 3

_HEAD: Final = Struct("<BBHIQQqq16sI")
"""The header of a frame without its checksum."""
CHECKSUM: Final = Struct("<I")
CHECKSUM_START: Final = _HEAD.size
HEADER_BYTES: Final = _HEAD.size + CHECKSUM.size
_FRAME_HEADER: Final = Struct(f"{_HEAD.format}I")
_CHECKED: Final = 0x2144DF1C
"""The crc32 of any bytes followed by their own crc32."""
COMMIT_BYTES: Final = HEADER_BYTES + 8
TYPE_BYTES_MAX: Final = 2**8 - 1
NO_EPISODE: Final = bytes(16)
_PADDING: Final = tuple(bytes(count) for count in range(8))


class Frame(NamedTuple):
    """One decoded frame. `size` is its length in bytes, `type` the type name in UTF-8, `checksum` the frame's crc32."""

    kind: int
    version: int
    position: int
    sequence: int
    wall_ns: int
    monotonic_ns: int
    episode: bytes
    type: bytes
    payload: bytes
    checksum: int = 0
    size: int = 0


Fields: TypeAlias = tuple[int, int, int, int, int, int, bytes, bytes, bytes, int, int]
"""The fields of a `Frame` as a plain tuple, because constructing the named one takes a fifth of the decoding time."""


def encode(frame: Frame, salt: int) -> bytes:
    """Encode one frame; computes its `checksum` and `size`."""
    kind, version, position, sequence, wall_ns, monotonic_ns, episode, name, payload, _, _ = frame
    body = encode_body(name, payload)
    sizes_and_times = len(name), version, len(payload), position, sequence, wall_ns, monotonic_ns
    return encode_frame_header(kind, *sizes_and_times, episode, salt, crc32(body)) + body


def encode_body(type_name: bytes, payload: bytes) -> bytes:
    """Encode the part after a frame's header. The live queue does so before it takes its lock."""
    return b"".join((type_name, payload, _PADDING[-(len(type_name) + len(payload)) & 7]))


def encode_frame_header(  # positional: keywords would cost every event 0.05 µs
    kind: int,
    type_bytes: int,
    version: int,
    payload_bytes: int,
    position: int,
    sequence: int,
    wall_ns: int,
    monotonic_ns: int,
    episode: bytes,
    salt: int,
    body_checksum: int,
    /,
) -> bytes:
    """Encode a frame's header: `CHECKSUM_START` bytes, then the checksum of the whole frame."""
    head = _HEAD.pack(
        kind, type_bytes, version, payload_bytes, position, sequence, wall_ns, monotonic_ns, episode, salt
    )
    return head + CHECKSUM.pack(crc32(head, body_checksum))


def encode_commit(*, position: int, count: int, checksum: int, wall_ns: int, monotonic_ns: int, salt: int) -> bytes:
    """Encode a commit frame: records up to `position` are on the disk, `count` of them since the previous one."""
    payload = CHECKSUM.pack(checksum)
    return encode(Frame(COMMIT, 0, position, count, wall_ns, monotonic_ns, NO_EPISODE, b"", payload), salt)


def encode_span(
    frames: Sequence[Frame], *, after: int, salt: int, uncommitted: Sequence[int] = ()
) -> tuple[bytes, bytes]:
    """Encode these records at the positions that follow `after`, and a commit frame.

    The commit frame covers them and the earlier records whose checksums are in `uncommitted`.
    """
    encoded = [encode(frame._replace(position=position), salt) for position, frame in enumerate(frames, after + 1)]
    checksums = [*uncommitted, *(CHECKSUM.unpack_from(content, CHECKSUM_START)[0] for content in encoded)]
    commit = encode_commit(
        position=after + len(frames),
        count=len(checksums),
        checksum=span_checksum(checksums),
        wall_ns=frames[-1].wall_ns if frames else 0,
        monotonic_ns=frames[-1].monotonic_ns if frames else 0,
        salt=salt,
    )
    return b"".join(encoded), commit


def decode(buffer: Buffer, offset: int, salt: int) -> Frame | None:
    """Decode the frame at `offset`; None for no frame, a torn or changed frame, or one of another segment."""
    for fields in decode_each(buffer, offset, salt):
        return make(Frame, fields)
    return None


def decode_each(buffer: Buffer, offset: int, salt: int) -> Iterator[Fields]:
    """Decode consecutive frames from `offset` until one does not decode; lazily, one per step.

    Takes 1 µs per frame, a third of it for the checksum.
    """
    unpack, end = _FRAME_HEADER.unpack, len(buffer)
    while (body_start := offset + HEADER_BYTES) <= end:
        header = buffer[offset:body_start]  # a copy, which no concurrent write changes between the next two steps
        (
            kind,
            type_bytes,
            version,
            payload_bytes,
            position,
            sequence,
            wall_ns,
            monotonic_ns,
            episode,
            salted,
            checksum,
        ) = unpack(header)
        if salted != salt or not EVENT <= kind <= COMMIT:
            return
        size = HEADER_BYTES + (type_bytes + payload_bytes + 7 & -8)
        offset += size
        if offset > end:
            return
        body = buffer[body_start:offset]
        if crc32(header, crc32(body)) != _CHECKED:
            return
        yield (
            kind,
            version,
            position,
            sequence,
            wall_ns,
            monotonic_ns,
            episode,
            body[:type_bytes],
            body[type_bytes : type_bytes + payload_bytes],
            checksum,
            size,
        )


def frame_bytes(type_bytes: int, payload_bytes: int) -> int:
    """Return the size of a frame whose type name and payload have these sizes, in bytes."""
    length = type_bytes + payload_bytes
    return HEADER_BYTES + length + (-length & 7)


def span_checksum(checksums: Sequence[int]) -> int:
    """Return the checksum of a span of records from the checksums of its frames; crc32 chained per record equals it."""
    return crc32(pack(f"<{len(checksums)}I", *checksums))


# === reader ===================================================================================================
#
# Read records of a living recorder from its segments, in order, with payloads untouched.
#
# A hole raises an error here, because the caller asks only for records that are synced. Recovery, which expects holes,
# uses `scan.py`.


RECORDS_AT_ONCE: Final = 500
"""Bounds the records read between two steps of other tasks, and by one call of the compiled core, which holds the
interpreter lock: half a millisecond."""


class ReadCursor(NamedTuple):
    """A place between two records: segment and offset of the next frame, and position of the record before it."""

    number: int
    offset: int
    position: int


class ReadPlace(NamedTuple):
    """A recorder's folder, the recorder's id, and the cursor from which its segments are read."""

    folder: Path
    recorder: bytes
    start: ReadCursor


class ReadBatch(NamedTuple):
    """Records, the size of their payloads, and the cursor behind them. `complete`: one more would exceed a limit."""

    records: list[Record]
    payload_bytes: int
    after: ReadCursor
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

    def __init__(self, place: ReadPlace) -> None:
        self.cursor = place.start
        self._folder = place.folder
        self._recorder = place.recorder
        self._number = 0
        self._path = Path()
        self._buffer: Buffer = b""
        self._types: dict[bytes, str] = {}

    def read(self, *, last: int, events_max: int, bytes_max: int, partial: ReadBatch | None = None) -> ReadBatch:
        """Extend `partial`, or a batch that begins at the cursor, by the records up to position `last`.

        The batch holds at most `events_max` records, and payloads of at most `bytes_max` bytes unless its first record
        is larger. The cursor stays; set it to `after` when the batch is handed out. Raises `SpoolDamaged`; and
        `FileNotFoundError` if the segments at the cursor were deleted.
        """
        records, total, (number, offset, position), _ = partial or ReadBatch([], 0, self.cursor, complete=False)
        types = self._types
        if number != self._number:
            self._open_segment(number)
        until = min(last, position + events_max - len(records))
        full = False
        while position < until and not full:
            salt, some = salt_of(self._recorder, number), min(until, position + RECORDS_AT_ONCE)
            offset, position, total = core.take_records(
                self._buffer, offset, salt, position, some, total, bytes_max, types, Record, records, None, None
            )
            if position == some:
                continue
            for frame in decode_each(self._buffer, offset, salt):
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
                if position == until or core.IS_COMPILED:
                    break
            else:
                number, offset = number + 1, self._next_segment(number + 1, offset, position)
                if not records:  # the finished segment may be deleted before the next read
                    self.cursor = ReadCursor(number, offset, position)
        complete = full or len(records) >= events_max or total >= bytes_max
        return ReadBatch(records, total, ReadCursor(number, offset, position), complete)

    def skip_to(self, position: int) -> None:
        """Move the cursor behind this position; the records up to it must be readable. Raises what `read` raises."""
        while self.cursor.position < position:
            self.cursor = self.read(last=position, events_max=10_000, bytes_max=2**22).after

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
