"""Encode and decode a segment's header; allocate, map and sync the segment file.

A file gets all its blocks before it is mapped, so that a full disk raises `OSError` during allocation and never a
SIGBUS during a write. It gets its name only after its allocation is on the disk.
"""

from __future__ import annotations

import errno
import mmap
import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from struct import Struct
from typing import Final, NamedTuple
from zlib import crc32

from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.ids import SEQUENCE_MAX, EpisodeId
from pycrorm_async.queue.files.file_access import open_file
from pycrorm_async.queue.files.frame import Buffer
from pycrorm_async.queue.files.locks import FileIdentity

MAGIC: Final = b"PYCRQSEG"
FORMAT: Final = 1
SUFFIX: Final = ".segment"
EPISODE_STARTED: Final = "EpisodeStarted"
EPISODE_ENDED: Final = "EpisodeEnded"
SEGMENT_BYTES_MAX: Final = 2**30
"""Bounds the memory needed to read a segment: 128 times the default size."""
_HEADER: Final = Struct("<8sII16sQQI")
_CHECKSUM: Final = Struct("<I")
_MADV_POPULATE_WRITE: Final = 23
"""Linux's number for this advice to `madvise`; Python's `mmap` has no name for it."""
_POSITION_MAX: Final = 2**62
"""Bounds the position in a header: no recorder reaches it, so a header above it was changed."""
_FIXED: Final = _HEADER.size + _CHECKSUM.size
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


def encode_header(header: SegmentHeader) -> bytes:
    """Encode a segment's header."""
    episodes = b"".join(_OPEN.pack(episode, *last) for episode, last in header.open.items())
    fixed = _HEADER.pack(
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
    fixed = buffer[: _HEADER.size]
    _, _, salt, recorder, number, base, count = _HEADER.unpack(fixed)
    end = header_bytes(count)
    if end > len(buffer):
        return None
    episodes = buffer[_FIXED:end]
    (checksum,) = _CHECKSUM.unpack_from(buffer, _HEADER.size)
    if crc32(fixed, crc32(episodes)) != checksum or salt != salt_of(recorder, number):
        return None
    opened = {EpisodeId(episode): LastRecord(*last) for episode, *last in _OPEN.iter_unpack(episodes)}
    if not 0 < base <= _POSITION_MAX or any(not 0 < last.sequence <= SEQUENCE_MAX for last in opened.values()):
        return None
    return SegmentHeader(recorder, number, base, opened)


def segment_path(folder: Path, number: int) -> Path:
    """Return the path of a segment; names sort as numbers do up to 10⁸ segments."""
    return folder / f"{number:08d}{SUFFIX}"


def segment_numbers(folder: Path) -> list[int]:
    """Return the numbers of the segments in this folder, in order. Files of other names are ignored."""
    stems = (path.name.removesuffix(SUFFIX) for path in folder.iterdir() if path.suffix == SUFFIX)
    numbers = ((stem, int(stem)) for stem in stems if stem.isascii() and stem.isdigit())
    return sorted(number for stem, number in numbers if 0 < number < 2**64 and stem == f"{number:08d}")


def read_segment(path: Path) -> bytes:
    """Read a segment that no process writes any more.

    Raises `SpoolDamaged` for a file larger than any segment, and `OSError`.
    """
    descriptor, size = _open_segment(path)
    with os.fdopen(descriptor, "rb") as file:
        return file.read(size)


def map_segment(path: Path) -> mmap.mmap:
    """Map a segment read-only, shared with the process that writes it. Raises as `read_segment` does."""
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


def sync_folder(folder: Path) -> None:
    """Sync the directory entries of a folder. Raises `OSError`."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
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
            sync_folder(folder)
            buffer = mmap.mmap(descriptor, size)
        except BaseException:
            os.close(descriptor)
            unfinished.unlink(missing_ok=True)
            path.unlink(missing_ok=True)
            raise
        return cls(number=number, path=path, descriptor=descriptor, buffer=buffer)

    def begin(self, header: SegmentHeader) -> int:
        """Write the header; return the offset of the first frame."""
        encoded = encode_header(header)
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
        """Close the mapping and the file. Idempotent."""
        if self.descriptor >= 0:
            self.buffer.close()
            os.close(self.descriptor)
            self.descriptor = -1
