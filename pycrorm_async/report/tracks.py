"""Keep how a value changed over the events of an episode, in columns that JSON holds compactly."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

__all__ = ["Track", "Texts", "rounded"]

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
        """Append a value; one of an equal value or of the same event has no entry of its own."""
        if self.values and self.values[-1] == value:
            return
        if self.at and (self.at[-1] == sequence or sequence <= self._first):
            self.at[-1], self.values[-1] = sequence, value
            return
        self.at.append(sequence)
        self.values.append(value)

    def columns(self, points_max: int | None = None) -> list[Any]:
        """Return the differences of the sequences, and the values; of more than `points_max` values evenly some."""
        at, values = self.at, self.values
        if points_max is not None and len(at) > points_max:
            step = -(-len(at) // points_max)
            at, values = at[::step], values[::step]
        return [[here - before for before, here in zip([0, *at], at, strict=False)], values]


class Texts:
    """Texts by number, each once: most nodes of a long episode share theirs with others."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {"": 0}

    def number(self, text: str) -> int:
        """Return the number of a text; that of the empty text is 0."""
        return self._numbers.setdefault(text, len(self._numbers))

    def cut(self, total_characters: int, *, shortest: int, longest: int) -> list[str]:
        """Return the texts by number, each cut to an equal share of `total_characters` within the bounds.

        A cut text ends with the number of characters that were left out.
        """
        limit = max(shortest, min(longest, total_characters // len(self._numbers)))
        return [
            each if len(each) <= limit else f"{each[:limit]}… ({len(each) - limit:,} more characters)"
            for each in self._numbers
        ]
