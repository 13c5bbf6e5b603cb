"""Suggest the nearest valid name in place of a wrong one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return a question for the end of a message, or an empty text where no valid name is near.

    >>> nearest("root_failure", ["root_failures", "arms"])
    '; did you mean root_failures?'
    """
    by_folded = {each.casefold(): each for each in valid}
    names = get_close_matches(name.casefold(), by_folded, n=3, cutoff=0.6)
    return did_you_mean([by_folded[each] for each in names]) if names else ""


def did_you_mean(names: Sequence[str]) -> str:
    """Return the question for one of these names.

    >>> did_you_mean(["pose", "move"])
    '; did you mean pose or move?'
    """
    *others, last = names
    return f"; did you mean {', '.join(others) + ' or ' if others else ''}{last}?"
