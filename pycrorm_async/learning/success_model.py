"""Predict the success of pick-ups: gradient-boosted trees, fitted to those that succeeded and those that failed.

>>> model = SuccessModel.fit(await memory.dataframe(MoveAndPickUp.query_with_failures()))
>>> model.probability([PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.6, 0.1, torso=0.2)], PickUpContext(height=0.9))
array([0.98])

A policy is fitted to successes alone, so it also repeats what was merely tried often. A model has seen the failures
too: it ranks any way to pick up, and needs fewer rollouts (see `README.md` for the figures).

**Trees.** scikit-learn's `HistGradientBoostingClassifier` fits them, in one thread and without randomness, so that
equal frames give equal models; their size is that which predicts held-out rows better. A model is stored as JSON
numbers, with the name and version of its features, and evaluated by numpy alone: using one needs neither scikit-learn
nor pickle. The sum of one leaf per tree and of the baseline is the logarithm of the odds.

**Draws.** A model proposes nothing itself. `draw` picks one of the proposals of a random source: one of those that the
model is confident of, one at which it is unsure (rounds of learning), or any.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError, MissingExtra, NotEnoughExperience
from pycrorm_async.learning.features import (
    FEATURES,
    GRASP_POLAR,
    GRASP_POLAR_VERSION,
    PickUpContext,
    features_of,
    features_of_frame,
    robot_of,
)
from pycrorm_async.learning.policy import Floats, PickUpChoice
from pycrorm_async.task_status import TaskStatus

if TYPE_CHECKING:
    import pandas as pd

CONFIDENT: Final = 0.85
"""The probability from which a model is confident of a success. In the air, of models of 3,000 rollouts that try where
they are unsure, 98.7, 98.9 and 99.2 % of the ways above 0.8, 0.85 and 0.9 succeed, and they cover 96.5, 95.9 and 95.0 %
of those that succeed. Where 8 % of all tries fail whatever the way, the bounds cover 72, 62 and 39 %."""
SURE: Final = 0.95
"""The probability from which a further success would teach a model little: of ways with 0.95 or more, 0.4 % failed."""
EACH_CLASS_MIN: Final = 20
"""The successes, and also the failures, that a model needs at least: two leaves of its trees take as many rows."""
WITHOUT_HEIGHT: Final = (
    "have no height over the robot: its pose, its torso or the pose of the object was not recorded (a robot without a"
    " torso has one in `MoveAndPickUp.query_with_failures`)"
)
_TREES: Final = 300
_LEARNING_RATE: Final = 0.05
_SHRINKAGE: Final = 1.0
"""The L2 regularisation of the leaves. It and small steps of many trees keep a model of few rollouts from claiming more
than these show: with the default settings of scikit-learn up to a point more of its confident ways failed."""
_LEAVES_MAX: Final = (8, 31)
"""Of these, the most leaves of a tree are those that predict held-out rows better. Where the same way can succeed or
fail, larger trees learn the chance of single rows: of 3,000 rollouts with errors of the robot, the tenth with the
highest predictions had 0.99 on average, and 0.90 of them succeeded; with 8 leaves these were 0.95 and 0.93. Without
errors, 8 leaves cover a tenth fewer of the ways that succeed."""
_PARTS: Final = 3
"""One part in this number of the rows is held out to choose the size of the trees."""
_ROWS_AT_ONCE: Final = 4_096
"""Bounds the memory of an evaluation: rows times trees numbers at once."""
_NEVER: Final = 1e-12
"""The least weight of a draw, so that a way of probability 0 comes last."""
_LARGEST: Final = float(np.finfo(np.float64).max)
"""Written for an infinite threshold, which JSON has not: every finite number is below it too."""


class Draws(StrEnum):
    """The way in which a model picks one of many proposals.

    Attributes:
        CONFIDENT: any of those that succeed with a probability of `CONFIDENT` or more; without any the likeliest.
        UNCERTAIN: weighted by p (1 - p) + 0.3 p: most lie where the model learns most, and some where it is sure.
        SEARCHED: of more proposals, some of them around the likeliest: the likeliest one, if none has a probability of
            `SURE`, else weighted by p (1 - p). So learning meets the ways that the model will choose, and the few that
            succeed at high tables.
        RANDOM: any.
    """

    CONFIDENT = "confident"
    UNCERTAIN = "uncertain"
    SEARCHED = "searched"
    RANDOM = "random"


class Tree(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A regression tree as arrays over its nodes, the root first and children behind their parent.

    Attributes:
        feature: index of the feature that splits the node; -1 for a leaf.
        threshold: rows with feature <= threshold go left.
        missing_left: whether rows without this feature go left.
        left, right: indexes of the children; a leaf names itself.
        value: what a leaf adds to the logarithm of the odds.
    """

    feature: tuple[int, ...]
    threshold: tuple[float, ...]
    missing_left: tuple[bool, ...]
    left: tuple[int, ...]
    right: tuple[int, ...]
    value: tuple[float, ...]

    def __post_init__(self) -> None:
        size = len(self.feature)
        if not size or any(len(getattr(self, name)) != size for name in self.__struct_fields__):
            raise ValueError("a tree has columns of unequal length, or no node")
        for node, (feature, left, right) in enumerate(zip(self.feature, self.left, self.right, strict=True)):
            is_leaf = feature == -1 and left == right == node
            if not is_leaf and not (0 <= feature < len(FEATURES) and node < min(left, right) < size):
                raise ValueError(f"a tree has a wrong split at node {node}")
            if not max(left, right) < size:
                raise ValueError(f"a tree has no node {max(left, right)}")
        if not all(map(math.isfinite, (*self.threshold, *self.value))):
            raise ValueError("a tree has numbers that are not finite")


class SuccessModel(msgspec.Struct, frozen=True, dict=True, tag_field="kind", tag="success model"):
    """The probability that a pick-up succeeds, as a function of the way and its circumstances.

    Attributes:
        features, features_version: name and version of the features that the trees split (`features.GRASP_POLAR`).
        trees, baseline: see the module.
        robot: the name of the robot that it was fitted to; None if the rows did not name one.
        rollouts, successes: number of pick-ups that it was fitted to, and of those that succeeded.
        draws: how `draw` picks; part of the model, so that its name also tells how rollouts were drawn.

    `SuccessModel.fit` returns one; `save_policy` and `load_policy` write and read it.
    """

    features: str
    features_version: int
    baseline: float
    trees: tuple[Tree, ...]
    robot: str | None
    rollouts: int
    successes: int
    draws: Draws = Draws.CONFIDENT

    def __post_init__(self) -> None:
        if not math.isfinite(self.baseline):
            raise ValueError("a model has a baseline that is not finite")

    @classmethod
    def fit(cls, tries: pd.DataFrame, *, min_samples_leaf: int = 10) -> SuccessModel:
        """Fit a model to pick-ups that succeeded or failed. Blocks: 0.6 s for 3,000 rows, 1.5 s for 20,000.

        Args:
            tries: the columns of `features.features_of_frame` and `status`, SUCCEEDED or FAILED; optionally `robot`.
                Rows of another status are left out, and without `height` (a robot without a torso) too.
            min_samples_leaf: minimum number of rows in a leaf.

        Raises:
            NotEnoughExperience: fewer than `EACH_CLASS_MIN` successes or failures with a height.
            CallerError: a column is missing or holds no numbers, or the rows are of several robots.
            MissingExtra: scikit-learn is not installed.
        """
        if min_samples_leaf < 1:
            raise CallerError(f"a leaf needs one row or more, got min_samples_leaf={min_samples_leaf}")
        ended = _ended(tries)
        robot = robot_of(ended)
        succeeded = (ended["status"] == TaskStatus.SUCCEEDED.value).to_numpy()
        successes = int(succeeded.sum())
        for kind, count in (("successes", successes), ("failures", len(ended) - successes)):
            if count < EACH_CLASS_MIN:
                message = f"{count} {kind} are too few to learn from: a success model needs {EACH_CLASS_MIN} successes"
                raise NotEnoughExperience(f"{message} and as many failures; {_remedy(tries)}")
        baseline, trees = _fit(features_of_frame(ended), succeeded, min_samples_leaf)
        name, version = GRASP_POLAR, GRASP_POLAR_VERSION
        return cls(name, version, baseline, trees, robot, len(ended), successes)

    @classmethod
    def untrained(cls) -> SuccessModel:
        """Return the model that knows nothing: every way has the probability 1/2, and it draws at random."""
        # Of version 1 for ever: it uses no feature, and its name is that of the rollouts that are recorded by it.
        return cls(GRASP_POLAR, 1, 0.0, (), None, 0, 0, Draws.RANDOM)

    def probability(self, choices: Sequence[PickUpChoice], context: PickUpContext) -> Floats:
        """Return for each choice the probability that it succeeds, shape (choices,)."""
        return self.probability_of(features_of(choices, context))

    def probability_in(self, tries: pd.DataFrame) -> Floats:
        """Return the probability of success of recorded pick-ups, shape (rows,). Raises `CallerError` as `fit` does."""
        return self.probability_of(features_of_frame(tries))

    def probability_of(self, rows: Floats) -> Floats:
        """Return the probability of success for rows of features, shape (rows, features) to (rows,)."""
        return np.concatenate([np.zeros(0), *self.parts_of(rows, _ROWS_AT_ONCE)])

    def parts_of(self, rows: Floats, rows_at_once: int) -> Iterator[Floats]:
        """Yield what `probability_of` returns, `rows_at_once` rows at a time; other tasks can run in between."""
        for first in range(0, len(rows), rows_at_once):
            log_odds = self.baseline + self._forest.sum(rows[first : first + rows_at_once])
            yield np.asarray(1 / (1 + np.exp(-log_odds)))

    def draw(
        self,
        rng: np.random.Generator,
        proposals: Sequence[PickUpChoice],
        context: PickUpContext,
        possible: Callable[[PickUpChoice], bool] = lambda _: True,
        shares: Floats | None = None,
    ) -> PickUpChoice:
        """Return one of the proposals, by `draws`: one that is `possible`, if any is; `shares` saves `probability`."""
        shares = self.probability(proposals, context) if shares is None else shares
        chance = rng.random(len(shares))
        match self.draws:
            case Draws.CONFIDENT:
                ranks = np.where(shares >= CONFIDENT, chance - 1, 1 - shares)
            case Draws.UNCERTAIN:
                weights = np.maximum(shares * (1 - shares) + 0.3 * shares, _NEVER)
                ranks = -np.log1p(-chance) / weights  # the order of a weighted draw without replacement
            case Draws.SEARCHED if shares.max() < SURE:
                ranks = 1 - shares
            case Draws.SEARCHED:
                ranks = -np.log1p(-chance) / np.maximum(shares * (1 - shares), _NEVER)
            case Draws.RANDOM:
                ranks = chance
        ordered: list[PickUpChoice] = [proposals[each] for each in np.argsort(ranks, kind="stable")]
        return next(filter(possible, ordered), ordered[0])

    def drawing(self, draws: Draws) -> SuccessModel:
        """Return the same model with another way to draw."""
        return msgspec.structs.replace(self, draws=draws)

    def coverage(self, tries: pd.DataFrame) -> float:
        """Return the share of these pick-ups of which the model is confident; NaN without any."""
        return float((self.probability_in(tries) >= CONFIDENT).mean()) if len(tries) else math.nan

    @cached_property
    def _forest(self) -> _Forest:
        return _Forest.of(self.trees)


def _ended(tries: pd.DataFrame) -> pd.DataFrame:
    if "status" not in tries.columns:
        raise CallerError("the frame has no column status: select the pick-ups that failed too, with their status")
    ended = tries[tries["status"].isin([TaskStatus.SUCCEEDED.value, TaskStatus.FAILED.value])]
    return ended.dropna(subset=["height"]) if "height" in ended.columns else ended


def _remedy(tries: pd.DataFrame) -> str:
    """Return what to do about too few pick-ups; those without a height are counted."""
    missing = int(tries["height"].isna().sum()) if "height" in tries.columns else 0
    if not missing:
        return "record more pick-ups"
    return f"{missing:,} of {len(tries):,} pick-ups {WITHOUT_HEIGHT}"


class _Forest(NamedTuple):
    """The nodes of all trees in common arrays; `roots` has the first node of each tree."""

    roots: NDArray[np.intp]
    feature: NDArray[np.intp]
    threshold: Floats
    missing_left: NDArray[np.bool_]
    left: NDArray[np.intp]
    right: NDArray[np.intp]
    value: Floats

    @classmethod
    def of(cls, trees: Sequence[Tree]) -> _Forest:
        sizes = np.array([len(each.feature) for each in trees], dtype=np.intp)
        roots = sizes.cumsum() - sizes
        shift = np.repeat(roots, sizes)

        def column(name: str, dtype: Any) -> Any:
            return np.array([entry for each in trees for entry in getattr(each, name)], dtype=dtype)

        # A leaf asks for feature 0, and both answers name itself.
        feature = np.maximum(column("feature", np.intp), 0)
        left, right = column("left", np.intp) + shift, column("right", np.intp) + shift
        return cls(
            roots, feature, column("threshold", np.float64), column("missing_left", np.bool_), left, right,
            column("value", np.float64),
        )  # fmt: skip

    def sum(self, rows: Floats) -> Floats:
        """Return the sum of the values of the leaves that each row reaches, shape (rows,)."""
        count, width = rows.shape
        numbers, first = rows.ravel(), np.repeat(np.arange(count) * width, len(self.roots))
        nodes = np.tile(self.roots, count)
        descending = np.arange(len(nodes))  # the pairs of row and tree that have not reached a leaf
        while True:
            at = nodes[descending]
            splits = self.left[at] != at
            descending, at = descending[splits], at[splits]
            if not len(descending):
                return np.asarray(self.value[nodes].reshape(count, -1).sum(axis=1))
            asked = numbers[first[descending] + self.feature[at]]
            goes_left = (asked <= self.threshold[at]) | (np.isnan(asked) & self.missing_left[at])
            nodes[descending] = np.where(goes_left, self.left[at], self.right[at])


def _fit(rows: Floats, succeeded: NDArray[np.bool_], min_samples_leaf: int) -> tuple[float, tuple[Tree, ...]]:
    """Fit the trees and return their baseline and nodes."""
    classifier, one_thread = _scikit_learn()
    held_out = np.empty(len(rows), dtype=np.bool_)
    held_out[np.argsort(succeeded, kind="stable")] = np.arange(len(rows)) % _PARTS == 0  # of successes and failures

    def boosted(part: NDArray[np.bool_], leaves: int) -> tuple[Any, list[int]]:
        """Return a classifier that is fitted to a part of the rows, and the numbers of the columns that it uses."""
        # scikit-learn cannot bin a column with less than two values, and would learn nothing from it.
        varied = [at for at, values in enumerate(rows[part].T) if len(np.unique(values[~np.isnan(values)])) > 1]
        if not varied:
            raise NotEnoughExperience("all pick-ups are alike: a success model needs different ways to pick up")
        booster = classifier(
            max_iter=_TREES,
            learning_rate=_LEARNING_RATE,
            l2_regularization=_SHRINKAGE,
            max_leaf_nodes=leaves,
            min_samples_leaf=min_samples_leaf,
            early_stopping=False,  # it would hold back a random part of the rows
            random_state=0,
        )
        return booster.fit(rows[part][:, varied], succeeded[part]), varied

    def held_out_loss(leaves: int) -> float:
        """Return the log loss on the held-out rows of what is fitted to the others."""
        booster, varied = boosted(~held_out, leaves)
        log_odds = booster.decision_function(rows[held_out][:, varied])
        return float(np.logaddexp(0.0, np.where(succeeded[held_out], -log_odds, log_odds)).mean())

    with one_thread(limits=1, user_api="openmp"):
        booster, varied = boosted(np.ones(len(rows), dtype=np.bool_), min(_LEAVES_MAX, key=held_out_loss))
    # No public attribute has the trees; a test compares the probabilities with scikit-learn's own.
    fitted = [predictor.nodes for [predictor] in booster._predictors]  # noqa: SLF001
    return float(booster._baseline_prediction.item()), tuple(_tree(nodes, varied) for nodes in fitted)  # noqa: SLF001


def _tree(nodes: Any, varied: Sequence[int]) -> Tree:
    """Convert scikit-learn's nodes; `varied` has the number of each column that it was fitted to."""
    own, is_leaf = np.arange(len(nodes)), nodes["is_leaf"].astype(bool)
    columns = {
        "feature": np.where(is_leaf, -1, np.array(varied)[np.where(is_leaf, 0, nodes["feature_idx"])]),
        "threshold": np.where(is_leaf, 0.0, np.minimum(nodes["num_threshold"], _LARGEST)),
        "missing_left": ~is_leaf & nodes["missing_go_to_left"].astype(bool),
        "left": np.where(is_leaf, own, nodes["left"]),
        "right": np.where(is_leaf, own, nodes["right"]),
        "value": np.where(is_leaf, nodes["value"], 0.0),
    }
    return Tree(**{name: tuple(values.tolist()) for name, values in columns.items()})


def _scikit_learn() -> tuple[Any, Any]:
    """Import the classifier and the limit of threads. Raises `MissingExtra` if scikit-learn is not installed."""
    try:
        from sklearn.ensemble import HistGradientBoostingClassifier
        from threadpoolctl import threadpool_limits
    except ImportError:
        raise MissingExtra("a success model needs scikit-learn: pip install 'pycrorm-async[learning]'") from None
    return HistGradientBoostingClassifier, threadpool_limits
