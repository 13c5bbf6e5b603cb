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
from collections.abc import Iterator, Sequence
from enum import Enum
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from pycrorm_async.errors import CallerError, MissingExtra, NotEnoughExperience
from pycrorm_async.learning.policy import ARMS, GRASPS, Floats, Leaf, Linear, Policy

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
            `height`, the object's height minus the torso's, m. Other columns are ignored. If all heights are equal,
            the height is not learned but kept as the policy's `constant_height`. Condition a policy that has learned
            heights on the present height, plus or minus 1 to 5 cm; unconditioned, it mixes the samples of all heights.
        min_samples_leaf: minimum number of rows in a leaf, two or more. A smaller number makes the policy repeat its
            samples more exactly: its success rate rises and its coverage falls (see `Policy.coverage`).

    Raises:
        NotEnoughExperience: fewer rows than `min_samples_leaf`.
        CallerError: a column is missing, a label is not an arm or grasp, or a number is missing or infinite.
        MissingExtra: pyjpt is not installed.
    """
    check_leaf(min_samples_leaf)
    if len(successes) < min_samples_leaf:
        message = f"{len(successes)} successes are too few to learn from: a leaf takes {min_samples_leaf}"
        remedy = "record more rollouts or choose a smaller --min-samples-leaf (min_samples_leaf=)"
        raise NotEnoughExperience(f"{message}; {remedy}")
    columns: dict[str, Any] = {name: _labels(successes, name, members) for name, members in SYMBOLS.items()}
    for name in PLACE:
        own = f"robot_in_{name}"  # the policy's name is that of policy files
        columns[name] = _numbers(successes, own if own in successes.columns else name)
    constant_height = None
    if HEIGHT in successes.columns:
        heights = _numbers(successes, HEIGHT)
        if np.ptp(heights) <= HEIGHTS_ALIKE_M:
            constant_height = float(heights[0])
        else:
            columns[HEIGHT] = heights
    return Policy(tuple(_fit(columns, min_samples_leaf)), constant_height=constant_height)


def check_leaf(min_samples_leaf: int) -> None:
    """Raise `CallerError` for leaves with fewer than two samples, which have no distribution."""
    if min_samples_leaf < 2:
        raise CallerError(f"a leaf needs two samples or more, got min_samples_leaf={min_samples_leaf}")


def _fit(columns: dict[str, Any], min_samples_leaf: int) -> list[Leaf]:
    """Fit a tree to the columns and return its leaves. Restores the filters of warnings, which pyjpt changes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        jpt = _pyjpt()
        symbols = {name: jpt.SymbolicType(name, [each.name for each in members]) for name, members in SYMBOLS.items()}
        variables = [
            jpt.SymbolicVariable(name, symbols[name]) if name in symbols else jpt.NumericVariable(name)
            for name in columns
        ]
        samples = np.column_stack([_encode(each, columns[each.name]) for each in variables])
        order = np.arange(len(samples))
        impurity = jpt.Impurity.from_tree(jpt.JPT(variables, min_samples_leaf=min_samples_leaf))
        impurity.setup(samples, order)
        return [
            _leaf(variables, samples[order[start:end]], (end - start) / len(samples))
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


def _leaf(variables: Sequence[Any], samples: Floats, weight: float) -> Leaf:
    """Fit pyjpt's distributions to the rows of one leaf and convert them to a `Leaf`."""
    distributions = {
        each.name: each.distribution()._fit(samples, col=column)  # noqa: SLF001 - no public method fits both kinds
        for column, each in enumerate(variables)
    }
    arms, grasps = (tuple(float(share) for share in distributions[name].probabilities) for name in SYMBOLS)
    x, y = (_linear(distributions[name].cdf) for name in PLACE)
    return Leaf(weight, arms, grasps, x, y, _linear(distributions[HEIGHT].cdf) if HEIGHT in distributions else None)


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


def _labels(successes: pd.DataFrame, name: str, members: Sequence[Enum]) -> list[str]:
    labels: list[str] = _column(successes, name).tolist()
    names = [each.name for each in members]
    if unknown := [label for label in labels if label not in names]:
        raise CallerError(f"column {name} holds {unknown[0]!r}, which is none of {', '.join(names)}")
    return labels


def _numbers(successes: pd.DataFrame, name: str) -> Floats:
    try:
        numbers = _column(successes, name).to_numpy(dtype=np.float64, na_value=np.nan)
    except (TypeError, ValueError):
        raise CallerError(f"column {name} holds values that are not numbers") from None
    if missing := int((~np.isfinite(numbers)).sum()):
        raise CallerError(f"column {name} has no finite number in {missing} of {len(numbers)} rows: drop those rows")
    return np.asarray(numbers)


def _column(successes: pd.DataFrame, name: str) -> Any:
    if name not in successes.columns:
        raise CallerError(f"the frame has no column {name}: select {', '.join((*SYMBOLS, *PLACE))} of the view")
    return successes[name]


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
