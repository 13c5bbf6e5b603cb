"""Compute the 95 % interval of a success rate."""

from __future__ import annotations

import math

_Z = 1.959964
"""95 % of a normal distribution are within this many standard deviations."""


def interval_95(successes: int, tries: int) -> tuple[float, float]:
    """Return the interval by Wilson's score, which also holds for few tries and for rates near 0 and 1.

    >>> interval_95(11, 20)
    (0.3420853, 0.7418022)

    Without a try it is from 0 to 1.
    """
    if not tries:
        return 0.0, 1.0
    rate, spread = successes / tries, _Z * _Z / tries
    middle = (rate + spread / 2) / (1 + spread)
    half = _Z * math.sqrt(rate * (1 - rate) / tries + spread / (4 * tries)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)
