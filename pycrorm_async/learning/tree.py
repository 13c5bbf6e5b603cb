"""Learn a policy from successful pick-ups: a Joint Probability Tree over arm, grasp and place (thesis, section 5.2).

>>> statement = select(View.arm, View.grasp, View.robot_in_object_x, View.robot_in_object_y)
>>> policy = learn(await memory.dataframe(statement.where(View.status == TaskStatus.SUCCEEDED)))

pyjpt chooses every split and fits the distributions of every leaf; the loop over the nodes is in this module. pyjpt's
own loop recurses once per split, so that it raises RecursionError at about 500 leaves, and it builds an array of all
rows for each distribution, so that its cost is quadratic in the rows. The loop here visits the nodes in the same order
and gives the same leaves, digit for digit, at a cost linear in the rows (about 10 s of processor time for 100,000).

The leaves are converted to a `Policy` at once, and pyjpt's own sampling, conditioning and queries are not used: its
sampling fails at random because of rounding, its `posterior` is wrong for leaves with both arms, and its queries have
no answer for a label that did not occur. A leaf's cumulative distributions are taken at their knots, which also removes
steps caused by rounding.

Fitting is deterministic, uses no random numbers, and restores the filters of warnings.
"""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from pycrorm_async.errors import CallerError, MissingExtra, NotEnoughExperience
from pycrorm_async.learning.features import (
    FEATURES,
    GRASP_POLAR,
    GRASP_POLAR_VERSION,
    features_of_frame,
    labels,
    numbers,
    robot_of,
)
from pycrorm_async.learning.polar_policy import KINDS, PolarLeaf, PolarPolicy
from pycrorm_async.learning.policy import ARMS, GRASPS, Floats, Leaf, Linear, Policy
from pycrorm_async.world.urdf import PR2

if TYPE_CHECKING:
    import pandas as pd

SYMBOLS: dict[str, Sequence[Enum]] = {"arm": ARMS, "grasp": GRASPS}
PLACE = ("object_x", "object_y")
HEIGHT = "height"
HEIGHTS_ALIKE_M = 1e-6
"""Heights that differ by no more than this count as one: far below any real difference, above rounding."""
JUMP_M = 0.001
"""The probability of a single value, at which a distribution jumps, is spread over this length below the value."""
_ROUNDING = 1e-9
"""A jump of no more than this probability is a rounding error and is dropped."""


def learn(successes: pd.DataFrame, *, min_samples_leaf: int = 25) -> Policy:
    """Fit a policy to successful pick-ups. Blocks: 0.5 s for 8,000 rows, 10 s for 100,000.

    Args:
        successes: one row for each successful pick-up: `arm` and `grasp` as names; `robot_in_object_x` and
            `robot_in_object_y`, the position of the robot's base in the object's own frame, m, as in
            `PickUpWithContextView`, or under their former names `object_x` and `object_y`; optionally
            `height`, the object's height minus the torso's, m, and `robot`, the only one that the policy is then used
            for, without it the PR2. Other columns are ignored. If all heights are equal, the height is not learned but
            kept as the policy's `constant_height`. Condition a policy that has learned heights on the present height,
            plus or minus 1 to 5 cm; unconditioned, it mixes the samples of all heights.
        min_samples_leaf: minimum number of rows in a leaf, two or more. A smaller number makes the policy repeat its
            samples more exactly: its success rate rises and its coverage falls (see `Policy.coverage`).

    Raises:
        NotEnoughExperience: fewer rows than `min_samples_leaf`.
        CallerError: a column is missing, a label is not an arm or grasp, a number is missing or infinite, or the rows
            are of several robots.
        MissingExtra: pyjpt is not installed.
    """
    check_leaf(min_samples_leaf)
    if len(successes) < min_samples_leaf:
        raise _too_few(len(successes), min_samples_leaf)
    columns: dict[str, Any] = {
        name: labels(successes, name, [each.name for each in members]) for name, members in SYMBOLS.items()
    }
    for name in PLACE:
        own = f"robot_in_{name}"  # the policy's name is that of policy files
        columns[name] = numbers(successes, own if own in successes.columns else name)
    constant_height = None
    if HEIGHT in successes.columns:
        heights = numbers(successes, HEIGHT)
        if np.ptp(heights) <= HEIGHTS_ALIKE_M:
            constant_height = float(heights[0])
        else:
            columns[HEIGHT] = heights
    domains = {name: [each.name for each in members] for name, members in SYMBOLS.items()}
    leaves = (_leaf(weight, fitted) for weight, fitted in _fit(columns, domains, min_samples_leaf))
    return Policy(tuple(leaves), constant_height=constant_height, robot=robot_of(successes) or PR2.name)


def learn_polar(successes: pd.DataFrame, *, min_samples_leaf: int = 15) -> PolarPolicy:
    """Fit a policy over the features "grasp-polar" to successful pick-ups (see `polar_policy`); blocks as `learn`.

    It needs fewer successes than `learn`, because both arms and all grasps from the side share theirs, and it sets the
    torso. The rows are those of `learn`, with objects at several heights over the torso.

    Raises what `learn` raises, and `CallerError` if all heights are equal.
    """
    check_leaf(min_samples_leaf)
    if len(successes) < min_samples_leaf:
        raise _too_few(len(successes), min_samples_leaf)
    rows = features_of_frame(successes)
    height = rows[:, FEATURES.index("height")]
    if np.ptp(height) <= HEIGHTS_ALIKE_M:
        message = f"all objects were {height[0]:.3f} m over the torso, so that a torso height cannot be learned"
        raise CallerError(f"{message}: record pick-ups at several heights, or learn without features")
    columns: dict[str, Any] = {"grasp": [KINDS[int(top)] for top in rows[:, FEATURES.index("top")]]}
    columns |= {name: rows[:, FEATURES.index(name)] for name in ("distance", "angle", "height")}
    leaves = (
        PolarLeaf(
            weight,
            tuple(float(share) for share in fitted["grasp"].probabilities),  # type: ignore[arg-type]  # two kinds
            *(_linear(fitted[name].cdf) for name in ("distance", "angle", "height")),
        )
        for weight, fitted in _fit(columns, {"grasp": list(KINDS)}, min_samples_leaf)
    )
    return PolarPolicy(GRASP_POLAR, GRASP_POLAR_VERSION, tuple(leaves), robot_of(successes))


def _too_few(successes: int, min_samples_leaf: int) -> NotEnoughExperience:
    message = f"{successes} successes are too few to learn from: a leaf takes {min_samples_leaf}"
    remedy = "record more rollouts or choose a smaller --min-samples-leaf (min_samples_leaf=)"
    return NotEnoughExperience(f"{message}; {remedy}")


def check_leaf(min_samples_leaf: int) -> None:
    """Raise `CallerError` for leaves with fewer than two samples, which have no distribution."""
    if min_samples_leaf < 2:
        raise CallerError(f"a leaf needs two samples or more, got min_samples_leaf={min_samples_leaf}")


def _fit(
    columns: dict[str, Any], domains: Mapping[str, list[str]], min_samples_leaf: int
) -> list[tuple[float, dict[str, Any]]]:
    """Fit a tree and return the weight of each leaf with pyjpt's distributions by column.

    `domains` has the columns of labels. Restores the filters of warnings, which pyjpt changes.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        jpt = _pyjpt()
        symbols = {name: jpt.SymbolicType(name, members) for name, members in domains.items()}
        variables = [
            jpt.SymbolicVariable(name, symbols[name]) if name in symbols else jpt.NumericVariable(name)
            for name in columns
        ]
        samples = np.column_stack([_encode(each, columns[each.name]) for each in variables])
        order = np.arange(len(samples))
        impurity = jpt.Impurity.from_tree(jpt.JPT(variables, min_samples_leaf=min_samples_leaf))
        impurity.setup(samples, order)
        return [
            ((end - start) / len(samples), _distributions(variables, samples[order[start:end]]))
            for start, end in _split(impurity, len(samples))
        ]


def _encode(variable: Any, values: Any) -> Floats:
    """Convert a column to the numbers pyjpt calculates with: a label becomes its index in the domain."""
    if variable.numeric:
        return np.asarray(values)
    codes = {label: variable.domain.values.map(label) for label in set(values)}
    return np.array([codes[label] for label in values], dtype=np.float64)


def _split(impurity: Any, count: int) -> Iterator[tuple[int, int]]:
    """Yield each leaf as a range of the order in which `impurity` sorts the rows, breadth first."""
    pending = deque([(0, count)])
    while pending:
        start, end = pending.popleft()
        if impurity.compute_best_split(start, end) >= 0:  # minus infinity if no split leaves enough rows on both sides
            middle = start + impurity.best_split_pos + 1
            pending += ((start, middle), (middle, end))
        else:
            yield start, end


def _distributions(variables: Sequence[Any], samples: Floats) -> dict[str, Any]:
    """Fit pyjpt's distributions to the rows of one leaf."""
    return {
        each.name: each.distribution()._fit(samples, col=column)  # noqa: SLF001 - no public method fits both kinds
        for column, each in enumerate(variables)
    }


def _leaf(weight: float, fitted: Mapping[str, Any]) -> Leaf:
    """Convert pyjpt's distributions to a leaf."""
    arms, grasps = (tuple(float(share) for share in fitted[name].probabilities) for name in SYMBOLS)
    x, y = (_linear(fitted[name].cdf) for name in PLACE)
    return Leaf(weight, arms, grasps, x, y, _linear(fitted[HEIGHT].cdf) if HEIGHT in fitted else None)


def _linear(cdf: Any) -> Linear:
    """Convert pyjpt's cumulative distribution to a piecewise linear one through the ends of its pieces.

    The first piece is 0 below the smallest value, the last is 1 above the largest. If several rows share the smallest
    value, the distribution jumps there.
    """
    knots = [piece.upper for piece in cdf.intervals[:-1]]
    jump = cdf.functions[1].eval(knots[0])
    cumulative = [jump, *(each.eval(knot) for each, knot in zip(cdf.functions[1:-1], knots[1:], strict=True))]
    if jump > _ROUNDING:
        knots, cumulative = [knots[0] - JUMP_M, *knots], [0.0, *cumulative]
    rising = np.maximum.accumulate(np.array(cumulative) - cumulative[0])
    return Linear(tuple(knots), tuple((rising / rising[-1]).tolist()))


def _pyjpt() -> SimpleNamespace:
    """Import the classes of pyjpt that this module uses. Raises `MissingExtra` if pyjpt is not installed."""
    try:
        from jpt.distributions import SymbolicType
        from jpt.learning.impurity import Impurity
        from jpt.trees import JPT
        from jpt.variables import NumericVariable, SymbolicVariable
    except ImportError:
        raise MissingExtra(
            "learning needs pyjpt, which exists up to Python 3.12: pip install 'pycrorm-async[learning]'"
        ) from None
    return SimpleNamespace(
        Impurity=Impurity,
        JPT=JPT,
        NumericVariable=NumericVariable,
        SymbolicType=SymbolicType,
        SymbolicVariable=SymbolicVariable,
    )
