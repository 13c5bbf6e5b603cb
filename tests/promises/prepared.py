"""Prepare what a page cannot make by the commands that it shows.

`<!-- run: NAME -->` above a block names one of `PREPARED`, which is called before the block is run.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Final

from pycrorm_async import Memory
from tests.projections.test_verify_damage import unlock

__all__ = ["PREPARED"]

_OTHERS: Final = 4
"""Events of an episode beside its observations: its start, its root's start and end, and its end."""


def damaged_memory(folder: Path) -> None:
    """Record twelve episodes, and change and delete events of four of them."""
    url = f"sqlite:///{folder}/damaged.db"
    with Memory.sync(url) as memory:
        for number in range(1, 13):
            with memory.recording.episode(description=f"walk {number}") as episode:
                for _ in range({7: 605, 11: 18}.get(number, 5) - _OTHERS):
                    episode.observe("step", {"length_m": 0.5})
    unlock(url)
    with closing(sqlite3.connect(folder / "damaged.db")) as database, database:
        database.executescript("""
            UPDATE event SET wall_ns = wall_ns + 1 WHERE episode = 7 AND sequence = 300;
            DELETE FROM event WHERE episode = 7 AND sequence > 580;
            UPDATE episode SET head = 580, folded = 580 WHERE number = 7;
            DELETE FROM event WHERE episode IN (9, 11);
            DELETE FROM episode WHERE number IN (9, 11);
            DELETE FROM pycrorm_digest WHERE episode = 11;
        """)


PREPARED: Final[Mapping[str, Callable[[Path], None]]] = {"damaged.db": damaged_memory}
"""The functions that make the material of a block in the reader's folder, by its name on the page."""
