"""Suggest the nearest valid name in place of a wrong one."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return a question for the end of a message, or an empty text where no valid name is near.

    >>> nearest("root_failure", ["root_failures", "arms"])
    '; did you mean root_failures?'
    """
    by_folded = {_folded(each): each for each in valid}
    names = get_close_matches(_folded(name), by_folded, n=3, cutoff=0.6)
    if not names:
        return ""
    first, *others = [by_folded[each] for each in names]
    return f"; did you mean {', '.join([first, *others][:-1]) + ' or ' if others else ''}{[first, *others][-1]}?"


def _folded(name: str) -> str:
    """Return the name without what makes it no nearer to another one: capital letters and the dashes of an option."""
    return name.casefold().lstrip("-")
