"""Construct and keep many small records cheaply."""

from __future__ import annotations

import gc
from typing import Final

__all__ = ["collect_seldom", "make"]

make: Final = tuple.__new__
"""`make(Record, values)` equals `Record(*values)` at half the cost, because it does not check the number of values."""

_OBJECTS: Final = 50_000
"""New objects between two garbage collections: more than the tuples of one batch, so that a batch triggers few."""


def collect_seldom() -> None:
    """Make garbage collections rare; for a process that only moves events.

    By default Python examines the new objects after every 700th allocation, so it examines the tens of thousands of
    tuples in a batch again and again and frees none. That takes a tenth to a fifth of the time of moving the batch.
    """
    gc.set_threshold(_OBJECTS)
