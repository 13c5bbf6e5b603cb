"""The only reader of a clock.

What is recorded is timed by the `Clock` that a part gets as an argument, so that tests can hand in their own; plans and
poses without a memory read the system's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

__all__ = ["Clock", "SYSTEM_CLOCK", "monotonic_ns"]


class Clock(NamedTuple):
    """Two readings in nanoseconds: UTC since 1970, and one that never goes back."""

    wall_ns: Callable[[], int]
    monotonic_ns: Callable[[], int]


SYSTEM_CLOCK = Clock(wall_ns=time.time_ns, monotonic_ns=time.monotonic_ns)
monotonic_ns = time.monotonic_ns
