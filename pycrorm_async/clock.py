"""Read the wall clock and the monotonic clock; no other module does.

Each part that records gets its `Clock` as an argument, so that tests can pass one of their own. Plans and poses without
a memory read `SYSTEM_CLOCK`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

__all__ = ["Clock", "SYSTEM_CLOCK", "monotonic_ns"]


class Clock(NamedTuple):
    """Two clocks that return nanoseconds: UTC since 1970, and a monotonic one, which never runs backwards."""

    wall_ns: Callable[[], int]
    monotonic_ns: Callable[[], int]


SYSTEM_CLOCK = Clock(wall_ns=time.time_ns, monotonic_ns=time.monotonic_ns)
monotonic_ns = time.monotonic_ns
