"""Compute the base-level activation of ACT-R, which grows with how recently and how often a way of acting was used.

A way is a type with all its texts but the outcome: the same object, arm and grasp. Its activation at time t is

    B = ln(sum over its uses j of (t - t_j)^-0.5), in seconds

computed as by Petrov (2006): exactly for the three newest uses, and for the older ones as if they were spread evenly
between the oldest and the third. The error was at most 0.15 in a million cases, 0.02 in half of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.recall.blocks import Group
from pycrorm_async.recall.case import OUTCOME
from pycrorm_async.recall.columns import Symbols, joined_words
from pycrorm_async.recall.library import CaseLibrary

_DECAY: Final = 0.5
"""The decay of ACT-R: almost all of its models leave it at this value."""
_EXACT: Final = 3
"""The number of newest uses that are counted exactly."""
_NUMBERS_MAX: Final = 2**62
"""Bounds the numbers of ways while the words of more features are added."""
_AGE_S_MIN: Final = 1e-3
"""The youngest age in s that counts, so that a use at this very moment does not outweigh all others."""


_NO_NODES: Final = np.zeros(0, np.int64)


class Forgotten(NamedTuple):
    """The cases whose ways have an activation below a threshold.

    Attributes:
        cases, ways: their numbers.
        nodes: the ids of the cases' nodes, ascending.
    """

    cases: int
    ways: int
    nodes: NDArray[np.int64]


def activation(ages_s: NDArray[np.float64]) -> float:
    """Return the activation of a way from the ages of its uses in s, the youngest first.

    >>> round(activation(np.array([1.0, 4.0])), 3)
    0.405
    """
    ages = np.maximum(ages_s, _AGE_S_MIN)
    total = float(np.sum(ages[:_EXACT] ** -_DECAY))
    if ages.size > _EXACT:
        total += _spread_evenly(ages.size - _EXACT, float(ages[_EXACT - 1]), float(ages[-1]))
    return float(np.log(total))


def forgotten(library: CaseLibrary, *, threshold: float, now_us: int) -> Forgotten:
    """Return the cases whose ways have an activation below the threshold. Nothing is deleted."""
    nodes, count = [], 0
    for name in library.types:
        ways = _ways_of(name, library, now_us)
        below = ways.activations < threshold
        nodes.append(ways.nodes[np.repeat(below, ways.sizes)])
        count += int(below.sum())
    hidden = np.sort(np.concatenate(nodes or [_NO_NODES]))
    return Forgotten(int(hidden.size), count, hidden)


class _Ways(NamedTuple):
    """The ways of one type.

    Attributes:
        nodes: the cases of the first way, of the second and so on.
        sizes: the number of the cases of each way.
        activations: of each way.
    """

    nodes: NDArray[np.int64]
    sizes: NDArray[np.int64]
    activations: NDArray[np.float64]


def _ways_of(name: str, library: CaseLibrary, now_us: int) -> _Ways:
    groups = library.groups(name)
    started_us = np.concatenate([each.started_us for each in groups])
    nodes = np.concatenate([each.nodes for each in groups])
    ways = _numbers_of_ways(groups, library)
    if (np.diff(started_us) > 0).any():  # cases of one block started between those of another
        newest_first = np.argsort(-started_us, kind="stable")
        started_us, nodes, ways = started_us[newest_first], nodes[newest_first], ways[newest_first]
    by_way = np.argsort(ways, kind="stable")
    ways = ways[by_way]
    firsts = np.flatnonzero(np.r_[True, ways[1:] != ways[:-1]])
    sizes = np.diff(firsts, append=ways.size)
    ages: NDArray[np.float64] = np.maximum((now_us - started_us[by_way]) / 1e6, _AGE_S_MIN)
    totals = np.zeros(firsts.size)
    for use in range(_EXACT):
        having = sizes > use
        totals[having] += ages[firsts[having] + use] ** -_DECAY
    long = sizes > _EXACT
    third, oldest = ages[firsts[long] + _EXACT - 1], ages[firsts[long] + sizes[long] - 1]
    totals[long] += _spread_evenly_all(sizes[long] - _EXACT, third, oldest)
    return _Ways(nodes[by_way], sizes, np.log(totals))


def _numbers_of_ways(groups: Sequence[Group], library: CaseLibrary) -> NDArray[np.int64]:
    """Return a number for each case, the same for all cases of a way."""
    sizes = [*map(len, groups)]
    ways, count = np.zeros(sum(sizes), np.int64), 1
    names = {name for group in groups for name in group.texts}
    for name in sorted(names - {*OUTCOME, "simulated"} - library.left_out):
        column = joined_words([group.texts.get(name) for group in groups], sizes, library.words(name))
        if not isinstance(column, Symbols):
            continue
        different = len(column.words) + 1
        if count > _NUMBERS_MAX // different:
            ways, count = _renumbered(ways)
        ways *= different
        ways += column.codes
        count *= different
    return ways


def _renumbered(ways: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Return the ways numbered from 0 on, and the number of different ones."""
    different, numbers = np.unique(ways, return_inverse=True)
    return numbers.astype(np.int64), int(different.size)


def _spread_evenly(count: int, third_s: float, oldest_s: float) -> float:
    return float(_spread_evenly_all(np.array([count]), np.array([third_s]), np.array([oldest_s]))[0])


def _spread_evenly_all(
    counts: NDArray[np.int64], third_s: NDArray[np.float64], oldest_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sum over the older uses of each way; if all have the same age, that of one times their number."""
    spread = oldest_s - third_s
    power = 1 - _DECAY
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (oldest_s**power - third_s**power) / (power * spread)
    means: NDArray[np.float64] = np.where(spread > 1e-9 * oldest_s, mean, third_s**-_DECAY)
    return means * counts
