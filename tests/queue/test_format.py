"""The files of a queue, byte by byte: frames, headers and declarations are read whole and unchanged or not at all."""

from __future__ import annotations

import mmap
import os
import resource
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pycrorm_async.events.codec import Heading
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue.format import (
    COMMIT,
    DECLARATION,
    EVENT,
    Frame,
    LastRecord,
    Segment,
    SegmentHeader,
    decode,
    decode_each,
    decode_header,
    encode,
    encode_commit,
    encode_segment_header,
    header_bytes,
)
from pycrorm_async.queue.scan import survey
from tests.queue.factories import (
    DECLARED,
    MONOTONIC_NS,
    RECORDER,
    SMALL,
    WALL_NS,
    FolderWriter,
    ended,
    episode,
    make,
    node,
    recover,
    started,
)

# === frame ====================================================================================================
#
# Frames are read whole and unchanged, or not at all; the golden bytes are computed here independently.

SALT = 0xA1B2C3D4
EPISODE = bytes(range(0x10, 0x20))
FRAME_WALL_NS = 1_700_000_000_123_456_789
FRAME_MONOTONIC_NS = 987_654_321

GOLDEN = {
    name: bytes.fromhex(digits)
    for name, digits in (
        line.split(" ") for line in (Path(__file__).parent.parent / "golden" / "queue_v1.hex").read_text().splitlines()
    )
}


def by_hand(head: bytes, body: bytes) -> bytes:
    """Pack 60 bytes of header, the checksum of header and body, and the body."""
    assert len(head) == 60
    assert len(body) % 8 == 0
    return head + struct.pack("<I", zlib.crc32(body + head)) + body


EVENT_BY_HAND = by_hand(
    struct.pack("<BBHI", 1, 11, 3, 10)
    + struct.pack("<QQ", 42, 7)
    + struct.pack("<qq", FRAME_WALL_NS, FRAME_MONOTONIC_NS)
    + EPISODE
    + struct.pack("<I", SALT),
    b"NodeStarted" + b'{"a":"\xc3\xa4"}' + b"\0\0\0",
)
DECLARATION_BY_HAND = by_hand(
    struct.pack("<BBHIQQqq", 2, 22, 1, 2, 43, 0, FRAME_WALL_NS, FRAME_MONOTONIC_NS)
    + bytes(16)
    + struct.pack("<I", SALT),
    b"DesignatorTypeDeclared" + b"{}",
)
COMMIT_BY_HAND = by_hand(
    struct.pack("<BBHIQQqq", 3, 0, 0, 4, 43, 2, FRAME_WALL_NS, FRAME_MONOTONIC_NS)
    + bytes(16)
    + struct.pack("<I", SALT),
    struct.pack("<I", 0xDEADBEEF) + bytes(4),
)


def event(payload: bytes = b'{"a":"\xc3\xa4"}', *, position: int = 42) -> bytes:
    return encode(
        Frame(EVENT, 3, position, 7, FRAME_WALL_NS, FRAME_MONOTONIC_NS, EPISODE, b"NodeStarted", payload), SALT
    )


def test_frames_have_their_golden_bytes_and_decode_to_what_was_written() -> None:
    commit = encode_commit(
        position=43, count=2, checksum=0xDEADBEEF, wall_ns=FRAME_WALL_NS, monotonic_ns=FRAME_MONOTONIC_NS, salt=SALT
    )
    by_hand = {"event": EVENT_BY_HAND, "declaration": DECLARATION_BY_HAND, "commit": COMMIT_BY_HAND}
    assert {name: GOLDEN[name] for name in by_hand} == by_hand
    assert (event(), commit) == (EVENT_BY_HAND, COMMIT_BY_HAND)
    times = FRAME_WALL_NS, FRAME_MONOTONIC_NS
    name, payload = b"NodeStarted", b'{"a":"\xc3\xa4"}'
    assert {each: decode(GOLDEN[each], 0, SALT)._replace(checksum=0) for each in by_hand} == {  # type: ignore[union-attr]
        "event": Frame(EVENT, 3, 42, 7, *times, EPISODE, name, payload, size=88),
        "declaration": Frame(DECLARATION, 1, 43, 0, *times, bytes(16), b"DesignatorTypeDeclared", b"{}", size=88),
        "commit": Frame(COMMIT, 0, 43, 2, *times, bytes(16), b"", b"\xef\xbe\xad\xde", size=72),
    }


@pytest.mark.parametrize("name", ["event", "declaration", "commit"])
def test_a_frame_whose_last_bytes_are_still_zeros_is_not_read(name: str) -> None:
    whole = GOLDEN[name]
    for end in range(len(whole)):
        torn = whole[:end] + bytes(len(whole) - end + 64)
        if torn[: len(whole)] != whole:  # the padding consists of zeros anyway
            assert decode(torn, 0, SALT) is None, end


@pytest.mark.parametrize("name", ["event", "declaration", "commit"])
def test_a_frame_with_any_one_bit_flipped_is_not_read(name: str) -> None:
    for bit in range(len(GOLDEN[name]) * 8):
        changed = bytearray(GOLDEN[name])
        changed[bit // 8] ^= 1 << bit % 8
        assert decode(bytes(changed), 0, SALT) is None, bit


@given(st.binary(max_size=300), st.integers(min_value=1, max_value=2**64 - 1), st.binary(max_size=16))
def test_any_payload_is_decoded_unchanged_and_frames_end_at_multiples_of_8(
    payload: bytes, position: int, after: bytes
) -> None:
    encoded = event(payload, position=position)
    frame = decode(encoded + after, 0, SALT)
    assert frame is not None
    assert (frame.payload, frame.position, frame.size) == (payload, position, len(encoded))
    assert len(encoded) % 8 == 0


ROW = (GOLDEN["event"], GOLDEN["declaration"], GOLDEN["commit"], event(b""))
OFFSETS = (0, 88, 176, 248)


def test_consecutive_frames_decode_as_each_does_alone() -> None:
    row = b"".join(ROW)
    each = list(decode_each(b"12345678" + row + bytes(64), 8, SALT))
    assert each == [decode(row, offset, SALT) for offset in OFFSETS]
    assert list(decode_each(row, 88, SALT)) == each[1:]
    assert list(decode_each(row, len(row), SALT)) == []


def test_reading_stops_before_the_first_frame_that_is_cut_at_any_byte() -> None:
    row = b"".join(ROW)
    whole = list(decode_each(row, 0, SALT))
    for end in range(len(row)):
        count = sum(offset + len(frame) <= end for offset, frame in zip(OFFSETS, ROW, strict=True))
        assert list(decode_each(row[:end], 0, SALT)) == whole[:count], end


def test_a_frame_is_decoded_only_when_it_is_requested() -> None:
    with mmap.mmap(-1, 4096) as buffer:
        buffer[:88] = GOLDEN["event"]
        each = decode_each(buffer, 0, SALT)
        assert next(each) == decode(GOLDEN["event"], 0, SALT)
        buffer[88:176] = GOLDEN["declaration"]
        assert next(each) == decode(GOLDEN["declaration"], 0, SALT)
        assert next(each, None) is None


# === declarations =============================================================================================
#
# Each segment begins with the designator types in use and with the latest descriptions, within an eighth of it.

DESCRIBED = Heading(None, "DescriptionDeclared", 1)
EIGHTH = SMALL.segment_bytes // 8


def description(number: int, size: int = 400) -> bytes:
    return b'{"urdf":"%s"}' % (b"%d " % number).ljust(size, b"=")


def declared_in_segments(writer: FolderWriter) -> list[list[bytes]]:
    """The payloads of the declarations in each segment."""
    segments: dict[int, list[bytes]] = {}
    survey_result = survey(
        writer.folder,
        RECORDER,
        on_frame=lambda after, frame: segments.setdefault(after.number, []).append(
            frame.payload if frame.kind == DECLARATION else b""
        ),
    )
    assert survey_result.damage is None
    return [[each for each in payloads if each] for payloads in segments.values()]


async def test_the_latest_descriptions_are_repeated_and_every_designator_type(tmp_path: Path) -> None:
    writer = FolderWriter(tmp_path)
    put = writer.appender.put
    put(started(1), b"{}", True)
    put(DECLARED, b'{"dtype":"A"}', True)
    many = 2 * EIGHTH // 400
    for number in range(many):
        put(DESCRIBED, description(number), True)
        if number == many // 2:
            put(DECLARED, b'{"dtype":"B"}', True)
    put(DESCRIBED, description(0), True)  # is used again
    segments = len(writer.appender.begun)
    while len(writer.appender.begun) == segments:
        put(node(1), b"n" * 1_000, True)
    last = declared_in_segments(writer)[-1]
    described = [each for each in last if each.startswith(b'{"urdf"')]
    assert [each for each in last if each not in described] == [b'{"dtype":"A"}', b'{"dtype":"B"}']
    latest = [*range(many - len(described) + 1, many), 0]
    assert sorted(described) == sorted(description(number) for number in latest)
    assert EIGHTH - 600 < sum(64 + len(each) + 24 for each in described) <= EIGHTH
    records = await recover(writer.folder)
    assert [each.type for each in records[:3]] == ["EpisodeStarted", "DesignatorTypeDeclared", "DescriptionDeclared"]


# === file format ==============================================================================================
#
# The file that a live queue writes, byte by byte, against bytes packed from the tables in the package docstring.

FILE_SALT = zlib.crc32(RECORDER + struct.pack("<Q", 1))
MOMENT = struct.pack("<q", WALL_NS) + struct.pack("<q", MONOTONIC_NS)


def header() -> bytes:
    """Return the header of segment 1, before which no episode was open."""
    fixed = b"PYCRQSEG" + struct.pack("<II", 1, FILE_SALT) + RECORDER + struct.pack("<QQI", 1, 1, 0)
    return fixed + struct.pack("<I", zlib.crc32(fixed))


def frame(kind: int, version: int, position: int, sequence: int, owner: bytes, name: bytes, payload: bytes) -> bytes:
    body = name + payload
    body += bytes(-len(body) % 8)
    head = struct.pack("<B", kind) + struct.pack("<B", len(name)) + struct.pack("<H", version)
    head += struct.pack("<I", len(payload)) + struct.pack("<Q", position) + struct.pack("<Q", sequence)
    head += MOMENT + owner + struct.pack("<I", FILE_SALT)
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


# === segment ==================================================================================================
#
# A segment's header is read whole or not at all, and a segment file has all its blocks before its first use.

SEGMENT = GOLDEN["segment"]
HEADER_RECORDER = bytes(range(0x20, 0x30))
HEADER = SegmentHeader(
    recorder=HEADER_RECORDER,
    number=5,
    base=43,
    open={
        EpisodeId(bytes(range(0x10, 0x20))): LastRecord(7, FRAME_WALL_NS, FRAME_MONOTONIC_NS),
        EpisodeId(bytes(range(0x30, 0x40))): LastRecord(1, FRAME_WALL_NS - 1, FRAME_MONOTONIC_NS - 1),
    },
)


def test_a_header_has_its_golden_bytes_and_decodes_to_what_was_written_whatever_follows() -> None:
    episodes = (
        bytes(range(0x10, 0x20))
        + struct.pack("<Qqq", 7, FRAME_WALL_NS, FRAME_MONOTONIC_NS)
        + bytes(range(0x30, 0x40))
        + struct.pack("<Qqq", 1, FRAME_WALL_NS - 1, FRAME_MONOTONIC_NS - 1)
    )
    salt = zlib.crc32(HEADER_RECORDER + struct.pack("<Q", 5))
    fixed = b"PYCRQSEG" + struct.pack("<II", 1, salt) + HEADER_RECORDER + struct.pack("<QQI", 5, 43, 2)
    by_hand = fixed + struct.pack("<I", zlib.crc32(episodes + fixed)) + episodes
    assert encode_segment_header(HEADER) == by_hand == SEGMENT
    assert len(SEGMENT) == header_bytes(2) == 136
    assert decode_header(SEGMENT) == HEADER
    assert decode_header(SEGMENT + b"\xff" * 100) == HEADER


def test_a_header_cut_at_any_byte_is_not_read() -> None:
    for end in range(len(SEGMENT)):
        assert decode_header(SEGMENT[:end]) is None, end


def test_a_header_with_any_one_bit_flipped_is_not_read() -> None:
    for bit in range(len(SEGMENT) * 8):
        changed = bytearray(SEGMENT)
        changed[bit // 8] ^= 1 << bit % 8
        assert decode_header(bytes(changed)) is None, bit


def test_a_preallocated_segment_consists_of_zeros_with_blocks_of_its_own(tmp_path: Path) -> None:
    segment = Segment.allocate(tmp_path, number=3, size=8192)
    segment.close()
    assert [path.name for path in tmp_path.iterdir()] == ["00000003.segment"]
    assert segment.path.read_bytes() == bytes(8192)
    assert segment.path.stat().st_blocks * 512 >= 8192


def page_faults_of_writes(segment: Segment, pages: range) -> int:
    before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
    for page in pages:
        segment.buffer[page * mmap.PAGESIZE] = 1
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before


@pytest.mark.skipif(
    tuple(map(int, os.uname().release.split(".")[:2])) < (5, 14), reason="this kernel makes no pages writable ahead"
)
def test_writes_into_touched_bytes_take_no_page_fault(tmp_path: Path) -> None:
    segment = Segment.allocate(tmp_path, number=1, size=64 * mmap.PAGESIZE)
    segment.touch(5, 32 * mmap.PAGESIZE)
    assert segment.buffer[:] == bytes(64 * mmap.PAGESIZE)
    assert page_faults_of_writes(segment, range(32)) < 8
    assert page_faults_of_writes(segment, range(32, 64)) >= 32
    segment.close()
