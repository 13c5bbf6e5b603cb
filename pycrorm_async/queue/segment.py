"""One segment file: its header, and the file itself, allocated ahead and mapped.

The whole file has its blocks before anything is mapped, so a full disk is an `OSError` while allocating and never a
SIGBUS while writing. It gets its name only when that is safe on the disk.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Mapping
from pathlib import Path
from struct import Struct
from typing import Final, NamedTuple
from zlib import crc32

from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue.frame import Buffer

__all__ = [
    "FORMAT",
    "OPENS",
    "CLOSES",
    "Last",
    "SegmentHeader",
    "Segment",
    "header_bytes",
    "encode_header",
    "decode_header",
    "format_of",
    "salt_of",
    "segment_path",
    "segment_numbers",
    "sync_folder",
]

MAGIC: Final = b"PYCRQSEG"
FORMAT: Final = 1
SUFFIX: Final = ".segment"
OPENS: Final = "EpisodeStarted"
CLOSES: Final = "EpisodeEnded"
_HEADER: Final = Struct("<8sII16sQQI")
_CHECKSUM: Final = Struct("<I")
_FIXED: Final = _HEADER.size + _CHECKSUM.size
_OPEN: Final = Struct("<16sQqq")


class Last(NamedTuple):
    """The last record of an open episode."""

    sequence: int
    wall_ns: int
    monotonic_ns: int


class SegmentHeader(NamedTuple):
    """Where a segment belongs: `base` is the position of its first record, `open` the episodes open before it."""

    recorder: bytes
    number: int
    base: int
    open: Mapping[EpisodeId, Last]


def header_bytes(episodes: int) -> int:
    """The size of a header that names so many open episodes."""
    return _FIXED + episodes * _OPEN.size


def salt_of(recorder: bytes, number: int) -> int:
    """What every frame of this segment carries, and no frame of another."""
    return crc32(number.to_bytes(8, "little"), crc32(recorder))


def encode_header(header: SegmentHeader) -> bytes:
    """The bytes at the begin of a segment."""
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
    """The format this segment was written in, or None where no header of any format begins."""
    if len(buffer) < _FIXED or buffer[: len(MAGIC)] != MAGIC:
        return None
    return int.from_bytes(buffer[8:12], "little")


def decode_header(buffer: Buffer) -> SegmentHeader | None:
    """The header, or None: made ahead and never begun, torn, or changed."""
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
    return SegmentHeader(
        recorder,
        number,
        base,
        {EpisodeId(episode): Last(*last) for episode, *last in _OPEN.iter_unpack(episodes)},
    )


def segment_path(folder: Path, number: int) -> Path:
    """The file of this number; names sort as numbers do up to 10⁸ segments."""
    return folder / f"{number:08d}{SUFFIX}"


def segment_numbers(folder: Path) -> list[int]:
    """The numbers of the segments in this folder, in order. Files of other names are not ours to judge."""
    stems = (path.name.removesuffix(SUFFIX) for path in folder.iterdir() if path.suffix == SUFFIX)
    return sorted(int(stem) for stem in stems if stem.isascii() and stem.isdigit() and len(stem) >= 8)


def sync_folder(folder: Path) -> None:
    """Makes the names in a folder safe. Raises `OSError`."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class Segment:
    """A segment this process writes: `buffer` is its bytes, shared with the file."""

    __slots__ = ("buffer", "descriptor", "number", "path")

    def __init__(self, *, number: int, path: Path, descriptor: int, buffer: mmap.mmap) -> None:
        self.number = number
        self.path = path
        self.descriptor = descriptor
        self.buffer = buffer

    @classmethod
    def allocate(cls, folder: Path, *, number: int, size: int) -> Segment:
        """A new file of zeros, safe on the disk under its name. Raises `OSError` and leaves nothing behind."""
        path = segment_path(folder, number)
        unfinished = path.with_suffix(".making")
        descriptor = os.open(unfinished, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
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
        """Writes the header and returns where the first frame goes."""
        encoded = encode_header(header)
        self.buffer[: len(encoded)] = encoded
        return len(encoded)

    def sync(self) -> None:
        """Everything in the mapping is on the disk. Raises `OSError`, after which nothing about it is known."""
        os.fdatasync(self.descriptor)

    def close(self) -> None:
        """Gives up the mapping and the file; what was written stays. Twice is once."""
        if self.descriptor >= 0:
            self.buffer.close()
            os.close(self.descriptor)
            self.descriptor = -1
