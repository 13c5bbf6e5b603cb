"""An envelope carries an event from a hook to the log: first as a `Heading`, then as a `Record`.

The caller of the queue passes a `Heading` and the payload's bytes. The queue, under its lock, adds position, sequence
and both times, which makes them a `Record`. Queue files, writer batches and database hold the same payload bytes.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from pycrorm_async.events.ids import EpisodeId

__all__ = ["Heading", "Receipt", "Record", "LOST", "is_computed_end"]

LOST: Final = b'{"status":"LOST"}'
"""Payload of the `EpisodeEnded` that recovery computes for an episode left open.

It stays at version 1 of `EpisodeEnded`, so that recovering a folder twice yields the same bytes.
"""


class Heading(NamedTuple):
    """The envelope without position, sequence and times.

    `episode` is None for a recorder-level record (a declaration).
    """

    episode: EpisodeId | None
    type: str
    version: int


class Receipt:
    """The sequence of one event, 0 until the event is written.

    The queue sets it in the same step as it writes the event. So the caller of a put that raised, as Ctrl-C makes it do
    at any call, can determine whether the event was written before.
    """

    __slots__ = ("sequence",)

    def __init__(self) -> None:
        self.sequence = 0


class Record(NamedTuple):
    """One event with its complete envelope. A recorder-level record has no episode and sequence 0.

    Attributes:
        position: 1, 2, 3 … over all records of one recorder.
        episode: 16 bytes of a UUIDv7, or None.
        sequence: 1, 2, 3 … inside the episode, without gaps; 0 without an episode.
        type: name of the event type, as in `pycrorm_async.events.types`.
        version: version of that type's shape.
        wall_ns: UTC, ns since 1970.
        monotonic_ns: ns, comparable inside one process life only.
        payload: the event as JSON, UTF-8.
    """

    position: int
    episode: EpisodeId | None
    sequence: int
    type: str
    version: int
    wall_ns: int
    monotonic_ns: int
    payload: bytes


def is_computed_end(record: Record) -> bool:
    """Return whether recovery computed this end.

    Such an end marks the last record kept in one folder; later events of the episode may exist elsewhere.
    """
    return record.type == "EpisodeEnded" and record.payload == LOST
