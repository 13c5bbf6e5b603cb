"""Name the reason of a failure: the class of an exception, or the template of a text that tells no class.

Failures are counted by their reasons. Every reader takes them from `reason_of`, so that a table, a page and an answer
group the same failures together.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pycrorm_async.events.types import FailureValue

UNNAMED: Final = "Failure"
"""The type that earlier versions recorded for every failure that was given as a text."""
GAP, NUMBER = "…", "#"
"""The signs for a name or an id, and for a number."""
_TEMPLATE_MAX = 120
"""Bounds the characters of a template; a recalled case keeps no longer word."""
_READ_MAX = 2_000
"""Bounds the characters of a text that are read for its template."""
_CLASS = re.compile(r"(?:[\w<>\[\]]+\.)+(\w+)")
_QUOTED = re.compile(r"""(?<!\w)(?:'[^']+'|"[^"]+"|`[^`]+`)(?!\w)""")
_SEPARATORS = r"\s,;=()\[\]{}<>|\"'`"
_WITH_DIGIT = re.compile(rf"[^{_SEPARATORS}]*\d[^{_SEPARATORS}]*?(?=[.:!?]*(?:[{_SEPARATORS}]|$))")
_IS_NUMBER = re.compile(r"[+-]?\.?\d+(?:[.:]\d+)*(?:e[+-]?\d+)?([^\W\d_]{0,3}(?:/[^\W\d_]{1,3})?|[%°])", re.IGNORECASE)
_SEVERAL = re.compile(rf"{NUMBER}(?:[\s,;]+{NUMBER}(?!\w))+")
_WORD = re.compile(r"[^\W\d_]{2}")


def reason_of(failure: FailureValue) -> str:
    """Return the reason of a recorded failure.

    >>> reason_of(FailureValue("pycrorm_async.plan.failures.IKError", "LEFT is too short"))
    'IKError'
    >>> reason_of(FailureValue("Failure", "motor 3 stalled after 2.5 s"))
    'motor # stalled after #s'
    """
    if failure.type == UNNAMED:
        return template_of(failure.message) or UNNAMED
    qualified = _CLASS.fullmatch(failure.type)
    return failure.type if qualified is None else qualified[1]


def template_of(text: str, names: Iterable[str] = ()) -> str:
    """Return a text with its numbers as # and its ids, quoted parts and these names as …, on one line.

    A text of which no word would be left, such as an error code, is its own template.

    >>> template_of("cannot reach milk with arm_2 at 0.52 m", ["milk"])
    'cannot reach … with … at # m'
    """
    line = " ".join(text[:_READ_MAX].split())
    template = _QUOTED.sub(GAP, line)
    present = sorted((each for each in {*names} if len(each) > 1 and each in template), key=len, reverse=True)
    if present:
        template = re.sub(rf"(?<!\w)(?:{'|'.join(map(re.escape, present))})(?!\w)", GAP, template)
    template = _SEVERAL.sub(NUMBER, _WITH_DIGIT.sub(_placeholder, template))
    shown = template.rstrip(".! ") if _WORD.search(template) else line
    return shown if len(shown) <= _TEMPLATE_MAX else f"{shown[: _TEMPLATE_MAX - 1]}…"


def _placeholder(match: re.Match[str]) -> str:
    number = _IS_NUMBER.fullmatch(match[0])
    return GAP if number is None else f"{NUMBER}{number[1] or ''}"
