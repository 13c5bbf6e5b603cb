"""A policy is a probability distribution over ways to pick an object up: arm, grasp, and position of the robot.

>>> policy = default_policy().condition(Evidence(arms=frozenset({Arms.LEFT})))
>>> choices = policy.sample(np.random.default_rng(69), 20)
>>> best_first = sorted(zip(-policy.likelihood(choices), choices))

It is a mixture of leaves. Inside a leaf arm, grasp, relative_x, relative_y and, if learned, the object's height over
the torso are independent, so that probabilities under evidence are exact: sums of products. The default policy and
every learned one are values of this class. The random generator is an argument; the same generator state gives the
same samples.

**Evidence.** Evidence restricts a policy to pick-ups with given arms, grasps, places and heights.

Lengths are in metres, in the object's own frame.

>>> near = Region((Rectangle(-1.0, -0.5, -0.3, 0.3),))
>>> evidence = Evidence(arms=frozenset({Arms.LEFT}), region=near)
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from statistics import NormalDist
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError, ImpossibleCondition, MissingExtra
from pycrorm_async.world.pose import Arms, Grasp
from pycrorm_async.world.urdf import PR2

# === evidence =================================================================================================


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

    @cached_property
    def limits(self) -> Floats:
        """Those of the region, shape (4, number of rectangles); without a region, those of one rectangle, infinite."""
        return _ANYWHERE if self.region is None else self.region.limits()

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


# === marginals ================================================================================================
#
# Distributions of one variable of a policy: normal, or with a piecewise linear cumulative distribution.
#
# Both have the methods `cdf`, `quantile`, `density` and `peak`; the first three map arrays to arrays.

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


# === policy ===================================================================================================

ARMS = (Arms.LEFT, Arms.RIGHT)
GRASPS = tuple(Grasp)
_ANYWHERE = np.array([[-math.inf], [math.inf], [-math.inf], [math.inf]])


class PickUpChoice(NamedTuple):
    """One way to pick an object up.

    Attributes:
        relative_x, relative_y: position of the robot's base, m, in the object's own frame.
        torso: height of the lifted torso, m; None leaves it as it is.
    """

    arm: Arms
    grasp: Grasp
    relative_x: float
    relative_y: float
    torso: float | None = None


class Leaf(msgspec.Struct, frozen=True):
    """A component of the mixture, in which all variables are independent.

    Attributes:
        weight: the probability of the leaf.
        arms, grasps: a probability for each of `ARMS` and of `GRASPS`.
        x, y: distributions of relative_x and relative_y, m.
        height: distribution of the object's height minus the torso's, m; None where it was not learned.
    """

    weight: float
    arms: tuple[float, ...]
    grasps: tuple[float, ...]
    x: Marginal
    y: Marginal
    height: Marginal | None = None

    def __post_init__(self) -> None:
        if not 0 < self.weight <= 1:
            raise ValueError(f"a leaf needs a weight in (0, 1], got weight {self.weight}")
        for shares, members in ((self.arms, ARMS), (self.grasps, GRASPS)):
            if len(shares) != len(members) or min(shares) < 0 or not math.isclose(sum(shares), 1, rel_tol=1e-6):
                raise ValueError(
                    f"a leaf needs {len(members)} probabilities >= 0 that sum to 1, got probabilities {shares}"
                )

    def allowed(self, evidence: Evidence) -> tuple[Floats, Floats, float]:
        """Return the probabilities of arms and grasps, 0 where the evidence excludes them, and that of the height."""
        height = 1.0
        if self.height is not None and evidence.height is not None:
            height = float(np.diff(self.height.cdf(np.array(evidence.height)))[0])
        return _mask(evidence.arms, ARMS, self.arms), _mask(evidence.grasps, GRASPS, self.grasps), height


@dataclass(frozen=True)
class Policy:
    """A distribution over `PickUpChoice`, conditioned on the evidence.

    Attributes:
        leaves: their weights sum to one. The leaves of a tree do not overlap.
        evidence: the condition.
        constant_height: the height over the torso, m, if all samples it was learned from had the same one. Such a
            policy applies to every height; its success at other heights is not known.
        robot: the name of the robot whose pick-ups it was learned from; None for the default policy, of any robot.

    Raises `ImpossibleCondition` if the evidence has probability 0.
    """

    leaves: tuple[Leaf, ...]
    evidence: Evidence = field(default_factory=Evidence)
    constant_height: float | None = None
    robot: str | None = PR2.name

    def __post_init__(self) -> None:
        if not self._mass > 0:
            raise ImpossibleCondition(f"the policy gives no probability to: {self.evidence}")

    def sample(self, rng: np.random.Generator, count: int = 1) -> list[PickUpChoice]:
        """Draw `count` independent choices. Two calls with count 1 draw the same choices as one call with count 2."""
        if count < 0:
            raise CallerError(f"cannot draw {count} choices: count must be >= 0")
        chance = rng.random((count, 5)).T
        cumulative = self._cells.ravel().cumsum()
        cell = np.searchsorted(cumulative, chance[0] * cumulative[-1], side="right")
        leaf, rectangle = np.divmod(cell, self._cells.shape[1])
        arms, grasps = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        places = np.zeros((2, count))
        for number in np.unique(leaf).tolist():
            rows = leaf == number
            drawn = self.leaves[number]
            arm_shares, grasp_shares, _ = drawn.allowed(self.evidence)
            arms[rows] = _draw_indices(arm_shares, chance[1, rows])
            grasps[rows] = _draw_indices(grasp_shares, chance[2, rows])
            x_min, x_max, y_min, y_max = self.evidence.limits[:, rectangle[rows]]
            places[0, rows] = _draw_between(drawn.x, x_min, x_max, chance[3, rows])
            places[1, rows] = _draw_between(drawn.y, y_min, y_max, chance[4, rows])
        return [
            PickUpChoice(ARMS[arm], GRASPS[grasp], x, y)
            for arm, grasp, x, y in zip(arms.tolist(), grasps.tolist(), *places.tolist(), strict=True)
        ]

    def likelihood(self, choices: Sequence[PickUpChoice]) -> Floats:
        """Return for each choice the probability of its arm and grasp times the density of its place, 1/m².

        All of it conditioned on the evidence, including that on the height; 0 for an impossible choice.
        """
        arm, grasp = (
            np.array([_index(members, each[part]) for each in choices], dtype=np.int64)
            for part, members in enumerate((ARMS, GRASPS))
        )
        x = np.array([each.relative_x for each in choices], dtype=np.float64)
        y = np.array([each.relative_y for each in choices], dtype=np.float64)
        total = np.zeros(len(choices))
        for leaf, cells in zip(self.leaves, self._cells, strict=True):
            if cells.any():
                arms, grasps, height = leaf.allowed(self.evidence)
                symbols = np.append(arms, 0.0)[arm] * np.append(grasps, 0.0)[grasp]
                total += leaf.weight * height * symbols * leaf.x.density(x) * leaf.y.density(y)
        if self.evidence.region is not None:
            total[~self.evidence.region.contains(x, y)] = 0.0
        return total / self._mass

    def coverage(self, choices: Sequence[PickUpChoice]) -> float:
        """Return the share of the choices with a likelihood > 0; small for a policy that only repeats its samples."""
        if not choices:
            raise CallerError("coverage needs at least one choice: no choices were given")
        return float((self.likelihood(choices) > 0).mean())

    def condition(self, evidence: Evidence) -> Policy:
        """Condition the policy on more evidence. Raises `ImpossibleCondition` if that has probability 0."""
        return replace(self, evidence=self.evidence & evidence)

    def probability(self, evidence: Evidence) -> float:
        """Return the probability of `evidence` given the policy's own evidence, between 0 and 1."""
        return min(1.0, float(_cells(self.leaves, self.evidence & evidence).sum()) / self._mass)

    def mode(self, *, width_m: float = 0.05) -> Policy:
        """Condition the policy on its most probable square of this width and on the likeliest arms and grasps there.

        The square, cut to the region, is the one with the highest probability of one leaf, arm and grasp. Squares of
        other leaves that tie with it are ignored. The square replaces the point of highest density because the
        density of a tree is also high wherever two samples lie close together by chance.
        """
        if not width_m > 0:
            raise CallerError(f"width_m must be > 0, got {width_m}")
        peaks = list(self._peaks(width_m))
        highest = max(probability for _, _, probability in peaks)
        number = next(number for number, _, probability in peaks if probability == highest)
        arms, grasps, _ = self.leaves[number].allowed(self.evidence)
        return self.condition(
            Evidence(
                arms=frozenset(arm for arm, share in zip(ARMS, arms, strict=True) if share == arms.max()),
                grasps=frozenset(grasp for grasp, share in zip(GRASPS, grasps, strict=True) if share == grasps.max()),
                region=Region(
                    tuple(square for leaf, square, probability in peaks if (leaf, probability) == (number, highest))
                ),
            )
        )

    def _peaks(self, width_m: float) -> Iterator[tuple[int, Rectangle, float]]:
        """Yield for each leaf in each rectangle: the leaf's number, its most probable square, and the probability."""
        for number, rectangle in zip(*(each.tolist() for each in self._cells.nonzero()), strict=True):
            leaf = self.leaves[number]
            arms, grasps, height = leaf.allowed(self.evidence)
            x_min, x_max, y_min, y_max = self.evidence.limits[:, rectangle].tolist()
            x, y = leaf.x.peak(x_min, x_max, width_m), leaf.y.peak(y_min, y_max, width_m)
            probability = leaf.weight * height * float(arms.max() * grasps.max()) * x.probability * y.probability
            yield number, Rectangle(x.low, x.high, y.low, y.high), probability

    @cached_property
    def _cells(self) -> Floats:
        return _cells(self.leaves, self.evidence)

    @cached_property
    def _mass(self) -> float:
        return float(self._cells.sum())


def _cells(leaves: Sequence[Leaf], evidence: Evidence) -> Floats:
    """Return the probability of each leaf in each rectangle under all evidence, shape (leaves, rectangles)."""
    x_min, x_max, y_min, y_max = evidence.limits
    cells = np.zeros((len(leaves), len(x_min)))
    for row, leaf in zip(cells, leaves, strict=True):
        arms, grasps, height = leaf.allowed(evidence)
        row[:] = leaf.weight * height * arms.sum() * grasps.sum()
        row *= (leaf.x.cdf(x_max) - leaf.x.cdf(x_min)) * (leaf.y.cdf(y_max) - leaf.y.cdf(y_min))
    return cells


def _draw_between(marginal: Marginal, low: Floats, high: Floats, chance: Floats) -> Floats:
    """Draw values inside [low, high] by inverting the cumulative distribution."""
    below, up_to = marginal.cdf(low), marginal.cdf(high)
    return np.clip(marginal.quantile(below + chance * (up_to - below)), low, high)


def _draw_indices(shares: Floats, chance: Floats) -> NDArray[np.intp]:
    """Draw indices with probabilities proportional to the shares; an index of share 0 is never drawn."""
    cumulative = shares.cumsum()
    return np.asarray(np.searchsorted(cumulative, chance * cumulative[-1], side="right"))


def _index(members: Sequence[object], member: object) -> int:
    """Return the member's index; -1 for an arm or grasp that no policy chooses, such as `Arms.BOTH`."""
    return members.index(member) if member in members else -1


def _mask(allowed: Container[object] | None, members: Sequence[object], shares: Sequence[float]) -> Floats:
    """Return the shares, 0 for members that are not allowed."""
    pairs = zip(members, shares, strict=True)
    return np.array([share if allowed is None or member in allowed else 0.0 for member, share in pairs])


# === default policy ===========================================================================================
#
# The default policy picks any arm and any grasp at random, from a random position within 2 m of the object.
#
# Arm and grasp are equally likely. relative_x and relative_y are normal with a variance of 0.5 m², in (-2 m, 2 m)²
# without the open square (-0.2 m, 0.2 m)² around the object; that region holds 0.94107 of the normal distribution.

VARIANCE_M2 = 0.5
"""The variance in m² of the base's place along each axis around the object, as in the thesis."""
FARTHEST_M = 2.0
"""Half the side in m of the square around the object in which the base is placed, as in the thesis."""
NEAREST_M = 0.2
"""Half the side in m of the square around the object that is left out, as in the thesis."""

AROUND_OBJECT = Region(
    (
        Rectangle(-FARTHEST_M, -NEAREST_M, -FARTHEST_M, FARTHEST_M),
        Rectangle(NEAREST_M, FARTHEST_M, -FARTHEST_M, FARTHEST_M),
        Rectangle(-NEAREST_M, NEAREST_M, -FARTHEST_M, -NEAREST_M),
        Rectangle(-NEAREST_M, NEAREST_M, NEAREST_M, FARTHEST_M),
    )
)


def default_policy() -> Policy:
    """Return the policy to start learning from; it does not depend on height.

    >>> default_policy().probability(Evidence(arms=frozenset({Arms.LEFT})))
    0.5
    """
    place = Normal(0.0, math.sqrt(VARIANCE_M2))
    anywhere = Leaf(1.0, (1 / len(ARMS),) * len(ARMS), (1 / len(GRASPS),) * len(GRASPS), place, place)
    return Policy((anywhere,), Evidence(region=AROUND_OBJECT), robot=None)


# === policy plot ==============================================================================================
#
# Draw policies: the density of robot positions around the object under each policy, and the positions that worked.

_SAMPLES = 200_000
"""The samples drawn for one plot, about 14 for each cell."""
_PLOT_RANGE_M = (-1.5, 1.5)
"""The plotted places of the base around the object along each axis, in m."""
_CELLS = 120
"""The cells along each axis of the plot, 2.5 cm wide."""


def draw_policies(
    policies: Mapping[str, Policy | Sequence[PickUpChoice]],
    path: Path | str,
    *,
    successes: Sequence[PickUpChoice] = (),
    seed: int = 0,
) -> None:
    """Draw the policies side by side under their titles into a file whose suffix sets the format (.png, .svg, .pdf).

    The density over relative_x and relative_y, for all arms and grasps together, is that of 200,000 samples, or of the
    given ones; the dots are the successes. Raises `MissingExtra` without matplotlib, `CallerError` if the file cannot
    be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("a figure needs matplotlib: pip install 'pycrorm-async[learning]'") from None
    figure = Figure(figsize=(6 * len(policies), 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(policies), squeeze=False)[0]
    for axes, (title, policy) in zip(panels, policies.items(), strict=True):
        drawn = policy.sample(np.random.default_rng(seed), _SAMPLES) if isinstance(policy, Policy) else policy
        *_, image = axes.hist2d(*_places(drawn), bins=_CELLS, range=(_PLOT_RANGE_M, _PLOT_RANGE_M), density=True)
        figure.colorbar(image, ax=axes, shrink=0.8, label="probability per m²")
        axes.plot(*_places(successes), ".", color="white", markersize=1.2, alpha=0.5)
        axes.plot(0, 0, "+", color="red", markersize=12)
        axes.set(title=title, xlabel="relative x, m (in the object's frame)", ylabel="relative y, m")
        axes.set(xlim=_PLOT_RANGE_M, ylim=_PLOT_RANGE_M, aspect="equal")
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise CallerError(f"cannot write the figure {path}: {error}") from None


def _places(choices: Sequence[PickUpChoice]) -> tuple[list[float], list[float]]:
    return [each.relative_x for each in choices], [each.relative_y for each in choices]
