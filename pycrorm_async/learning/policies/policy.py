"""A policy is a probability distribution over ways to pick an object up: arm, grasp, and position of the robot.

>>> policy = default_policy().condition(Evidence(arms=frozenset({Arms.LEFT})))
>>> choices = policy.sample(np.random.default_rng(69), 20)
>>> best_first = sorted(zip(-policy.likelihood(choices), choices))

It is a mixture of leaves. Inside a leaf arm, grasp, relative_x, relative_y and, if learned, the object's height over
the torso are independent, so that probabilities under evidence are exact: sums of products. The default policy and
every learned one are values of this class. The random generator is an argument; the same generator state gives the
same samples.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError, ImpossibleCondition
from pycrorm_async.learning.policies.evidence import Evidence, Rectangle, Region
from pycrorm_async.learning.policies.marginals import Floats, Marginal
from pycrorm_async.world.enums import Arms, Grasp

ARMS = (Arms.LEFT, Arms.RIGHT)
GRASPS = tuple(Grasp)
_ANYWHERE = np.array([[-math.inf], [math.inf], [-math.inf], [math.inf]])


class PickUpChoice(NamedTuple):
    """One way to pick an object up.

    Attributes:
        relative_x, relative_y: position of the robot's base, m, in the object's own frame.
    """

    arm: Arms
    grasp: Grasp
    relative_x: float
    relative_y: float


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

    Raises `ImpossibleCondition` if the evidence has probability 0.
    """

    leaves: tuple[Leaf, ...]
    evidence: Evidence = field(default_factory=Evidence)
    constant_height: float | None = None

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
            x_min, x_max, y_min, y_max = self._limits[:, rectangle[rows]]
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
            x_min, x_max, y_min, y_max = self._limits[:, rectangle].tolist()
            x, y = leaf.x.peak(x_min, x_max, width_m), leaf.y.peak(y_min, y_max, width_m)
            probability = leaf.weight * height * float(arms.max() * grasps.max()) * x.probability * y.probability
            yield number, Rectangle(x.low, x.high, y.low, y.high), probability

    @cached_property
    def _cells(self) -> Floats:
        return _cells(self.leaves, self.evidence)

    @cached_property
    def _mass(self) -> float:
        return float(self._cells.sum())

    @cached_property
    def _limits(self) -> Floats:
        return _limits(self.evidence)


def _cells(leaves: Sequence[Leaf], evidence: Evidence) -> Floats:
    """Return the probability of each leaf in each rectangle under all evidence, shape (leaves, rectangles)."""
    x_min, x_max, y_min, y_max = _limits(evidence)
    cells = np.zeros((len(leaves), len(x_min)))
    for row, leaf in zip(cells, leaves, strict=True):
        arms, grasps, height = leaf.allowed(evidence)
        row[:] = leaf.weight * height * arms.sum() * grasps.sum()
        row *= (leaf.x.cdf(x_max) - leaf.x.cdf(x_min)) * (leaf.y.cdf(y_max) - leaf.y.cdf(y_min))
    return cells


def _limits(evidence: Evidence) -> Floats:
    return _ANYWHERE if evidence.region is None else evidence.region.limits()


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
