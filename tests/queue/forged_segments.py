"""Change a field of a real segment and correct every checksum, so that a reader reaches the checks behind them."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any
from zlib import crc32

from pycrorm_async.queue.format import (
    CHECKSUM,
    COMMIT,
    Frame,
    decode_header,
    encode,
    header_bytes,
    salt_of,
    span_checksum,
)
from pycrorm_async.queue.scan import whole_frames

__all__ = ["NAMES", "change_a_frame", "change_the_header", "rewritten"]

NAMES = (b"\xff\xfe", b"\xed\xa0\x80", b"Node\0", b"", b"x" * 255, b"\xc3\x84", b"EpisodeEnded", b"EpisodeStarted")
"""Names of event types: invalid UTF-8, a lone surrogate, a zero, empty, unknown, and those that open or close an
episode.
"""
_NUMBERS = (0, 1, 2, 2**26, 2**31, 2**62, 2**63 - 1)
_PAYLOADS = (b"", b"\xff", b"\0", b"null", b"[" * 5000, b'{"type":[]}', b"1e999", b'{"wall_ns":' + b"9" * 400 + b"}")


def rewritten(path: Path, frames: list[Frame], start: int, salt: int) -> None:
    """Return the segment with these frames, and with commit frames that match the records before them."""
    unsaid: list[int] = []
    content = path.read_bytes()
    parts = [content[:start]]
    for frame in frames:
        payload, sequence = frame.payload, frame.sequence
        if frame.kind == COMMIT:
            covered, unsaid = unsaid, []
            payload, sequence = CHECKSUM.pack(span_checksum(covered)), len(covered)
        encoded = encode(frame._replace(payload=payload, sequence=sequence), salt)
        if frame.kind != COMMIT:
            unsaid.append(CHECKSUM.unpack_from(encoded, 60)[0])
        parts.append(encoded)
    written = b"".join(parts)
    path.write_bytes(written + bytes(max(0, len(content) - len(written))))


def change_a_frame(path: Path, rng: random.Random, *, fitting: bool = True, name: bytes | None = None) -> int:
    """Change one record and return its position. Without `fitting`, commit frames stay as they were."""
    content = path.read_bytes()
    header = decode_header(content)
    assert header is not None
    salt, start = salt_of(header.recorder, header.number), header_bytes(len(header.open))
    frames = [frame for _, frame in whole_frames(content, start, salt)]
    index = rng.choice([number for number, frame in enumerate(frames) if frame.kind != COMMIT])
    frame = frames[index]
    changes: dict[str, Any] = {
        "type": rng.choice(NAMES) if name is None else name,
        "payload": rng.choice(_PAYLOADS),
        "version": rng.choice((0, 2, 65535)),
        "kind": rng.choice((1, 2)),
        "position": frame.position + rng.choice((-1, 1, 2**40)),
        "sequence": rng.choice(_NUMBERS),
        "wall_ns": rng.choice((-(2**63), -1, *_NUMBERS)),
        "monotonic_ns": rng.choice((-(2**63), -1, *_NUMBERS)),
        "episode": rng.choice((bytes(16), b"\xff" * 16)),
    }
    field = rng.choice(list(changes)) if name is None else "type"
    frames[index] = frame._replace(**{field: changes[field]})
    if fitting:
        rewritten(path, frames, start, salt)
        return frame.position
    parts = [content[:start], *(encode(each, salt) for each in frames)]
    path.write_bytes(b"".join(parts).ljust(len(content), b"\0"))
    return frame.position


def change_the_header(path: Path, rng: random.Random) -> None:
    """Change one field of the segment header."""
    content = bytearray(path.read_bytes())
    header = decode_header(bytes(content))
    assert header is not None
    end = header_bytes(len(header.open))
    places = [(16, 16), (32, 8), (40, 8)]  # the recorder, the segment's number, the base
    if header.open:
        places += [(56, 16), (72, 8)]  # an open episode and its sequence
    offset, size = rng.choice(places)
    content[offset : offset + size] = rng.choice((bytes(size), b"\xff" * size, rng.randbytes(size)))
    content[52:56] = crc32(content[:52], crc32(content[56:end])).to_bytes(4, "little")
    path.write_bytes(content)
