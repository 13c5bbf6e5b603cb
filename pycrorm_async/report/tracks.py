"""Keep the changes of a value over the events of an episode, in columns that are compact as JSON."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from itertools import islice
from typing import Any

_DIGITS = 4
"""Rounds lengths to 0.1 mm and angles to 0.006 degrees, which the page cannot show finer."""


def rounded(values: Iterable[float]) -> list[float]:
    """Round numbers for the page."""
    return [round(each, _DIGITS) + 0.0 for each in values]


class Track:
    """The values of one quantity, each with the sequence of the event that set it.

    Only the last value before the event `first` is kept.
    """

    __slots__ = ("_first", "at", "values")

    def __init__(self, first: int) -> None:
        self._first = first
        self.at: list[int] = []
        self.values: list[Any] = []

    def set(self, sequence: int, value: Any) -> None:
        """Append a value; leave out one that equals the last, and replace the last if it is of the same event."""
        if self.values and self.values[-1] == value:
            return
        if self.at and (self.at[-1] == sequence or sequence <= self._first):
            self.at[-1], self.values[-1] = sequence, value
            return
        self.at.append(sequence)
        self.values.append(value)

    def columns(self, points_max: int | None = None, *, after: int = 0) -> list[Any]:
        """Return the differences of the sequences, and the values, of the entries behind event `after`.

        Of more than `points_max` entries, which must be numbers, it returns the least and the greatest of each group of
        neighbours, so that the range of a curve stays that of all values.
        """
        begin = bisect_right(self.at, after)
        at, values = self.at[begin:], self.values[begin:]
        if points_max is not None and len(at) > points_max:
            kept = _extremes(values, points_max)
            at, values = [at[each] for each in kept], [values[each] for each in kept]
        return [differences(at), values]


def _extremes(values: list[Any], points_max: int) -> list[int]:
    """Return the indices of the least and the greatest value in each bucket of neighbours, and that of the last."""
    size = -(-2 * len(values) // points_max)
    kept = {len(values) - 1}
    for begin in range(0, len(values), size):
        bucket = range(begin, min(begin + size, len(values)))
        kept |= {min(bucket, key=values.__getitem__), max(bucket, key=values.__getitem__)}
    return sorted(kept)


def differences(values: Iterable[int]) -> list[int]:
    """Return the first value and the difference of each other one to the value before it."""
    before, result = 0, []
    for each in values:
        result.append(each - before)
        before = each
    return result


class Texts:
    """Texts by number, each once: most nodes of a long episode share theirs with others."""

    def __init__(self) -> None:
        self.sequence = 0
        """The sequence of the event that is being read."""
        self._numbers: dict[str, int] = {"": 0}
        self._first_used: list[int] = [0]

    def number(self, text: str) -> int:
        """Return the number of a text; that of the empty text is 0."""
        number = self._numbers.setdefault(text, len(self._numbers))
        if number == len(self._first_used):
            self._first_used.append(self.sequence)
        return number

    def cut(self, total_characters: int, *, shortest: int, longest: int, after: int = -1) -> list[str]:
        """Return the texts that events behind `after` were the first to use, by number, each cut to an equal share.

        All texts share `total_characters`, within the bounds. A cut text ends with the number of characters left out.
        """
        limit = max(shortest, min(longest, total_characters // len(self._numbers)))
        begin = bisect_right(self._first_used, after)
        return [
            each if len(each) <= limit else f"{each[:limit]}… ({len(each) - limit:,} more characters)"
            for each in islice(self._numbers, begin, None)
        ]
