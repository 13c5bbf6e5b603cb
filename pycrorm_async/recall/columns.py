"""The columns of a block: one feature of many cases of one type, as NumPy arrays.

`Symbols` holds at most one word a case, `Sets` several, `Numbers` a float. Words are kept once, in a dictionary of the
column; code 0 means that a case does not have the feature, code i the word i - 1, and NaN that it has no number.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["Column", "Mask", "Numbers", "Sets", "Symbols", "Words", "joined_numbers", "joined_words", "smallest_codes"]

Mask: TypeAlias = NDArray[np.bool_]
Codes: TypeAlias = "NDArray[np.unsignedinteger[Any]]"
Floats: TypeAlias = NDArray[np.floating[Any]]


class Words(tuple[str, ...]):
    """The dictionary of a column: different words, in alphabetical order."""

    @cached_property
    def _codes(self) -> Mapping[str, int]:
        return {word: code for code, word in enumerate(self, 1)}

    def code(self, word: str) -> int:
        """Return the code of a word; 0 if no case has it."""
        return self._codes.get(word, 0)


class Symbols:
    """A text feature that has at most one value a case."""

    def __init__(self, words: Words, codes: Codes) -> None:
        self.words = words
        self.codes = codes

    @classmethod
    def of(cls, values: Sequence[Any]) -> Symbols:
        """Make the column of these values, None where a case does not have the feature."""
        words = Words(sorted({each for each in values if each}))
        codes = {word: code for code, word in enumerate(words, 1)}
        return cls(words, smallest_codes([codes.get(each, 0) if each else 0 for each in values], len(words)))

    def equal_to(self, word: str, rows: slice) -> Mask:
        """Return which of these rows have the word."""
        code = self.words.code(word)
        return self.codes[rows] == code if code else np.zeros(self.codes[rows].size, np.bool_)

    def value(self, row: int) -> str | None:
        """Return the value of a case; None if it has none."""
        code = int(self.codes[row])
        return self.words[code - 1] if code else None

    def counts(self) -> dict[str, int]:
        """Return the number of cases that have each word."""
        sizes = np.bincount(self.codes, minlength=len(self.words) + 1)[1:].tolist()
        return dict(zip(self.words, sizes, strict=True))

    def recoded(self, words: Words) -> Symbols:
        """Return the column with a dictionary that contains its own."""
        return Symbols(words, _translation(self.words, words)[self.codes])


class Sets:
    """A text feature that has any number of values a case, as the types of nearby objects."""

    def __init__(self, words: Words, sizes: NDArray[np.uint8], codes: Codes) -> None:
        self.words = words
        self.sizes = sizes
        self.codes = codes

    @classmethod
    def of(cls, values: Sequence[str | tuple[str, ...] | None]) -> Sets:
        """Make the column of these values, None or an empty tuple where a case does not have the feature."""
        rows = [(each,) if isinstance(each, str) else each or () for each in values]
        words = Words(sorted({each for row in rows for each in row}))
        codes = {word: code for code, word in enumerate(words, 1)}
        sizes = np.array([len(row) for row in rows], np.uint8)
        return cls(words, sizes, smallest_codes([codes[each] for row in rows for each in row], len(words)))

    @cached_property
    def _ends(self) -> NDArray[np.int64]:
        return np.cumsum(self.sizes, dtype=np.int64)

    @cached_property
    def _rows(self) -> NDArray[np.int32]:
        return np.repeat(np.arange(self.sizes.size, dtype=np.int32), self.sizes)

    def equal_to(self, word: str, rows: slice) -> Mask:
        """Return which of these rows have the word among their values."""
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

    def counts(self) -> dict[str, int]:
        """Return the number of cases that have each word."""
        sizes = np.bincount(self.codes, minlength=len(self.words) + 1)[1:].tolist()
        return dict(zip(self.words, sizes, strict=True))

    def recoded(self, words: Words) -> Sets:
        """Return the column with a dictionary that contains its own."""
        return Sets(words, self.sizes, _translation(self.words, words)[self.codes])


class Numbers:
    """A number, as float32 where that is how its cases have it, otherwise as float64."""

    def __init__(self, values: Floats) -> None:
        self.values = values

    @classmethod
    def of(cls, values: Iterable[float | None]) -> Numbers:
        """Make the column of these values, None where a case does not have the feature."""
        wide = np.array([np.nan if each is None else each for each in values], np.float64)
        with np.errstate(over="ignore"):
            narrow = wide.astype(np.float32)
        return cls(narrow if np.array_equal(narrow, wide, equal_nan=True) else wide)

    def value(self, row: int) -> float | None:
        """Return the value of a case; None if it has none."""
        value = float(self.values[row])
        return value if value == value else None

    def present(self) -> Floats:
        """Return the numbers of the cases that have one, as float64."""
        wide = self.values.astype(np.float64)
        return wide[~np.isnan(wide)]


Column: TypeAlias = Symbols | Sets | Numbers


def joined_words(parts: Sequence[tuple[Symbols | Sets | None, int]]) -> Symbols | Sets:
    """Put columns of one feature below each other; None and a count stand for cases without the feature."""
    words = Words(sorted({word for column, _ in parts if column is not None for word in column.words}))
    if any(isinstance(column, Sets) for column, _ in parts):
        sets = [_as_sets(column, count).recoded(words) for column, count in parts]
        codes = np.concatenate([each.codes for each in sets])
        return Sets(words, np.concatenate([each.sizes for each in sets]), codes)
    empty = np.uint8
    symbols = [
        column.recoded(words).codes if isinstance(column, Symbols) else np.zeros(count, empty)
        for column, count in parts
    ]
    return Symbols(words, np.concatenate(symbols))


def joined_numbers(parts: Sequence[tuple[Numbers | None, int]]) -> Numbers:
    """Put columns of one number below each other; None and a count stand for cases without it."""
    values = [np.full(count, np.nan, np.float32) if column is None else column.values for column, count in parts]
    return Numbers(np.concatenate(values))


def smallest_codes(codes: Any, largest: int) -> Codes:
    """Return codes as the smallest unsigned integers that hold `largest`."""
    smallest: Codes = np.asarray(codes, np.min_scalar_type(largest))
    return smallest


def taken(column: Column, order: NDArray[np.int64]) -> Column:
    """Return the column with its cases in another order."""
    match column:
        case Symbols(words=words, codes=codes):
            return Symbols(words, codes[order])
        case Numbers(values=values):
            return Numbers(values[order])
        case Sets():
            ends = np.cumsum(column.sizes, dtype=np.int64)
            sizes = column.sizes[order]
            starts = (ends - column.sizes)[order]
            firsts = np.cumsum(sizes, dtype=np.int64) - sizes
            places = np.repeat(starts - firsts, sizes) + np.arange(int(sizes.sum(dtype=np.int64)))
            return Sets(column.words, sizes, column.codes[places])


def _as_sets(column: Symbols | Sets | None, count: int) -> Sets:
    match column:
        case None:
            return Sets(Words(), np.zeros(count, np.uint8), np.zeros(0, np.uint8))
        case Symbols(words=words, codes=codes):
            return Sets(words, (codes > 0).astype(np.uint8), codes[codes > 0])
        case Sets():
            return column


def _translation(old: Words, new: Words) -> Codes:
    return smallest_codes([0, *(new.code(word) for word in old)], len(new))
