"""`EventTimes` gives the events of one episode the times at which they happened, where its executive reports them.

A time is the wall clock's, UTC in ns, alone or with that of a monotonic clock. Wall times are recorded as they are
given. The monotonic time of an episode never goes back, because durations and the state at a moment are computed from
it: an event that is given an earlier time happens, by this clock, with the event before it.
"""

import operator
from typing import Any, NamedTuple, TypeAlias

from pycrorm_async.clock import Clock, utc_of
from pycrorm_async.errors import CallerError

At: TypeAlias = int | tuple[int, int]
"""When an event happened: UTC in ns since 1970; or a pair of that and the time of a monotonic clock in ns."""
_NS = range(-(2**63), 2**63)
_TOLERANCE_NS = 1_000_000_000
"""Bounds how far a time may go back without a warning: the stamps of two sensors differ by less."""


class EventTime(NamedTuple):
    """The two times of an event: UTC in ns, and monotonic ns."""

    wall_ns: int
    monotonic_ns: int


def event_time(at: object) -> tuple[int, int | None]:
    """Return the wall time and, if it is given, the monotonic time. Raises `CallerError` for anything else."""
    wall: Any
    monotonic: Any
    wall, monotonic = at if isinstance(at, tuple) and len(at) == 2 else (at, None)
    try:
        if isinstance(wall, bool) or isinstance(monotonic, bool):
            raise TypeError  # noqa: TRY301
        times = operator.index(wall), None if monotonic is None else operator.index(monotonic)
    except TypeError:
        raise CallerError(
            f"at must be UTC in ns since 1970 as an int, or a pair of it and a monotonic time in ns, not {at!r:.100}"
        ) from None
    if times[0] not in _NS or (times[1] is not None and times[1] not in _NS):
        raise CallerError(f"at must fit into 64 bits: {at!r:.100}")
    return times


class EventTimes:
    """The times of one episode.

    Attributes:
        began: the time of the episode's start, if its executive gave it; otherwise the clock gives the time of each
            event for which none is given.
    """

    def __init__(self, clock: Clock, at: At | None) -> None:
        self._clock = clock
        self._has_warned = False
        self.began: EventTime | None = None
        if at is not None:
            wall_ns, monotonic_ns = event_time(at)
            self.began = EventTime(wall_ns, wall_ns if monotonic_ns is None else monotonic_ns)
        self._latest = self.began
        self._began_wall_ns = self.began.wall_ns if self.began is not None else clock.wall_ns()

    def next(self, at: At | None) -> tuple[EventTime | None, str | None]:
        """Return the time of the next event, None for that of the clock; and a warning if it goes back.

        Without `at`, an event happens with the one before it. Raises `CallerError` for a wrong `at`.
        """
        if at is None:
            return (self._latest if self.began is not None else None), None
        wall_ns, monotonic_ns = event_time(at)
        if self.began is None:
            now = EventTime(*(read() for read in self._clock))
            if monotonic_ns is None:
                monotonic_ns = now.monotonic_ns - now.wall_ns + wall_ns
            monotonic_ns = min(monotonic_ns, now.monotonic_ns)
        elif monotonic_ns is None:
            monotonic_ns = self.began.monotonic_ns - self.began.wall_ns + wall_ns
        warning = None
        latest = self._latest
        if latest is not None and monotonic_ns < latest.monotonic_ns:
            if monotonic_ns < latest.monotonic_ns - _TOLERANCE_NS:
                warning = self._warning(wall_ns, latest.monotonic_ns - monotonic_ns, "the event before it")
            monotonic_ns = latest.monotonic_ns
        elif wall_ns < self._began_wall_ns - _TOLERANCE_NS:
            warning = self._warning(wall_ns, self._began_wall_ns - wall_ns, "the start of the episode")
        self._latest = EventTime(wall_ns, monotonic_ns)
        return self._latest, warning

    def _warning(self, wall_ns: int, back_ns: int, what: str) -> str | None:
        """Return the line about an event whose time goes back, if it is the first of the episode."""
        if self._has_warned:
            return None
        self._has_warned = True
        return (
            f"the time {_text(wall_ns)} lies {back_ns / 1e9:.3f} s before {what}: the event keeps it, and durations"
            " count from the later time (further times of this episode that go back are not reported)"
        )


def _text(wall_ns: int) -> str:
    try:
        return f"{utc_of(wall_ns // 1000):%Y-%m-%dT%H:%M:%S.%fZ}"
    except OverflowError:
        return f"{wall_ns} ns"
