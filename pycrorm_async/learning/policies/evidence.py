"""What is known, or demanded, of a pick-up before it is chosen. Metres, in the object's own frame.

>>> near = Region((Rectangle(-1.0, -0.5, -0.3, 0.3),))
>>> known = Evidence(arms=frozenset({Arms.LEFT}), region=near)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.learning.policies.marginals import Floats
from pycrorm_async.world.enums import Arms, Grasp

__all__ = ["Evidence", "Rectangle", "Region"]


class Rectangle(NamedTuple):
    """Where the robot may stand: relative_x and relative_y between the two, which belong to it."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float


@dataclass(frozen=True)
class Region:
    """Rectangles that have at most edges in common; none is nowhere.

    Raises `CallerError`: rectangles that overlap, without an extent, or without end.
    """

    rectangles: tuple[Rectangle, ...]

    def __post_init__(self) -> None:
        for each in self.rectangles:
            if not (all(map(math.isfinite, each)) and each.x_min < each.x_max and each.y_min < each.y_max):
                raise CallerError(f"a rectangle has finite limits, the smaller first: {each}")
        x_min, x_max, y_min, y_max = self.limits()
        for number, each in enumerate(self.rectangles[:-1]):
            later = slice(number + 1, None)
            over_x = (x_min[later] < each.x_max) & (x_max[later] > each.x_min)
            over_y = (y_min[later] < each.y_max) & (y_max[later] > each.y_min)
            if (over := over_x & over_y).any():
                other = self.rectangles[number + 1 + int(over.argmax())]
                raise CallerError(f"the rectangles of a region must not overlap: {each} and {other}")

    def __and__(self, other: Region) -> Region:
        """What is in both."""
        mine, theirs = self.limits()[:, :, None], other.limits()[:, None, :]
        x_min, y_min = np.maximum(mine[[0, 2]], theirs[[0, 2]])
        x_max, y_max = np.minimum(mine[[1, 3]], theirs[[1, 3]])
        common = np.array([x_min, x_max, y_min, y_max])[:, (x_min < x_max) & (y_min < y_max)]
        return Region(tuple(Rectangle(*each) for each in common.T.tolist()))

    def limits(self) -> Floats:
        """x_min, x_max, y_min and y_max of the rectangles, an array (4, number of rectangles)."""
        return np.array(self.rectangles, dtype=np.float64).reshape(-1, 4).T

    def contains(self, x: Floats, y: Floats) -> NDArray[np.bool_]:
        """For each point whether it is inside or on an edge."""
        x_min, x_max, y_min, y_max = self.limits()
        x, y = x[:, None], y[:, None]
        return np.asarray(((x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)).any(axis=1))


@dataclass(frozen=True)
class Evidence:
    """Everything that is not None must hold.

    Attributes:
        arms, grasps: one of these.
        region: the robot stands there.
        height: the object's height minus the torso's, between the two, m. A policy that knows nothing of heights
            passes it over.

    Raises `CallerError`: members of another enum, a height that is no interval.
    """

    arms: frozenset[Arms] | None = None
    grasps: frozenset[Grasp] | None = None
    region: Region | None = None
    height: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name, members, kind in (("arms", self.arms, Arms), ("grasps", self.grasps, Grasp)):
            # Arms.LEFT == Grasp.LEFT, for both are the number 1
            if members is not None and not all(isinstance(each, kind) for each in members):
                raise CallerError(f"evidence on {name} takes members of {kind.__name__}, not {set(members)}")
        if self.height is not None:
            low, high = self.height
            if not -math.inf < low < high < math.inf:
                raise CallerError(f"a height is known as an interval (low, high) in m, not {self.height}")

    def __and__(self, other: Evidence) -> Evidence:
        """What must hold if both must. Two heights that have nothing in common hold nowhere."""
        region = other.region if self.region is None else self.region
        if self.region is not None and other.region is not None:
            region = self.region & other.region
        height = self.height or other.height
        if self.height is not None and other.height is not None:
            height = max(self.height[0], other.height[0]), min(self.height[1], other.height[1])
            if height[0] >= height[1]:
                height, region = self.height, Region(())
        return Evidence(_common(self.arms, other.arms), _common(self.grasps, other.grasps), region, height)

    def __str__(self) -> str:
        said = [f"{name} {_names(members)}" for name, members in (("arms", self.arms), ("grasps", self.grasps))]
        region = "anywhere" if self.region is None else f"in {len(self.region.rectangles)} rectangles"
        height = "any height" if self.height is None else f"height {self.height[0]:.3f} to {self.height[1]:.3f} m"
        return ", ".join((*said, region, height))


_Member = TypeVar("_Member", Arms, Grasp)


def _common(mine: frozenset[_Member] | None, theirs: frozenset[_Member] | None) -> frozenset[_Member] | None:
    if mine is None or theirs is None:
        return theirs if mine is None else mine
    return mine & theirs


def _names(members: frozenset[Arms] | frozenset[Grasp] | None) -> str:
    return "any" if members is None else "/".join(sorted(each.name for each in members)) or "none"
