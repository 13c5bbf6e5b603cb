"""Find the cases most like a cue: the cue, the activation of cases, and the exact search.

**Search.** Find the cases most like a cue. The search is exact: it finds the cases that comparing every one would find.

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

**Activation.** Compute the base-level activation of ACT-R, which grows with how recently and how often a way of acting
was used.

A way is a type with all its texts but the outcome: the same object, arm and grasp. Its activation at time t is

    B = ln(sum over its uses j of (t - t_j)^-0.5), in seconds

computed as by Petrov (2006): exactly for the three newest uses, and for the older ones as if they were spread evenly
between the oldest and the third. The error was at most 0.15 in a million cases, 0.02 in half of them.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from numbers import Real
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.query.text import nearest
from pycrorm_async.recall.blocks import WORDS_MAX, CaseLibrary, Group
from pycrorm_async.recall.columns import OUTCOME, TEXT_MAX, Mask, is_angle, joined

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
        return sum(self.words) + len(self.tolerances) or 1.0

    @property
    def reachable(self) -> float:
        """The highest weighted similarity that a case can have: without words that no case has."""
        seen = (weight for pair, weight in zip(self.pairs, self.words, strict=True) if pair not in self.never_seen)
        return sum(seen) + len(self.tolerances) or float(not self.pairs)


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
        seen = [sum(int((group.having(*each) & ended).sum()) for group, ended in groups) for each in cue.has]
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
    places, similarity = _similarity(group, rows, cue, weights, lowest)
    steps = np.rint(similarity / weights.total * _STEPS).astype(np.int64)
    for condition in _conditions(group, rows, cue):
        steps[~condition[places]] = -1
    chosen = np.flatnonzero(steps == bound)[: cue.k]  # the newest of equal ones come first
    if chosen.size < cue.k:
        chosen = np.flatnonzero(steps >= lowest)
        if chosen.size > cue.k:
            scores = steps[chosen]
            limit = np.partition(scores, scores.size - cue.k)[scores.size - cue.k]
            above, equal = chosen[scores > limit], chosen[scores == limit]
            chosen = np.concatenate([above, equal[: cue.k - above.size]])
    scores, places = steps[chosen], np.arange(rows.start, rows.stop)[places][chosen]
    columns = scores.tolist(), group.started_us[places].tolist(), group.nodes[places].tolist(), places.tolist()
    return [Match(score, started, node, group, row) for score, started, node, row in zip(*columns, strict=True)]


def _similarity(
    group: Group, rows: slice, cue: Cue, weights: Weights, lowest: int
) -> tuple[slice | NDArray[np.int64], NDArray[np.float64]]:
    """Return the weighted similarity of those of the rows that can have a score of `lowest`, and their places.

    The terms are added in the order of the cue. The numbers are compared only of rows whose words leave that score
    possible, if these are fewer than half.
    """
    if not (cue.has or cue.near):
        return slice(None), np.ones(rows.stop - rows.start)
    total = np.zeros(rows.stop - rows.start)
    for pair, weight in zip(cue.has, weights.words, strict=True):
        column = group.texts.get(pair[0])
        if column is not None and pair[1] in column.words.codes_by_word:
            total += column.having(pair[1], rows) * weight
    places: slice | NDArray[np.int64] = slice(None)
    needed = (lowest - 1) / _STEPS * weights.total
    left = sum(each.feature in group.numbers for each in cue.near)
    for wanted, tolerance in zip(cue.near, weights.tolerances, strict=True):
        numbers = group.numbers.get(wanted.feature)
        if numbers is None:
            continue
        possible = np.flatnonzero(total >= needed - left)
        if 2 * possible.size < total.size:
            places, total = possible if isinstance(places, slice) else places[possible], total[possible]
        total += _nearness(numbers.values[rows][places], wanted, tolerance)
        left -= 1
    return places, total


def _nearness(values: NDArray[np.floating], wanted: Wanted, tolerance: float) -> NDArray[np.float64]:
    near = values.astype(np.float64)
    near -= wanted.value
    np.abs(near, out=near)
    if is_angle(wanted.feature):
        np.fmod(near, math.tau, out=near)
        near = np.minimum(near, math.tau - near)
    near /= -tolerance
    near += 1
    return np.fmax(near, 0.0, out=near)  # 0 where the case has no number


def _reachable(group: Group, cue: Cue, weights: Weights) -> float:
    """Return the highest weighted similarity that the words and numbers of a group allow."""
    if not (cue.has or cue.near):
        return 1.0
    numbers = sum(wanted.feature in group.numbers for wanted in cue.near)
    return numbers + sum(
        weight
        for (feature, word), weight in zip(cue.has, weights.words, strict=True)
        if feature in group.texts and word in group.texts[feature].words.codes_by_word
    )


def _conditions(group: Group, rows: slice, cue: Cue) -> Iterator[Mask]:
    """Yield a mask of the rows that fulfil it for each condition, except the times of their starts."""
    for pair in cue.lacks:
        yield ~group.having(*pair, rows)
    for pair in cue.requires:
        yield group.having(*pair, rows)
    if cue.episodes is not None:
        yield np.isin(group.episodes[rows], list(cue.episodes))
    if cue.prohibit:
        yield np.isin(group.nodes[rows], list(cue.prohibit), invert=True)
    if not cue.simulated and "simulated" in group.texts:
        yield group.performed[rows]
    if cue.during_us is not None:
        yield group.started_us[rows] >= cue.during_us[0]
        yield _ended_by(group, cue.during_us[1], rows)
    if cue.as_of_us is not None:
        yield _ended_by(group, cue.as_of_us, rows)


def _ended_by(group: Group, moment_us: int, rows: slice = slice(None)) -> Mask:
    """Return a mask of the cases that had ended by a moment; False for a lost one, which has no duration."""
    durations = group.numbers.get("duration")
    if durations is None:
        return np.zeros(group.nodes[rows].size, np.bool_)
    ended: Mask = group.started_us[rows] + durations.values[rows].astype(np.float64) * 1e6 <= moment_us
    return ended


def _bound(similarity: float, total: float) -> int:
    return round(similarity / total * _STEPS)


# === cue ======================================================================================================
#
# A cue describes the cases to recall: features that they share, as far as possible, and conditions that they fulfil.
#
# `has` and `near` make cases similar; a case without some of them has a lower score. Type, `lacks`, times, episodes and
# `prohibit` are conditions: a case that does not fulfil them is left out.

FEATURES_MAX = 256
"""Bounds the words and numbers of a cue."""
K_MAX = 10_000
"""Bounds the cases of one answer."""
_LISTED = 12
"""Bounds the names that an error lists."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """A wanted number; tolerance None means the standard deviation of this number among the cases of the type."""

    feature: str
    value: float
    tolerance: float | None = None


@dataclass(frozen=True, kw_only=True)
class Cue:
    """The cases to recall. Times are µs since 1970, nodes and episodes as in this database.

    Attributes:
        type: a dtype; None for cases of every type.
        has: pairs of feature and word. A feature with several values may occur several times.
        near: the wanted numbers.
        lacks, requires: pairs of feature and word that a case must not have, and that it must have.
        before_us, after_us: a case starts before the one, and at or after the other.
        during_us: start and end of an interval in which a case starts and ends.
        as_of_us: a case has ended by then; word frequencies count only cases that had ended by then.
        episodes: numbers of episodes; None for all.
        prohibit: ids of nodes whose cases are left out.
        simulated: whether simulations are answers too.
        k: the number of cases of the answer.
        minimum: the lowest score of an answer, 0 to 1. Cases with score 0 are left out.
        left_out: the number of features of the original case that the cue does not have, for a cue made from a case.
    """

    type: str | None = None
    has: tuple[tuple[str, str], ...] = ()
    near: tuple[Wanted, ...] = ()
    lacks: tuple[tuple[str, str], ...] = ()
    requires: tuple[tuple[str, str], ...] = ()
    before_us: int | None = None
    after_us: int | None = None
    during_us: tuple[int, int] | None = None
    as_of_us: int | None = None
    episodes: frozenset[int] | None = None
    prohibit: frozenset[int] = frozenset()
    simulated: bool = False
    k: int = 20
    minimum: float = 0.0
    left_out: int = 0

    def __str__(self) -> str:
        """Return the cue as `pycrorm recall` takes it."""
        numbers = [
            f"{each.feature}~{each.value:g}{f'±{each.tolerance:g}' if each.tolerance else ''}" for each in self.near
        ]
        pairs = [f"{name}={value}" for name, value in self.has]
        absent = [f"not:{name}={value}" for name, value in self.lacks]
        return " ".join([*([self.type] if self.type else []), *pairs, *numbers, *absent])


def symbols_of(pairs: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Return the pairs of feature and word of `has` or `lacks`; a list has several words. Raises `CallerError`."""
    return tuple(dict.fromkeys(_symbols(pairs)))


def numbers_of(near: Mapping[str, Any]) -> tuple[Wanted, ...]:
    """Return the wanted numbers of `near`: numbers, or pairs of number and tolerance. Raises `CallerError`."""
    return tuple(_wanted(feature, value) for feature, value in _mapping(near).items())


def word(value: object) -> str:
    """Return a value as cases have it: the name of an enum's member or of a class, or its text.

    >>> word(Arms.LEFT), word(True), word("MILK")
    ('LEFT', 'True', 'MILK')
    """
    match value:
        case Enum():
            return value.name
        case type():
            return value.__name__
    return str(value)


def dtype_of(designator: str | type | None) -> str | None:
    """Return the type of a designator class, of a mapped class, or by its name.

    >>> dtype_of(PickUpAction), dtype_of("PickUpAction")
    ('PickUpAction', 'PickUpAction')
    """
    if designator is None or isinstance(designator, str):
        return designator
    dtype = getattr(designator, "__dtype__", None)
    if isinstance(dtype, str):
        return dtype
    if not isinstance(designator, type):
        raise CallerError(f"{shortened(designator)} is not a type: give a designator class, or the name of one")
    return word(designator).removeprefix("ORM")


def closest(name: str, valid: Iterable[str]) -> str:
    """Return the end of an error's line: the names most like this one, or else some of the valid ones.

    >>> closest("graps", ["arm", "grasp", "height"])
    '; did you mean grasp?'
    """
    names = sorted(valid)
    question = nearest(name[:TEXT_MAX], names)
    listed = f"; there are {', '.join(names[:_LISTED])}{', ...' if len(names) > _LISTED else ''}" if names else ""
    return question or listed


def never_seen(type_: str, library: CaseLibrary) -> str:
    """Return the line about a type without a case: the types most like it, or else some of those with cases."""
    return f"never seen: type {type_}{closest(type_, library.types)}"


# --- invalid cues ---------------------------------------------------------------------------------------------


def check_cue(cue: Cue, library: CaseLibrary) -> None:
    """Raise `CallerError` for a cue that no memory, or not this one, can answer; the message is one line.

    A type or a word that never occurred is no error: `Answer.never_seen` lists it.
    """
    if cue.type is None and not (cue.has or cue.near or cue.lacks):
        raise CallerError("the cue is empty: give a type, or features in `has`, `near` or `lacks`")
    k: object = cue.k
    minimum: object = cue.minimum
    if not isinstance(k, int) or not 1 <= k <= K_MAX:
        raise CallerError(f"k must be 1 to {K_MAX:,}, got {shortened(k)}")
    if not isinstance(minimum, int | float) or not 0 <= minimum <= 1:
        raise CallerError(f"minimum must be a score from 0 to 1, got {shortened(minimum)}")
    if len(cue.has) + len(cue.near) + len(cue.lacks) > FEATURES_MAX:
        count = len(cue.has) + len(cue.near) + len(cue.lacks)
        raise CallerError(f"the cue has {count:,} features, and at most {FEATURES_MAX} are compared")
    contradiction = next((each for each in cue.lacks if each in cue.has), None)
    if contradiction is not None:
        raise CallerError(f"{'='.join(contradiction)} is both in `has` and in `lacks`, so no case can be an answer")
    if cue.before_us is not None and cue.after_us is not None and cue.before_us <= cue.after_us:
        raise CallerError("`before` is not later than `after`, so no case can be an answer")
    if cue.during_us is not None and cue.during_us[1] < cue.during_us[0]:
        raise CallerError("`during` ends before it starts, so no case can be an answer")
    if library.size(cue.type):
        _check_features(cue, library)


def _check_features(cue: Cue, library: CaseLibrary) -> None:
    texts, numbers = library.texts(cue.type), library.numbers(cue.type)
    owner = f"no case of {cue.type}" if cue.type else "no case"
    for feature, value in (*cue.has, *cue.lacks, *cue.requires):
        if feature in texts:
            continue
        if feature in library.left_out:
            raise CallerError(f"{feature} has more than {WORDS_MAX:,} different values, so it is not compared")
        if feature in numbers:
            raise CallerError(f"{feature} is a number: ask for it with `near` (FEATURE~NUMBER), got the text {value!r}")
        raise CallerError(f"{owner} has a feature {shortened(feature)}{closest(feature, texts)}")
    for each in cue.near:
        if each.feature in numbers:
            continue
        if each.feature in texts:
            raise CallerError(
                f"{each.feature} is a text: ask for it with `has` (FEATURE=TEXT), got the number {each.value:g}"
            )
        raise CallerError(f"{owner} has a number {shortened(each.feature)}{closest(each.feature, numbers)}")


def _symbols(pairs: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for feature, value in _mapping(pairs).items():
        for each in value if isinstance(value, list | tuple | set | frozenset) else [value]:
            if isinstance(each, Real) and not isinstance(each, bool | Enum):
                raise CallerError(f"{feature} is given as the number {each}: ask for numbers with `near`")
            if each is None:
                raise CallerError(
                    f"{feature} is given as None: leave it out, or give the values that it must not have in `lacks`"
                )
            symbol = word(each)
            if len(symbol) > TEXT_MAX:
                raise CallerError(f"{feature} is a text of {len(symbol):,} characters; cases have at most {TEXT_MAX}")
            if not symbol:
                raise CallerError(f"{feature} is an empty text, which no case has")
            yield feature, symbol


def _mapping(features: object) -> Mapping[str, Any]:
    if isinstance(features, Mapping):
        return features
    raise CallerError(f"features are given as {shortened(features)}: give a dictionary, as in {{'arm': 'LEFT'}}")


def _wanted(feature: str, value: Any) -> Wanted:
    pair = value if isinstance(value, tuple | list) else (value,)
    if len(pair) not in (1, 2):
        raise CallerError(f"{feature} is given as {len(pair)} values: give a number, or a number and its tolerance")
    wanted, *tolerances = (_number(feature, each) for each in pair)
    if tolerances and tolerances[0] <= 0:
        raise CallerError(f"the tolerance of {feature} must be greater than 0, got {tolerances[0]:g}")
    return Wanted(feature, wanted, *tolerances)


def _number(feature: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise CallerError(f"{feature} is given as {shortened(value)}, which is not a number: ask for texts with `has`")
    number = float(value)
    if not math.isfinite(number):
        raise CallerError(f"{feature} must be a finite number, got {number}")
    return number


def shortened(value: object) -> str:
    """Return a value as it is written in an error's line."""
    text = repr(value)
    return text if len(text) <= TEXT_MAX else f"{text[:40]}... ({len(text):,} characters)"


# === activation ===============================================================================================

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
    """The cases of each way whose activation is below a threshold. Cases with equal values have a way in common.

    Attributes:
        cases, ways: their numbers.
        nodes: the ids of the cases' nodes, ascending.
    """

    cases: int
    ways: int
    nodes: NDArray[np.int64]


def forgotten(library: CaseLibrary, *, threshold: float, now_us: int) -> Forgotten:
    """Return the cases of the ways whose activation is below the threshold. Nothing is deleted."""
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
    totals[long] += _spread_evenly(sizes[long] - _EXACT, third, oldest)
    return _Ways(nodes[by_way], sizes, np.log(totals))


def _numbers_of_ways(groups: Sequence[Group], library: CaseLibrary) -> NDArray[np.int64]:
    """Return a number for each case, the same for all cases of a way."""
    sizes = [*map(len, groups)]
    ways, count = np.zeros(sum(sizes), np.int64), 1
    names = {name for group in groups for name in group.texts}
    for name in sorted(names - {*OUTCOME, "simulated"} - library.left_out):
        if library.words(name).has_tuples:
            continue
        column = joined([group.texts.get(name) for group in groups], sizes, library.words(name))
        different = len(column.words) + 1
        if count > _NUMBERS_MAX // different:
            kept, numbers = np.unique(ways, return_inverse=True)
            ways, count = numbers.astype(np.int64), int(kept.size)
        ways *= different
        ways += column.values
        count *= different
    return ways


def _spread_evenly(
    counts: NDArray[np.int64], third_s: NDArray[np.float64], oldest_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sum over the older uses of each way; if all have the same age, that of one times their number."""
    spread = oldest_s - third_s
    power = 1 - _DECAY
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (oldest_s**power - third_s**power) / (power * spread)
    means: NDArray[np.float64] = np.where(spread > 1e-9 * oldest_s, mean, third_s**-_DECAY)
    return means * counts
