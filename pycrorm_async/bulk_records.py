"""For what is done to every one of many events."""

from __future__ import annotations

import gc
from typing import Final

__all__ = ["collect_seldom", "make"]

make: Final = tuple.__new__
"""`make(Record, values)` is `Record(*values)` at half the cost: nobody looks whether there are too few or too many."""

_OBJECTS: Final = 50_000


def collect_seldom() -> None:
    """For a process that does nothing but move events.

    Python's collector looks at all new objects at every 700th of them: at the ten thousands of tuples of a batch again
    and again, to find nothing. That is a tenth to a fifth of the time of moving them.
    """
    gc.set_threshold(_OBJECTS)
