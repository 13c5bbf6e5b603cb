"""A policy over polar features: kind of grasp, distance and angle of the base, and the object's height over the torso.

>>> policy = learn_polar(successes)
>>> policy.sample(np.random.default_rng(69), 20, PickUpContext(height=0.9, torso_limits=(0.0, 0.33)))

It is a mixture of leaves, as `Policy`, but over the features of `features.py`: both arms and the three grasps from the
side share their experience, and a choice includes the height of the torso. In a context, the leaves count by the
probability that the torso can give their height; inside a leaf the variables are independent. All arms and all grasps
of a kind are equally likely.

The boxes of such a leaf are sectors around the object, which rectangles of free places cut in no simple way: there is
no condition on a region. `MoveAndPickUp` leaves out the samples in places that are not free.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from pycrorm_async.errors import ImpossibleCondition
from pycrorm_async.learning.features import (
    FEATURES,
    PickUpContext,
    features_of,
    features_of_frame,
    place_of,
)
from pycrorm_async.learning.policy import ARMS, Evidence, Floats, Marginal, PickUpChoice
from pycrorm_async.world.pose import Grasp

if TYPE_CHECKING:
    import pandas as pd

_GRASPS_OF: Final = {"SIDE": (Grasp.FRONT, Grasp.LEFT, Grasp.RIGHT), "TOP": (Grasp.TOP,)}
_GRASPS: Final = tuple(_GRASPS_OF.values())
KINDS: Final = tuple(_GRASPS_OF)
"""Kinds of grasps, in the order of a leaf's probabilities."""
_NEAR_M: Final = 0.01
"""The distance in m below which the density over the floor no longer rises."""
HEIGHT_TOLERANCE_M = 0.05
"""Experience with objects up to this much higher or lower counts where the torso cannot make up for the difference."""


class PolarLeaf(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A component of the mixture, in which all variables are independent.

    Attributes:
        weight: the probability of the leaf.
        kinds: a probability for each of `KINDS`.
        distance, angle, height: distributions of these features, m, rad and m.
    """

    weight: float
    kinds: tuple[float, float]
    distance: Marginal
    angle: Marginal
    height: Marginal

    def __post_init__(self) -> None:
        if not 0 < self.weight <= 1:
            raise ValueError(f"a leaf needs a weight in (0, 1], got weight {self.weight}")
        if min(self.kinds) < 0 or not math.isclose(sum(self.kinds), 1, rel_tol=1e-6):
            raise ValueError(f"a leaf needs 2 probabilities >= 0 that sum to 1, got probabilities {self.kinds}")


class PolarPolicy(
    msgspec.Struct,
    frozen=True,
    tag_field="kind",
    tag="polar policy",
    forbid_unknown_fields=True,
    omit_defaults=True,  # so that the name of a policy of an earlier version stays
):
    """A distribution over `PickUpChoice` in a context.

    Attributes:
        features, features_version: name and version of the features (`features.GRASP_POLAR`).
        leaves: their weights sum to one, and they do not overlap.
        robot: the name of the robot whose pick-ups it was learned from; None if it is not known.
    """

    features: str
    features_version: int
    leaves: tuple[PolarLeaf, ...]
    robot: str | None = None

    def __post_init__(self) -> None:
        if not math.isclose(sum(leaf.weight for leaf in self.leaves), 1, rel_tol=1e-6):
            raise ValueError("the weights of the leaves do not sum to one")

    def sample(
        self,
        rng: np.random.Generator,
        count: int,
        context: PickUpContext,
        evidence: Evidence = Evidence(),  # noqa: B008  frozen
    ) -> list[PickUpChoice]:
        """Draw `count` independent choices; two calls with count 1 draw the same ones as one call with count 2.

        Only the arms and grasps of the evidence count. Raises `ImpossibleCondition` if the policy gives them and the
        object's height no probability.
        """
        low, high = _heights(context)
        arms = [arm for arm in ARMS if evidence.arms is None or arm in evidence.arms]
        grasps = [[each for each in kind if evidence.grasps is None or each in evidence.grasps] for kind in _GRASPS]
        shares = self._shares(low, high) * [len(some) / len(kind) for some, kind in zip(grasps, _GRASPS, strict=True)]
        if not (arms and shares.sum() > 0):
            limits = f"an object {low:.3f} to {high:.3f} m over the torso"
            raise ImpossibleCondition(f"the policy gives no probability to {limits} with: {evidence}")
        chance = rng.random((count, 6))
        cumulative = shares.ravel().cumsum()
        cells = np.searchsorted(cumulative, chance[:, 0] * cumulative[-1], side="right")
        choices: list[PickUpChoice] = []
        for leaf, kind, row in zip(*(each.tolist() for each in divmod(cells, len(KINDS))), chance[:, 1:], strict=True):
            drawn, among = self.leaves[leaf], grasps[kind]
            arm, grasp = arms[int(row[0] * len(arms))], among[int(row[1] * len(among))]
            distance, angle = (
                float(each.quantile(row[[at]])[0]) for each, at in ((drawn.distance, 2), (drawn.angle, 3))
            )
            below, up_to = drawn.height.cdf(np.array([low, high]))
            height = float(np.clip(drawn.height.quantile(below + row[[4]] * (up_to - below)), low, high)[0])
            torso = None if context.torso_limits is None else context.height - height
            choices.append(PickUpChoice(arm, grasp, *place_of(arm, grasp, distance, angle), torso))
        return choices

    def likelihood(self, choices: Sequence[PickUpChoice], context: PickUpContext) -> Floats:
        """Return the density of each choice, shape (choices,), up to a common factor; 0 for an impossible one."""
        return self.density_of(features_of(choices, context))

    def density_of(self, rows: Floats) -> Floats:
        """Return the density of rows of features, shape (rows, features) to (rows,), per m² of floor and m of torso."""
        top, distance, angle, height = (
            rows[:, FEATURES.index(name)] for name in ("top", "distance", "angle", "height")
        )
        total = np.zeros(len(rows))
        for leaf in self.leaves:
            kinds = np.where(top == 1, leaf.kinds[1] / len(_GRASPS[1]), leaf.kinds[0] / len(_GRASPS[0]))
            place = leaf.distance.density(distance) * leaf.angle.density(angle)
            total += leaf.weight * kinds * place * leaf.height.density(height)
        return np.asarray(total / (len(ARMS) * np.maximum(distance, _NEAR_M)))

    def coverage(self, tries: pd.DataFrame) -> float:
        """Return the share of these pick-ups that the policy could have chosen; NaN without any."""
        return float((self.density_of(features_of_frame(tries)) > 0).mean()) if len(tries) else math.nan

    def _shares(self, low: float, high: float) -> Floats:
        """Return the probability of each leaf and kind at heights between these, shape (leaves, kinds)."""
        at_height = [leaf.weight * float(np.diff(leaf.height.cdf(np.array([low, high])))[0]) for leaf in self.leaves]
        return np.asarray(np.array(at_height)[:, None] * np.array([leaf.kinds for leaf in self.leaves]))


def _heights(context: PickUpContext) -> tuple[float, float]:
    """Return the limits of the object's height over the torso, m."""
    if context.torso_limits is None:
        height = context.height - context.torso
        return height - HEIGHT_TOLERANCE_M, height + HEIGHT_TOLERANCE_M
    lowest, highest = context.torso_limits
    return context.height - highest, context.height - lowest
