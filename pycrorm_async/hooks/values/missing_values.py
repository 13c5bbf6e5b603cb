"""Counts the values that could not be recorded, and warns once for each type and field.

A plan performs the same action a million times, so a warning for each perform would bury the log. The counter says how
often, the first warning of a field says why.
"""

from __future__ import annotations

import logging
from typing import NamedTuple

__all__ = ["Missing", "MissingValues"]

WARNED_MAX = 1_000
"""Types and fields that are warned about by name. Classes made in a loop could otherwise grow the set for ever."""

_log = logging.getLogger("pycrorm_async")


class Missing(NamedTuple):
    """How many values were recorded as missing, and the last of them with its reason; status shows both."""

    total: int
    last: str | None


class MissingValues:
    """The counter of one memory. Any thread may note a value."""

    def __init__(self) -> None:
        self._total = 0
        self._last: str | None = None
        self._warned: set[tuple[str, str]] = set()

    @property
    def count(self) -> Missing:
        return Missing(self._total, self._last)

    def note(self, owner: str, field: str, reason: str) -> None:
        """Count one value of that field of that type as missing."""
        self._total += 1
        self._last = f"{owner}.{field}: {reason}"
        if (owner, field) in self._warned or len(self._warned) > WARNED_MAX:
            return
        self._warned.add((owner, field))
        if len(self._warned) > WARNED_MAX:
            _log.warning("values of more than %d fields are missing; the others are only counted", WARNED_MAX)
        else:
            _log.warning("%s.%s is recorded as missing: %s (said once; status counts how often)", owner, field, reason)
