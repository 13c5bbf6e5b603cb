"""A segment's header is read whole or not at all, and a segment file has all its blocks before its first use."""

import mmap
import os
import resource
import struct
import zlib
from pathlib import Path

import pytest

from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue.format import (
    LastRecord,
    Segment,
    SegmentHeader,
    decode_header,
    encode_segment_header,
    format_of,
    header_bytes,
    segment_numbers,
)

GOLDEN = dict(
    line.split(" ") for line in (Path(__file__).parent.parent / "golden" / "queue_v1.hex").read_text().splitlines()
)
SEGMENT = bytes.fromhex(GOLDEN["segment"])
WALL_NS = 1_700_000_000_123_456_789
MONOTONIC_NS = 987_654_321
RECORDER = bytes(range(0x20, 0x30))
HEADER = SegmentHeader(
    recorder=RECORDER,
    number=5,
    base=43,
    open={
        EpisodeId(bytes(range(0x10, 0x20))): LastRecord(7, WALL_NS, MONOTONIC_NS),
        EpisodeId(bytes(range(0x30, 0x40))): LastRecord(1, WALL_NS - 1, MONOTONIC_NS - 1),
    },
)


def test_a_header_has_its_golden_bytes() -> None:
    episodes = (
        bytes(range(0x10, 0x20))
        + struct.pack("<Qqq", 7, WALL_NS, MONOTONIC_NS)
        + bytes(range(0x30, 0x40))
        + struct.pack("<Qqq", 1, WALL_NS - 1, MONOTONIC_NS - 1)
    )
    salt = zlib.crc32(RECORDER + struct.pack("<Q", 5))
    fixed = b"PYCRQSEG" + struct.pack("<II", 1, salt) + RECORDER + struct.pack("<QQI", 5, 43, 2)
    by_hand = fixed + struct.pack("<I", zlib.crc32(episodes + fixed)) + episodes
    assert encode_segment_header(HEADER) == by_hand == SEGMENT
    assert len(SEGMENT) == header_bytes(2) == 136


def test_a_header_decodes_to_what_was_written_whatever_follows() -> None:
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


def test_preallocated_space_has_no_header_and_no_format() -> None:
    assert decode_header(bytes(4096)) is None
    assert format_of(bytes(4096)) is None
    assert format_of(b"") is None


def test_a_newer_format_is_reported_though_its_header_cannot_be_read() -> None:
    newer = SEGMENT[:8] + struct.pack("<I", 2) + b"something else altogether" + bytes(100)
    assert format_of(newer) == 2
    assert decode_header(newer) is None


def test_a_preallocated_segment_consists_of_zeros_with_blocks_of_its_own(tmp_path: Path) -> None:
    segment = Segment.allocate(tmp_path, number=3, size=8192)
    segment.close()
    assert [path.name for path in tmp_path.iterdir()] == ["00000003.segment"]
    assert segment.path.read_bytes() == bytes(8192)
    assert segment.path.stat().st_blocks * 512 >= 8192


def test_allocating_in_a_deleted_folder_raises_the_error_of_the_system(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Segment.allocate(tmp_path / "gone", number=1, size=4096)


def test_files_with_other_names_are_not_segments(tmp_path: Path) -> None:
    for name in (
        "00000002.segment",
        "100000001.segment",
        "1.segment",
        "x.segment",
        "00000003.making",
        "²²²²²²²².segment",
    ):
        (tmp_path / name).touch()
    assert segment_numbers(tmp_path) == [2, 100_000_001]


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


def test_touching_beyond_the_end_of_a_segment_has_no_effect(tmp_path: Path) -> None:
    segment = Segment.allocate(tmp_path, number=1, size=mmap.PAGESIZE)
    for start, end in ((0, 2**30), (mmap.PAGESIZE - 1, 2**30), (mmap.PAGESIZE, 2**30), (0, 0)):
        segment.touch(start, end)
    assert segment.path.read_bytes() == bytes(mmap.PAGESIZE)
    segment.close()
