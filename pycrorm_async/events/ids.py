"""Numbers that name things: episodes, events, rows.

An episode is named by a UUIDv7, an event by (episode, sequence), a row by (episode number, sequence, slot) packed into
53 bits, so that data frames (float64 where a column is nullable) and JSON hold every row id exactly:

    episode number 22 bits | sequence 26 bits | slot 5 bits

The episode *number* is given by a database at first append and belongs to that database alone.
"""

from __future__ import annotations

import uuid
from typing import NamedTuple, NewType

__all__ = [
    "EpisodeId",
    "EpisodeNumber",
    "Sequence",
    "Position",
    "RowId",
    "RowKey",
    "SEQUENCE_MAX",
    "EPISODE_NUMBER_MAX",
    "SLOT_MAX",
    "SLOT_NODE",
    "SLOT_ROBOT_POSE",
    "SLOT_FIRST_FIELD",
    "episode_id",
    "episode_text",
    "parse_episode_id",
    "row_id",
    "row_key",
]

EpisodeId = NewType("EpisodeId", bytes)
"""The 16 bytes of a UUIDv7."""
EpisodeNumber = NewType("EpisodeNumber", int)
Sequence = NewType("Sequence", int)
"""1, 2, 3 … inside an episode, without gaps."""
Position = NewType("Position", int)
"""1, 2, 3 … inside a recorder, over all its episodes."""
RowId = NewType("RowId", int)

EPISODE_NUMBER_MAX = 2**22 - 1
SEQUENCE_MAX = 2**26 - 1
SLOT_MAX = 2**5 - 1

SLOT_NODE = 0
"""The row of the event itself: a node and its designator, an object as it was, an attachment."""
SLOT_ROBOT_POSE = 1
SLOT_FIRST_FIELD = 2


class RowKey(NamedTuple):
    """What a row id is made of; with the episode's UUID in place of its number it compares across databases."""

    number: EpisodeNumber
    sequence: Sequence
    slot: int


def row_id(number: int, sequence: int, slot: int) -> RowId:
    """The id of the row that (episode number, sequence, slot) makes.

    >>> row_id(1, 2, 3)
    2147483715
    """
    assert 0 <= number <= EPISODE_NUMBER_MAX, number
    assert 0 <= sequence <= SEQUENCE_MAX, sequence
    assert 0 <= slot <= SLOT_MAX, slot
    return RowId(number << 31 | sequence << 5 | slot)


def row_key(row: int) -> RowKey:
    """The opposite of `row_id`."""
    return RowKey(EpisodeNumber(row >> 31), Sequence(row >> 5 & SEQUENCE_MAX), row & SLOT_MAX)


def episode_id(wall_ns: int, randomness: bytes) -> EpisodeId:
    """A UUIDv7 (RFC 9562) of that moment: 48 bits of milliseconds, then 10 bytes of randomness less six bits."""
    assert len(randomness) == 10, len(randomness)
    value = (wall_ns // 1_000_000 & 2**48 - 1) << 80 | int.from_bytes(randomness)
    value = value & ~(0xF << 76) | 0x7 << 76
    value = value & ~(0x3 << 62) | 0x2 << 62
    return EpisodeId(value.to_bytes(16))


def episode_text(episode: EpisodeId) -> str:
    """The id as people read it: 8-4-4-4-12 hexadecimal digits."""
    return str(uuid.UUID(bytes=episode))


def parse_episode_id(text: str) -> EpisodeId:
    """The opposite of `episode_text`; a `ValueError` says what is no UUID."""
    return EpisodeId(uuid.UUID(text).bytes)
