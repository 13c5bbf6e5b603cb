"""A policy: with which arm and grasp to pick an object up and where to stand for it, with what probability.

>>> policy = default_policy().condition(Evidence(arms=frozenset({Arms.LEFT})))
>>> choices = policy.sample(np.random.default_rng(69), 20)
>>> best_first = sorted(zip(-policy.likelihood(choices), choices))

It is a mixture of leaves, in each of which arm, grasp, relative_x, relative_y and, if it was learned, the object's
height over the torso are independent. Together with the evidence it is conditioned on, that is all there is to it:
probabilities under evidence are sums of products, exact, and every policy, the default one or a learned one, is a value
of this one class. Chance comes in as an argument; the same generator gives the same samples.
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

__all__ = ["ARMS", "GRASPS", "Leaf", "PickUpChoice", "Policy"]

ARMS = (Arms.LEFT, Arms.RIGHT)
GRASPS = tuple(Grasp)
_ANYWHERE = np.array([[-math.inf], [math.inf], [-math.inf], [math.inf]])


class PickUpChoice(NamedTuple):
    """One way to pick an object up.

    Attributes:
        relative_x, relative_y: where the robot's base stands, m, in the object's own frame.
    """

    arm: Arms
    grasp: Grasp
    relative_x: float
    relative_y: float


class Leaf(msgspec.Struct, frozen=True):
    """A part of a policy in which nothing depends on anything else.

    Attributes:
        weight: the probability of the leaf.
        arms, grasps: a probability for each of `ARMS` and of `GRASPS`.
        height: the object's height minus the torso's, m; None where it was not learned.
    """

    weight: float
    arms: tuple[float, ...]
    grasps: tuple[float, ...]
    x: Marginal
    y: Marginal
    height: Marginal | None = None

    def __post_init__(self) -> None:
        if not 0 < self.weight <= 1:
            raise ValueError(f"a leaf of weight {self.weight}")
        for shares, members in ((self.arms, ARMS), (self.grasps, GRASPS)):
            if len(shares) != len(members) or min(shares) < 0 or not math.isclose(sum(shares), 1, rel_tol=1e-6):
                raise ValueError(f"a leaf with probabilities {shares}")

    def allowed(self, evidence: Evidence) -> tuple[Floats, Floats, float]:
        """The probabilities of the arms and grasps that may be, 0 for the others; that of the height."""
        height = 1.0
        if self.height is not None and evidence.height is not None:
            height = float(np.diff(self.height.cdf(np.array(evidence.height)))[0])
        return _only(evidence.arms, ARMS, self.arms), _only(evidence.grasps, GRASPS, self.grasps), height


@dataclass(frozen=True)
class Policy:
    """A distribution over `PickUpChoice`, given the evidence.

    Attributes:
        leaves: their weights sum to one. Those of a tree have no point in common.
        evidence: what holds for sure.
        constant_height: where all experience was with objects at one height over the torso, that one, m. Then the
            policy is offered for every height, and how it does at others is to be tried.

    Raises `ImpossibleCondition`: nothing is left under the evidence.
    """

    leaves: tuple[Leaf, ...]
    evidence: Evidence = field(default_factory=Evidence)
    constant_height: float | None = None

    def __post_init__(self) -> None:
        if not self._mass > 0:
            raise ImpossibleCondition(f"the policy gives no probability to: {self.evidence}")

    def sample(self, rng: np.random.Generator, count: int = 1) -> list[PickUpChoice]:
        """So many independent choices. Two calls for one draw the same as one call for two."""
        if count < 0:
            raise CallerError(f"{count} choices cannot be drawn")
        chance = rng.random((count, 5)).T
        cumulative = self._cells.ravel().cumsum()
        cell = np.searchsorted(cumulative, chance[0] * cumulative[-1], side="right")
        leaf, rectangle = np.divmod(cell, self._cells.shape[1])
        arms, grasps = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        places = np.zeros((2, count))
        for number in np.unique(leaf).tolist():
            here = leaf == number
            drawn = self.leaves[number]
            arm_shares, grasp_shares, _ = drawn.allowed(self.evidence)
            arms[here] = _picked(arm_shares, chance[1, here])
            grasps[here] = _picked(grasp_shares, chance[2, here])
            x_min, x_max, y_min, y_max = self._limits[:, rectangle[here]]
            places[0, here] = _between(drawn.x, x_min, x_max, chance[3, here])
            places[1, here] = _between(drawn.y, y_min, y_max, chance[4, here])
        return [
            PickUpChoice(ARMS[arm], GRASPS[grasp], x, y)
            for arm, grasp, x, y in zip(arms.tolist(), grasps.tolist(), *places.tolist(), strict=True)
        ]

    def likelihood(self, choices: Sequence[PickUpChoice]) -> Floats:
        """For each choice the probability of its arm and grasp times the density of its place, 1/m²; 0 if impossible.

        Given the evidence, that on the height included.
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
        """The share of the choices that the policy could have made: one that only repeats what it saw has little."""
        if not choices:
            raise CallerError("the coverage of no choices is not defined")
        return float((self.likelihood(choices) > 0).mean())

    def condition(self, evidence: Evidence) -> Policy:
        """The policy where this holds too. Raises `ImpossibleCondition` where it never does."""
        return replace(self, evidence=self.evidence & evidence)

    def probability(self, evidence: Evidence) -> float:
        """How likely it is that this holds, given the evidence there is; between 0 and 1."""
        return min(1.0, float(_cells(self.leaves, self.evidence & evidence).sum()) / self._mass)

    def mode(self, *, width_m: float = 0.05) -> Policy:
        """Conditioned on where it is most likely: on a square of this width, and the arms and grasps likeliest there.

        Of all squares, cut to the region, the one in which a leaf has most of its probability for one arm and grasp.
        Ties in another leaf are left out. Where the density is highest in a point tells little: a tree's distributions
        are steep wherever two samples lay close together by chance.
        """
        if not width_m > 0:
            raise CallerError(f"a square {width_m} m wide is none")
        peaks = list(self._peaks(width_m))
        most = max(held for _, _, held in peaks)
        number = next(number for number, _, held in peaks if held == most)
        arms, grasps, _ = self.leaves[number].allowed(self.evidence)
        return self.condition(
            Evidence(
                arms=frozenset(arm for arm, share in zip(ARMS, arms, strict=True) if share == arms.max()),
                grasps=frozenset(grasp for grasp, share in zip(GRASPS, grasps, strict=True) if share == grasps.max()),
                region=Region(tuple(square for leaf, square, held in peaks if (leaf, held) == (number, most))),
            )
        )

    def _peaks(self, width_m: float) -> Iterator[tuple[int, Rectangle, float]]:
        """Of each leaf in each rectangle: the leaf's number, the square that holds most of it, and how much."""
        for number, rectangle in zip(*(each.tolist() for each in self._cells.nonzero()), strict=True):
            leaf = self.leaves[number]
            arms, grasps, height = leaf.allowed(self.evidence)
            x_min, x_max, y_min, y_max = self._limits[:, rectangle].tolist()
            x, y = leaf.x.peak(x_min, x_max, width_m), leaf.y.peak(y_min, y_max, width_m)
            held = leaf.weight * height * float(arms.max() * grasps.max()) * x.held * y.held
            yield number, Rectangle(x.low, x.high, y.low, y.high), held

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
    """The probability of each leaf in each rectangle, (leaves, rectangles), together with all other evidence."""
    x_min, x_max, y_min, y_max = _limits(evidence)
    cells = np.zeros((len(leaves), len(x_min)))
    for row, leaf in zip(cells, leaves, strict=True):
        arms, grasps, height = leaf.allowed(evidence)
        row[:] = leaf.weight * height * arms.sum() * grasps.sum()
        row *= (leaf.x.cdf(x_max) - leaf.x.cdf(x_min)) * (leaf.y.cdf(y_max) - leaf.y.cdf(y_min))
    return cells


def _limits(evidence: Evidence) -> Floats:
    return _ANYWHERE if evidence.region is None else evidence.region.limits()


def _between(marginal: Marginal, low: Floats, high: Floats, chance: Floats) -> Floats:
    """Values between the two, drawn by turning the distribution round."""
    below, up_to = marginal.cdf(low), marginal.cdf(high)
    return np.clip(marginal.quantile(below + chance * (up_to - below)), low, high)


def _picked(shares: Floats, chance: Floats) -> NDArray[np.intp]:
    """Indices, each as often as its share says; never one of share 0."""
    cumulative = shares.cumsum()
    return np.asarray(np.searchsorted(cumulative, chance * cumulative[-1], side="right"))


def _index(members: Sequence[object], member: object) -> int:
    """Of an arm or grasp that no policy chooses: -1."""
    return members.index(member) if member in members else -1


def _only(wanted: Container[object] | None, members: Sequence[object], shares: Sequence[float]) -> Floats:
    """The shares, 0 for members that are not wanted."""
    pairs = zip(members, shares, strict=True)
    return np.array([share if wanted is None or member in wanted else 0.0 for member, share in pairs])
