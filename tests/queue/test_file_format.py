"""The file that a live queue writes, byte by byte, against bytes packed from the tables in the package docstring."""

import struct
import zlib
from dataclasses import replace
from pathlib import Path

from pycrorm_async.events.codec import Heading
from tests.queue.factories import DECLARED, MONOTONIC_NS, RECORDER, SMALL, WALL_NS, ended, episode, make, started

SALT = zlib.crc32(RECORDER + struct.pack("<Q", 1))
MOMENT = struct.pack("<q", WALL_NS) + struct.pack("<q", MONOTONIC_NS)


def header() -> bytes:
    """Return the header of segment 1, before which no episode was open."""
    fixed = b"PYCRQSEG" + struct.pack("<II", 1, SALT) + RECORDER + struct.pack("<QQI", 1, 1, 0)
    return fixed + struct.pack("<I", zlib.crc32(fixed))


def frame(kind: int, version: int, position: int, sequence: int, owner: bytes, name: bytes, payload: bytes) -> bytes:
    body = name + payload
    body += bytes(-len(body) % 8)
    head = struct.pack("<B", kind) + struct.pack("<B", len(name)) + struct.pack("<H", version)
    head += struct.pack("<I", len(payload)) + struct.pack("<Q", position) + struct.pack("<Q", sequence)
    head += MOMENT + owner + struct.pack("<I", SALT)
    return head + struct.pack("<I", zlib.crc32(body + head)) + body


def test_a_live_queue_writes_the_documented_bytes(tmp_path: Path) -> None:
    queue = make(tmp_path, settings=replace(SMALL, sync_interval_ms=3_600_000))
    put = (
        (DECLARED, b'{"kind":"action"}', 2, 1, 0),
        (started(1), b"{}", 1, 2, 1),
        (Heading(episode(1), "x" * 255, 65_535), b"", 1, 3, 2),
        *((Heading(episode(1), "Node", 3), b"\xc3\xa4\x00\xff"[:size], 1, 4 + size, 3 + size) for size in range(5)),
        (ended(1), b"{}", 1, 9, 8),
    )
    events = [
        frame(kind, heading.version, position, sequence, heading.episode or bytes(16), heading.type.encode(), payload)
        for heading, payload, kind, position, sequence in put
    ]
    for heading, payload, *_ in put:
        queue.put_nowait(heading, payload)
    written = (queue.folder / "00000001.segment").read_bytes()
    assert written == (header() + b"".join(events)).ljust(4096, b"\0")

    queue.release()
    checksums = b"".join(each[60:64] for each in events)
    commit = frame(3, 0, 9, 9, bytes(16), b"", struct.pack("<I", zlib.crc32(checksums)))
    written = (queue.folder / "00000001.segment").read_bytes()
    assert written == (header() + b"".join(events) + commit).ljust(4096, b"\0")
