"""What travels from a hook to the log: a heading, then the record it becomes.

The caller of the queue gives a `Heading` and the payload's bytes. Under the queue's lock these get their position,
sequence and both times, and are a `Record` from then on: in the queue's files, in the writer's batches and in the
database, always the same payload bytes.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from pycrorm_async.events.ids import EpisodeId

__all__ = ["Heading", "Record", "LOST", "is_computed_end"]

LOST: Final = b'{"status":"LOST"}'
"""The payload of the end that recovery computes for an episode left open, version 1 of `EpisodeEnded` for ever."""


class Heading(NamedTuple):
    """Where an event belongs and what it is. `episode` is None for a record of the recorder itself (a declaration)."""

    episode: EpisodeId | None
    type: str
    version: int


class Record(NamedTuple):
    """One event, whole. A recorder-level record has no episode and sequence 0.

    Attributes:
        position: 1, 2, 3 … over everything this recorder wrote.
        episode: 16 bytes of a UUIDv7, or None.
        sequence: 1, 2, 3 … inside the episode, without gaps; 0 without an episode.
        type: name of the event's type, as in `pycrorm_async.events.types`.
        version: of that type's shape.
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
    """Whether recovery made this end up: it says how far its folder knew, and not that nothing came after."""
    return record.type == "EpisodeEnded" and record.payload == LOST
