"""What the log gives back: an event as it is stored, and the state of an episode; and what is asked for at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, EpisodeId

__all__ = [
    "StoredEvent",
    "EpisodeRow",
    "Basis",
    "Stored",
    "Incarnation",
    "NOTHING_KNOWN",
    "numbers_reserved",
    "Span",
    "beyond",
    "share_out",
]


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


class Basis(NamedTuple):
    """What an append builds on: what this log had confirmed before.

    Attributes:
        witness: the episode that was stored last, and how far. A log that holds less of it takes nothing.
        number_of: the number that an episode was given before; it gets it back where it is free.
        above: the highest number that is known to be given; new episodes get higher ones.
    """

    witness: tuple[EpisodeId, int] | None
    number_of: Callable[[EpisodeId], int | None]
    above: int


NOTHING_KNOWN = Basis(None, lambda _: None, 0)


class Stored(NamedTuple):
    """What became of a batch: why episodes refused records, and every episode as it is now."""

    refusals: Mapping[EpisodeId, str]
    rows: Mapping[EpisodeId, EpisodeRow]


class Incarnation(NamedTuple):
    """Once that the log was found to have gone back: when, from which spool, and what could be done."""

    noticed_wall_ns: int
    noticed_by: str
    reason: str


_RESERVE_MAX = 4_096
"""Left free behind the highest number known when a log went back, for what other spools had stored in it: as many
episodes as a hundred robots begin in an hour. A thousand failovers would use up all numbers, so it shrinks then."""


def numbers_reserved(above: int) -> int:
    """How many numbers are left free behind this one.

    >>> numbers_reserved(1_000), numbers_reserved(EPISODE_NUMBER_MAX - 640)
    (4096, 10)
    """
    return min(_RESERVE_MAX, max(0, EPISODE_NUMBER_MAX - above) // 64)


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
