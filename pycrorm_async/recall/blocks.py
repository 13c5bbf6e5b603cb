"""A block holds many cases as columns; the section "block rows" encodes it as rows of a table.

The cases of one type form a group, the newest first: by the time of their start, then by their node. Groups follow each
other in the alphabetical order of their types. A column has the cases of those types that have its feature, so types
whose parameters differ take no space from each other. Equal cases make equal columns, in any order and by any merges.

**Block rows.** Encode a block as rows `(feature, kind, words, data)` of a table, and decode it from them.

The groups follow each other in the alphabetical order of their types. The column of a feature holds one value for each
case of the groups that have the feature, group after group.

| kind | words | data, little-endian |
|---|---|---|
| `groups` (feature `type`) | the types, as a JSON list | uint32: the number of cases of each |
| `integer64` (`node`, `started`) | NULL | int64 for each case: id of the node; µs since 1970 |
| `integer32` (`parent`) | NULL | int32: sequence of the nearest action around it; 0 for none |
| `symbol8`, `symbol16` | `{"types": [...], "words": [...]}` | uint8 or uint16: 0 for none, else 1 + the word's place |
| `set8`, `set16` | the same | uint8: how many values each case has; then all values, as for `symbol` |
| `number32`, `number64` | `{"types": [...]}` | float32 or float64; NaN for none |
| `left_out` | NULL | empty: the feature has more than `WORDS_MAX` words here, so it is not kept |

A feature may have a row of text and one of numbers: feature and kind name a row. Equal cases make equal rows, whatever
their order. The words of a column are in alphabetical order.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from operator import itemgetter
from types import MappingProxyType
from typing import Any, Final, Generic, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.events.ids import SEQUENCE_MAX, row_id, row_key
from pycrorm_async.recall.columns import (
    FEATURES_MAX,
    RESERVED,
    Case,
    Numbers,
    Sets,
    Symbols,
    Words,
    bounded_case,
    is_angle,
    joined,
    joined_numbers,
    joined_words,
)

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


# === block rows ===============================================================================================

_Shape = TypeVar("_Shape")


class BlockRow(NamedTuple):
    """One row of a stored block; see the module."""

    feature: str
    kind: str
    words: str | None
    data: bytes


def encode(block: Block) -> list[BlockRow]:
    """Return the rows of a block. Raises `ValueError` for a block without a case."""
    if not block.sizes:
        raise ValueError("a block without a case has no rows")
    return [
        BlockRow("type", "groups", _json(list(block.sizes)), np.array([*block.sizes.values()], "<u4").tobytes()),
        BlockRow("node", "integer64", None, block.nodes.astype("<i8").tobytes()),
        BlockRow("started", "integer64", None, block.started_us.astype("<i8").tobytes()),
        BlockRow("parent", "integer32", None, block.parents.astype("<i4").tobytes()),
        *(_text_row(name, each) for name, each in block.texts.items()),
        *(_number_row(name, each) for name, each in block.numbers.items()),
        *(BlockRow(name, "left_out", None, b"") for name in sorted(block.left_out)),
    ]


def decode(rows: Iterable[tuple[str, str, str | None, bytes]]) -> Block:
    """Return the block of these rows, in any order. Raises `ValueError` if they contradict each other."""
    by_key = {(feature, kind): (words, data) for feature, kind, words, data in rows}
    try:
        names, sizes = by_key.pop(("type", "groups"))
        nodes, started, parents = (
            by_key.pop(each)[1] for each in (("node", "integer64"), ("started", "integer64"), ("parent", "integer32"))
        )
    except KeyError as error:
        raise ValueError(f"the block has no row {error}") from None
    groups = _sizes(_decoded(names, list[str]), _array(sizes, "<u4"))
    texts: dict[str, Spread[Symbols | Sets]] = {}
    numbers: dict[str, Spread[Numbers]] = {}
    left_out = set()
    for (feature, kind), (words, data) in sorted(by_key.items()):
        if kind == "left_out":
            left_out.add(feature)
        elif kind in ("number32", "number64"):
            numbers[feature] = _numbers(feature, kind, words, data, groups)
        else:
            texts[feature] = _row_texts(feature, kind, words, data, groups)
    count = sum(groups.values())
    node, start, parent = _array(nodes, "<i8", count), _array(started, "<i8", count), _array(parents, "<i4", count)
    block = Block(groups, node, start, parent, texts, numbers, frozenset(left_out))
    _validate_order(block)
    return block


# --- rows of columns ------------------------------------------------------------------------------------------


class _Types(msgspec.Struct):
    types: list[str]


class _Dictionary(_Types):
    words: list[str]


def _text_row(name: str, spread: Spread[Symbols | Sets]) -> BlockRow:
    column = spread.column
    words = _json({"types": spread.types, "words": tuple(column.words)})
    width = 1 if len(column.words) < 256 else 2
    codes = column.codes.astype(f"<u{width}").tobytes()
    if isinstance(column, Sets):
        return BlockRow(name, f"set{8 * width}", words, column.sizes.tobytes() + codes)
    return BlockRow(name, f"symbol{8 * width}", words, codes)


def _number_row(name: str, spread: Spread[Numbers]) -> BlockRow:
    values = spread.column.values
    data = values.astype(f"<f{values.itemsize}").tobytes()
    return BlockRow(name, f"number{8 * values.itemsize}", _json({"types": spread.types}), data)


def _numbers(feature: str, kind: str, words: str | None, data: bytes, groups: Mapping[str, int]) -> Spread[Numbers]:
    types = _decoded(words, _Types).types
    count = _count(feature, types, groups)
    return Spread(tuple(types), Numbers(_array(data, "<f4" if kind == "number32" else "<f8", count)))


def _row_texts(
    feature: str, kind: str, words: str | None, data: bytes, groups: Mapping[str, int]
) -> Spread[Symbols | Sets]:
    if kind not in ("symbol8", "symbol16", "set8", "set16"):
        raise ValueError(f"feature {feature!r} has the unknown kind {kind!r}")
    dictionary = _decoded(words, _Dictionary)
    vocabulary, types = Words(dictionary.words), tuple(dictionary.types)
    count = _count(feature, dictionary.types, groups)
    dtype = "<u1" if kind.endswith("8") else "<u2"
    if kind.startswith("symbol"):
        codes = _array(data, dtype, count)
        _validate_codes(feature, codes, vocabulary)
        return Spread(types, Symbols(vocabulary, codes))
    sizes = _array(data[:count], "<u1", count)
    codes = _array(data[count:], dtype, int(sizes.sum(dtype=np.int64)))
    _validate_codes(feature, codes, vocabulary)
    return Spread(types, Sets(vocabulary, sizes, codes))


def _validate_codes(feature: str, codes: NDArray[Any], words: Words) -> None:
    if codes.size and int(codes.max()) > len(words):
        raise ValueError(f"feature {feature!r} has the code {int(codes.max())} and {len(words)} words")


def _sizes(types: Sequence[str], sizes: NDArray[Any]) -> dict[str, int]:
    if len(types) != sizes.size or len(set(types)) != len(types):
        raise ValueError(f"the block has {len(types)} types and {sizes.size} sizes of groups")
    return dict(zip(types, sizes.tolist(), strict=True))


def _count(feature: str, types: Sequence[str], groups: Mapping[str, int]) -> int:
    """Return the length of a column that has these types only."""
    owners = set(types)
    if list(types) != [name for name in groups if name in owners]:
        raise ValueError(f"feature {feature!r} has the types {types!r}, the block {list(groups)!r}")
    return sum(groups[name] for name in types)


def _array(data: bytes, dtype: str, count: int | None = None) -> NDArray[Any]:
    """Return the values; `count` is their number, if the block knows it."""
    if len(data) % np.dtype(dtype).itemsize or count not in (None, len(data) // np.dtype(dtype).itemsize):
        raise ValueError(f"{len(data)} bytes are not {count} values of {np.dtype(dtype).name}")
    return np.frombuffer(data, dtype)


def _json(value: object) -> str:
    return msgspec.json.encode(value).decode()


def _decoded(text: str | None, shape: type[_Shape]) -> _Shape:
    try:
        return msgspec.json.decode(text or "", type=shape)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise ValueError(f"the words of a column cannot be read: {error}") from None


def _validate_order(block: Block) -> None:
    """Raise `ValueError` for cases of one type that are not in order."""
    ages = np.diff(block.started_us)
    wrong = (ages > 0) | ((ages == 0) & (np.diff(block.nodes) >= 0))
    wrong[np.cumsum([*block.sizes.values()])[:-1] - 1] = False
    if wrong.any():
        raise ValueError("the cases of a type are not in the order of their starts")


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

    def range_of(self, type: str | None, feature: str) -> tuple[float, float] | None:  # noqa: A002
        """Return the least and the greatest number of a feature among the cases of a type; None without any."""
        groups = [group for group in self.groups(type) if feature in group.numbers]
        ranges = [_cached(group, ("range", feature), lambda group: _range(group, feature)) for group in groups]
        lows_and_highs = [each for each in ranges if each is not None]
        if not lows_and_highs:
            return None
        return min(low for low, _ in lows_and_highs), max(high for _, high in lows_and_highs)

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
