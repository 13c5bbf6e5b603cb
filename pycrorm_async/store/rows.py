"""What the log gives back: an event as it is stored, and the state of an episode."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["StoredEvent", "EpisodeRow"]


class StoredEvent(NamedTuple):
    """One event of the log. `payload` holds the bytes that were appended."""

    number: int
    sequence: int
    type: str
    version: int
    wall_ns: int
    monotonic_ns: int
    payload: bytes


class EpisodeRow(NamedTuple):
    """How far an episode is.

    Attributes:
        number: in this database.
        id: the UUID as text.
        head: last sequence stored; 1 to `head` are all there.
        folded: last sequence the tables show.
        started_wall_ns: of the first event that arrived.
        ended_wall_ns: of EpisodeEnded; None while that is not stored.
        refused: why the log took no more of it, or None.
        parked: why the tables take no more of it, or None.
    """

    number: int
    id: str
    head: int
    folded: int
    started_wall_ns: int
    ended_wall_ns: int | None = None
    refused: str | None = None
    parked: str | None = None
