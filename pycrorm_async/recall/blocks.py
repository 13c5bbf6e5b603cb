"""A block holds many cases as columns; `block_rows` encodes it as rows of a table.

The cases of one type form a group, the newest first: by the time of their start, then by their node. Groups follow each
other in the alphabetical order of their types. A column has the cases of those types that have its feature, so types
whose parameters differ take no space from each other. Equal cases make equal columns, in any order and by any merges.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from typing import Any, Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.events.ids import SEQUENCE_MAX, row_id, row_key
from pycrorm_async.recall.case import FEATURES_MAX, RESERVED, Case, bounded_case
from pycrorm_async.recall.columns import Numbers, Sets, Symbols, joined_numbers, joined_words

WORDS_MAX: Final = 16_384
"""Bounds the words of a feature in a memory.

A feature with more of them identifies single cases, so it cannot show that two are similar.
"""
EPISODE_SHIFT: Final = row_id(1, 0, 0).bit_length() - 1
"""The bits of a node's id below its episode's number."""

_SEQUENCE: Final = row_id(0, 1, 0)
_Column = TypeVar("_Column", Numbers, Symbols | Sets)
Rows = slice | NDArray[np.int64]


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
    """Counts and sums of this group, computed at the first search; `CaseLibrary` and `joined_words` own the keys."""

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
class Spread(Generic[_Column]):
    """A column over the groups of some types of a block, in their order."""

    types: tuple[str, ...]
    column: _Column


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
    texts: Mapping[str, Spread[Symbols | Sets]]
    numbers: Mapping[str, Spread[Numbers]]
    left_out: frozenset[str] = frozenset()

    @classmethod
    def of(cls, cases: Iterable[Case]) -> Block:
        """Make a block of cases, each as `bounded_case` returns it."""
        rows = [case if len(case.symbols) + len(case.numbers) <= FEATURES_MAX else bounded_case(case) for case in cases]
        counts = Counter(case.type for case in rows)
        sizes = {name: counts[name] for name in sorted(counts)}
        codes = {name: code for code, name in enumerate(sizes)}
        types = np.array([codes[case.type] for case in rows])
        nodes = np.array([case.node for case in rows], np.int64)
        started = np.array([case.started_us for case in rows], np.int64)
        order = np.lexsort((-nodes, -started, types))
        ordered = [rows[place] for place in order.tolist()]
        columns = list(zip(*ordered, strict=True)) or [()] * len(Case._fields)
        *_, symbols, numbers, statuses, reasons, durations, parents, simulated = columns
        texts: dict[str, Spread[Symbols | Sets]] = {
            "status": _spread(sizes, _texts, statuses),
            "reason": _spread(sizes, _texts, reasons),
            "simulated": _spread(sizes, _texts, ["yes" if each else None for each in simulated]),
            **_spreads(sizes, _texts, symbols),
        }
        values = {"duration": _spread(sizes, Numbers.of, durations), **_spreads(sizes, Numbers.of, numbers)}
        return _without_long_dictionaries(
            cls(
                sizes,
                nodes[order],
                started[order],
                (np.array([each or 0 for each in parents], np.int64) // _SEQUENCE & SEQUENCE_MAX).astype(np.int32),
                {name: each for name, each in sorted(texts.items()) if each.types},
                {name: each for name, each in sorted(values.items()) if each.types},
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
        spans, first = {}, 0
        for name, size in self.sizes.items():
            spans[name] = slice(first, first + size)
            first += size
        return spans

    @cached_property
    def groups(self) -> dict[str, Group]:
        """The groups by type, in alphabetical order."""
        return {name: self.group(name) for name in self.sizes}

    def group(self, name: str) -> Group:
        """Return the cases of a type, always the same object; the columns share the memory of the block."""
        if name not in self._made:
            self._made[name] = self._group(name)
        return self._made[name]

    @cached_property
    def _made(self) -> dict[str, Group]:
        return {}

    def _group(self, name: str) -> Group:
        span = self.spans[name]
        return Group(
            name,
            self.nodes[span],
            self.started_us[span],
            self.parents[span],
            {feature: self._part(each, name) for feature, each in self.texts.items() if name in each.types},
            {feature: self._part(each, name) for feature, each in self.numbers.items() if name in each.types},
        )

    def where(self, kept: NDArray[np.bool_]) -> Block:
        """Return the block with those of its cases for which `kept` is True, in their order."""
        sizes = {name: size for name, span in self.spans.items() if (size := int(kept[span].sum()))}
        columns = self.nodes[kept], self.started_us[kept], self.parents[kept]
        texts = {name: self._where(each, kept, sizes) for name, each in self.texts.items()}
        numbers = {name: self._where(each, kept, sizes) for name, each in self.numbers.items()}
        texts = {name: each for name, each in texts.items() if each.types}
        numbers = {name: each for name, each in numbers.items() if each.types}
        return Block(sizes, *columns, texts, numbers, self.left_out)

    def _where(self, spread: Spread[_Column], kept: NDArray[np.bool_], sizes: Mapping[str, int]) -> Spread[_Column]:
        column = spread.column.taken(np.flatnonzero(kept[self.rows_of(spread.types)]))
        return Spread(tuple(name for name in spread.types if name in sizes), column)

    def rows_of(self, types: tuple[str, ...]) -> Rows:
        """Return the places of the cases of these types."""
        if len(types) == len(self.sizes):
            return slice(None)
        return np.concatenate([np.arange(self.spans[name].start, self.spans[name].stop) for name in types])

    def _part(self, spread: Spread[_Column], name: str) -> _Column:
        first = sum(self.sizes[each] for each in spread.types[: spread.types.index(name)])
        return spread.column.part(first, first + self.sizes[name])


def merge(blocks: Sequence[Block]) -> Block:
    """Return one block with the cases of all."""
    names = sorted({name for block in blocks for name in block.sizes})
    codes = {name: code for code, name in enumerate(names)}
    types = np.concatenate([np.repeat([codes[name] for name in each.sizes], [*each.sizes.values()]) for each in blocks])
    nodes = np.concatenate([each.nodes for each in blocks])
    started = np.concatenate([each.started_us for each in blocks])
    order = np.lexsort((-nodes, -started, types))
    sizes = dict(zip(names, np.bincount(types, minlength=len(names)).tolist(), strict=True))
    parents = np.concatenate([each.parents for each in blocks])[order]
    left_out = frozenset[str]().union(*(each.left_out for each in blocks))
    merged = Block(sizes, nodes[order], started[order], parents, {}, {}, left_out)
    rows: dict[tuple[Block, tuple[str, ...]], Rows] = {}

    def places(block: Block, owners: tuple[str, ...]) -> Rows:
        if (block, owners) not in rows:
            rows[block, owners] = block.rows_of(owners)
        return rows[block, owners]

    def joined(spreads: Sequence[Spread[_Column] | None], join: Callable[..., _Column]) -> Spread[_Column]:
        owned = {name for each in spreads if each is not None for name in each.types}
        owners = tuple(name for name in names if name in owned)
        whole = join(
            [
                None if each is None else each.column.placed(places(block, each.types), len(block))
                for block, each in zip(blocks, spreads, strict=True)
            ],
            [len(block) for block in blocks],
        )
        return Spread(owners, whole.taken(order).taken(places(merged, owners)))

    texts = {
        name: joined([block.texts.get(name) for block in blocks], joined_words)
        for name in sorted({name for block in blocks for name in block.texts} - left_out)
    }
    numbers = {
        name: joined([block.numbers.get(name) for block in blocks], joined_numbers)
        for name in sorted({name for block in blocks for name in block.numbers})
    }
    return _without_long_dictionaries(
        Block(sizes, merged.nodes, merged.started_us, merged.parents, texts, numbers, left_out)
    )


# --- columns of cases -----------------------------------------------------------------------------------------


def _spreads(
    sizes: Mapping[str, int], column: Callable[[Sequence[Any]], _Column], situations: Sequence[Mapping[str, Any]]
) -> dict[str, Spread[_Column]]:
    """Make the column of each feature of the situations, each over the types that have it."""
    owners: dict[str, list[str]] = {}
    values: dict[str, list[Any]] = {}
    first = 0
    for name, size in sizes.items():
        for feature, each in _values_by_feature(situations[first : first + size]).items():
            owners.setdefault(feature, []).append(name)
            values.setdefault(feature, []).extend(each)
        first += size
    reserved = RESERVED.intersection(owners)
    assert not reserved, f"features of a situation cannot be named {', '.join(sorted(reserved))}"
    spreads = {}
    for feature, types in owners.items():
        spreads[feature] = _spread({name: sizes[name] for name in types}, column, values[feature])
    return spreads


def _values_by_feature(situations: Sequence[Mapping[str, Any]]) -> Mapping[str, Sequence[Any]]:
    """Return the values of each feature of the situations, None where one does not have it."""
    names = tuple(situations[0])
    if len(names) > 1 and {*map(len, situations)} == {len(names)}:  # as of most types, whose fields are always set
        with suppress(KeyError):
            return dict(zip(names, zip(*map(itemgetter(*names), situations), strict=True), strict=True))
    features = frozenset[str]().union(*situations)
    return {feature: [each.get(feature) for each in situations] for feature in features}


def _spread(
    sizes: Mapping[str, int], column: Callable[[Sequence[Any]], _Column], values: Sequence[Any]
) -> Spread[_Column]:
    """Make the column of a feature, without the types of which no case has a value that is kept."""
    spread = Spread(tuple(sizes), column(values))
    present = spread.column.present()
    if present.all():
        return spread
    firsts = np.cumsum([0, *sizes.values()])[:-1]
    having = np.logical_or.reduceat(present, firsts).tolist()
    types = tuple(name for name, each in zip(sizes, having, strict=True) if each)
    kept = np.repeat(having, [*sizes.values()])
    return spread if all(having) else Spread(types, spread.column.taken(np.flatnonzero(kept)))


def _texts(values: Sequence[Any]) -> Symbols | Sets:
    return Sets.of(values) if tuple in {*map(type, values)} else Symbols.of(values)


def _without_long_dictionaries(block: Block) -> Block:
    long = {name for name, each in block.texts.items() if len(each.column.words) > WORDS_MAX}
    if not long:
        return block
    texts = {name: each for name, each in block.texts.items() if name not in long}
    columns = block.nodes, block.started_us, block.parents
    return Block(block.sizes, *columns, texts, block.numbers, block.left_out | long)
