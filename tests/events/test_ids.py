"""Ids are exact in every representation, and can be split again."""

import json
import uuid

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pycrorm_async.events.ids import (
    EPISODE_NUMBER_MAX,
    SEQUENCE_MAX,
    SLOT_MAX,
    episode_id,
    episode_text,
    parse_episode_id,
    row_id,
    row_key,
)

numbers = st.integers(0, EPISODE_NUMBER_MAX)
sequences = st.integers(0, SEQUENCE_MAX)
slots = st.integers(0, SLOT_MAX)


def test_the_largest_row_id_is_exact_as_a_float_and_in_json() -> None:
    largest = row_id(4_194_303, 67_108_863, 31)
    assert largest == 9_007_199_254_740_991  # 2**53 - 1
    assert int(float(largest)) == largest
    assert int(float(largest - 1)) == largest - 1
    assert json.loads(json.dumps({"id": largest}), parse_int=float)["id"] == largest


def test_a_row_id_is_packed_as_documented() -> None:
    assert row_id(1, 2, 3) == 2_147_483_648 + 64 + 3
    assert row_key(2_147_483_715) == (1, 2, 3)


@given(numbers, sequences, slots)
def test_a_row_id_splits_into_its_parts(number: int, sequence: int, slot: int) -> None:
    assert row_key(row_id(number, sequence, slot)) == (number, sequence, slot)


@given(st.tuples(numbers, sequences, slots), st.tuples(numbers, sequences, slots))
def test_row_ids_order_as_episode_sequence_slot(a: tuple[int, int, int], b: tuple[int, int, int]) -> None:
    assert (row_id(*a) < row_id(*b)) == (a < b)


@pytest.mark.parametrize("outside", [(2**22, 0, 0), (0, 2**26, 0), (0, 0, 32), (-1, 0, 0)])
def test_a_row_id_out_of_range_is_refused(outside: tuple[int, int, int]) -> None:
    with pytest.raises(AssertionError):
        row_id(*outside)


def test_an_episode_id_is_a_version_seven_uuid_of_its_moment() -> None:
    name = episode_id(1_700_000_000_123_456_789, bytes(range(10)))
    read = uuid.UUID(bytes=bytes(name))
    assert read.version == 7
    assert read.variant == uuid.RFC_4122
    assert read.int >> 80 == 1_700_000_000_123
    assert episode_text(name) == str(read)
    assert parse_episode_id(str(read)) == name


def test_episode_ids_of_later_milliseconds_sort_later() -> None:
    assert episode_id(5_000_000, b"\xff" * 10) < episode_id(6_000_000, b"\x00" * 10)
