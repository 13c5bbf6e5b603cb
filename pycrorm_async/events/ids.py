"""Ids identify episodes, events and rows.

A UUID identifies an episode, (episode, sequence) an event, and (episode number, sequence, slot) a row: the slot
distinguishes the rows of one event. A row id packs these three into 62 bits:

    episode number 31 bits | sequence 26 bits | slot 5 bits

It is an integer in tables, data frames, exported files and JSON. A reader that has doubles only, such as JavaScript,
rounds one above 2**53, of an episode from number 4,194,304 on; so the pages identify a node by its episode's number and
its sequence, which a double holds.

The rows of a list, such as the percepts of one detection, share an id and differ in a further column. A database
assigns the episode *number* at the first append; it is valid in that database only.
"""

import uuid
from typing import NamedTuple, NewType

EpisodeId = NewType("EpisodeId", bytes)
"""The 16 bytes of a UUIDv7; of an episode with a name of its own, of a UUIDv5, or of any UUID that its caller gave."""
EpisodeNumber = NewType("EpisodeNumber", int)
Sequence = NewType("Sequence", int)
"""1, 2, 3 … inside an episode, without gaps."""
Position = NewType("Position", int)
"""1, 2, 3 … inside a recorder, over all its episodes."""
RowId = NewType("RowId", int)
"""Episode number, sequence and slot in one integer of 62 bits (see `row_id`)."""

EPISODE_NUMBER_MAX = 2**31 - 1
"""Bounds the episodes of one database: the 31 bits of a row id that hold the number, an `integer` on PostgreSQL."""
EPISODE_NUMBER_MAX_0_1 = 2**22 - 1
"""Bounds the episodes of a database that version 0.1.0 made, until its owner opens it for writing."""
SEQUENCE_MAX = 2**26 - 1
"""Bounds the events of one episode: the 26 bits of a row id that hold the sequence."""
SLOT_MAX = 2**5 - 1
"""Bounds the row ids of one event: the 5 bits of a row id that hold the slot."""

_NUMBER_DIGITS = len(str(EPISODE_NUMBER_MAX))
NUMBER_SHIFT = 31
"""The bits of a row id behind the episode's number, those of the sequence and the slot."""

_NAMES = uuid.UUID("7f0e6c1a-3b52-4a8e-9f0d-5d2f1c7a64b1")
"""The namespace of the names of episodes, chosen at random."""

SLOT_NODE = 0
"""Slot of the event's own row: a node and its designator, an object's state, an attachment."""
SLOT_ROBOT_POSE = 1
"""Slot of the robot's pose at the start of a node."""
SLOT_FIRST_FIELD = 2
"""Slot of a designator's first declared field; the further fields follow in the order of declaration."""


class RowKey(NamedTuple):
    """The three parts of a row id. To compare rows across databases, replace the number by the episode's UUID."""

    number: EpisodeNumber
    sequence: Sequence
    slot: int


def row_id(number: int, sequence: int, slot: int) -> RowId:
    """Pack (episode number, sequence, slot) into a row id.

    >>> row_id(1, 2, 3)
    2147483715
    """
    assert 0 <= number <= EPISODE_NUMBER_MAX, number
    assert 0 <= sequence <= SEQUENCE_MAX, sequence
    assert 0 <= slot <= SLOT_MAX, slot
    return RowId(number << NUMBER_SHIFT | sequence << 5 | slot)


def row_id_min(number: int, sequence: int = 0) -> int:
    """Return the lowest row id of an episode from an event on; `number` may exceed its maximum by 1, for a bound."""
    return number << NUMBER_SHIFT | sequence << 5


def row_key(row: int) -> RowKey:
    """Unpack a row id; the inverse of `row_id`."""
    return RowKey(EpisodeNumber(row >> NUMBER_SHIFT), Sequence(row >> 5 & SEQUENCE_MAX), row & SLOT_MAX)


def episode_id(wall_ns: int, randomness: bytes) -> EpisodeId:
    """Build a UUIDv7 (RFC 9562) from a wall time in ns and 10 random bytes.

    The first 48 bits are the milliseconds since 1970; six of the random bits make room for version and variant.
    """
    assert len(randomness) == 10, len(randomness)
    value = (wall_ns // 1_000_000 & 2**48 - 1) << 80 | int.from_bytes(randomness)
    value = value & ~(0xF << 76) | 0x7 << 76
    value = value & ~(0x3 << 62) | 0x2 << 62
    return EpisodeId(value.to_bytes(16))


def named_episode_id(name: str | uuid.UUID) -> EpisodeId:
    """Return the id of an episode with a name of its own: that of a UUID or its text is itself, of another a UUIDv5.

    >>> episode_text(named_episode_id("kitchen 2019-05-01"))
    '432178db-930b-5aac-b76f-4affd3efcf41'
    """
    if isinstance(name, uuid.UUID):
        return EpisodeId(name.bytes)
    return parse_episode_id(name) if is_episode_id(name) else EpisodeId(uuid.uuid5(_NAMES, name).bytes)


def is_named(episode: bytes) -> bool:
    """Return whether the episode has a name, by which a later recorder can continue it."""
    return episode[6] >> 4 == 5


def episode_text(episode: EpisodeId) -> str:
    """Format an episode id as 8-4-4-4-12 hexadecimal digits."""
    digits = episode.hex()  # a `uuid.UUID` takes eight times as long
    return f"{digits[:8]}-{digits[8:12]}-{digits[12:16]}-{digits[16:20]}-{digits[20:]}"


def parse_episode_id(text: str) -> EpisodeId:
    """Parse the text of an episode id; the inverse of `episode_text`. Raises `ValueError` if it is not a UUID."""
    return EpisodeId(uuid.UUID(text).bytes)


def number_in(text: str) -> EpisodeNumber | None:
    """Return the episode number that a text is; None for one that no episode can have, or that is written otherwise.

    >>> number_in("17"), number_in("017"), number_in("2147483648")
    (17, None, None)
    """
    is_short = text.isdecimal() and text.isascii() and len(text) <= _NUMBER_DIGITS
    number = int(text) if is_short else -1
    return EpisodeNumber(number) if 0 <= number <= EPISODE_NUMBER_MAX and str(number) == text else None


def is_episode_id(text: str) -> bool:
    """Return whether this is the text of an episode id, in the one form in which ids are stored."""
    try:
        return episode_text(parse_episode_id(text)) == text
    except ValueError:
        return False
