"""Count the values that could not be recorded, and log one warning for each type and field.

A plan may perform the same action a million times, so one warning per perform would bury the log. The warning states
the reason, the counter the number of values.
"""

from __future__ import annotations

import logging
from typing import NamedTuple

WARNED_MAX = 1_000
"""Bounds the (type, field) pairs with a warning of their own, because classes created in a loop would never stop."""

_log = logging.getLogger("pycrorm_async")


class Missing(NamedTuple):
    """The number of values recorded as missing, and the last one with its reason; `status` shows both."""

    total: int
    last: str | None


class MissingValues:
    """Counts the missing values of one memory. Any thread may call `note`."""

    def __init__(self) -> None:
        self._total = 0
        self._last: str | None = None
        self._warned: set[tuple[str, str]] = set()

    @property
    def count(self) -> Missing:
        return Missing(self._total, self._last)

    def note(self, owner: str, field: str, reason: str) -> None:
        """Count one missing value, and warn if it is the first of its type and field."""
        self._note(owner, field, f"is recorded as missing: {reason}", reason)

    def note_renamed(self, owner: str, field: str, name: str, reason: str) -> None:
        """Count a field or type whose values are kept under another name, and warn if it is the first of its type."""
        self._note(owner, field, f"is recorded as {name!r}: {reason}", f"recorded as {name!r}: {reason}")

    def _note(self, owner: str, field: str, text: str, reason: str) -> None:
        self._total += 1
        self._last = f"{owner}.{field}: {reason}"
        if (owner, field) in self._warned or len(self._warned) > WARNED_MAX:
            return
        self._warned.add((owner, field))
        if len(self._warned) > WARNED_MAX:
            _log.warning("more than %d fields have missing values; further ones are only counted in status", WARNED_MAX)
        else:
            _log.warning("%s.%s %s (further values of this field are only counted in status)", owner, field, text)
