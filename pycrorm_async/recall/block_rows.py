"""Encode a block as rows `(feature, kind, words, data)` of a table, and decode it from them.

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

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.recall.blocks import Block, Spread
from pycrorm_async.recall.columns import Numbers, Sets, Symbols, Words

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
            texts[feature] = _texts(feature, kind, words, data, groups)
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


def _texts(
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
