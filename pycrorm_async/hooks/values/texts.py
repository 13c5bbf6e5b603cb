"""Texts that the log can hold: cleaned, cut and marked, of exceptions and of any value, whatever its class raises."""

from __future__ import annotations

from reprlib import Repr
from typing import Any

__all__ = ["clean", "clean_repr", "cut", "message_of", "reading_fault"]

_REPR_MAX = 200
_TEXT_MAX = 150
"""Of a text inside a repr, so that there is room for how long it was."""


def reading_fault(error: BaseException) -> str:
    """The reason why a value is missing whose own code raised this."""
    message = cut(clean(message_of(error)), _REPR_MAX)
    return f"reading it raised {type(error).__name__}{': ' if message else ''}{message}"


def message_of(failure: BaseException) -> str:
    """The text of an exception. Never raises."""
    try:
        return str(failure)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001  a user's __str__ may raise anything
        return f"<its message could not be made: {type(error).__name__}>"


def clean(text: str) -> str:
    """The text without what the log cannot hold: U+0000 and lone surrogates become escapes."""
    return str.replace(text, "\x00", "\\x00").encode("utf-8", "backslashreplace").decode()


def cut(text: str, characters_max: int) -> str:
    """The text, or its beginning, marked as cut with how long it was."""
    return text[:characters_max] + _more(len(text), "characters", characters_max)


def _more(length: int, unit: str, length_max: int = _TEXT_MAX) -> str:
    """The mark of what was cut."""
    return f"… ({length:,} {unit})" if length > length_max else ""


def clean_repr(value: Any) -> str:
    """A cut repr for people, made without writing out all of a large container. Never raises."""
    text = clean(_Brief().repr(value))
    return text if len(text) <= _REPR_MAX else f"{text[:_REPR_MAX]}…"


class _Brief(Repr):
    """The standard library's bounded repr, for bytes and subclasses of str too, and with faults named."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdeque = self.maxdict = 20
        self.maxother = self.maxlong = self.maxstring = 2 * _REPR_MAX
        self._left = _REPR_MAX  # each part takes a character at least

    def repr1(self, x: Any, level: int) -> str:
        self._left -= 1
        if self._left < 0:
            return "…"
        try:
            if isinstance(x, str) and type(x).__repr__ is str.__repr__:
                return repr(str.__getitem__(x, slice(_TEXT_MAX))) + _more(str.__len__(x), "characters")
            if isinstance(x, bytes | bytearray):
                return repr(bytes(x[:_TEXT_MAX])) + _more(len(x), "bytes")
            return super().repr1(x, level)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001  a user's __repr__ may raise anything
            return f"<a {type(x).__name__} whose repr raised {type(error).__name__}>"

    def repr_instance(self, x: Any, level: int) -> str:  # noqa: ARG002  the signature of the class it extends
        return str.__str__(repr(x))
