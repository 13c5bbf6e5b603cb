"""Define the values that the log returns: stored events, the state of episodes, and spans of events to read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, EpisodeId


class StoredEvent(NamedTuple):
    """One event of the log. `payload` is the appended bytes, unchanged."""

    number: int
    sequence: int
    type: str
    version: int
    wall_ns: int
    monotonic_ns: int
    payload: bytes


def consecutive(events: Sequence[StoredEvent], after: int) -> Sequence[StoredEvent]:
    """Return the events of an episode behind sequence `after`, up to the first that is missing."""
    if not events or events[-1].sequence == after + len(events):
        return events
    return [each for sequence, each in enumerate(events, after + 1) if each.sequence == sequence]


class EpisodeRow(NamedTuple):
    """The state of an episode.

    Attributes:
        number: in this database.
        id: the UUID as text.
        head: last stored sequence; events 1 to `head` are all stored.
        folded: last sequence visible in the tables.
        started_wall_ns: wall time of the first stored event.
        ended_wall_ns: wall time of EpisodeEnded; None until it is stored.
        refused: why the log refused events of the episode, or None.
        parked: why folding the episode stopped, or None.
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
    """Facts that this log confirmed before an append.

    Attributes:
        witness: the episode stored last, and its head. A log with a lower head went back and refuses the append.
        number_of: returns an episode's former number, which it gets again if the number is free.
        above: the highest number known to be assigned; new episodes get higher ones.
    """

    witness: tuple[EpisodeId, int] | None
    number_of: Callable[[EpisodeId], int | None]
    above: int


NOTHING_KNOWN = Basis(None, lambda _: None, 0)
"""The basis of an append without confirmed facts."""


class Stored(NamedTuple):
    """The result of an append: reasons of refusals by episode, and the current row of each episode in the batch."""

    refusals: Mapping[EpisodeId, str]
    rows: Mapping[EpisodeId, EpisodeRow]


class Incarnation(NamedTuple):
    """One time the log went back: when and from which spool that was noticed, and the outcome."""

    noticed_wall_ns: int
    noticed_by: str
    reason: str


_RESERVE_MAX = 4_096
"""Bounds the numbers left free behind the highest known one when a log went back, for episodes that other spools had
stored: as many as a hundred robots begin in an hour. Shrinks as numbers run out: failovers never exhaust them."""


def numbers_reserved(above: int) -> int:
    """Return the number of episode numbers to leave free behind this one.

    >>> numbers_reserved(1_000), numbers_reserved(EPISODE_NUMBER_MAX - 640)
    (4096, 10)
    """
    return min(_RESERVE_MAX, max(0, EPISODE_NUMBER_MAX - above) // 64)


class Span(NamedTuple):
    """The events of an episode behind sequence `after`, up to sequence `last`."""

    number: int
    after: int
    last: int


def size_of(spans: Sequence[Span]) -> int:
    """Return the number of events in these spans.

    >>> size_of([Span(1, 0, 7), Span(2, 3, 4)])
    8
    """
    return sum(each.last - each.after for each in spans)


def pages_of(spans: Sequence[Span], limit: int) -> Iterator[list[Span]]:
    """Divide spans into pages of at most `limit` events, in their order.

    >>> [*pages_of([Span(1, 0, 7), Span(2, 3, 4)], 5)]
    [[Span(number=1, after=0, last=5)], [Span(number=1, after=5, last=7), Span(number=2, after=3, last=4)]]
    """
    page: list[Span] = []
    left = limit
    for number, first, last in spans:
        after = first
        while after < last:
            part = Span(number, after, min(last, after + left))
            page.append(part)
            left -= part.last - after
            after = part.last
            if not left:
                yield page
                page, left = [], limit
    if page:
        yield page


def beyond(behind: Sequence[EpisodeRow], reached: Mapping[int, int]) -> list[EpisodeRow]:
    """Return the episodes that will still be behind after a running fold; `reached` is its last sequence by number.

    >>> beyond([EpisodeRow(1, "", head=9, folded=0, started_wall_ns=0)], {1: 7})[0].folded
    7
    """
    return [
        each._replace(folded=max(each.folded, reached.get(each.number, 0)))
        for each in behind
        if each.head > reached.get(each.number, 0)
    ]


_SHARE_MIN = 1_000
"""Smallest share of an episode, in events, because adjacent rows are read and written together."""


def share_out(behind: Sequence[EpisodeRow], limit: int) -> list[Span]:
    """Divide the next `limit` events among these episodes, so that none waits for long.

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
