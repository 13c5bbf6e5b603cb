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

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.recall.blocks import Block, Group
from pycrorm_async.recall.columns import Numbers, Sets, Symbols, Words, joined_numbers, joined_words

__all__ = ["BlockRow", "decode", "encode"]

_Shape = TypeVar("_Shape")


class BlockRow(NamedTuple):
    """One row of a stored block; see the module."""

    feature: str
    kind: str
    words: str | None
    data: bytes


def encode(block: Block) -> list[BlockRow]:
    """Return the rows of a block. Raises `ValueError` for a block without a case."""
    groups = list(block.groups.values())
    if not groups:
        raise ValueError("a block without a case has no rows")
    sizes = np.array([len(each) for each in groups], "<u4")
    rows = [
        BlockRow("type", "groups", _json([each.type for each in groups]), sizes.tobytes()),
        BlockRow("node", "integer64", None, _bytes([each.nodes for each in groups], "<i8")),
        BlockRow("started", "integer64", None, _bytes([each.started_us for each in groups], "<i8")),
        BlockRow("parent", "integer32", None, _bytes([each.parents for each in groups], "<i4")),
    ]
    for name in sorted({name for each in groups for name in each.texts}):
        owners = [each for each in groups if name in each.texts]
        rows.append(_text_row(name, owners, joined_words([(each.texts[name], len(each)) for each in owners])))
    for name in sorted({name for each in groups for name in each.numbers}):
        owners = [each for each in groups if name in each.numbers]
        values = joined_numbers([(each.numbers[name], len(each)) for each in owners]).values
        types = _json({"types": [each.type for each in owners]})
        width = values.itemsize
        rows.append(BlockRow(name, f"number{8 * width}", types, values.astype(f"<f{width}").tobytes()))
    return [*rows, *(BlockRow(name, "left_out", None, b"") for name in sorted(block.left_out))]


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
    spans = _spans(_decoded(names, list[str]), _array(sizes, "<u4"))
    texts: dict[str, dict[str, Symbols | Sets]] = {name: {} for name in spans}
    numbers: dict[str, dict[str, Numbers]] = {name: {} for name in spans}
    left_out = set()
    for (feature, kind), (words, data) in by_key.items():
        if kind == "left_out":
            left_out.add(feature)
        elif kind in ("number32", "number64"):
            for name, column in _number_columns(feature, kind, words, data, spans):
                numbers[name][feature] = column
        else:
            for name, text in _text_columns(feature, kind, words, data, spans):
                texts[name][feature] = text
    count = sum(span.stop - span.start for span in spans.values())
    node, start, parent = _array(nodes, "<i8", count), _array(started, "<i8", count), _array(parents, "<i4", count)
    groups = {
        name: Group(name, node[span], start[span], parent[span], texts[name], numbers[name])
        for name, span in spans.items()
    }
    for group in groups.values():
        _validate(group)
    return Block(groups, frozenset(left_out))


# --- rows of columns ------------------------------------------------------------------------------------------


class _Types(msgspec.Struct):
    types: list[str]


class _Dictionary(_Types):
    words: list[str]


def _text_row(name: str, owners: Sequence[Group], column: Symbols | Sets) -> BlockRow:
    words = _json({"types": [each.type for each in owners], "words": list(column.words)})
    width = 1 if len(column.words) < 256 else 2
    codes = column.codes.astype(f"<u{width}").tobytes()
    if isinstance(column, Sets):
        return BlockRow(name, f"set{8 * width}", words, column.sizes.tobytes() + codes)
    return BlockRow(name, f"symbol{8 * width}", words, codes)


def _number_columns(
    feature: str, kind: str, words: str | None, data: bytes, spans: Mapping[str, slice]
) -> Iterator[tuple[str, Numbers]]:
    owners, count = _owners(feature, _decoded(words, _Types).types, spans)
    values = _array(data, "<f4" if kind == "number32" else "<f8", count)
    return ((name, Numbers(values[span])) for name, span in owners)


def _text_columns(
    feature: str, kind: str, words: str | None, data: bytes, spans: Mapping[str, slice]
) -> Iterator[tuple[str, Symbols | Sets]]:
    if kind not in ("symbol8", "symbol16", "set8", "set16"):
        raise ValueError(f"feature {feature!r} has the unknown kind {kind!r}")
    dictionary = _decoded(words, _Dictionary)
    known = Words(dictionary.words)
    owners, count = _owners(feature, dictionary.types, spans)
    dtype = "<u1" if kind.endswith("8") else "<u2"
    if kind.startswith("symbol"):
        codes = _array(data, dtype, count)
        _validate_codes(feature, codes, known)
        for name, span in owners:
            yield name, Symbols(known, codes[span])
        return
    sizes = _array(data[:count], "<u1", count)
    codes = _array(data[count:], dtype, int(sizes.sum(dtype=np.int64)))
    _validate_codes(feature, codes, known)
    first = 0
    for name, span in owners:
        last = first + int(sizes[span].sum(dtype=np.int64))
        yield name, Sets(known, sizes[span], codes[first:last])
        first = last


def _validate_codes(feature: str, codes: NDArray[Any], words: Words) -> None:
    if codes.size and int(codes.max()) > len(words):
        raise ValueError(f"feature {feature!r} has the code {int(codes.max())} and {len(words)} words")


def _spans(types: Sequence[str], sizes: NDArray[Any]) -> dict[str, slice]:
    if len(types) != sizes.size or len(set(types)) != len(types):
        raise ValueError(f"the block has {len(types)} types and {sizes.size} sizes of groups")
    ends = np.cumsum(sizes, dtype=np.int64).tolist()
    return {name: slice(end - size, end) for name, end, size in zip(types, ends, sizes.tolist(), strict=True)}


def _owners(feature: str, types: Sequence[str], spans: Mapping[str, slice]) -> tuple[list[tuple[str, slice]], int]:
    """Return the span of each type in a column that has only these types, and the length of the column."""
    strange = [name for name in types if name not in spans]
    if strange or len(set(types)) != len(types):
        raise ValueError(f"feature {feature!r} has the types {types!r}, the block {list(spans)!r}")
    owners, first = [], 0
    for name in types:
        last = first + spans[name].stop - spans[name].start
        owners.append((name, slice(first, last)))
        first = last
    return owners, first


def _array(data: bytes, dtype: str, count: int | None = None) -> NDArray[Any]:
    """Return the values; `count` is their number, if the block knows it."""
    if len(data) % np.dtype(dtype).itemsize or count not in (None, len(data) // np.dtype(dtype).itemsize):
        raise ValueError(f"{len(data)} bytes are not {count} values of {np.dtype(dtype).name}")
    return np.frombuffer(data, dtype)


def _bytes(parts: Sequence[NDArray[Any]], dtype: str) -> bytes:
    return np.concatenate(parts).astype(dtype).tobytes()


def _json(value: object) -> str:
    return msgspec.json.encode(value).decode()


def _decoded(text: str | None, shape: type[_Shape]) -> _Shape:
    try:
        return msgspec.json.decode(text or "", type=shape)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise ValueError(f"the words of a column cannot be read: {error}") from None


def _validate(group: Group) -> None:
    """Raise `ValueError` for cases that are not in order."""
    ages = np.diff(group.started_us)
    if ((ages > 0) | ((ages == 0) & (np.diff(group.nodes) >= 0))).any():
        raise ValueError(f"the cases of {group.type} are not in the order of their starts")
