"""A clock that advances only when a test advances it."""

from datetime import UTC, datetime

from pycrorm_async.clock import Clock

__all__ = ["FakeClock"]


class FakeClock:
    """Times for `Memory.open(url, clock=fake.clock)`.

    >>> fake = FakeClock(datetime(2026, 1, 1, tzinfo=UTC))
    >>> fake.advance(1.5)
    >>> fake.clock.monotonic_ns()
    1500000000
    """

    def __init__(self, start: datetime = datetime(2026, 1, 1, tzinfo=UTC)) -> None:
        """The wall clock starts at `start`, which must have a time zone, the monotonic clock at 0 ns."""
        self._wall_ns = int(start.timestamp()) * 10**9 + start.microsecond * 1_000
        self._monotonic_ns = 0
        self.clock = Clock(wall_ns=lambda: self._wall_ns, monotonic_ns=lambda: self._monotonic_ns)

    def advance(self, seconds: float) -> None:
        """Advance both clocks."""
        self._wall_ns += round(seconds * 1e9)
        self._monotonic_ns += round(seconds * 1e9)
