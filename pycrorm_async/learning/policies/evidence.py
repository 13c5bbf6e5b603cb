"""Evidence restricts a policy to pick-ups with given arms, grasps, places and heights.

Lengths are in metres, in the object's own frame.

>>> near = Region((Rectangle(-1.0, -0.5, -0.3, 0.3),))
>>> evidence = Evidence(arms=frozenset({Arms.LEFT}), region=near)
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


class Rectangle(NamedTuple):
    """A rectangle of robot positions: relative_x and relative_y between the limits, limits included; m."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float


@dataclass(frozen=True)
class Region:
    """A union of rectangles that may share edges but not overlap; without rectangles, the empty set.

    Raises `CallerError` for rectangles that overlap, are empty, or are infinite.
    """

    rectangles: tuple[Rectangle, ...]

    def __post_init__(self) -> None:
        for each in self.rectangles:
            if not (all(map(math.isfinite, each)) and each.x_min < each.x_max and each.y_min < each.y_max):
                raise CallerError(f"a rectangle needs finite limits, the smaller first, got {each}")
        x_min, x_max, y_min, y_max = self.limits()
        for number, each in enumerate(self.rectangles[:-1]):
            later = slice(number + 1, None)
            over_x = (x_min[later] < each.x_max) & (x_max[later] > each.x_min)
            over_y = (y_min[later] < each.y_max) & (y_max[later] > each.y_min)
            if (over := over_x & over_y).any():
                other = self.rectangles[number + 1 + int(over.argmax())]
                raise CallerError(f"the rectangles of a region must not overlap: {each} and {other}")

    def __and__(self, other: Region) -> Region:
        """Intersect the two regions."""
        mine, theirs = self.limits()[:, :, None], other.limits()[:, None, :]
        x_min, y_min = np.maximum(mine[[0, 2]], theirs[[0, 2]])
        x_max, y_max = np.minimum(mine[[1, 3]], theirs[[1, 3]])
        common = np.array([x_min, x_max, y_min, y_max])[:, (x_min < x_max) & (y_min < y_max)]
        return Region(tuple(Rectangle(*each) for each in common.T.tolist()))

    def limits(self) -> Floats:
        """Return x_min, x_max, y_min and y_max of the rectangles, an array of shape (4, number of rectangles)."""
        return np.array(self.rectangles, dtype=np.float64).reshape(-1, 4).T

    def contains(self, x: Floats, y: Floats) -> NDArray[np.bool_]:
        """Return for each point whether it is inside a rectangle or on an edge."""
        x_min, x_max, y_min, y_max = self.limits()
        x, y = x[:, None], y[:, None]
        return np.asarray(((x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)).any(axis=1))


@dataclass(frozen=True)
class Evidence:
    """The conditions that a pick-up must fulfil; None leaves an attribute unrestricted.

    Attributes:
        arms, grasps: the allowed members.
        region: the allowed positions of the robot.
        height: limits (low, high) of the object's height minus the torso's, m. A policy that has not learned heights
            ignores it.

    Raises `CallerError` for members of another enum and for a height that is not an interval.
    """

    arms: frozenset[Arms] | None = None
    grasps: frozenset[Grasp] | None = None
    region: Region | None = None
    height: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name, members, kind in (("arms", self.arms, Arms), ("grasps", self.grasps, Grasp)):
            # Arms.LEFT == Grasp.LEFT because both are the integer 1: compare the types.
            if members is not None and not all(isinstance(each, kind) for each in members):
                raise CallerError(f"evidence on {name} must be members of {kind.__name__}, got {set(members)}")
        if self.height is not None:
            low, high = self.height
            if not -math.inf < low < high < math.inf:
                raise CallerError(f"evidence on height takes an interval (low, high) in m, got {self.height}")

    def __and__(self, other: Evidence) -> Evidence:
        """Combine both conditions. Two disjoint heights give the empty region, which no pick-up fulfils."""
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
        members = [f"{name} {_names(members)}" for name, members in (("arms", self.arms), ("grasps", self.grasps))]
        region = "anywhere" if self.region is None else f"in {len(self.region.rectangles)} rectangles"
        height = "any height" if self.height is None else f"height {self.height[0]:.3f} to {self.height[1]:.3f} m"
        return ", ".join((*members, region, height))


_Member = TypeVar("_Member", Arms, Grasp)


def _common(mine: frozenset[_Member] | None, theirs: frozenset[_Member] | None) -> frozenset[_Member] | None:
    if mine is None or theirs is None:
        return theirs if mine is None else mine
    return mine & theirs


def _names(members: frozenset[Arms] | frozenset[Grasp] | None) -> str:
    return "any" if members is None else "/".join(sorted(each.name for each in members)) or "none"
