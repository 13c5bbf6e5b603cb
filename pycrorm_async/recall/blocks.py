"""A block holds many cases as columns; the section "block bytes" encodes it for its row in the table.

The cases of one type form a group, the newest first: by the time of their start, then by their node. Groups follow each
other in the alphabetical order of their types. A column has the cases of those types that have its feature, so types
whose parameters differ take no space from each other. Equal cases make equal columns, in any order and by any merges.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from operator import itemgetter
from types import MappingProxyType
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.events.ids import SEQUENCE_MAX, row_id, row_key
from pycrorm_async.recall.columns import RESERVED, Case, Column, Mask, Summary, Words, is_angle, joined, joined_words

WORDS_MAX: Final = 16_384
"""Bounds the words of a feature in a memory.

A feature with more of them identifies single cases, so it cannot show that two are similar.
"""
EPISODE_SHIFT: Final = row_id(1, 0, 0).bit_length() - 1
"""The bits of a node's id below its episode's number."""

_SEQUENCE: Final = row_id(0, 1, 0)


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
    texts: Mapping[str, Column]
    numbers: Mapping[str, Column]

    @classmethod
    def of(cls, cases: Iterable[Case]) -> Group:
        """Make a group of cases of one type."""
        rows = sorted(cases, key=lambda case: (-case.started_us, -case.node))
        nodes, started_us, types, symbols, numbers, statuses, reasons, durations, parents, simulated = zip(
            *rows, strict=True
        )
        texts, values = _values(symbols), _values(numbers)
        reserved = RESERVED & (texts.keys() | values.keys())
        assert not reserved, f"features of a situation cannot be named {', '.join(sorted(reserved))}"
        marks = ["yes" if each else None for each in simulated]
        return cls(
            types[0],
            np.array(nodes, np.int64),
            np.array(started_us, np.int64),
            (np.array([each or 0 for each in parents], np.int64) // _SEQUENCE & SEQUENCE_MAX).astype(np.int32),
            _columns({**texts, "status": statuses, "reason": reasons, "simulated": marks}, Column.of_texts),
            _columns({**values, "duration": durations}, Column.of_numbers),
        )

    @classmethod
    def joined(cls, groups: Sequence[Group]) -> Group:
        """Return one group with the cases of all, which have one type."""
        nodes = np.concatenate([each.nodes for each in groups])
        started_us = np.concatenate([each.started_us for each in groups])
        parents = np.concatenate([each.parents for each in groups])
        sizes = [*map(len, groups)]
        texts, numbers = (
            {
                name: joined([each.get(name) for each in columns], sizes)
                for name in sorted(frozenset[str]().union(*columns))
            }
            for columns in ([each.texts for each in groups], [each.numbers for each in groups])
        )
        return cls(groups[0].type, nodes, started_us, parents, texts, numbers).taken(np.lexsort((-nodes, -started_us)))

    def __len__(self) -> int:
        """Return the number of cases."""
        return int(self.nodes.size)

    def having(self, feature: str, word: str, rows: slice = slice(None)) -> Mask:
        """Return a mask of these rows: True where the text feature of the case has the word."""
        column = self.texts.get(feature)
        return np.zeros(self.nodes[rows].size, np.bool_) if column is None else column.having(word, rows)

    @property
    def performed(self) -> Mask:
        """A mask of the cases that are no simulations."""
        simulated = self.texts.get("simulated")
        return np.ones(len(self), np.bool_) if simulated is None else ~simulated.present()

    def taken(self, rows: NDArray[Any]) -> Group:
        """Return the group of some of its cases: of these rows, or those for which a mask is True."""
        arrays = self.nodes[rows], self.started_us[rows], self.parents[rows]
        texts, numbers = (
            {name: each.taken(rows) for name, each in columns.items()} for columns in (self.texts, self.numbers)
        )
        return Group(self.type, *arrays, texts, numbers)

    @cached_property
    def episodes(self) -> NDArray[np.int64]:
        """The episode's number of each case."""
        return self.nodes >> EPISODE_SHIFT

    def case(self, row: int) -> Case:
        """Return one case; row 0 is the newest."""
        node, parent = int(self.nodes[row]), int(self.parents[row])
        texts = {name: value for name, column in self.texts.items() if (value := column.value(row)) is not None}
        numbers = {name: number for name, each in self.numbers.items() if (number := each.value(row)) is not None}
        status, reason, simulated = texts.pop("status", ""), texts.pop("reason", None), texts.pop("simulated", None)
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
class CaseBlock:
    """Many cases, grouped by type.

    Attributes:
        groups: by type, in alphabetical order. They have one dictionary for each text feature.
        left_out: features that are not kept because they have too many words.
    """

    groups: Mapping[str, Group]
    left_out: frozenset[str] = frozenset()

    @classmethod
    def of(cls, cases: Iterable[Case]) -> CaseBlock:
        """Make a block of cases.

        A block keeps a case without infinite numbers and long texts, and with rounded numbers.
        """
        by_type: dict[str, list[Case]] = {}
        for case in cases:
            by_type.setdefault(case.type, []).append(case)
        return _block([Group.of(by_type[name]) for name in sorted(by_type)])

    def __len__(self) -> int:
        """Return the number of cases."""
        return int(self.nodes.size)

    @cached_property
    def nodes(self) -> NDArray[np.int64]:
        """The nodes of the cases, group after group."""
        return np.concatenate([each.nodes for each in self.groups.values()] or [np.zeros(0, np.int64)])

    def cases(self) -> Iterator[Case]:
        """Yield the cases, group after group, the newest of each group first."""
        return (group.case(row) for group in self.groups.values() for row in range(len(group)))

    def without(self, nodes: NDArray[np.int64]) -> CaseBlock:
        """Return the block without the cases of these nodes."""
        return self._kept({name: np.isin(each.nodes, nodes, invert=True) for name, each in self.groups.items()})

    def pruned(self) -> CaseBlock:
        """Return the block with dictionaries of the words that its cases have, and no others."""
        pruned = {
            name: replace(group, texts={feature: each.pruned() for feature, each in group.texts.items()})
            for name, group in self.groups.items()
        }
        return merge([replace(self, groups=pruned)])

    def of_episodes(self, first: int, end: int) -> CaseBlock:
        """Return the block with the cases of the episodes from number `first` up to but not including `end`."""
        groups = self.groups.items()
        return self._kept({name: (each.episodes >= first) & (each.episodes < end) for name, each in groups})

    def _kept(self, kept: Mapping[str, Mask]) -> CaseBlock:
        groups = {
            name: group if kept[name].all() else group.taken(kept[name])
            for name, group in self.groups.items()
            if kept[name].any()
        }
        return CaseBlock(groups, self.left_out)


def is_same(one: CaseBlock, other: CaseBlock) -> bool:
    """Return whether two blocks have equal cases; their dictionaries may have further words."""
    return one.groups.keys() == other.groups.keys() and all(
        _is_same_group(group, other.groups[name]) for name, group in one.groups.items()
    )


def _is_same_group(one: Group, other: Group) -> bool:
    pairs = (one.nodes, other.nodes), (one.started_us, other.started_us), (one.parents, other.parents)
    if not all(np.array_equal(*each) for each in pairs):
        return False
    for columns, others in ((one.texts, other.texts), (one.numbers, other.numbers)):
        present, others_present = (
            {name: column for name, column in each.items() if column.present().any()} for each in (columns, others)
        )
        if present.keys() != others_present.keys() or not all(
            column.equals(others_present[name]) for name, column in present.items()
        ):
            return False
    return True


def merge(blocks: Sequence[CaseBlock]) -> CaseBlock:
    """Return one block with the cases of all."""
    by_type: dict[str, list[Group]] = {}
    for group in chain.from_iterable(block.groups.values() for block in blocks):
        by_type.setdefault(group.type, []).append(group)
    left_out = frozenset[str]().union(*(each.left_out for each in blocks))
    return _block([Group.joined(by_type[name]) for name in sorted(by_type)], left_out)


def _block(groups: Sequence[Group], left_out: frozenset[str] = frozenset()) -> CaseBlock:
    """Return the block of these groups, with one dictionary for each feature, and without those that are too long."""
    words = {name: joined_words(each) for name, each in dictionaries(groups).items()}
    left_out |= {name for name, each in words.items() if each.word_count > WORDS_MAX}
    united = (
        replace(
            group, texts={name: each.recoded(words[name]) for name, each in group.texts.items() if name not in left_out}
        )
        for group in groups
    )
    return CaseBlock({group.type: group for group in united}, left_out)


def dictionaries(groups: Iterable[Group]) -> Mapping[str, Sequence[Words]]:
    """Return the different dictionaries of each text feature in these groups."""
    words: dict[str, dict[int, Words]] = {}
    for group in groups:
        for name, column in group.texts.items():
            words.setdefault(name, {})[id(column.words)] = column.words
    return {name: [*each.values()] for name, each in words.items()}


def _values(situations: Sequence[Mapping[str, Any]]) -> Mapping[str, Sequence[Any]]:
    """Return the values of each feature of the situations, None where one does not have it."""
    names = tuple(situations[0])
    if len(names) > 1 and {*map(len, situations)} == {len(names)}:  # as of most types, whose fields are always set
        with suppress(KeyError):
            return dict(zip(names, zip(*map(itemgetter(*names), situations), strict=True), strict=True))
    features = frozenset[str]().union(*situations)
    return {feature: [each.get(feature) for each in situations] for feature in features}


def _columns(values: Mapping[str, Sequence[Any]], column_of: Callable[[Sequence[Any]], Column]) -> Mapping[str, Column]:
    """Make the columns of these features, without those of which no case has a value that is kept."""
    columns = {name: column_of(values[name]) for name in sorted(values)}
    return {name: each for name, each in columns.items() if each.present().any()}


# === block bytes ==============================================================================================
#
# The bytes of a block: the length of its heading in 8 bytes, the heading as MessagePack, and the arrays, all
# little-endian. The heading and each array are followed by zeros up to a multiple of 8 bytes, so that arrays can be
# used where they are read. A block of 65,536 cases is decoded in 0.1 ms, as `npz` in 5 ms; Arrow would be a dependency.


class _BlockHeading(msgspec.Struct, array_like=True):
    """Each group by type, with the number of its cases and its columns by feature and kind, and the dictionaries.

    The arrays of a group are its nodes and starts (int64), its parents (int32), and the values of each column of this
    kind: unsigned integers for texts, floats for numbers.
    """

    groups: list[tuple[str, int, list[tuple[str, str]]]]
    words: dict[str, list[str | tuple[str, ...]]]
    left_out: list[str]


_heading: Final = msgspec.msgpack.Decoder(_BlockHeading).decode


def encode(block: CaseBlock) -> bytes:
    """Return the bytes of a block."""
    groups: list[tuple[str, int, list[tuple[str, str]]]] = []
    arrays: list[NDArray[Any]] = []
    for group in block.groups.values():
        columns = [*group.texts.items(), *group.numbers.items()]
        groups.append((group.type, len(group), [(name, _kind(each.values)) for name, each in columns]))
        arrays += [group.nodes, group.started_us, group.parents, *(each.values for _, each in columns)]
    words = {name: [*each] for name, (each,) in dictionaries(block.groups.values()).items()}
    heading = msgspec.msgpack.encode(_BlockHeading(groups, words, sorted(block.left_out)))
    parts = [len(heading).to_bytes(8, "little"), heading, *(each.astype(_kind(each)).tobytes() for each in arrays)]
    return b"".join(chain.from_iterable((each, bytes(-len(each) % 8)) for each in parts))


def decode(data: bytes) -> CaseBlock:
    """Return the block of the bytes that `encode` made; its arrays share their memory."""
    place = 8 + int.from_bytes(data[:8], "little")
    heading = _heading(data[8:place])

    def array(kind: str, count: int) -> NDArray[Any]:
        nonlocal place
        place += -place % 8
        values = np.frombuffer(data, kind, count, place)
        place += values.nbytes
        return values

    words = {name: Words(each) for name, each in heading.words.items()}
    groups = {}
    for name, size, columns in heading.groups:
        arrays = array("<i8", size), array("<i8", size), array("<i4", size)
        texts, numbers = {}, {}
        for feature, kind in columns:
            if kind[1] == "u":
                texts[feature] = Column(array(kind, size), words[feature])
            else:
                numbers[feature] = Column(array(kind, size))
        groups[name] = Group(name, *arrays, texts, numbers)
    return CaseBlock(groups, frozenset(heading.left_out))


def _kind(values: NDArray[Any]) -> str:
    return f"<{values.dtype.kind}{values.itemsize}"


# === library ==================================================================================================
#
# `CaseLibrary` holds all cases of a memory, and counts what a search weighs: words, spreads and sizes by type.
#
# A *case* is an action that has ended, with its outcome. Its situation consists of *features* (`cases.py`), which are
# texts or numbers; the value of a text is a *word*. A *cue* (`search.py`) is the words and numbers that a search looks
# for. Cases are stored as columns in *blocks*, and the cases of one type in a block are a *group* (`blocks.py`). The
# *spread* of a number is its standard deviation among the cases of a type.

NEAR_M = 0.1
"""The distance in m, of the base in the object's frame and of the height, at which a past try counts exp(-1/2)."""
ANGLE_TOLERANCE = 0.5
"""The tolerance in rad of an angle for which the cue has none, about 30 degrees."""


class CaseLibrary:
    """The cases of a memory at one moment, which never change: a reader makes a new library when it has more blocks.

    `type` None means the cases of all types in each method. A renamed type is found by any of its names; its cases
    carry the present name. Counts are cached in the library, and those of one column in it, which belongs to the block
    and therefore serves the next library too. No lock protects the caches.

    Args:
        blocks: the cases.
        names: the present name of each renamed type, by every name that it has or had. A name that is missing is a
            present one.
    """

    def __init__(self, blocks: Sequence[CaseBlock] = (), names: Mapping[str, str] = MappingProxyType({})) -> None:
        self.blocks = tuple(blocks)
        self._names = names
        self._groups: dict[str | None, tuple[Group, ...]] = {}
        self._words: dict[str, Words] = {}
        self._features: dict[str | None, tuple[frozenset[str], frozenset[str]]] = {}

    def __len__(self) -> int:
        """Return the number of cases."""
        return sum(map(len, self.blocks))

    @cached_property
    def types(self) -> Mapping[str, int]:
        """The number of cases of each type, in alphabetical order."""
        sizes: Counter[str] = Counter()
        for group in self._recorded_groups:
            sizes[self.present_name(group.type)] += len(group)
        return dict(sorted(sizes.items()))

    @cached_property
    def recorded_types(self) -> frozenset[str]:
        """The names under which the cases were recorded."""
        return frozenset(group.type for group in self._recorded_groups)

    @cached_property
    def _recorded_groups(self) -> tuple[Group, ...]:
        return tuple(chain.from_iterable(block.groups.values() for block in self.blocks))

    def names_of(self, type: str | None) -> tuple[str, ...]:  # noqa: A002
        """Return the names under which the cases of a type were recorded."""
        return tuple(sorted(name for name in self.recorded_types if self._is(name, type)))

    def present_name(self, name: str) -> str:
        """Return the present name of a type."""
        return self._names.get(name, name)

    def _is(self, name: str, type: str | None) -> bool:  # noqa: A002
        return type is None or self.present_name(name) == self.present_name(type)

    @cached_property
    def left_out(self) -> frozenset[str]:
        """The text features with more than `WORDS_MAX` words, which are not compared."""
        long = (name for name, each in self._dictionaries.items() if _exceeds(each))
        return frozenset(chain(long, *(block.left_out for block in self.blocks)))

    def groups(self, type: str | None = None) -> tuple[Group, ...]:  # noqa: A002  the name of the feature
        """Return the groups of a type, that with the newest case first."""
        groups = self._groups.get(type)
        if groups is None:
            chosen = [self._group(each) for each in self._recorded_groups if self._is(each.type, type)]
            groups = tuple(sorted(chosen, key=lambda each: (-int(each.started_us[0]), -int(each.nodes[0]))))
            self._groups[type] = groups
        return groups

    def _group(self, group: Group) -> Group:
        present = self.present_name(group.type)
        return group if present == group.type else replace(group, type=present)

    def words(self, feature: str) -> Words:
        """Return one dictionary of a text feature, for the cases of all types."""
        if feature not in self._words:
            self._words[feature] = joined_words(self._dictionaries.get(feature, ()))
        return self._words[feature]

    @cached_property
    def _dictionaries(self) -> Mapping[str, Sequence[Words]]:
        return dictionaries(self._recorded_groups)

    def size(self, type: str | None = None) -> int:  # noqa: A002
        """Return the number of cases of a type."""
        return len(self) if type is None else self.types.get(self.present_name(type), 0)

    def seen(self, type: str | None, feature: str, word: str) -> int:  # noqa: A002
        """Return the number of cases of a type whose text feature has this word."""
        return sum(group.texts[feature].count(word) for group in self.groups(type) if feature in group.texts)

    def texts(self, type: str | None = None) -> frozenset[str]:  # noqa: A002
        """Return the names of the text features of a type, those of the outcome among them."""
        return self._features_of(type)[0]

    def numbers(self, type: str | None = None) -> frozenset[str]:  # noqa: A002
        """Return the names of the numbers of a type, the duration among them."""
        return self._features_of(type)[1]

    def _features_of(self, type: str | None) -> tuple[frozenset[str], frozenset[str]]:  # noqa: A002
        if type not in self._features:
            groups = self.groups(type)
            texts = frozenset(chain.from_iterable(group.texts for group in groups))
            numbers = frozenset(chain.from_iterable(group.numbers for group in groups))
            self._features[type] = texts - (RESERVED - {"status", "reason"}) - self.left_out, numbers
        return self._features[type]

    def tolerance(self, type: str | None, feature: str) -> float:  # noqa: A002
        """Return the tolerance of a number for which the cue has none: its standard deviation, to two digits.

        It is rounded, so that it does not depend on the order in which the blocks are added up. A number that is the
        same in all cases has the deviation 0, by which no distance can be divided; its tolerance is 1.0.
        """
        if is_angle(feature):
            return ANGLE_TOLERANCE
        low, high = self.range_of(type, feature) or (0.0, 0.0)
        if low == high:
            return 1.0
        parts = self._summaries(type, feature)
        size = sum(each.size for each in parts)
        mean = math.fsum(each.size * each.mean for each in parts) / size
        squares = math.fsum(each.size * (each.variance + (each.mean - mean) ** 2) for each in parts)
        return float(f"{math.sqrt(squares / size):.1e}")

    def range_of(self, type: str | None, feature: str) -> tuple[float, float] | None:  # noqa: A002
        """Return the least and the greatest number of a feature among the cases of a type; None if there are none."""
        parts = self._summaries(type, feature)
        return (min(each.least for each in parts), max(each.greatest for each in parts)) if parts else None

    def _summaries(self, type: str | None, feature: str) -> list[Summary]:  # noqa: A002
        columns = (group.numbers[feature] for group in self.groups(type) if feature in group.numbers)
        return [summary for column in columns if (summary := column.summary) is not None]

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
    if sum(each.word_count for each in dictionaries) <= WORDS_MAX:
        return False
    return len({*chain.from_iterable(each.codes_by_word for each in dictionaries)}) > WORDS_MAX
