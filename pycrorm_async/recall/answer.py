"""The answer to a cue: the cases most like it, the reasons for each, and their success rate.

>>> answer = await memory.recall(type=PickUpAction, has={"object_type": "MILK"}, near={"height": 0.93})
>>> answer.success
Rate(share=0.55, low=0.34, high=0.74, successes=11, tries=20)
>>> answer.reasons
[('IKError', 9)]
>>> print(answer[0].why())
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Final, NamedTuple, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import SEQUENCE_MAX, row_id_min
from pycrorm_async.query.frames import TRIED
from pycrorm_async.query.notebook_html import cases_html
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.query.success import interval_95
from pycrorm_async.recall.blocks import EPISODE_SHIFT, CaseLibrary, Group
from pycrorm_async.recall.columns import Case, Mask, is_angle
from pycrorm_async.recall.search import Cue, Match, Weights, never_seen, search, weights_of
from pycrorm_async.visible_text import visible


class Rate(NamedTuple):
    """The number of successes among some cases, with the 95 % Wilson interval of their share, from `low` to `high`."""

    share: float
    low: float
    high: float
    successes: int
    tries: int

    def __str__(self) -> str:
        """Return it as `11 of 20 succeeded (34-74 %)`."""
        return f"{self.successes} of {self.tries} succeeded ({100 * self.low:.0f}-{100 * self.high:.0f} %)"


class Compared(NamedTuple):
    """One feature of a cue beside that of a case.

    Attributes:
        wanted, found: words or numbers; `found` is None where the case does not have the feature.
        difference: the distance of two numbers; None for words, and where the case has no number.
        tolerance: the distance from which on numbers are not alike; None for words.
        similarity, weight: 0 to 1, and its share in the score.
    """

    feature: str
    wanted: str | float
    found: str | tuple[str, ...] | float | None
    difference: float | None
    tolerance: float | None
    similarity: float
    weight: float

    def __str__(self) -> str:
        """Return it as `height: wanted 0.93, was 0.9 (0.03 off, tolerance 0.1)`."""
        actual = f"{'was ' if self.found is not None else ''}{value_text(self.found)}"
        off = "" if self.difference is None else f" ({self.difference:.3g} off, tolerance {self.tolerance:.3g})"
        return f"{self.feature}: wanted {value_text(self.wanted)}, {actual}{off}"


class Typical(NamedTuple):
    """The summary of one feature over the cases of an answer, weighted by their scores.

    Attributes:
        value: the mean of numbers, the commonest word.
        spread: the standard deviation of numbers; None for words.
        share: the part of the cases, by score, that have a number or the commonest word.
    """

    value: float | str
    spread: float | None
    share: float


class Surroundings(Protocol):
    """Protocol that finds the neighbours of a case, the state of the memory when it started, and failures' outcomes."""

    async def next(self, case: Case) -> Case | None: ...
    async def previous(self, case: Case) -> Case | None: ...
    async def parent(self, case: Case) -> Case | None: ...
    async def moment(self, case: Case) -> Moment: ...
    async def outcomes(self, nodes: Sequence[int]) -> Mapping[int, str]: ...


@dataclass(frozen=True)
class RecalledCase:
    """One case of an answer. Its values are read from the columns at the first access.

    Attributes:
        match: its place in the columns, with its score.
        cue, weights: the cue with which it is compared, and the weights of its features.
        memory: finds its neighbours and its moment; None for an answer without a memory.
    """

    match: Match
    cue: Cue
    weights: Weights
    memory: Surroundings | None = field(default=None, repr=False)

    @property
    def score(self) -> float:
        """Its likeness to the cue, 0 to 1."""
        return self.match.score

    @cached_property
    def case(self) -> Case:
        """The action: its situation, its outcome, its place in the memory."""
        return self.match.group.case(self.match.row)

    @property
    def node(self) -> int:
        """The id of its task-tree node."""
        return self.match.node

    @property
    def symbols(self) -> Mapping[str, str | tuple[str, ...]]:
        """The texts of its situation."""
        return self.case.symbols

    @property
    def numbers(self) -> Mapping[str, float]:
        """The numbers of its situation."""
        return self.case.numbers

    @property
    def status(self) -> str:
        """The name of the status with which it ended."""
        return self.case.status

    @cached_property
    def compared(self) -> tuple[Compared, ...]:
        """Each feature of the cue beside that of the case."""
        return compare(self.cue, self.case, self.weights)

    @property
    def matched(self) -> tuple[Compared, ...]:
        """The features that are alike, at least in part."""
        return tuple(each for each in self.compared if each.similarity > 0)

    @property
    def missed(self) -> tuple[Compared, ...]:
        """The features that differ, that are further off than their tolerance, or that the case does not have."""
        return tuple(each for each in self.compared if each.similarity == 0)

    def difference(self) -> str:
        """Return the features that are not quite alike, with the values of the case, as text."""
        return "; ".join(
            f"{each.feature} {value_text(each.found)}"
            + ("" if each.difference is None else f" ({each.difference:.3g} off)")
            for each in self.compared
            if each.similarity < 1
        )

    async def next(self) -> Case | None:
        """Return the action that started next under the same parent."""
        return await self._memory.next(self.case)

    async def previous(self) -> Case | None:
        """Return the action that started before it under the same parent."""
        return await self._memory.previous(self.case)

    async def parent(self) -> Case | None:
        """Return the nearest action around it; None outside any, and while that runs."""
        return await self._memory.parent(self.case)

    async def moment(self) -> Moment:
        """Return the task tree and the world as they were when it started."""
        return await self._memory.moment(self.case)

    async def outcome(self) -> str | None:
        """Return how the plan went on after it failed, as `RootFailure.outcome`; None for a case that did not fail."""
        return (await self._memory.outcomes([self.node])).get(self.node)

    @property
    def _memory(self) -> Surroundings:
        if self.memory is None:
            raise CallerError("this case was not recalled from a memory: use `memory.recall`")
        return self.memory

    def why(self) -> str:
        """Return the score and the compared features, as lines of text."""
        case = self.case
        reason = f" ({case.reason})" if case.reason else ""
        lines = [f"{case.type} in episode {case.episode}, event {case.sequence}: {case.status}{reason}"]
        lines.append(f"  score {self.score:.3f}")
        lines += [f"  alike   {each}" for each in self.matched]
        lines += [f"  differs {each}" for each in self.missed]
        return "\n".join(lines)


class Answer(Sequence[RecalledCase]):
    """The cases most like a cue, the best first.

    Attributes:
        cue: the searched cue.
        cases: each with its score; fewer than `cue.k` if the memory has fewer that share a feature with the cue.
        considered: the number of cases of the type, among which words were counted.
        never_seen: pairs of feature and word in `has` or `only` that none of them has.
        joined: the names under which the cases of the type were recorded, if it was renamed.
        notes: lines about a type that never occurred, with the nearest ones, and numbers out of the range seen.
    """

    def __init__(
        self,
        cue: Cue,
        cases: Sequence[RecalledCase],
        weights: Weights,
        joined: Sequence[str] = (),
        notes: Sequence[str] = (),
    ) -> None:
        self.cue = cue
        self.cases = tuple(cases)
        self.considered = weights.cases
        self.never_seen = weights.never_seen
        self.joined = tuple(joined)
        self.notes = tuple(notes)

    def __len__(self) -> int:
        """Return the number of cases."""
        return len(self.cases)

    @overload
    def __getitem__(self, index: int) -> RecalledCase: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[RecalledCase]: ...
    def __getitem__(self, index: int | slice) -> RecalledCase | Sequence[RecalledCase]:
        """Return a case, the most similar at 0."""
        return self.cases[index]

    @property
    def success(self) -> Rate | None:
        """The success rate of the cases; None if none of them ran to its end."""
        return success_of(each.case for each in self.cases)

    @property
    def reasons(self) -> list[tuple[str, int]]:
        """The reasons of the failures among the cases, the commonest first, with their numbers."""
        return _commonest(each.case.reason for each in self._failed() if each.case.reason)

    async def outcomes(self) -> list[tuple[str, int]]:
        """Return how plans went on after the failures among the cases, the commonest first, with their numbers.

        See `RootFailure.outcome`.
        """
        failed = self._failed()
        memory = failed[0].memory if failed else None
        return _commonest((await memory.outcomes([each.node for each in failed])).values()) if memory else []

    def _failed(self) -> list[RecalledCase]:
        return [each for each in self.cases if each.status in ("FAILED", "ERROR")]

    def typical(self, feature: str, *, status: str | None = None) -> Typical | None:
        """Summarise one feature over the cases, each weighted by its score (blending, in the terms of ACT-R).

        Args:
            feature: a name, as `height`, or `duration`.
            status: of the cases to count, as SUCCEEDED; by default all.

        Returns None if no case has the feature.
        """
        chosen = [each for each in self.cases if status in (None, each.case.status)]
        whole = math.fsum(each.score for each in chosen)
        values = ((_value_of(each.case, feature), each.score) for each in chosen)
        numbers = [(value, score) for value, score in values if isinstance(value, float)]
        if numbers:
            return _blended(numbers, whole, angle=is_angle(feature))
        words: dict[str, float] = {}
        for each in chosen:
            value = _value_of(each.case, feature)
            for word in (value,) if isinstance(value, str) else value if isinstance(value, tuple) else ():
                words[word] = words.get(word, 0.0) + each.score
        if not words:
            return None
        value, score = min(words.items(), key=lambda item: (-item[1], item[0]))
        return Typical(value, None, score / whole if whole else 0.0)

    def why(self) -> str:
        """Return the answer's summary, as lines of text."""
        head = f"{len(self)} of {self.considered:,} cases for {self.cue}"
        lines = [head, *([f"  {self.success}"] if self.success else [])]
        if self.reasons:
            lines.append(f"  reasons: {', '.join(f'{name} {count}' for name, count in self.reasons)}")
        if self.cue.left_out:
            lines.append(f"  left out: {self.cue.left_out} features of the action that weigh least")
        if self.joined:
            lines.append(f"  renamed: counts the cases of {' and '.join(self.joined)}")
        lines += [f"  never seen: {feature}={word}" for feature, word in self.never_seen]
        lines += [f"  {each}" for each in self.notes]
        return "\n".join(lines)

    __str__ = why

    def __repr__(self) -> str:
        """Return the summary in one line, for an interpreter."""
        return f"<Answer: {visible('; '.join(map(str.strip, self.why().splitlines())), kept='')}>"

    def table(self) -> tuple[tuple[str, ...], list[tuple[object, ...]]]:
        """Return the header and the rows of the table that commands and notebooks print."""
        header = ("score", "type", "episode", "event", "started", "status", "reason", "differs")
        rows: list[tuple[object, ...]] = [
            (
                each.score,
                each.case.type,
                each.case.episode,
                each.case.sequence,
                each.case.started_at.strftime("%Y-%m-%d %H:%M:%S"),
                each.case.status,
                each.case.reason,
                each.difference(),
            )
            for each in self.cases
        ]
        return header, rows

    def _repr_html_(self) -> str:
        header, rows = self.table()
        return cases_html(self.why().splitlines(), header, rows)


def answer(cue: Cue, library: CaseLibrary, memory: Surroundings | None = None) -> Answer:
    """Search the cases most like a cue, and compare each of them with it. The cue was checked by `check_cue`."""
    weights = weights_of(cue, library)
    cases = [RecalledCase(each, cue, weights, memory) for each in search(cue, library, weights)]
    unseen = tuple(pair for pair in cue.requires if library.seen(cue.type, *pair) == 0)
    weights = weights._replace(never_seen=tuple(dict.fromkeys((*weights.never_seen, *unseen))))
    joined = library.names_of(cue.type) if cue.type is not None else ()
    return Answer(cue, cases, weights, joined if {*joined} - {cue.type} else (), [*_notes(cue, library)])


def _notes(cue: Cue, library: CaseLibrary) -> Iterator[str]:
    """Yield a line for a type that never occurred, and for each number that is out of the range of its cases."""
    if cue.type is not None and not library.size(cue.type):
        yield never_seen(cue.type, library)
    for each in cue.near:
        seen = None if is_angle(each.feature) else library.range_of(cue.type, each.feature)
        if seen is not None and not seen[0] <= each.value <= seen[1]:
            yield f"out of range: {each.feature} {each.value:.4g}; seen are {seen[0]:.4g} to {seen[1]:.4g}"


def _commonest(words: Iterable[str]) -> list[tuple[str, int]]:
    return sorted(Counter(words).items(), key=lambda item: (-item[1], item[0]))


def compare(cue: Cue, case: Case, weights: Weights) -> tuple[Compared, ...]:
    """Return each feature of the cue beside that of a case."""
    whole = weights.total
    words = [
        Compared(feature, wanted, value, None, None, float(has), weight / whole)
        for (feature, wanted), weight in zip(cue.has, weights.words, strict=True)
        for value in [_value_of(case, feature)]
        for has in [wanted in value if isinstance(value, tuple) else value == wanted]
    ]
    numbers = []
    for wanted, tolerance in zip(cue.near, weights.tolerances, strict=True):
        value = _value_of(case, wanted.feature)
        difference, similarity = None, 0.0
        if isinstance(value, float):
            difference = abs(value - wanted.value)
            if is_angle(wanted.feature):
                difference = math.fmod(difference, math.tau)
                difference = min(difference, math.tau - difference)
            similarity = max(1 - difference / tolerance, 0.0)
        numbers.append(Compared(wanted.feature, wanted.value, value, difference, tolerance, similarity, 1 / whole))
    return (*words, *numbers)


def success_of(cases: Iterable[Case]) -> Rate | None:
    """Return the success rate among the cases that ran to their end; None if none did."""
    return rate_of(Counter(case.status for case in cases))


def rate_of(statuses: Mapping[str, int]) -> Rate | None:
    """Return the success rate from the number of cases with each status; None if none ran to its end."""
    tries, successes = sum(statuses.get(each.name, 0) for each in TRIED), statuses.get("SUCCEEDED", 0)
    if not tries:
        return None
    share = successes / tries
    return Rate(share, *interval_95(successes, tries), successes, tries)


def _blended(numbers: Sequence[tuple[float, float]], whole: float, *, angle: bool) -> Typical:
    weight = math.fsum(score for _, score in numbers)
    if angle:
        sine = math.fsum(score * math.sin(value) for value, score in numbers) / weight
        cosine = math.fsum(score * math.cos(value) for value, score in numbers) / weight
        length = min(1.0, math.hypot(sine, cosine))
        spread = math.sqrt(-2 * math.log(length)) if length > 0 else math.inf
        return Typical(math.atan2(sine, cosine), spread, weight / whole)
    mean = math.fsum(score * value for value, score in numbers) / weight
    variance = math.fsum(score * (value - mean) ** 2 for value, score in numbers) / weight
    return Typical(mean, math.sqrt(variance), weight / whole)


def _value_of(case: Case, feature: str) -> str | tuple[str, ...] | float | None:
    match feature:
        case "status":
            return case.status
        case "reason":
            return case.reason
        case "duration":
            return case.duration_s
    value = case.symbols.get(feature)
    return case.numbers.get(feature) if value is None else value


def value_text(value: str | tuple[str, ...] | float | None) -> str:
    """Format the value of a feature, on one line."""
    match value:
        case None:
            return "not known"
        case float():
            return f"{value:.4g}"
        case tuple():
            return ", ".join(value)
    return value


# === following ================================================================================================
#
# Find the neighbours of an action and the actions in a temporal relation with it; count which types follow which.
#
# The next action of a case is the one that started after it under the same parent. The relations are those of Allen
# between the intervals from start to end; moments that differ by less than a millisecond count as one.

_SAME_US: Final = 1_000
"""Moments nearer to each other than this, in µs, count as one: durations are kept to seven digits."""


class Relation(Enum):
    """The relations of Allen: how one interval lies to another."""

    BEFORE = "before"
    MEETS = "meets"
    OVERLAPS = "overlaps"
    STARTS = "starts"
    DURING = "during"
    FINISHES = "finishes"
    EQUALS = "equals"
    FINISHED_BY = "finished by"
    CONTAINS = "contains"
    STARTED_BY = "started by"
    OVERLAPPED_BY = "overlapped by"
    MET_BY = "met by"
    AFTER = "after"


_NONE: Final = np.zeros(0, np.int64)
_BY_ENDS: Final = {
    (-1, -1): Relation.OVERLAPS,
    (-1, 0): Relation.FINISHED_BY,
    (-1, 1): Relation.CONTAINS,
    (0, -1): Relation.STARTS,
    (0, 0): Relation.EQUALS,
    (0, 1): Relation.STARTED_BY,
    (1, -1): Relation.DURING,
    (1, 0): Relation.FINISHES,
    (1, 1): Relation.OVERLAPPED_BY,
}
"""The relations of two intervals that share some time, by how their starts and their ends compare."""


class Follower(NamedTuple):
    """One type of action that came next.

    Attributes:
        type: None for the cases after which no action started under the same parent.
        cases: the number of times that this type came next.
        share: that number divided by the number of all cases in question.
        success: the success rate of these actions; None if none of them ran to its end.
    """

    type: str | None
    cases: int
    share: float
    success: Rate | None


class Following(NamedTuple):
    """The actions that came next after some cases, the commonest first."""

    cases: int
    followers: tuple[Follower, ...]


def relation(first: Case, second: Case) -> Relation | None:
    """Return the relation of the first case's interval to the second's; None if one has no end because it was lost."""
    if first.duration_s is None or second.duration_s is None:
        return None
    starts, ends = first.started_us, first.started_us + first.duration_s * 1e6
    other_starts, other_ends = second.started_us, second.started_us + second.duration_s * 1e6
    by_starts, by_ends = _order(starts, other_starts), _order(ends, other_ends)
    if by_starts and by_ends:  # neither a common start nor a common end, so that an action of no length meets none
        gap, other_gap = _order(ends, other_starts), _order(other_ends, starts)
        if gap <= 0:
            return Relation.MEETS if gap == 0 else Relation.BEFORE
        if other_gap <= 0:
            return Relation.MET_BY if other_gap == 0 else Relation.AFTER
    return _BY_ENDS[by_starts, by_ends]


class Sequences:
    """The cases of a library in the order in which they happened under each parent."""

    def __init__(self, library: CaseLibrary) -> None:
        self._library = library
        self._groups = library.groups()
        sizes = [len(group) for group in self._groups]
        self._firsts = np.cumsum([0, *sizes])[:-1].tolist()
        self._group_numbers = np.repeat(np.arange(len(sizes)), sizes)
        self._rows = np.concatenate([np.arange(size, dtype=np.int64) for size in sizes] or [_NONE])
        nodes = np.concatenate([group.nodes for group in self._groups] or [_NONE])
        parents = np.concatenate([group.parents.astype(np.int64) for group in self._groups] or [_NONE])
        self._by_node = np.argsort(nodes, kind="stable")
        self._nodes = nodes[self._by_node]
        keys = (self._nodes >> EPISODE_SHIFT) * (SEQUENCE_MAX + 1) + parents[self._by_node]
        by_key = np.argsort(keys, kind="stable")
        self._by_parent = self._by_node[by_key]
        self._keys = keys[by_key]
        self._places = np.empty_like(self._by_parent)
        self._places[self._by_parent] = np.arange(nodes.size)
        self._types = tuple(library.types)
        self._statuses = library.words("status")
        self._next = self._outcomes_of_next()

    def _outcomes_of_next(self) -> NDArray[np.int64]:
        """Return, for each case, a number for type and status of the action that came next; -1 where none did."""
        outcomes = np.empty_like(self._places)
        width = len(self._statuses) + 1
        codes = {name: code for code, name in enumerate(self._types)}
        for group, first in zip(self._groups, self._firsts, strict=True):
            statuses = group.texts["status"].recoded(self._statuses).values.astype(np.int64)
            outcomes[first : first + len(group)] = codes[group.type] * width + statuses
        following = np.full_like(self._places, -1)
        is_next = np.flatnonzero(self._keys[1:] == self._keys[:-1])
        following[self._by_parent[is_next]] = outcomes[self._by_parent[is_next + 1]]
        return following

    def case(self, node: int) -> Case | None:
        """Return the case of a node; None if it has none, because it is not an action or still runs."""
        index = self._index(node)
        return None if index is None else self._case(index)

    def next(self, case: Case) -> Case | None:
        """Return the action that started next under the same parent."""
        return self._sibling(case, 1)

    def previous(self, case: Case) -> Case | None:
        """Return the action that started before it under the same parent."""
        return self._sibling(case, -1)

    def parent(self, case: Case) -> Case | None:
        """Return the nearest action around it; None outside any, and while that runs."""
        return None if case.parent is None else self.case(case.parent)

    def related(self, case: Case, wanted: Relation) -> list[Case]:
        """Return the other cases of its episode that lie in this relation to it, as in "they happened during it"."""
        ends = np.searchsorted(self._nodes, [row_id_min(case.episode), row_id_min(case.episode + 1)])
        others = (self._case(int(index)) for index in self._by_node[ends[0] : ends[1]])
        related = [each for each in others if each.node != case.node and relation(each, case) is wanted]
        return sorted(related, key=lambda each: (each.started_us, each.node))

    def follows(self, dtype: str, *, status: str | None = None, reason: str | None = None) -> Following:
        """Count the actions that came next after the actions of a type, with their success rates, without simulations.

        Args:
            dtype: type of the actions before.
            status, reason: their outcome; by default any.
        """
        dtype = self._library.present_name(dtype)
        outcomes = np.concatenate(
            [
                self._next[first : first + len(group)][_chosen(group, status, reason)]
                for group, first in zip(self._groups, self._firsts, strict=True)
                if group.type == dtype
            ]
            or [_NONE]
        )
        if not outcomes.size:
            return Following(0, ())
        counts: dict[str, Counter[str]] = {}
        last, *numbers = np.bincount(outcomes + 1, minlength=1).tolist()
        width = len(self._statuses) + 1
        for outcome, count in enumerate(numbers):
            if count:
                counts.setdefault(self._types[outcome // width], Counter())[
                    str(self._statuses[outcome % width - 1])
                ] = count
        followers = [
            Follower(name, each.total(), each.total() / outcomes.size, rate_of(each)) for name, each in counts.items()
        ]
        if last:
            followers.append(Follower(None, last, last / outcomes.size, None))
        order = sorted(followers, key=lambda each: (-each.cases, each.type or ""))
        return Following(int(outcomes.size), tuple(order))

    def _sibling(self, case: Case, step: int) -> Case | None:
        index = self._index(case.node)
        if index is None:
            return None
        place = int(self._places[index])
        other = place + step
        if not 0 <= other < self._keys.size or self._keys[other] != self._keys[place]:
            return None
        return self._case(int(self._by_parent[other]))

    def _index(self, node: int) -> int | None:
        place = int(np.searchsorted(self._nodes, node))
        return int(self._by_node[place]) if place < self._nodes.size and int(self._nodes[place]) == node else None

    def _case(self, index: int) -> Case:
        return self._groups[int(self._group_numbers[index])].case(int(self._rows[index]))


def _chosen(group: Group, status: str | None, reason: str | None) -> Mask:
    chosen = group.performed
    for feature, word in (("status", status), ("reason", reason)):
        if word is not None:
            chosen &= group.having(feature, word)
    return chosen


def _order(first: float, second: float) -> int:
    """Compare two moments in µs: -1, 0 or 1."""
    return 0 if abs(first - second) < _SAME_US else -1 if first < second else 1
