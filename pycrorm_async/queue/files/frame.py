"""Encode and decode one frame; pure. The docstring of `pycrorm_async.queue` specifies the layout.

A frame decodes complete and unchanged or not at all, because its checksum covers every bit.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Sequence
from struct import Struct, pack
from typing import Final, NamedTuple, TypeAlias
from zlib import crc32

from pycrorm_async.bulk_records import make

Buffer: TypeAlias = bytes | mmap.mmap

EVENT: Final = 1
DECLARATION: Final = 2
COMMIT: Final = 3

_HEAD: Final = Struct("<BBHIQQqq16sI")
"""The header of a frame without its checksum."""
CHECKSUM: Final = Struct("<I")
CHECKSUM_START: Final = _HEAD.size
HEADER_BYTES: Final = _HEAD.size + CHECKSUM.size
_HEADER: Final = Struct(f"{_HEAD.format}I")
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
    return encode_header(kind, *sizes_and_times, episode, salt, crc32(body)) + body


def encode_body(type_name: bytes, payload: bytes) -> bytes:
    """Encode the part after a frame's header. The live queue does so before it takes its lock."""
    return b"".join((type_name, payload, _PADDING[-(len(type_name) + len(payload)) & 7]))


def encode_header(  # positional: keywords would cost every event 0.05 µs
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
    unpack, end = _HEADER.unpack, len(buffer)
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
