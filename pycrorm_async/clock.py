"""Read the wall clock and the monotonic clock; no other module does.

Each part that records gets its `Clock` as an argument, so that tests can pass one of their own. Plans and poses without
a memory read `SYSTEM_CLOCK`.
"""

import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import NamedTuple

_CLOCK_UNSYNCHRONIZED = 5
"""TIME_ERROR of adjtimex(2): no time service has synchronized the clock."""


class Clock(NamedTuple):
    """Two clocks that return nanoseconds: UTC since 1970, and a monotonic one, which never runs backwards."""

    wall_ns: Callable[[], int]
    monotonic_ns: Callable[[], int]


SYSTEM_CLOCK = Clock(wall_ns=time.time_ns, monotonic_ns=time.monotonic_ns)
monotonic_ns = time.monotonic_ns
_EPOCH, _MICROSECOND = datetime(1970, 1, 1, tzinfo=UTC), timedelta(microseconds=1)


def utc_of(microseconds: int) -> datetime:
    """Return the moment that many µs after 1970 began in UTC. Raises `OverflowError` behind the year 9999."""
    return _EPOCH + _MICROSECOND * microseconds


def microseconds_of(moment: datetime) -> int:
    """Return the µs from the beginning of 1970 in UTC to a moment, which must have a time zone."""
    return (moment - _EPOCH) // _MICROSECOND


class ClockQuality(NamedTuple):
    """The quality of the system's wall clock, as the kernel knows it from the time service (NTP, PTP).

    Attributes:
        synchronized: whether a time service keeps the clock synchronized.
        error_us: the estimated error, microseconds; large without a time service.
    """

    synchronized: bool
    error_us: int


def clock_quality() -> ClockQuality | None:
    """Ask the kernel for the quality of the wall clock; None if it does not answer. Changes nothing; takes 1 µs."""
    question = _clock_question()
    return question() if question is not None else None


@cache
def _clock_question() -> Callable[[], ClockQuality | None] | None:
    """Return the function that asks the kernel; None with a C library that lacks it. Loading it takes 30 µs."""
    import ctypes

    class Timex(ctypes.Structure):
        """The first fields of `struct timex`, and room for the others."""

        _fields_ = (
            ("modes", ctypes.c_uint),
            ("offset", ctypes.c_long),
            ("freq", ctypes.c_long),
            ("maxerror", ctypes.c_long),
            ("esterror", ctypes.c_long),
            ("others", ctypes.c_long * 32),
        )

    try:
        adjtimex = ctypes.CDLL(None).adjtimex
    except (OSError, AttributeError):
        return None

    def ask() -> ClockQuality | None:
        timex = Timex()
        state = adjtimex(ctypes.byref(timex))
        return None if state < 0 else ClockQuality(state != _CLOCK_UNSYNCHRONIZED, timex.esterror)

    return ask
