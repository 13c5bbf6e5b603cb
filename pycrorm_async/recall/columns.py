"""Hold one feature of many cases as a column of a block (`recall.blocks`), in NumPy arrays.

`Symbols` holds at most one word a case, `Sets` several, `Numbers` a float. Words are kept once, in a dictionary of the
column; code 0 means that a case does not have the feature, code i the word i - 1, and NaN that it has no number.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.events.ids import row_key

Mask: TypeAlias = NDArray[np.bool_]
Codes: TypeAlias = "NDArray[np.unsignedinteger[Any]]"
Floats: TypeAlias = NDArray[np.floating[Any]]
Rows: TypeAlias = "slice | NDArray[np.int64]"


class Words(tuple[str, ...]):
    """The dictionary of a column: different words, in alphabetical order."""

    @cached_property
    def codes(self) -> Mapping[str, int]:
        """The code of each word."""
        return {word: code for code, word in enumerate(self, 1)}

    def code(self, word: str) -> int:
        """Return the code of a word; 0 if no case has it."""
        return self.codes.get(word, 0)

    def codes_in(self, other: Words) -> Codes:
        """Return, for each code of this dictionary, that of its word in another one, which contains all of them.

        The last result is kept, because the columns of many groups share two dictionaries.
        """
        kept: tuple[Words, Codes] | None = self.__dict__.get("_codes_in")
        if kept is None or kept[0] is not other:
            codes = other.codes
            kept = other, smallest_codes([0, *(codes[word] for word in self)], len(other))
            self.__dict__["_codes_in"] = kept
        return kept[1]


class Symbols:
    """A text feature that has at most one value a case."""

    def __init__(self, words: Words, codes: Codes) -> None:
        self.words = words
        self.codes = codes

    @classmethod
    def of(cls, values: Sequence[Any]) -> Symbols:
        """Make the column of these texts, None where a case does not have the feature. Long ones are left out."""
        different = {*values}
        words = Words(sorted(each for each in different if each and len(each) <= TEXT_MAX))
        codes = {**dict.fromkeys(different, 0), **words.codes}
        return cls(words, np.fromiter(map(codes.__getitem__, values), np.min_scalar_type(len(words)), len(values)))

    def equal_to(self, word: str, rows: slice) -> Mask:
        """Return a mask of these rows: True where the case has the word."""
        code = self.words.code(word)
        return self.codes[rows] == code if code else np.zeros(self.codes[rows].size, np.bool_)

    def value(self, row: int) -> str | None:
        """Return the value of a case; None if it has none."""
        code = int(self.codes[row])
        return self.words[code - 1] if code else None

    def counts(self) -> NDArray[np.int64]:
        """Return the number of cases that have each code."""
        return np.bincount(self.codes, minlength=len(self.words) + 1)

    def present(self) -> Mask:
        """Return a mask of all cases: True where the case has the feature."""
        return self.codes > 0

    def part(self, first: int, last: int) -> Symbols:
        """Return the column of some cases, with the same dictionary."""
        return Symbols(self.words, self.codes[first:last])

    def placed(self, rows: Rows, count: int) -> Symbols:
        """Return the column of more cases, of which these rows are its own and the others have no value."""
        codes = np.zeros(count, self.codes.dtype)
        codes[rows] = self.codes
        return Symbols(self.words, codes)

    def taken(self, rows: Rows) -> Symbols:
        """Return the column with some of its cases, in their order."""
        return Symbols(self.words, self.codes[rows])

    def recoded(self, words: Words) -> Symbols:
        """Return the column with a dictionary that contains its own."""
        return self if words is self.words else Symbols(words, self.words.codes_in(words)[self.codes])


class Sets:
    """A text feature that has any number of values a case, as the types of nearby objects."""

    def __init__(self, words: Words, sizes: NDArray[np.uint8], codes: Codes) -> None:
        self.words = words
        self.sizes = sizes
        self.codes = codes

    @classmethod
    def of(cls, values: Sequence[Any]) -> Sets:
        """Make the column of these texts and tuples of texts, None where a case does not have the feature."""
        kept = {each: _bounded_set(each) for each in {*values}}
        words = Words(sorted({*chain.from_iterable(kept.values())}))
        codes = {each: [words.codes[word] for word in row] for each, row in kept.items()}
        rows = [codes[each] for each in values]
        sizes = np.array([len(row) for row in rows], np.uint8)
        return cls(words, sizes, smallest_codes([*chain.from_iterable(rows)], len(words)))

    @cached_property
    def _ends(self) -> NDArray[np.int64]:
        return np.cumsum(self.sizes, dtype=np.int64)

    @cached_property
    def _rows(self) -> NDArray[np.int32]:
        return np.repeat(np.arange(self.sizes.size, dtype=np.int32), self.sizes)

    def equal_to(self, word: str, rows: slice) -> Mask:
        """Return a mask of these rows: True where the case has the word among its values."""
        start, stop, _ = rows.indices(self.sizes.size)
        mask = np.zeros(stop - start, np.bool_)
        code = self.words.code(word)
        if code and stop > start:
            ends = self._ends
            values = slice(int(ends[start] - self.sizes[start]), int(ends[stop - 1]))
            mask[self._rows[values][self.codes[values] == code] - start] = True
        return mask

    def value(self, row: int) -> tuple[str, ...] | None:
        """Return the values of a case; None if it has none."""
        end = int(self._ends[row])
        codes = self.codes[end - int(self.sizes[row]) : end].tolist()
        return tuple(self.words[code - 1] for code in codes) or None

    def counts(self) -> NDArray[np.int64]:
        """Return the number of cases that have each code."""
        return np.bincount(self.codes, minlength=len(self.words) + 1)

    def present(self) -> Mask:
        """Return a mask of all cases: True where the case has the feature."""
        return self.sizes > 0

    def part(self, first: int, last: int) -> Sets:
        """Return the column of some cases, with the same dictionary."""
        start = int(self._ends[first - 1]) if first else 0
        stop = int(self._ends[last - 1]) if last else 0
        return Sets(self.words, self.sizes[first:last], self.codes[start:stop])

    def placed(self, rows: Rows, count: int) -> Sets:
        """Return the column of more cases, of which these rows are its own and the others have no value."""
        sizes = np.zeros(count, np.uint8)
        sizes[rows] = self.sizes
        return Sets(self.words, sizes, self.codes)

    def taken(self, rows: Rows) -> Sets:
        """Return the column with some of its cases, in their order."""
        sizes = self.sizes[rows]
        starts = (self._ends - self.sizes)[rows]
        firsts = np.cumsum(sizes, dtype=np.int64) - sizes
        places = np.repeat(starts - firsts, sizes) + np.arange(int(sizes.sum(dtype=np.int64)))
        return Sets(self.words, sizes, self.codes[places])

    def recoded(self, words: Words) -> Sets:
        """Return the column with a dictionary that contains its own."""
        return self if words is self.words else Sets(words, self.sizes, self.words.codes_in(words)[self.codes])


class Numbers:
    """A number, as float32 unless a case has a larger one than `SINGLE_MAX`, which are kept as float64."""

    def __init__(self, values: Floats) -> None:
        self.values = values

    @classmethod
    def of(cls, values: Sequence[float | None]) -> Numbers:
        """Make the column of these numbers, None where a case does not have the feature; infinite ones are left out."""
        wide = np.array(values, np.float64)  # with NaN for None
        wide[np.isinf(wide)] = np.nan
        large = np.abs(wide) > SINGLE_MAX
        narrow = np.where(large, np.nan, wide).astype(np.float32)
        return cls(np.where(large, wide, narrow) if large.any() else narrow)

    def value(self, row: int) -> float | None:
        """Return the value of a case; None if it has none."""
        value = float(self.values[row])
        return value if value == value else None

    def present(self) -> Mask:
        """Return a mask of all cases: True where the case has the number."""
        return ~np.isnan(self.values)

    def part(self, first: int, last: int) -> Numbers:
        """Return the column of some cases."""
        return Numbers(self.values[first:last])

    def placed(self, rows: Rows, count: int) -> Numbers:
        """Return the column of more cases, of which these rows are its own and the others have no number."""
        values = np.full(count, np.nan, self.values.dtype)
        values[rows] = self.values
        return Numbers(values)

    def taken(self, rows: Rows) -> Numbers:
        """Return the column with some of its cases, in their order."""
        return Numbers(self.values[rows])


def joined_words(
    columns: Sequence[Symbols | Sets | None], sizes: Sequence[int], words: Words | None = None
) -> Symbols | Sets:
    """Put columns of one feature below each other; for a missing column, that many cases without the feature are added.

    `words` is a dictionary that contains those of all columns; by default it is made.
    """
    if words is None:
        words = joined([column.words for column in columns if column is not None])
    parts = list(zip(columns, sizes, strict=True))
    if any(isinstance(column, Sets) for column in columns):
        sets = [_as_sets(column, size).recoded(words) for column, size in parts]
        codes = np.concatenate([each.codes for each in sets])
        return Sets(words, np.concatenate([each.sizes for each in sets]), codes)
    symbols = [
        column.recoded(words).codes if isinstance(column, Symbols) else np.zeros(size, np.uint8)
        for column, size in parts
    ]
    return Symbols(words, np.concatenate(symbols) if symbols else np.zeros(0, np.uint8))


def joined_numbers(columns: Sequence[Numbers | None], sizes: Sequence[int]) -> Numbers:
    """Put columns of one number below each other; for a missing column, that many cases without it are added."""
    values = [
        np.full(size, np.nan, np.float32) if column is None else column.values
        for column, size in zip(columns, sizes, strict=True)
    ]
    return Numbers(np.concatenate(values))


def smallest_codes(codes: Any, largest: int) -> Codes:
    """Return codes as the smallest unsigned integers that hold `largest`."""
    smallest: Codes = np.asarray(codes, np.min_scalar_type(largest))
    return smallest


def joined(dictionaries: Iterable[Words]) -> Words:
    """Return one dictionary with the words of all."""
    different = {id(each): each for each in dictionaries}
    if len(different) == 1:
        return next(iter(different.values()))
    return Words(sorted({*chain.from_iterable(different.values())}))


def _bounded_set(value: str | tuple[str, ...] | None) -> tuple[str, ...]:
    words = (value,) if isinstance(value, str) else value or ()
    return tuple(sorted({each for each in words if each and len(each) <= TEXT_MAX}))[:SYMBOLS_MAX]


def _as_sets(column: Symbols | Sets | None, count: int) -> Sets:
    match column:
        case None:
            return Sets(Words(), np.zeros(count, np.uint8), np.zeros(0, np.uint8))
        case Symbols(words=words, codes=codes):
            return Sets(words, (codes > 0).astype(np.uint8), codes[codes > 0])
        case Sets():
            return column


# === case =====================================================================================================
#
# A case is one action that has ended: the situation in which it was started, and its outcome.
#
# The situation consists of symbols and numbers, each under the name of its feature, known before the action ran. The
# outcome (status, reason, duration) is never compared with a cue unless the cue names it. A case never changes.

OUTCOME = ("status", "reason", "duration")
"""The features of the outcome. They are found by name like others, but only if a cue names them."""
RESERVED = frozenset({"node", "parent", "started", "type", "simulated", *OUTCOME})
"""Names that a feature of a situation cannot have, because the case itself has them."""
FEATURES_MAX = 256
"""Bounds the features of one case; beyond them the last ones in alphabetical order are left out."""
SYMBOLS_MAX = 255
"""Bounds the symbols of one feature, as the objects nearby; beyond them the last ones in order are left out."""
TEXT_MAX = 120
"""The longest symbol in characters. A longer text is prose, which hardly ever recurs, and is left out."""
SINGLE_MAX = 2.0**24
"""Up to this magnitude a number is kept as float32, which here is exact to 1 or better; beyond it as float64."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Case(NamedTuple):
    """One action that has ended.

    Attributes:
        node: id of its task-tree node: episode number, sequence and slot 0 in one integer.
        started_us: its start, µs since 1970: the wall time of the episode's start and the monotonic time since then.
        type: its dtype, as `PickUpAction`.
        symbols: texts by feature; a tuple for a feature with several values at once, as the types of nearby objects.
        numbers: finite numbers by feature, in m, rad and s. A feature whose name ends in `yaw` is an angle.
        status: name of the `TaskStatus` with which it ended.
        reason: class of the failure; None without one.
        duration_s: None for an action that is LOST.
        parent: id of the node of the nearest action around it; None outside any.
        simulated: whether it belongs to a simulation.
    """

    node: int
    started_us: int
    type: str
    symbols: Mapping[str, str | tuple[str, ...]]
    numbers: Mapping[str, float]
    status: str
    reason: str | None = None
    duration_s: float | None = None
    parent: int | None = None
    simulated: bool = False

    @property
    def episode(self) -> int:
        """The number of its episode in this database."""
        return row_key(self.node).number

    @property
    def sequence(self) -> int:
        """The sequence of its start in its episode."""
        return row_key(self.node).sequence

    @property
    def started_at(self) -> datetime:
        """The moment of its start, to the microsecond."""
        return _EPOCH + timedelta(microseconds=self.started_us)


def bounded_case(case: Case) -> Case:
    """Return the case as blocks store it: without infinite numbers, long texts and excess features, numbers rounded.

    The result depends on the case alone, so an action gives the same case in any block.
    """
    symbols = {name: kept for name, value in case.symbols.items() if (kept := _bounded(value))}
    numbers = {name: _stored(value) for name, value in case.numbers.items() if math.isfinite(value)}
    taken = RESERVED & (symbols.keys() | numbers.keys())
    assert not taken, f"features of a situation cannot be named {', '.join(sorted(taken))}"
    if len(symbols) + len(numbers) > FEATURES_MAX:
        kept_names = set(sorted({*symbols, *numbers})[:FEATURES_MAX])
        symbols = {name: value for name, value in symbols.items() if name in kept_names}
        numbers = {name: value for name, value in numbers.items() if name in kept_names}
    duration_s = case.duration_s
    if duration_s is not None:
        duration_s = _stored(duration_s) if math.isfinite(duration_s) else None
    reason = case.reason if case.reason and len(case.reason) <= TEXT_MAX else None
    return case._replace(symbols=symbols, numbers=numbers, duration_s=duration_s, reason=reason)


def is_angle(feature: str) -> bool:
    """Return whether the feature is an angle in rad, so that -3.1 is near 3.1."""
    return feature.endswith("yaw")


def _bounded(value: str | tuple[str, ...]) -> str | tuple[str, ...]:
    if isinstance(value, str):
        return value if len(value) <= TEXT_MAX else ""
    return tuple(sorted({each for each in value if each and len(each) <= TEXT_MAX}))[:SYMBOLS_MAX]


def _stored(value: Any) -> float:
    return float(value) if abs(value) > SINGLE_MAX else float(np.float32(value))
