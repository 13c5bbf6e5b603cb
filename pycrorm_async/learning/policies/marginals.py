"""How one number of a policy is distributed: normally, or as a piecewise linear cumulative distribution says.

Both answer the same four questions; arrays in, arrays out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

__all__ = ["Floats", "Linear", "Marginal", "Normal", "Peak"]

Floats = NDArray[np.float64]


class Peak(NamedTuple):
    """A window, and the probability in it."""

    low: float
    high: float
    held: float


class Normal(msgspec.Struct, frozen=True, tag="normal"):
    """The normal distribution."""

    mean: float
    sigma: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and 0 < self.sigma < math.inf):
            raise ValueError(f"a normal distribution of mean {self.mean} and sigma {self.sigma}")

    def cdf(self, at: Floats) -> Floats:
        """The probability of what is at most this."""
        scaled = (at - self.mean) / (self.sigma * math.sqrt(2))
        return np.array([(1 + math.erf(each)) / 2 for each in scaled])

    def quantile(self, share: Floats) -> Floats:
        """The value below which this share of the probability lies; shares in [0, 1]."""
        distribution = NormalDist(self.mean, self.sigma)
        inside = np.clip(share, 1e-300, 1 - 2**-53)
        return np.array([distribution.inv_cdf(each) for each in inside])

    def density(self, at: Floats) -> Floats:
        """Probability per unit."""
        scaled = (at - self.mean) / self.sigma
        return np.asarray(np.exp(-scaled * scaled / 2) / (self.sigma * math.sqrt(2 * math.pi)))

    def peak(self, low: float, high: float, width: float) -> Peak:
        """The window of this width, or the whole if that is narrower, that holds most of what is between the two."""
        start = _start(self.mean - width / 2, low, high, width)
        end = min(start + width, high)
        return Peak(float(start), float(end), float(np.diff(self.cdf(np.array([start, end])))[0]))


class Linear(msgspec.Struct, frozen=True, tag="linear"):
    """Between neighbouring knots the probability is spread evenly; before the first and after the last there is none.

    Attributes:
        knots: increasing.
        cumulative: the probability up to each knot, from 0 to 1.
    """

    knots: tuple[float, ...]
    cumulative: tuple[float, ...]

    def __post_init__(self) -> None:
        if not (len(self.knots) == len(self.cumulative) > 1 and all(map(math.isfinite, self.knots))):
            raise ValueError("a distribution without as many knots as probabilities, two or more")
        if not (_rises(self.knots, strictly=True) and _rises(self.cumulative, strictly=False)):
            raise ValueError("a distribution whose knots or probabilities do not rise")
        if (self.cumulative[0], self.cumulative[-1]) != (0.0, 1.0):
            raise ValueError("a distribution whose probabilities are not from 0 to 1")

    def cdf(self, at: Floats) -> Floats:
        """The probability of what is at most this."""
        return np.interp(at, self.knots, self.cumulative)

    def quantile(self, share: Floats) -> Floats:
        """The value below which this share of the probability lies; shares in [0, 1]."""
        return np.interp(share, self.cumulative, self.knots)

    def density(self, at: Floats) -> Floats:
        """Probability per unit; on a knot that of what follows, on the last one that of what is before."""
        slopes = np.diff(self.cumulative) / np.diff(self.knots)
        after = np.searchsorted(self.knots, at, side="right") - 1
        inside = (at >= self.knots[0]) & (at <= self.knots[-1])
        return np.where(inside, slopes[np.clip(after, 0, len(slopes) - 1)], 0.0)

    def peak(self, low: float, high: float, width: float) -> Peak:
        """The window of this width, or the whole if that is narrower, that holds most of what is between the two.

        The first of several. One of its ends is a knot, or one of the two.
        """
        knots = np.array(self.knots)
        starts = _start(np.concatenate([knots, knots - width]), low, high, width)
        ends = np.minimum(starts + width, high)
        held = self.cdf(ends) - self.cdf(starts)
        best = int(held.argmax())
        return Peak(float(starts[best]), float(ends[best]), float(held[best]))


Marginal = Normal | Linear


def _rises(values: Sequence[float], *, strictly: bool) -> bool:
    steps = np.diff(values)
    return bool((steps > 0).all() if strictly else (steps >= 0).all())


def _start(wanted: Any, low: float, high: float, width: float) -> Any:
    """Where a window begins that should begin there and must lie between the two."""
    return np.clip(wanted, low, max(low, high - width))
