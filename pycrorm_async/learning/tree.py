"""A policy learned from what went well: a Joint Probability Tree over arm, grasp and place (thesis, section 5.2).

>>> statement = select(View.arm, View.grasp, View.object_x, View.object_y).where(View.status == TaskStatus.SUCCEEDED)
>>> policy = learn(await memory.dataframe(statement))

pyjpt fits the tree. Its leaves are read into the numbers of a `Policy` right away, and from there on it is not needed:
its own sampling, conditioning and queries are not used. They fail at random over rounding (sampling), are wrong for
leaves of both arms (`posterior`), or have no answer for a label that was never seen. A leaf's cumulative distributions
are taken at their knots, which also mends steps that rounding left in them.

Fitting is deterministic, touches no generator of random numbers, and leaves warnings and Ctrl-C as they were.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from enum import Enum
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from pycrorm_async.errors import CallerError, MissingExtra, NotEnoughExperience
from pycrorm_async.learning.marginals import Floats, Linear
from pycrorm_async.learning.policy import ARMS, GRASPS, Leaf, Policy

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
    """The policy that does again what went well, and what lies between; some 0.5 s for 8,000 rows, in which it waits.

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
    """The leaves of the tree over these columns.

    Fitted beside the calling thread, for in the main one pyjpt turns Ctrl-C off; in one process, without a pool of
    forked ones. What it does to the filters of warnings when it is imported is undone.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        jpt = _pyjpt()
        symbols = {name: jpt.SymbolicType(name, [each.name for each in members]) for name, members in SYMBOLS.items()}
        variables = [
            jpt.SymbolicVariable(name, symbols[name]) if name in symbols else jpt.NumericVariable(name)
            for name in columns
        ]
        tree = jpt.JPT(variables, min_samples_leaf=min_samples_leaf)
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="pycrorm-learn") as beside:
            beside.submit(tree.learn, jpt.DataFrame(columns), multicore=0).result()
    rows = sum(leaf.samples for leaf in tree.leaves.values())
    return [_read(leaf, leaf.samples / rows) for _, leaf in sorted(tree.leaves.items())]


def _read(leaf: Any, weight: float) -> Leaf:
    """A leaf of pyjpt's tree as one of ours."""
    found = {variable.name: distribution for variable, distribution in leaf.distributions.items()}
    arms, grasps = (tuple(float(share) for share in found[name].probabilities) for name in SYMBOLS)
    x, y = (_linear(found[name].cdf) for name in PLACE)
    return Leaf(weight, arms, grasps, x, y, _linear(found[HEIGHT].cdf) if HEIGHT in found else None)


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
        from jpt.trees import JPT
        from jpt.variables import NumericVariable, SymbolicVariable
        from pandas import DataFrame
    except ImportError:
        raise MissingExtra("learning needs pyjpt: pip install 'pycrorm-async[learning]'") from None
    return SimpleNamespace(
        DataFrame=DataFrame,
        JPT=JPT,
        NumericVariable=NumericVariable,
        SymbolicType=SymbolicType,
        SymbolicVariable=SymbolicVariable,
    )
