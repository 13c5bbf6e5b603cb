"""Describe exceptions and arbitrary values as texts, also if their `__str__` or `__repr__` raises.

Methods of `str` are called as `str.method(text)`, so that those of a user's subclass do not run.
"""

from __future__ import annotations

from reprlib import Repr
from typing import Any

_REPR_MAX = 200
"""Bounds the characters of a repr that is recorded in place of a value; enough to recognise the value."""
_TEXT_MAX = 150
"""Bounds the characters of a text inside a repr; below `_REPR_MAX`, so that the mark with the text's length fits."""


def reading_fault(error: BaseException) -> str:
    """Return the reason why a value was not recorded, if reading the value raised `error`."""
    message = cut(clean(message_of(error)), _REPR_MAX)
    return f"reading it raised {type(error).__name__}{': ' if message else ''}{message}"


def message_of(failure: BaseException) -> str:
    """Return the message of an exception, also of one whose `__str__` raises an `Exception`."""
    try:
        return str(failure)
    except Exception as error:  # noqa: BLE001  a user's __str__ may raise anything
        return f"<its __str__ raised {type(error).__name__}>"


def clean(text: str) -> str:
    """Replace U+0000 and lone surrogates, which no event can hold, with escapes."""
    return str.replace(text, "\x00", "\\x00").encode("utf-8", "backslashreplace").decode()


def cut(text: str, characters_max: int) -> str:
    """Truncate a text after `characters_max` characters and append a mark that gives its full length."""
    return text[:characters_max] + _cut_mark(len(text), "characters", characters_max)


def _cut_mark(length: int, unit: str, length_max: int = _TEXT_MAX) -> str:
    return f"… ({length:,} {unit})" if length > length_max else ""


def clean_repr(value: Any) -> str:
    """Return a shortened repr; a large list, tuple, set or dict is not represented as a whole first.

    Returns also for a value whose `__repr__` raises an `Exception`.
    """
    text = clean(_Brief().repr(value))
    return text if len(text) <= _REPR_MAX else f"{text[:_REPR_MAX]}…"


class _Brief(Repr):
    """The standard library's bounded repr, also of bytes and subclasses of str. Names a type whose repr raises."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdeque = self.maxdict = 20
        self.maxother = self.maxlong = self.maxstring = 2 * _REPR_MAX
        self._left = _REPR_MAX  # a part takes at least one character, so more parts would be cut off anyway

    def repr1(self, x: Any, level: int) -> str:
        self._left -= 1
        if self._left < 0:
            return "…"
        try:
            if isinstance(x, str) and type(x).__repr__ is str.__repr__:
                return repr(str.__getitem__(x, slice(_TEXT_MAX))) + _cut_mark(str.__len__(x), "characters")
            if isinstance(x, bytes | bytearray):
                kind = bytes if isinstance(x, bytes) else bytearray
                return repr(kind(x[:_TEXT_MAX])) + _cut_mark(len(x), "bytes")
            return super().repr1(x, level)
        except Exception as error:  # noqa: BLE001  a user's __repr__ may raise anything
            return f"<a {type(x).__name__} whose repr raised {type(error).__name__}>"

    def repr_instance(self, x: Any, level: int) -> str:  # noqa: ARG002  `Repr` gives the signature
        return str.__str__(repr(x))
