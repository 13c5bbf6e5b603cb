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
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.events.ids import SEQUENCE_MAX, row_id, row_key
from pycrorm_async.recall.columns import (
    FEATURES_MAX,
    RESERVED,
    Case,
    Column,
    Rows,
    Summary,
    Words,
    bounded,
    is_angle,
    joined,
    joined_words,
)

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

    def __len__(self) -> int:
        """Return the number of cases."""
        return int(self.nodes.size)

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


class Spread(NamedTuple):
    """A column over the groups of some types of a block, in their order."""

    types: tuple[str, ...]
    column: Column


Spreads = Mapping[str, Spread]


@dataclass(frozen=True, eq=False)
class Block:
    """Many cases, grouped by type.

    Attributes:
        sizes: the number of cases of each type, in alphabetical order.
        nodes, started_us, parents: as in `Group`, group after group.
        texts, numbers: the columns by feature, those of the outcome among them.
        left_out: features that are not kept because they have too many words.
    """

    sizes: Mapping[str, int]
    nodes: NDArray[np.int64]
    started_us: NDArray[np.int64]
    parents: NDArray[np.int32]
    texts: Spreads
    numbers: Spreads
    left_out: frozenset[str] = frozenset()

    @classmethod
    def of(cls, cases: Iterable[Case]) -> Block:
        """Make a block of cases, at least one.

        A block keeps a case without infinite numbers, long texts and features beyond `FEATURES_MAX`, and with rounded
        numbers. What it keeps depends on the case alone, so an action gives the same case in any block.
        """
        rows = [case if len(case.symbols) + len(case.numbers) <= FEATURES_MAX else _limited(case) for case in cases]
        rows.sort(key=lambda case: (case.type, -case.started_us, -case.node))
        sizes = Counter(case.type for case in rows)
        nodes, started_us, _, symbols, numbers, statuses, reasons, durations, parents, simulated = zip(
            *rows, strict=True
        )
        texts = _owned(sizes, symbols)
        texts |= {"status": (sizes, statuses), "reason": (sizes, reasons)}
        texts["simulated"] = sizes, ["yes" if each else None for each in simulated]
        return _without_long_dictionaries(
            cls(
                sizes,
                np.array(nodes, np.int64),
                np.array(started_us, np.int64),
                (np.array([each or 0 for each in parents], np.int64) // _SEQUENCE & SEQUENCE_MAX).astype(np.int32),
                _spreads(texts, Column.of_texts),
                _spreads(_owned(sizes, numbers) | {"duration": (sizes, durations)}, Column.of_numbers),
            )
        )

    def __len__(self) -> int:
        """Return the number of cases."""
        return int(self.nodes.size)

    def cases(self) -> Iterator[Case]:
        """Yield the cases, group after group, the newest of each group first."""
        return (group.case(row) for group in self.groups.values() for row in range(len(group)))

    @cached_property
    def spans(self) -> dict[str, slice]:
        """The places of the cases of each type."""
        ends = np.cumsum([*self.sizes.values()]).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(self.sizes.items(), ends, strict=True)}

    @cached_property
    def groups(self) -> dict[str, Group]:
        """The groups by type, in alphabetical order; their columns share the memory of the block."""
        texts, numbers = self._parts(self.texts), self._parts(self.numbers)
        return {
            name: Group(name, self.nodes[span], self.started_us[span], self.parents[span], texts[name], numbers[name])
            for name, span in self.spans.items()
        }

    def _parts(self, spreads: Spreads) -> dict[str, dict[str, Column]]:
        parts: dict[str, dict[str, Column]] = {name: {} for name in self.sizes}
        for feature, (types, column) in spreads.items():
            first = 0
            for name in types:
                last = first + self.sizes[name]
                parts[name][feature] = column.taken(slice(first, last))
                first = last
        return parts

    def where(self, kept: NDArray[np.bool_]) -> Block:
        """Return the block with those of its cases for which `kept` is True, in their order."""
        sizes = {name: size for name, span in self.spans.items() if (size := int(kept[span].sum()))}

        def where(spreads: Spreads) -> Spreads:
            columns = {
                feature: Spread(
                    tuple(name for name in types if name in sizes), column.taken(kept[self.rows_of(types)].nonzero()[0])
                )
                for feature, (types, column) in spreads.items()
            }
            return {feature: each for feature, each in columns.items() if each.types}

        columns = self.nodes[kept], self.started_us[kept], self.parents[kept]
        return Block(sizes, *columns, where(self.texts), where(self.numbers), self.left_out)

    def rows_of(self, types: tuple[str, ...]) -> Rows:
        """Return the places of the cases of these types."""
        if len(types) == len(self.sizes):
            return slice(None)
        return np.concatenate([np.arange(self.spans[name].start, self.spans[name].stop) for name in types])


def merge(blocks: Sequence[Block]) -> Block:
    """Return one block with the cases of all."""
    names = sorted({name for block in blocks for name in block.sizes})
    codes = {name: code for code, name in enumerate(names)}
    types = np.concatenate([np.repeat([codes[name] for name in each.sizes], [*each.sizes.values()]) for each in blocks])
    nodes = np.concatenate([each.nodes for each in blocks])
    started = np.concatenate([each.started_us for each in blocks])
    order = np.lexsort((-nodes, -started, types))
    parents = np.concatenate([each.parents for each in blocks])[order]
    sizes = dict(zip(names, np.bincount(types).tolist(), strict=True))
    left_out = frozenset[str]().union(*(each.left_out for each in blocks))
    merged = Block(sizes, nodes[order], started[order], parents, {}, {}, left_out)
    rows: dict[tuple[Block, tuple[str, ...]], Rows] = {}

    def places(block: Block, owners: tuple[str, ...]) -> Rows:
        if (block, owners) not in rows:
            rows[block, owners] = block.rows_of(owners)
        return rows[block, owners]

    def merged_spreads(spreads_of_blocks: Sequence[Spreads]) -> Spreads:
        spreads = {}
        for feature in sorted(frozenset[str]().union(*spreads_of_blocks)):
            having = [each.get(feature) for each in spreads_of_blocks]
            owned = frozenset(chain.from_iterable(each.types for each in having if each is not None))
            whole = joined(
                [
                    None if each is None else each.column.placed(places(block, each.types), len(block))
                    for block, each in zip(blocks, having, strict=True)
                ],
                [*map(len, blocks)],
            )
            owners = tuple(name for name in names if name in owned)
            spreads[feature] = Spread(owners, whole.taken(order).taken(places(merged, owners)))
        return spreads

    texts, numbers = merged_spreads([each.texts for each in blocks]), merged_spreads([each.numbers for each in blocks])
    return _without_long_dictionaries(replace(merged, texts=texts, numbers=numbers))


# --- columns of cases -----------------------------------------------------------------------------------------

_Owned = dict[str, tuple[Mapping[str, int], Sequence[Any]]]
"""The values of each feature, in those types that have it, which are given with their sizes."""


def _owned(sizes: Mapping[str, int], situations: Sequence[Mapping[str, Any]]) -> _Owned:
    """Return the values of each feature of the situations, None where a case of a type does not have it."""
    owners: dict[str, dict[str, int]] = {}
    values: dict[str, list[Any]] = {}
    first = 0
    for name, size in sizes.items():
        for feature, each in _values_by_feature(situations[first : first + size]).items():
            owners.setdefault(feature, {})[name] = size
            values.setdefault(feature, []).extend(each)
        first += size
    reserved = RESERVED.intersection(owners)
    assert not reserved, f"features of a situation cannot be named {', '.join(sorted(reserved))}"
    return {feature: (types, values[feature]) for feature, types in owners.items()}


def _values_by_feature(situations: Sequence[Mapping[str, Any]]) -> Mapping[str, Sequence[Any]]:
    names = tuple(situations[0])
    if len(names) > 1 and {*map(len, situations)} == {len(names)}:  # as of most types, whose fields are always set
        with suppress(KeyError):
            return dict(zip(names, zip(*map(itemgetter(*names), situations), strict=True), strict=True))
    features = frozenset[str]().union(*situations)
    return {feature: [each.get(feature) for each in situations] for feature in features}


def _spreads(owned: _Owned, column_of: Callable[[Sequence[Any]], Column]) -> Spreads:
    """Make the column of each feature, without the types of which no case has a value that is kept."""
    spreads = {}
    for feature, (sizes, values) in sorted(owned.items()):
        column, types = column_of(values), tuple(sizes)
        present = column.present()
        if not present.all():
            having = np.logical_or.reduceat(present, np.cumsum([0, *sizes.values()])[:-1])
            types = tuple(name for name, each in zip(sizes, having.tolist(), strict=True) if each)
            column = column.taken(np.repeat(having, [*sizes.values()]).nonzero()[0])
        if types:
            spreads[feature] = Spread(types, column)
    return spreads


def _limited(case: Case) -> Case:
    """Return a case with the first `FEATURES_MAX` of its features that a block keeps."""
    symbols = {name: value for name, value in case.symbols.items() if bounded(value)}
    numbers = {name: number for name, number in case.numbers.items() if math.isfinite(number)}
    kept = {*sorted({*symbols, *numbers})[:FEATURES_MAX]}
    return case._replace(
        symbols={name: value for name, value in symbols.items() if name in kept},
        numbers={name: number for name, number in numbers.items() if name in kept},
    )


def _without_long_dictionaries(block: Block) -> Block:
    long = {name for name, each in block.texts.items() if each.column.words.word_count > WORDS_MAX}
    left_out = block.left_out | long
    if not left_out:
        return block
    return replace(
        block, texts={name: each for name, each in block.texts.items() if name not in left_out}, left_out=left_out
    )


# === block bytes ==============================================================================================
#
# The bytes of a block: the length of its heading in 8 bytes, the heading as MessagePack, and the arrays, all
# little-endian. The heading and each array are followed by zeros up to a multiple of 8 bytes, so that arrays can be
# used where they are read. A block of 65,536 cases is decoded in 0.1 ms, as `npz` in 5 ms; Arrow would be a dependency.


class _Heading(msgspec.Struct, array_like=True):
    """The number of cases of each type, feature, types, kind and dictionary of each column, and what is left out.

    The arrays are the nodes and starts (int64), the parents (int32), and the values of each column of this kind.
    """

    sizes: dict[str, int]
    columns: list[tuple[str, tuple[str, ...], str, list[str | tuple[str, ...]] | None]]
    left_out: list[str]


_heading: Final = msgspec.msgpack.Decoder(_Heading).decode


def encode(block: Block) -> bytes:
    """Return the bytes of a block."""
    spreads = [*block.texts.items(), *block.numbers.items()]
    columns = [(name, types, _kind(each.values), each.dictionary()) for name, (types, each) in spreads]
    heading = msgspec.msgpack.encode(_Heading({**block.sizes}, columns, sorted(block.left_out)))
    arrays: list[NDArray[Any]] = [block.nodes, block.started_us, block.parents]
    arrays += [each.column.values for _, each in spreads]
    parts = [len(heading).to_bytes(8, "little"), heading, *(each.astype(_kind(each)).tobytes() for each in arrays)]
    return b"".join(chain.from_iterable((each, bytes(-len(each) % 8)) for each in parts))


def decode(data: bytes) -> Block:
    """Return the block of the bytes that `encode` made; its arrays share their memory."""
    place = 8 + int.from_bytes(data[:8], "little")
    heading = _heading(data[8:place])

    def array(kind: str, count: int) -> NDArray[Any]:
        nonlocal place
        place += -place % 8
        values = np.frombuffer(data, kind, count, place)
        place += values.nbytes
        return values

    count = sum(heading.sizes.values())
    arrays = array("<i8", count), array("<i8", count), array("<i4", count)
    texts, numbers = {}, {}
    for feature, types, kind, words in heading.columns:
        values = array(kind, sum(heading.sizes[name] for name in types))
        if words is None:
            numbers[feature] = Spread(types, Column(values))
        else:
            texts[feature] = Spread(types, Column(values, Words(words)))
    return Block(heading.sizes, *arrays, texts, numbers, frozenset(heading.left_out))


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

    def __init__(self, blocks: Sequence[Block] = (), names: Mapping[str, str] = MappingProxyType({})) -> None:
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
            chosen = [
                self._group(block.groups[name]) for block in self.blocks for name in block.sizes if self._is(name, type)
            ]
            groups = tuple(sorted(chosen, key=lambda each: (-int(each.started_us[0]), -int(each.nodes[0]))))
            self._groups[type] = groups
        return groups

    def _group(self, group: Group) -> Group:
        present = self.present_name(group.type)
        return group if present == group.type else replace(group, type=present)

    def words(self, feature: str) -> Words:
        """Return one dictionary of a text feature, for the cases of all types."""
        if feature not in self._words:
            columns = (block.texts[feature].column for block in self.blocks if feature in block.texts)
            self._words[feature] = joined_words(column.words for column in columns) or Words()
        return self._words[feature]

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
        """Return the least and the greatest number of a feature among the cases of a type; None without any."""
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
