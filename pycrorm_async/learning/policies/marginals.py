"""Distributions of one variable of a policy: normal, or with a piecewise linear cumulative distribution.

Both have the methods `cdf`, `quantile`, `density` and `peak`; the first three map arrays to arrays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Peak(NamedTuple):
    """A window and the probability inside it."""

    low: float
    high: float
    probability: float


class Normal(msgspec.Struct, frozen=True, tag="normal"):
    """The normal distribution."""

    mean: float
    sigma: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and 0 < self.sigma < math.inf):
            raise ValueError(
                f"a normal distribution needs a finite mean and a finite sigma > 0,"
                f" got mean {self.mean} and sigma {self.sigma}"
            )

    def cdf(self, at: Floats) -> Floats:
        """Return the probability of values <= `at`."""
        scaled = (at - self.mean) / (self.sigma * math.sqrt(2))
        return np.array([(1 + math.erf(each)) / 2 for each in scaled])

    def quantile(self, share: Floats) -> Floats:
        """Return the value below which this share of the probability lies; shares in [0, 1]."""
        distribution = NormalDist(self.mean, self.sigma)
        inside = np.clip(share, 1e-300, 1 - 2**-53)
        return np.array([distribution.inv_cdf(each) for each in inside])

    def density(self, at: Floats) -> Floats:
        """Return the probability per unit."""
        scaled = (at - self.mean) / self.sigma
        return np.asarray(np.exp(-scaled * scaled / 2) / (self.sigma * math.sqrt(2 * math.pi)))

    def peak(self, low: float, high: float, width: float) -> Peak:
        """Return the most probable window of this width inside [low, high], or all of [low, high] if it is narrower."""
        start = _start(self.mean - width / 2, low, high, width)
        end = min(start + width, high)
        return Peak(float(start), float(end), float(np.diff(self.cdf(np.array([start, end])))[0]))


class Linear(msgspec.Struct, frozen=True, tag="linear"):
    """A distribution that is uniform between neighbouring knots and zero outside them.

    Attributes:
        knots: values of the variable, increasing.
        cumulative: the probability up to each knot, from 0 to 1.
    """

    knots: tuple[float, ...]
    cumulative: tuple[float, ...]

    def __post_init__(self) -> None:
        if not (len(self.knots) == len(self.cumulative) > 1 and all(map(math.isfinite, self.knots))):
            raise ValueError("a distribution needs as many finite knots as probabilities, two or more")
        if not (_rises(self.knots, strictly=True) and _rises(self.cumulative, strictly=False)):
            raise ValueError("a distribution has knots or probabilities that do not rise")
        if (self.cumulative[0], self.cumulative[-1]) != (0.0, 1.0):
            raise ValueError("a distribution has probabilities that do not run from 0 to 1")

    def cdf(self, at: Floats) -> Floats:
        """Return the probability of values <= `at`."""
        return np.interp(at, self.knots, self.cumulative)

    def quantile(self, share: Floats) -> Floats:
        """Return the value below which this share of the probability lies; shares in [0, 1]."""
        return np.interp(share, self.cumulative, self.knots)

    def density(self, at: Floats) -> Floats:
        """Return the probability per unit; at a knot that of the piece after it, at the last knot that before it."""
        slopes = np.diff(self.cumulative) / np.diff(self.knots)
        after = np.searchsorted(self.knots, at, side="right") - 1
        inside = (at >= self.knots[0]) & (at <= self.knots[-1])
        return np.where(inside, slopes[np.clip(after, 0, len(slopes) - 1)], 0.0)

    def peak(self, low: float, high: float, width: float) -> Peak:
        """Return the most probable window of this width inside [low, high], or all of [low, high] if it is narrower.

        The lowest of equally probable ones. A maximum has an end at a knot or at a limit, so only those are compared.
        """
        knots = np.array(self.knots)
        starts = _start(np.concatenate([knots, knots - width]), low, high, width)
        ends = np.minimum(starts + width, high)
        probabilities = self.cdf(ends) - self.cdf(starts)
        best = int(probabilities.argmax())
        return Peak(float(starts[best]), float(ends[best]), float(probabilities[best]))


Marginal = Normal | Linear


def _rises(values: Sequence[float], *, strictly: bool) -> bool:
    steps = np.diff(values)
    return bool((steps > 0).all() if strictly else (steps >= 0).all())


def _start(preferred: Any, low: float, high: float, width: float) -> Any:
    """Return the start nearest to `preferred` of a window that lies inside [low, high]."""
    return np.clip(preferred, low, max(low, high - width))
