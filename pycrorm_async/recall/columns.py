"""Hold one feature of many cases as a column of a block (`recall.blocks`), in NumPy arrays.

A column of texts keeps each different value once, in its dictionary: a word, or a tuple of words, as the types of
nearby objects. It has a code for each case: i for the value i - 1 of the dictionary, 0 for none. A column of numbers
has a float for each case, NaN for none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.clock import utc_of
from pycrorm_async.events.ids import row_key

Mask: TypeAlias = NDArray[np.bool_]
Value: TypeAlias = "str | tuple[str, ...]"


class Words(tuple[Value, ...]):
    """The dictionary of a column: different values in alphabetical order, words before tuples of words."""

    @classmethod
    def of(cls, values: Iterable[Value]) -> Words:
        """Return the dictionary of these values."""
        return cls(sorted({*values}, key=lambda each: (isinstance(each, tuple), each)))

    @cached_property
    def codes(self) -> Mapping[Value | None, int]:
        """The code of each value."""
        return {value: code for code, value in enumerate(self, 1)}

    @cached_property
    def codes_by_word(self) -> Mapping[str, Sequence[int]]:
        """The codes of the values that are this word, or have it among several, by word."""
        codes: dict[str, list[int]] = {}
        for code, value in enumerate(self, 1):
            for word in (value,) if isinstance(value, str) else value:
                codes.setdefault(word, []).append(code)
        return codes

    @property
    def has_tuples(self) -> bool:
        """Whether a value is a tuple of words."""
        return bool(self) and isinstance(self[-1], tuple)

    @property
    def word_count(self) -> int:
        """The number of different words, also inside of tuples."""
        return len(self.codes_by_word) if self.has_tuples else len(self)

    def codes_in(self, other: Words) -> NDArray[Any]:
        """Return, for each code of this dictionary, that of its value in another one, which contains all of them.

        The last result is kept, because the columns of many groups share two dictionaries.
        """
        kept: tuple[Words, NDArray[Any]] | None = self.__dict__.get("_codes_in")
        if kept is None or kept[0] is not other:
            codes = np.array([0, *map(other.codes.__getitem__, self)], np.min_scalar_type(len(other)))
            kept = self.__dict__["_codes_in"] = other, codes
        return kept[1]


class Summary(NamedTuple):
    """The numbers of a column: how many there are, their mean, variance, least and greatest."""

    size: int
    mean: float
    variance: float
    least: float
    greatest: float


class Column:
    """One feature of some cases: `values` are codes of `words`, or numbers if that is None."""

    def __init__(self, values: NDArray[Any], words: Words | None = None) -> None:
        self.values = values
        self._words = words

    @classmethod
    def of_texts(cls, values: Sequence[Any]) -> Column:
        """Make the column of words and tuples of words, None where a case does not have the feature.

        Long words are left out.
        """
        kept = {each: _bounded(each) for each in {*values}}
        words = Words.of(each for each in kept.values() if each)
        codes = {each: words.codes.get(value, 0) for each, value in kept.items()}
        return cls(np.fromiter(map(codes.__getitem__, values), np.min_scalar_type(len(words)), len(values)), words)

    @classmethod
    def of_numbers(cls, values: Sequence[float | None]) -> Column:
        """Make the column of these numbers, None where a case does not have the feature; infinite ones are left out.

        They are float32 unless a case has one larger than `SINGLE_MAX`, which are kept as float64.
        """
        wide = np.array(values, np.float64)  # with NaN for None
        wide[np.isinf(wide)] = np.nan
        large = np.abs(wide) > SINGLE_MAX
        narrow = np.where(large, np.nan, wide).astype(np.float32)
        return cls(np.where(large, wide, narrow) if large.any() else narrow)

    @property
    def is_number(self) -> bool:
        """Whether it is a column of numbers."""
        return self._words is None

    @property
    def words(self) -> Words:
        """The dictionary of a column of texts."""
        assert self._words is not None
        return self._words

    def having(self, word: str, rows: slice = slice(None)) -> Mask:
        """Return a mask of these rows: True where the case has the word."""
        codes = self.words.codes_by_word.get(word, ())
        mask: Mask
        if len(codes) == 1:
            mask = self.values[rows] == codes[0]
        else:
            wanted = np.zeros(len(self.words) + 1, np.bool_)
            wanted[[*codes]] = True
            mask = wanted[self.values[rows]]
        return mask

    def count(self, word: str) -> int:
        """Return the number of cases that have the word, which is counted once: most words are never asked for."""
        if word not in self.words.codes_by_word:
            return 0
        if word not in self._counts:
            self._counts[word] = int(np.count_nonzero(self.having(word)))
        return self._counts[word]

    @cached_property
    def _counts(self) -> dict[str, int]:
        return {}

    @cached_property
    def summary(self) -> Summary | None:
        """The summary of the numbers; None if there are none."""
        numbers = self.values[self.present()].astype(np.float64)
        if not numbers.size:
            return None
        return Summary(numbers.size, *map(float, (numbers.mean(), numbers.var(), numbers.min(), numbers.max())))

    def value(self, row: int) -> Any:
        """Return the word, the tuple of words or the number of a case; None if it has none."""
        if self._words is None:
            number = float(self.values[row])
            return number if number == number else None
        code = int(self.values[row])
        return self._words[code - 1] if code else None

    def present(self) -> Mask:
        """Return a mask of all cases: True where the case has the feature."""
        mask: Mask = ~np.isnan(self.values) if self._words is None else self.values > 0
        return mask

    def equals(self, other: Column) -> bool:
        """Return whether another column of the same feature has the same value for each case."""
        if self.is_number or other.is_number:
            return self.is_number == other.is_number and np.array_equal(self.values, other.values, equal_nan=True)
        codes = np.array([0, *(other.words.codes.get(each, -1) for each in self.words)])
        return np.array_equal(codes[self.values], other.values)

    def taken(self, rows: NDArray[Any]) -> Column:
        """Return the column of some of its cases: of these rows, or those for which a mask is True."""
        return Column(self.values[rows], self._words)

    def pruned(self) -> Column:
        """Return the column with a dictionary of the words that its cases have, and no others."""
        if self._words is None:
            return self
        codes, places = np.unique(self.values, return_inverse=True)
        words = Words.of(self._words[code - 1] for code in codes.tolist() if code)
        new = [words.codes[self._words[code - 1]] if code else 0 for code in codes.tolist()]
        return Column(np.array(new, np.min_scalar_type(len(words)))[places], words)

    def recoded(self, words: Words | None) -> Column:
        """Return the column with a dictionary that contains its own."""
        if words is None or words is self._words:
            return self
        return Column(self.words.codes_in(words)[self.values], words)


def joined(columns: Sequence[Column | None], sizes: Sequence[int], words: Words | None = None) -> Column:
    """Put columns of one feature below each other; for a missing column, that many cases without the feature are added.

    Args:
        columns: one of them at least.
        sizes: the number of cases of each.
        words: a dictionary that contains those of all columns of texts; by default it is made.
    """
    first = next(each for each in columns if each is not None)
    if words is None and not first.is_number:
        words = joined_words(each.words for each in columns if each is not None)
    absent, narrow = (np.nan, np.float32) if words is None else (0, np.uint8)
    parts = zip(columns, sizes, strict=True)
    values = [np.full(size, absent, narrow) if each is None else each.recoded(words).values for each, size in parts]
    return Column(np.concatenate(values), words)


def joined_words(dictionaries: Iterable[Words]) -> Words:
    """Return one dictionary with the values of all."""
    different = {id(each): each for each in dictionaries}
    return next(iter(different.values())) if len(different) == 1 else Words.of(chain.from_iterable(different.values()))


def _bounded(value: Value | None) -> Value | None:
    if value is None or isinstance(value, str):
        return value if value and len(value) <= TEXT_MAX else None
    return tuple(sorted({each for each in value if each and len(each) <= TEXT_MAX})) or None


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
TEXT_MAX = 120
"""The longest symbol in characters. A longer text is prose, which hardly ever recurs, and is left out."""
SINGLE_MAX = 2.0**24
"""Up to this magnitude a number is kept as float32, which here is exact to 1 or better; beyond it as float64."""


class Case(NamedTuple):
    """One action that has ended.

    Attributes:
        node: id of its task-tree node: episode number, sequence and slot 0 in one integer.
        started_us: its start, µs since 1970: the wall time of the episode's start and the monotonic time since then.
        type: its dtype, as `PickUpAction`.
        symbols: texts by feature; a tuple for a feature with several values at once, as the types of nearby objects.
        numbers: finite numbers by feature, in m, rad and s. A feature whose name ends in `yaw` is an angle.
        status: name of the `TaskStatus` with which it ended.
        reason: class of the failure; None if there is none.
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
        return utc_of(self.started_us)


def is_angle(feature: str) -> bool:
    """Return whether the feature is an angle in rad, so that -3.1 is near 3.1."""
    return feature.endswith("yaw")
