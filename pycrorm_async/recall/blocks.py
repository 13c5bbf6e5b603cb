"""A block holds many cases as columns; `block_rows` encodes it as rows of a table.

The cases of one type form a group, the newest first: by the time of their start, then by their node. A group has the
columns of those features that its cases have, so types whose parameters differ take no space from each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.events.ids import row_id, row_key
from pycrorm_async.recall.case import Case, bounded_case
from pycrorm_async.recall.columns import Numbers, Sets, Symbols, joined_numbers, joined_words, taken

__all__ = ["Block", "Group", "WORDS_MAX", "merge", "merged_group"]

WORDS_MAX: Final = 16_384
"""Bounds the words of a feature in a memory. A feature with more of them names single cases and likens none."""

_EPISODE_SHIFT: Final = row_id(1, 0, 0).bit_length() - 1


@dataclass(frozen=True, eq=False)
class Group:
    """The cases of one type in a block, the newest first.

    Attributes:
        nodes, started_us, parents: of each case; a parent is a sequence in the same episode, 0 for none.
        texts, numbers: the columns by feature, those of the outcome among them.
    """

    type: str
    nodes: NDArray[np.int64]
    started_us: NDArray[np.int64]
    parents: NDArray[np.int32]
    texts: Mapping[str, Symbols | Sets]
    numbers: Mapping[str, Numbers]
    caches: dict[object, Any] = field(default_factory=dict, repr=False)
    """Holds what a search computes of this group once."""

    def __len__(self) -> int:
        """Return the number of cases."""
        return int(self.nodes.size)

    @cached_property
    def episodes(self) -> NDArray[np.int64]:
        """The episode's number of each case."""
        return self.nodes >> _EPISODE_SHIFT

    def case(self, row: int) -> Case:
        """Return one case; row 0 is the newest."""
        node, parent = int(self.nodes[row]), int(self.parents[row])
        texts = {name: value for name, column in self.texts.items() if (value := column.value(row)) is not None}
        numbers = {name: number for name, each in self.numbers.items() if (number := each.value(row)) is not None}
        status, reason, simulated = texts.pop("status", ""), texts.pop("reason", None), texts.pop("simulated", None)
        assert isinstance(status, str)
        assert reason is None or isinstance(reason, str)
        return Case(
            node,
            int(self.started_us[row]),
            self.type,
            texts,
            numbers,
            status,
            reason,
            numbers.pop("duration", None),
            row_id(row_key(node).number, parent, 0) if parent else None,
            simulated is not None,
        )


@dataclass(frozen=True, eq=False)
class Block:
    """Many cases, grouped by type.

    Attributes:
        groups: by type, in alphabetical order.
        left_out: features that are not kept because they have too many words.
    """

    groups: Mapping[str, Group]
    left_out: frozenset[str] = frozenset()

    @classmethod
    def of(cls, cases: Iterable[Case]) -> Block:
        """Make a block of cases, each bounded by `bounded_case`."""
        by_type: dict[str, list[Case]] = {}
        for case in cases:
            by_type.setdefault(case.type, []).append(bounded_case(case))
        return _without_long_dictionaries({name: _group(name, by_type[name]) for name in sorted(by_type)}, frozenset())

    def __len__(self) -> int:
        """Return the number of cases."""
        return sum(map(len, self.groups.values()))

    def cases(self) -> Iterator[Case]:
        """Yield the cases, group after group, the newest of each group first."""
        return (group.case(row) for group in self.groups.values() for row in range(len(group)))


def merge(blocks: Sequence[Block]) -> Block:
    """Return one block with the cases of all."""
    groups: dict[str, Group] = {}
    for name in sorted({name for block in blocks for name in block.groups}):
        groups[name] = merged_group([block.groups[name] for block in blocks if name in block.groups])
    return _without_long_dictionaries(groups, frozenset().union(*(block.left_out for block in blocks)))


# --- groups ---------------------------------------------------------------------------------------------------


def _group(name: str, cases: list[Case]) -> Group:
    cases.sort(key=lambda case: (case.started_us, case.node), reverse=True)
    texts: dict[str, Symbols | Sets] = {"status": Symbols.of([case.status for case in cases])}
    for optional, values in (
        ("reason", [case.reason for case in cases]),
        ("simulated", ["yes" if case.simulated else None for case in cases]),
    ):
        if any(values):
            texts[optional] = Symbols.of(values)
    for feature in dict.fromkeys(feature for case in cases for feature in case.symbols):
        column = [case.symbols.get(feature) for case in cases]
        many = any(isinstance(each, tuple) for each in column)
        texts[feature] = (
            Sets.of(column) if many else Symbols.of([each for each in column if not isinstance(each, tuple)])
        )
    numbers = {
        feature: Numbers.of([case.numbers.get(feature) for case in cases])
        for feature in dict.fromkeys(feature for case in cases for feature in case.numbers)
    }
    if any(case.duration_s is not None for case in cases):
        numbers["duration"] = Numbers.of([case.duration_s for case in cases])
    return Group(
        name,
        np.array([case.node for case in cases], np.int64),
        np.array([case.started_us for case in cases], np.int64),
        np.array([row_key(case.parent).sequence if case.parent else 0 for case in cases], np.int32),
        dict(sorted(texts.items())),
        dict(sorted(numbers.items())),
    )


def merged_group(groups: Sequence[Group]) -> Group:
    """Return one group with the cases of all, which are of one type."""
    if len(groups) == 1:
        return replace(groups[0], caches={})
    nodes = np.concatenate([each.nodes for each in groups])
    started = np.concatenate([each.started_us for each in groups])
    order = np.lexsort((nodes, started))[::-1]
    texts: dict[str, Symbols | Sets] = {}
    for name in sorted({name for each in groups for name in each.texts}):
        column = taken(joined_words([(each.texts.get(name), len(each)) for each in groups]), order)
        assert not isinstance(column, Numbers)
        texts[name] = column
    numbers: dict[str, Numbers] = {}
    for name in sorted({name for each in groups for name in each.numbers}):
        column = taken(joined_numbers([(each.numbers.get(name), len(each)) for each in groups]), order)
        assert isinstance(column, Numbers)
        numbers[name] = column
    parents = np.concatenate([each.parents for each in groups])[order]
    return Group(groups[0].type, nodes[order], started[order], parents, texts, numbers)


def _without_long_dictionaries(groups: Mapping[str, Group], left_out: frozenset[str]) -> Block:
    words: dict[str, set[str]] = {}
    for group in groups.values():
        for name, column in group.texts.items():
            words.setdefault(name, set()).update(column.words)
    left_out |= {name for name, each in words.items() if len(each) > WORDS_MAX}
    if left_out:
        groups = {
            name: replace(group, texts={key: each for key, each in group.texts.items() if key not in left_out})
            for name, group in groups.items()
        }
    return Block(groups, left_out)
