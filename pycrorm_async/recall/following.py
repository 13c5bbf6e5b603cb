"""Find the neighbours of an action and the actions in a temporal relation with it; count which types follow which.

The next action of a case is the one that started after it under the same parent. The relations are those of Allen
between the intervals from start to end; moments that differ by less than a millisecond count as one.
"""

from __future__ import annotations

from collections import Counter
from enum import Enum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.events.ids import SEQUENCE_MAX, row_id
from pycrorm_async.recall.answer import Rate, rate_of
from pycrorm_async.recall.blocks import EPISODE_SHIFT, Group
from pycrorm_async.recall.case import Case
from pycrorm_async.recall.columns import Mask, joined_words
from pycrorm_async.recall.library import CaseLibrary

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
            statuses = joined_words([group.texts.get("status")], [len(group)], self._statuses)
            outcomes[first : first + len(group)] = codes[group.type] * width + statuses.codes.astype(np.int64)
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
        ends = np.searchsorted(self._nodes, [row_id(case.episode, 0, 0), row_id(case.episode + 1, 0, 0)])
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
                counts.setdefault(self._types[outcome // width], Counter())[self._statuses[outcome % width - 1]] = count
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
    chosen = np.ones(len(group), np.bool_)
    for feature, word in (("status", status), ("reason", reason)):
        if word is not None:
            column = group.texts.get(feature)
            chosen &= column is not None and column.equal_to(word, slice(None))
    if "simulated" in group.texts:
        chosen &= ~group.texts["simulated"].equal_to("yes", slice(None))
    return chosen


def _order(first: float, second: float) -> int:
    """Compare two moments in µs: -1, 0 or 1."""
    return 0 if abs(first - second) < _SAME_US else -1 if first < second else 1
