"""A policy learned from what went well: a Joint Probability Tree over arm, grasp and place (thesis, section 5.2).

>>> statement = select(View.arm, View.grasp, View.object_x, View.object_y).where(View.status == TaskStatus.SUCCEEDED)
>>> policy = learn(await memory.dataframe(statement))

pyjpt chooses every split and fits the distributions of every leaf; the loop over the nodes is ours. pyjpt's own loop
calls itself once for each node that it splits and so ends in a RecursionError at about 500 leaves, and it builds an
array of all rows for each distribution, so that its cost grows with the square of the rows. The loop here takes the
nodes in the same order and gives the same leaves, digit for digit, at a cost that grows with the rows (about 10 s of
processor time for 100,000).

The leaves are read into the numbers of a `Policy` right away, and from there on pyjpt is not needed: its own sampling,
conditioning and queries are not used. They fail at random over rounding (sampling), are wrong for leaves of both arms
(`posterior`), or have no answer for a label that was never seen. A leaf's cumulative distributions are taken at their
knots, which also removes steps that rounding left in them.

Fitting is deterministic, touches no generator of random numbers, and leaves warnings and Ctrl-C as they were.
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
from pycrorm_async.learning.policies.marginals import Floats, Linear
from pycrorm_async.learning.policies.policy import ARMS, GRASPS, Leaf, Policy

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["learn", "check_leaf"]

SYMBOLS: dict[str, Sequence[Enum]] = {"arm": ARMS, "grasp": GRASPS}
PLACE = ("object_x", "object_y")
HEIGHT = "height"
HEIGHTS_ALIKE_M = 1e-6
JUMP_M = 0.001
"""The probability of a single value, at which a distribution jumps, is spread over this much below it."""
_ROUNDING = 1e-9


def learn(successes: pd.DataFrame, *, min_samples_leaf: int = 25) -> Policy:
    """The policy that does again what went well, and what lies between; 0.5 s for 8,000 rows, 10 s for 100,000. Blocks.

    Args:
        successes: a row for each pick-up that went well: `arm` and `grasp` as names, `object_x` and `object_y`, where
            the robot's base stood in the object's own frame, m, as in `PickUpWithContextView`; and, if wanted,
            `height`, the object's height minus the torso's, m. Other columns are passed over. If all heights are
            the same, it is not learned, but kept as the policy's `constant_height`. A policy that knows heights is
            asked with evidence on the one at hand, give or take 1 to 5 cm; without, it mixes what works at any.
        min_samples_leaf: so many rows, two or more, are in every leaf. With fewer the policy repeats more exactly
            what it saw: more of what it does succeeds, and less of what would is done (see `Policy.coverage`).

    Raises:
        NotEnoughExperience: there are fewer rows than a leaf needs.
        CallerError: columns that are missing, labels that are no arm or grasp, numbers that are missing or infinite.
        MissingExtra: pyjpt is not installed.
    """
    check_leaf(min_samples_leaf)
    if len(successes) < min_samples_leaf:
        message = f"{len(successes)} successes are too few to learn from: a leaf takes {min_samples_leaf}"
        raise NotEnoughExperience(f"{message}; try more, or with a smaller min_samples_leaf")
    columns: dict[str, Any] = {name: _labels(successes, name, members) for name, members in SYMBOLS.items()}
    columns |= {name: _numbers(successes, name) for name in PLACE}
    constant_height = None
    if HEIGHT in successes.columns:
        heights = _numbers(successes, HEIGHT)
        if np.ptp(heights) <= HEIGHTS_ALIKE_M:
            constant_height = float(heights[0])
        else:
            columns[HEIGHT] = heights
    return Policy(tuple(_fitted(columns, min_samples_leaf)), constant_height=constant_height)


def check_leaf(min_samples_leaf: int) -> None:
    """Raises `CallerError` for leaves in which nothing can be distributed."""
    if min_samples_leaf < 2:
        raise CallerError(f"a leaf needs two samples or more, not min_samples_leaf={min_samples_leaf}")


def _fitted(columns: dict[str, Any], min_samples_leaf: int) -> list[Leaf]:
    """The leaves of the tree over these columns. What pyjpt does to the filters of warnings is undone."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        jpt = _pyjpt()
        symbols = {name: jpt.SymbolicType(name, [each.name for each in members]) for name, members in SYMBOLS.items()}
        variables = [
            jpt.SymbolicVariable(name, symbols[name]) if name in symbols else jpt.NumericVariable(name)
            for name in columns
        ]
        samples = np.column_stack([_coded(each, columns[each.name]) for each in variables])
        order = np.arange(len(samples))
        impurity = jpt.Impurity.from_tree(jpt.JPT(variables, min_samples_leaf=min_samples_leaf))
        impurity.setup(samples, order)
        return [
            _leaf(variables, samples[order[start:end]], (end - start) / len(samples))
            for start, end in _split(impurity, len(samples))
        ]


def _coded(variable: Any, values: Any) -> Floats:
    """A column as pyjpt calculates with it: numbers as they are, a label as its place in the domain."""
    if variable.numeric:
        return np.asarray(values)
    codes = {label: variable.domain.values.map(label) for label in set(values)}
    return np.array([codes[label] for label in values], dtype=np.float64)


def _split(impurity: Any, count: int) -> Iterator[tuple[int, int]]:
    """The leaves as ranges of the order that `impurity` sorts the rows into; the leaves nearest to the root first."""
    waiting = deque([(0, count)])
    while waiting:
        start, end = waiting.popleft()
        if impurity.compute_best_split(start, end) >= 0:  # minus infinity where no split leaves enough on both sides
            middle = start + impurity.best_split_pos + 1
            waiting += ((start, middle), (middle, end))
        else:
            yield start, end


def _leaf(variables: Sequence[Any], samples: Floats, weight: float) -> Leaf:
    """Distributions that pyjpt fits to the rows of one leaf, as a leaf of ours."""
    fitted = {
        each.name: each.distribution()._fit(samples, col=column)  # noqa: SLF001 - there is no public one for both kinds
        for column, each in enumerate(variables)
    }
    arms, grasps = (tuple(float(share) for share in fitted[name].probabilities) for name in SYMBOLS)
    x, y = (_linear(fitted[name].cdf) for name in PLACE)
    return Leaf(weight, arms, grasps, x, y, _linear(fitted[HEIGHT].cdf) if HEIGHT in fitted else None)


def _linear(cdf: Any) -> Linear:
    """The piecewise linear distribution through the ends of the pieces.

    The first piece is 0 up to the smallest value and the last is 1 from the largest on. Where several rows have the
    smallest value in common, or all do, there is a jump at it.
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
    known = [each.name for each in members]
    if unknown := [label for label in labels if label not in known]:
        raise CallerError(f"column {name} holds {unknown[0]!r}, which is none of {', '.join(known)}")
    return labels


def _numbers(successes: pd.DataFrame, name: str) -> Floats:
    try:
        numbers = _column(successes, name).to_numpy(dtype=np.float64, na_value=np.nan)
    except (TypeError, ValueError):
        raise CallerError(f"column {name} holds something else than numbers") from None
    if missing := int((~np.isfinite(numbers)).sum()):
        raise CallerError(f"column {name} has no finite number in {missing} of {len(numbers)} rows: leave those out")
    return np.asarray(numbers)


def _column(successes: pd.DataFrame, name: str) -> Any:
    if name not in successes.columns:
        raise CallerError(f"the frame has no column {name}: select {', '.join((*SYMBOLS, *PLACE))} of the view")
    return successes[name]


def _pyjpt() -> SimpleNamespace:
    """What is needed of it. Raises `MissingExtra` where it is not installed."""
    try:
        from jpt.distributions import SymbolicType
        from jpt.learning.impurity import Impurity
        from jpt.trees import JPT
        from jpt.variables import NumericVariable, SymbolicVariable
    except ImportError:
        raise MissingExtra("learning needs pyjpt: pip install 'pycrorm-async[learning]'") from None
    return SimpleNamespace(
        Impurity=Impurity,
        JPT=JPT,
        NumericVariable=NumericVariable,
        SymbolicType=SymbolicType,
        SymbolicVariable=SymbolicVariable,
    )
