"""Find the cases most like a cue. The search is exact: it finds the cases that comparing every one would find.

The score of a case is the sum of weight times similarity over the features of the cue, divided by the sum of weights.

- A word is there or not: similarity 1 or 0. Its weight is ln((N + 1) / (n + 1)) + 0.1, where n of N cases of the type
  have it, so rare words weigh more, but at most `WEIGHT_MAX`, so that a word which no case has cannot hide a case that
  matches all else.
- A number has similarity 1 at the wanted value and 0 at its tolerance and beyond, linear between, and weight 1.

Cases of equal score are ordered by their start, the newest first, then by their node. Scores are compared in steps of
10^-9, because sums of the same weights in another order may differ in the last bit.

Theory of operation. Groups are visited by their newest case, the newest group first. A group has a best score that its
words and numbers allow. The search skips a group whose best score is below that of the k-th case found so far, or equal
to it where the group is older; it ends when all further groups are such. Without a number in the cue, a common cue ends
in the first group.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.recall.blocks import Group
from pycrorm_async.recall.case import is_angle
from pycrorm_async.recall.columns import Mask
from pycrorm_async.recall.cue import Cue, Wanted
from pycrorm_async.recall.library import CaseLibrary

WEIGHT_MAX: Final = 3.0
"""Bounds the weight of a word; it is that of a word which one of twenty cases has."""

_STEPS: Final = 1e9
"""The steps from score 0 to score 1."""
_FIRST_ROWS: Final = 4_096
"""The newest rows of a group, which are compared first, because a common cue ends in them."""


class Weights(NamedTuple):
    """The weights of a cue's features in one library.

    Attributes:
        pairs, words: the pairs in `has`, and the weight of each.
        cases: the cases among which words were counted.
        tolerances: of each number in `near`.
        never_seen: the pairs of `has` that no case has.
    """

    pairs: tuple[tuple[str, str], ...]
    words: tuple[float, ...]
    cases: int
    tolerances: tuple[float, ...]
    never_seen: tuple[tuple[str, str], ...]

    @property
    def total(self) -> float:
        """The sum of all weights; 1 for a cue of conditions only, which every case fulfils alike."""
        total = 0.0
        for weight in self.words:
            total += weight
        return total + len(self.tolerances) or 1.0

    @property
    def reachable(self) -> float:
        """The highest weighted similarity that a case can have: without words that no case has."""
        total, unseen = 0.0, set(self.never_seen)
        for pair, weight in zip(self.pairs, self.words, strict=True):
            total += 0.0 if pair in unseen else weight
        for _ in self.tolerances:
            total += 1
        return total or float(not self.pairs)


class Match(NamedTuple):
    """A case that is like the cue, by its group and row; ordered as an answer is."""

    steps: int
    started_us: int
    node: int
    group: Group
    row: int

    @property
    def score(self) -> float:
        """Its score from 0 to 1."""
        return self.steps / _STEPS


def weights_of(cue: Cue, library: CaseLibrary) -> Weights:
    """Return the weight of each feature of the cue, counted within its type."""
    cases, seen = library.size(cue.type), []
    if cue.as_of_us is None:
        seen = [library.seen(cue.type, feature, value) for feature, value in cue.has]
    else:
        groups = [(group, _ended_by(group, cue.as_of_us)) for group in library.groups(cue.type)]
        cases = sum(int(ended.sum()) for _, ended in groups)
        seen = [
            sum(int((_having(group, each, slice(None)) & ended).sum()) for group, ended in groups) for each in cue.has
        ]
    words = tuple(min(WEIGHT_MAX, math.log((cases + 1) / (count + 1)) + 0.1) for count in seen)
    tolerances = tuple(each.tolerance or library.tolerance(cue.type, each.feature) for each in cue.near)
    never_seen = tuple(pair for pair, count in zip(cue.has, seen, strict=True) if count == 0)
    return Weights(cue.has, words, cases, tolerances, never_seen)


def search(cue: Cue, library: CaseLibrary, weights: Weights) -> list[Match]:
    """Return the `k` cases most like the cue, the best first."""
    lowest = max(round(cue.minimum * _STEPS), 1 if cue.has or cue.near else 0)
    limit = _bound(weights.reachable, weights.total)
    best: list[Match] = []
    for group in library.groups(cue.type):
        newest = int(group.started_us[0]), int(group.nodes[0])
        if len(best) == cue.k and (limit, *newest) <= best[-1][:3]:
            break  # the groups after this one are older still
        bound = _bound(_reachable(group, cue, weights), weights.total)
        if bound < lowest or (len(best) == cue.k and (bound, *newest) <= best[-1][:3]):
            continue
        for rows in _parts(group, cue):
            last = best[-1] if len(best) == cue.k else None
            if last is not None and (bound, int(group.started_us[rows.start])) < last[:2]:
                break
            matches = _matches(group, rows, cue, weights, max(lowest, last.steps if last is not None else 0), bound)
            if best:
                best = heapq.nlargest(cue.k, [*best, *matches], key=_order)
            else:
                best = sorted(matches, key=_order, reverse=True)
    return best


def _order(match: Match) -> tuple[int, int, int]:
    return match[:3]


def _parts(group: Group, cue: Cue) -> Iterator[slice]:
    """Yield the rows of a group that started in time: first a few, then the others."""
    first = 0 if cue.before_us is None else int(np.searchsorted(-group.started_us, -cue.before_us, side="right"))
    last = len(group) if cue.after_us is None else int(np.searchsorted(-group.started_us, -cue.after_us, side="right"))
    middle = min(last, first + _FIRST_ROWS)
    return (rows for rows in (slice(first, middle), slice(middle, last)) if rows.start < rows.stop)


def _matches(group: Group, rows: slice, cue: Cue, weights: Weights, lowest: int, bound: int) -> list[Match]:
    """Return the best `k` cases of these rows from a score on; none has a score above `bound`."""
    steps = np.rint(_similarity(group, rows, cue, weights) / weights.total * _STEPS).astype(np.int64)
    for condition in _conditions(group, rows, cue):
        steps[~condition] = -1
    chosen = np.flatnonzero(steps == bound)[: cue.k]  # the newest of equal ones come first
    if chosen.size < cue.k:
        chosen = np.flatnonzero(steps >= lowest)
        if chosen.size > cue.k:
            scores = steps[chosen]
            limit = np.partition(scores, scores.size - cue.k)[scores.size - cue.k]
            above, equal = chosen[scores > limit], chosen[scores == limit]
            chosen = np.concatenate([above, equal[: cue.k - above.size]])
    places = rows.start + chosen
    columns = steps[chosen].tolist(), group.started_us[places].tolist(), group.nodes[places].tolist(), places.tolist()
    return [Match(score, started, node, group, row) for score, started, node, row in zip(*columns, strict=True)]


def _similarity(group: Group, rows: slice, cue: Cue, weights: Weights) -> NDArray[np.float64]:
    """Return the weighted similarity of each row; the terms are added in the order of the cue."""
    if not (cue.has or cue.near):
        return np.ones(rows.stop - rows.start)
    total = np.zeros(rows.stop - rows.start)
    for pair, weight in zip(cue.has, weights.words, strict=True):
        column = group.texts.get(pair[0])
        if column is not None and column.words.code(pair[1]):
            total += column.equal_to(pair[1], rows) * weight
    for wanted, tolerance in zip(cue.near, weights.tolerances, strict=True):
        numbers = group.numbers.get(wanted.feature)
        if numbers is not None:
            total += _nearness(numbers.values[rows], wanted, tolerance)
    return total


def _nearness(values: NDArray[np.floating], wanted: Wanted, tolerance: float) -> NDArray[np.float64]:
    distances = np.abs(values.astype(np.float64) - wanted.value)
    if is_angle(wanted.feature):
        distances = np.fmod(distances, math.tau)
        distances = np.minimum(distances, math.tau - distances)
    return np.nan_to_num(np.maximum(1 - distances / tolerance, 0.0), copy=False)


def _reachable(group: Group, cue: Cue, weights: Weights) -> float:
    """Return the highest weighted similarity that the words and numbers of a group allow."""
    if not (cue.has or cue.near):
        return 1.0
    total = 0.0
    for pair, weight in zip(cue.has, weights.words, strict=True):
        column = group.texts.get(pair[0])
        if column is not None and column.words.code(pair[1]):
            total += weight
    for wanted in cue.near:
        total += wanted.feature in group.numbers
    return total


def _conditions(group: Group, rows: slice, cue: Cue) -> Iterator[Mask]:
    """Yield a mask of the rows that fulfil it for each condition, except the times of their starts."""
    for pair in cue.lacks:
        yield ~_having(group, pair, rows)
    for pair in cue.requires:
        yield _having(group, pair, rows)
    if cue.episodes is not None:
        yield np.isin(group.episodes[rows], list(cue.episodes))
    if cue.prohibit:
        yield np.isin(group.nodes[rows], list(cue.prohibit), invert=True)
    if not cue.simulated and "simulated" in group.texts:
        yield ~group.texts["simulated"].equal_to("yes", rows)
    if cue.during_us is not None:
        yield group.started_us[rows] >= cue.during_us[0]
        yield _ended_by(group, cue.during_us[1], rows)
    if cue.as_of_us is not None:
        yield _ended_by(group, cue.as_of_us, rows)


def _having(group: Group, pair: tuple[str, str], rows: slice) -> Mask:
    column = group.texts.get(pair[0])
    return (
        np.zeros(len(range(*rows.indices(len(group)))), np.bool_) if column is None else column.equal_to(pair[1], rows)
    )


def _ended_by(group: Group, moment_us: int, rows: slice = slice(None)) -> Mask:
    """Return a mask of the cases that had ended by a moment; False for a lost one, which has no duration."""
    durations = group.numbers.get("duration")
    if durations is None:
        return np.zeros(group.nodes[rows].size, np.bool_)
    ended: Mask = group.started_us[rows] + durations.values[rows].astype(np.float64) * 1e6 <= moment_us
    return ended


def _bound(similarity: float, total: float) -> int:
    return round(similarity / total * _STEPS)
