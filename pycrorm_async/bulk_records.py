"""Construct and keep many small records cheaply."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

make: Final = tuple.__new__
"""`make(Record, values)` equals `Record(*values)` at half the cost, because it does not check the number of values."""

_OBJECTS: Final = 50_000
"""New objects between two garbage collections: more than the tuples of one batch, so that a batch triggers few."""


def collect_seldom() -> None:
    """Make garbage collections rare; for a process that only moves events.

    By default Python examines the new objects after every 700th allocation, so it examines the tens of thousands of
    tuples in a batch again and again and frees none. That takes a tenth to a fifth of the time of moving the batch.
    Nor does it examine what was imported, which lives until the end.
    """
    gc.freeze()
    gc.set_threshold(_OBJECTS)


@contextmanager
def collecting_seldom() -> Iterator[None]:
    """Make garbage collections rare inside the block; for a user's process, while it makes objects of many rows.

    The objects live on, so each collection walks all of them and frees none: for 25,000 rows half of the time. The
    block raises the threshold, and leaves the collector on: garbage that other code makes meanwhile, in this thread or
    another, stays bounded. Nor does the block turn the collector off and on, because turning it on would let it run a
    finalizer in a thread that holds the recorder's lock (`queue.appender`).

    Blocks may overlap, in threads and in tasks: only one that finds a lower threshold raises it, and puts it back if it
    is still the raised one. A block that ends early costs the others collections, and no order leaves the threshold
    raised. A threshold that the program sets itself, and a collector that is off, remain as they are.
    """
    usual = gc.get_threshold()
    if not 0 < usual[0] < _OBJECTS:
        yield
        return
    gc.set_threshold(_OBJECTS)
    try:
        yield
    finally:
        if gc.get_threshold()[0] == _OBJECTS:
            gc.set_threshold(*usual)
