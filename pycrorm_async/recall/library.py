"""`CaseLibrary` holds all cases of a memory, and counts what a search weighs: words, spreads and sizes by type.

A *case* is an action that has ended, with its outcome. Its situation consists of *features* (`cases/situation.py`),
which are texts or numbers; the value of a text is a *word*. A *cue* (`cue.py`) is the words and numbers that a search
looks for. Cases are stored as columns in *blocks*, and the cases of one type in a block are a *group* (`blocks.py`).
The *spread* of a number is its standard deviation among the cases of a type.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import chain
from types import MappingProxyType
from typing import Any

import numpy as np

from pycrorm_async.recall.blocks import WORDS_MAX, Block, Group
from pycrorm_async.recall.case import RESERVED, Case, is_angle
from pycrorm_async.recall.columns import Words, joined

ANGLE_TOLERANCE = 0.5
"""The tolerance in rad of an angle for which the cue has none, about 30 degrees."""


class CaseLibrary:
    """The cases of a memory at one moment, which never change: a reader makes a new library when it has more blocks.

    `type` None means the cases of all types in each method. A renamed type is found by any of its names; its cases
    carry the present name. Counts are cached in the library, and those of one group in `Group.caches`, which belong to
    the block and therefore serve the next library too. No lock protects the caches.

    Args:
        blocks: the cases.
        names: the present name of each renamed type, by every name that it has or had. A name that is missing is a
            present one.
    """

    def __init__(self, blocks: Sequence[Block] = (), names: Mapping[str, str] = MappingProxyType({})) -> None:
        self.blocks = tuple(blocks)
        self._names = names
        self._spreads: dict[tuple[str | None, str], float] = {}
        self._groups: dict[str | None, tuple[Group, ...]] = {}
        self._words: dict[str, Words] = {}
        self._texts: dict[str | None, frozenset[str]] = {}
        self._numbers: dict[str | None, frozenset[str]] = {}

    def __len__(self) -> int:
        """Return the number of cases."""
        return sum(map(len, self.blocks))

    @cached_property
    def types(self) -> Mapping[str, int]:
        """The number of cases of each type, in alphabetical order."""
        sizes: Counter[str] = Counter()
        for block in self.blocks:
            for name, size in block.sizes.items():
                sizes[self.present_name(name)] += size
        return dict(sorted(sizes.items()))

    @cached_property
    def recorded_types(self) -> frozenset[str]:
        """The names under which the cases were recorded."""
        return frozenset(chain.from_iterable(block.sizes for block in self.blocks))

    def names_of(self, type: str | None) -> tuple[str, ...]:  # noqa: A002
        """Return the names under which the cases of a type were recorded."""
        return tuple(sorted(name for name in self.recorded_types if self._is(name, type)))

    def joins(self, names: Mapping[str, str]) -> bool:
        """Return whether these names give any type another present name than the library's own names do.

        The reader then makes a new library, in which the cases of the renamed types belong together.
        """
        return any(names.get(each, each) != self.present_name(each) for each in {*names, *self._names, *self.types})

    def present_name(self, name: str) -> str:
        """Return the present name of a type."""
        return self._names.get(name, name)

    def _is(self, name: str, type: str | None) -> bool:  # noqa: A002
        return type is None or self.present_name(name) == self.present_name(type)

    @cached_property
    def left_out(self) -> frozenset[str]:
        """The text features with more than `WORDS_MAX` words, which are not compared."""
        words: dict[str, list[Words]] = {}
        for block in self.blocks:
            for name, spread in block.texts.items():
                words.setdefault(name, []).append(spread.column.words)
        long = (name for name, each in words.items() if _exceeds(each))
        return frozenset(chain(long, *(block.left_out for block in self.blocks)))

    def groups(self, type: str | None = None) -> tuple[Group, ...]:  # noqa: A002  the name of the feature
        """Return the groups of a type, that with the newest case first."""
        groups = self._groups.get(type)
        if groups is None:
            chosen = [self._group(block, name) for block in self.blocks for name in block.sizes if self._is(name, type)]
            groups = tuple(sorted(chosen, key=lambda each: (-int(each.started_us[0]), -int(each.nodes[0]))))
            self._groups[type] = groups
        return groups

    def words(self, feature: str) -> Words:
        """Return one dictionary of a text feature, for the cases of all types."""
        words = self._words.get(feature)
        if words is None:
            columns = (block.texts[feature].column for block in self.blocks if feature in block.texts)
            words = self._words[feature] = joined(column.words for column in columns)
        return words

    def _group(self, block: Block, name: str) -> Group:
        group, present = block.group(name), self.present_name(name)
        return group if present == name else replace(group, type=present)

    def size(self, type: str | None = None) -> int:  # noqa: A002
        """Return the number of cases of a type."""
        return len(self) if type is None else self.types.get(self.present_name(type), 0)

    def seen(self, type: str | None, feature: str, word: str) -> int:  # noqa: A002
        """Return the number of cases of a type whose text feature has this word."""
        total, key = 0, ("counts", feature)
        for group in self.groups(type):
            column = group.texts.get(feature)
            code = 0 if column is None else column.words.code(word)
            if column is not None and code:
                counts = group.caches.get(key)
                if counts is None:
                    counts = group.caches[key] = column.counts().tolist()
                total += counts[code]
        return total

    def texts(self, type: str | None = None) -> frozenset[str]:  # noqa: A002
        """Return the names of the text features of a type, those of the outcome among them."""
        names = self._texts.get(type)
        if names is None:
            every = frozenset(chain.from_iterable(group.texts for group in self.groups(type)))
            names = self._texts[type] = every - (RESERVED - {"status", "reason"}) - self.left_out
        return names

    def numbers(self, type: str | None = None) -> frozenset[str]:  # noqa: A002
        """Return the names of the numbers of a type, the duration among them."""
        names = self._numbers.get(type)
        if names is None:
            names = self._numbers[type] = frozenset(chain.from_iterable(group.numbers for group in self.groups(type)))
        return names

    def tolerance(self, type: str | None, feature: str) -> float:  # noqa: A002
        """Return the tolerance of a number for which the cue has none: its standard deviation, to two digits.

        It is rounded, so that it does not depend on the order in which the blocks are added up. A number that is the
        same in all cases has the deviation 0, by which no distance can be divided; its tolerance is 1.0.
        """
        if is_angle(feature):
            return ANGLE_TOLERANCE
        spread = self._spreads.get((type, feature))
        if spread is None:
            groups = [group for group in self.groups(type) if feature in group.numbers]
            spread = self._spreads[type, feature] = float(f"{_standard_deviation(groups, feature):.1e}")
        return spread if spread > 0 else 1.0

    def find(self, node: int) -> Case | None:
        """Return the case of a node; None if it has none."""
        for group in self.groups():
            rows = np.flatnonzero(group.nodes == node)
            if rows.size:
                return group.case(int(rows[0]))
        return None

    def __iter__(self) -> Iterator[Case]:
        """Yield every case, in no particular order."""
        return (group.case(row) for group in self.groups() for row in range(len(group)))


def _exceeds(dictionaries: Sequence[Words]) -> bool:
    """Return whether there are more than `WORDS_MAX` words.

    Checks the sum of sizes first, because it usually decides without building the union.
    """
    return sum(map(len, dictionaries)) > WORDS_MAX and len({*chain.from_iterable(dictionaries)}) > WORDS_MAX


def _standard_deviation(groups: Sequence[Group], feature: str) -> float:
    """Compute the standard deviation from sums about the midrange, to avoid cancellation."""
    ranges = [_cached(group, ("range", feature), lambda group: _range(group, feature)) for group in groups]
    ranges = [each for each in ranges if each is not None]
    if not ranges:
        return 0.0
    middle = (min(low for low, _ in ranges) + max(high for _, high in ranges)) / 2
    parts = [
        _cached(group, ("moments", feature, middle), lambda group: _moments(group, feature, middle)) for group in groups
    ]
    count, total, squares = (math.fsum(each) for each in zip(*parts, strict=True))
    return math.sqrt(max(0.0, squares / count - (total / count) ** 2))


def _range(group: Group, feature: str) -> tuple[float, float] | None:
    column = group.numbers[feature]
    values = column.values[column.present()]
    return (float(values.min()), float(values.max())) if values.size else None


def _moments(group: Group, feature: str, middle: float) -> tuple[float, float, float]:
    """Return the count, the sum and the sum of squares of the distances from the middle."""
    column = group.numbers[feature]
    distances = column.values[column.present()].astype(np.float64) - middle
    return float(distances.size), float(distances.sum()), float(np.square(distances).sum())


def _cached(group: Group, key: object, computed: Callable[[Group], Any]) -> Any:
    if key not in group.caches:
        group.caches[key] = computed(group)
    return group.caches[key]
