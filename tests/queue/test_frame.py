"""Frames are read whole and unchanged, or not at all; the golden bytes are computed here independently."""

import mmap
import struct
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pycrorm_async.queue.format import (
    COMMIT,
    DECLARATION,
    EVENT,
    Frame,
    decode,
    decode_each,
    encode,
    encode_commit,
    span_checksum,
)

SALT = 0xA1B2C3D4
EPISODE = bytes(range(0x10, 0x20))
WALL_NS = 1_700_000_000_123_456_789
MONOTONIC_NS = 987_654_321

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
    + struct.pack("<qq", WALL_NS, MONOTONIC_NS)
    + EPISODE
    + struct.pack("<I", SALT),
    b"NodeStarted" + b'{"a":"\xc3\xa4"}' + b"\0\0\0",
)
DECLARATION_BY_HAND = by_hand(
    struct.pack("<BBHIQQqq", 2, 22, 1, 2, 43, 0, WALL_NS, MONOTONIC_NS) + bytes(16) + struct.pack("<I", SALT),
    b"DesignatorTypeDeclared" + b"{}",
)
COMMIT_BY_HAND = by_hand(
    struct.pack("<BBHIQQqq", 3, 0, 0, 4, 43, 2, WALL_NS, MONOTONIC_NS) + bytes(16) + struct.pack("<I", SALT),
    struct.pack("<I", 0xDEADBEEF) + bytes(4),
)


def event(payload: bytes = b'{"a":"\xc3\xa4"}', *, position: int = 42) -> bytes:
    return encode(Frame(EVENT, 3, position, 7, WALL_NS, MONOTONIC_NS, EPISODE, b"NodeStarted", payload), SALT)


def test_an_event_has_its_golden_bytes_and_decodes_to_what_was_written() -> None:
    assert event() == EVENT_BY_HAND == GOLDEN["event"]
    checksum = zlib.crc32(EVENT_BY_HAND[64:] + EVENT_BY_HAND[:60])
    assert decode(GOLDEN["event"], 0, SALT) == Frame(
        EVENT, 3, 42, 7, WALL_NS, MONOTONIC_NS, EPISODE, b"NodeStarted", b'{"a":"\xc3\xa4"}', checksum, 88
    )


def test_a_declaration_has_its_golden_bytes_and_decodes_to_what_was_written() -> None:
    frame = decode(GOLDEN["declaration"], 0, SALT)
    assert GOLDEN["declaration"] == DECLARATION_BY_HAND
    assert frame is not None
    assert (frame.kind, frame.position, frame.sequence, frame.episode) == (DECLARATION, 43, 0, bytes(16))
    assert (frame.type, frame.payload, frame.size) == (b"DesignatorTypeDeclared", b"{}", 88)


def test_a_commit_has_its_golden_bytes_and_decodes_to_what_was_written() -> None:
    encoded = encode_commit(
        position=43, count=2, checksum=0xDEADBEEF, wall_ns=WALL_NS, monotonic_ns=MONOTONIC_NS, salt=SALT
    )
    frame = decode(GOLDEN["commit"], 0, SALT)
    assert encoded == COMMIT_BY_HAND == GOLDEN["commit"]
    assert frame is not None
    assert (frame.kind, frame.position, frame.sequence, frame.payload, frame.size) == (
        COMMIT,
        43,
        2,
        b"\xef\xbe\xad\xde",
        72,
    )


@pytest.mark.parametrize("name", ["event", "declaration", "commit"])
def test_a_frame_cut_at_any_byte_is_not_read(name: str) -> None:
    for end in range(len(GOLDEN[name])):
        assert decode(GOLDEN[name][:end], 0, SALT) is None, end


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


@pytest.mark.parametrize("name", ["event", "declaration", "commit"])
def test_bytes_before_and_after_a_frame_do_not_matter(name: str) -> None:
    whole = GOLDEN[name]
    frame_alone = decode(whole, 0, SALT)
    assert frame_alone is not None
    for around in (b"\0" * 8, b"\xff" * 8, whole):
        assert decode(around + whole + around, len(around), SALT) == frame_alone


def test_a_frame_of_another_segment_is_not_read() -> None:
    assert decode(GOLDEN["event"], 0, SALT + 1) is None


def test_preallocated_space_holds_no_frame() -> None:
    assert decode(bytes(4096), 0, SALT) is None
    assert decode(bytes(4096), 0, 0) is None


def test_a_length_beyond_the_end_is_no_frame_and_reads_nothing() -> None:
    head = struct.pack("<BBHIQQqq", 1, 255, 1, 2**32 - 1, 1, 1, 0, 0) + EPISODE + struct.pack("<I", SALT)
    assert decode(head + bytes(4096), 0, SALT) is None


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


def test_reading_stops_after_a_frame_with_any_one_bit_flipped() -> None:
    row = b"".join(ROW)
    whole = list(decode_each(row, 0, SALT))
    for bit in range(88 * 8, 176 * 8):
        changed = bytearray(row)
        changed[bit // 8] ^= 1 << bit % 8
        assert list(decode_each(bytes(changed), 0, SALT)) == whole[:1], bit


def test_a_frame_is_decoded_only_when_it_is_requested() -> None:
    with mmap.mmap(-1, 4096) as buffer:
        buffer[:88] = GOLDEN["event"]
        each = decode_each(buffer, 0, SALT)
        assert next(each) == decode(GOLDEN["event"], 0, SALT)
        buffer[88:176] = GOLDEN["declaration"]
        assert next(each) == decode(GOLDEN["declaration"], 0, SALT)
        assert next(each, None) is None


@given(st.lists(st.integers(min_value=0, max_value=2**32 - 1), max_size=50))
def test_the_checksum_of_a_span_is_that_of_its_records_in_sequence(checksums: list[int]) -> None:
    span = 0
    for checksum in checksums:
        span = zlib.crc32(struct.pack("<I", checksum), span)
    assert span_checksum(checksums) == span
