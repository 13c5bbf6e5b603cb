"""What the log gives back: an event as it is stored, and the state of an episode; and what is asked for at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

__all__ = ["StoredEvent", "EpisodeRow", "Span", "beyond", "share_out"]


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


class Span(NamedTuple):
    """The events of an episode from the one that follows sequence `after` to sequence `last`."""

    number: int
    after: int
    last: int


def beyond(behind: Sequence[EpisodeRow], reached: Mapping[int, int]) -> list[EpisodeRow]:
    """Those that are behind still once what somebody folds now is in the tables: by number, up to where that is.

    >>> beyond([EpisodeRow(1, "", head=9, folded=0, started_wall_ns=0)], {1: 7})[0].folded
    7
    """
    return [
        each._replace(folded=max(each.folded, reached.get(each.number, 0)))
        for each in behind
        if each.head > reached.get(each.number, 0)
    ]


_SHARE_MIN = 1_000
"""So much of an episode is read at once even if many wait: rows that lie together are read and written together."""


def share_out(behind: Sequence[EpisodeRow], limit: int) -> list[Span]:
    """What of these episodes is read next, at most `limit` events: something of each, so that none waits for long.

    >>> share_out([EpisodeRow(1, "", head=90_000, folded=0, started_wall_ns=0)], 100)
    [Span(number=1, after=0, last=100)]
    """
    share = max(limit // len(behind), _SHARE_MIN) if behind else 0
    spans: list[Span] = []
    for each in behind:
        count = min(each.head - each.folded, share, limit)
        if count <= 0:
            break
        spans.append(Span(each.number, each.folded, each.folded + count))
        limit -= count
    return spans
