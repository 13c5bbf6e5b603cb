"""Move away what SQLite left beside a database that was removed, before a new one is made under its name.

A write-ahead log and its index belong to one file, and their names to whatever file is there. A process that still has
the removed file open shares the index with every process that opens the new one: both would take the pages of one for
those of the other. And SQLite deletes a write-ahead log that it finds beside an empty database, with all transactions
in it that only a crash kept out of the old file; here it is kept.
"""

from __future__ import annotations

import fcntl
import logging
import os
import time
from pathlib import Path
from typing import Final

__all__ = ["move_leftovers"]

_INDEX: Final = "-shm"
_WITH_CONTENT: Final = ("-wal", "-journal")
_ORPHANED: Final = ".orphaned"
"""Added to the name of what is kept; the next one takes its place, so that there is one at most."""
_TURN_S: Final = 10.0
"""How long another process may take to do the same. It does so in a moment; another user may hold the lock for ever."""
_TRY_AGAIN_S: Final = 0.001

_log = logging.getLogger("pycrorm_async")


def move_leftovers(database: Path) -> None:
    """Leave nothing beside a database that does not exist. Raises `OSError`.

    Processes that make the same database at the same time take turns: a leftover is moved only while there is no
    database, so it never belongs to one that another process has made and opened meanwhile.
    """
    leftovers = [database.with_name(database.name + suffix) for suffix in (*_WITH_CONTENT, _INDEX)]
    if not any(each.exists() for each in leftovers):
        return
    folder = os.open(database.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        _await_turn(folder)
        if database.exists():
            return
        for each in leftovers:
            if not each.exists():
                continue
            if each.name.endswith(_INDEX) or not each.stat().st_size:
                each.unlink(missing_ok=True)
            else:
                kept = each.replace(each.with_name(each.name + _ORPHANED))
                _log.warning("%s was removed without %s, which is kept as %s", database, each.name, kept.name)
    finally:
        os.close(folder)


def _await_turn(folder: int) -> None:
    until_s = time.monotonic() + _TURN_S
    while time.monotonic() < until_s:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_TRY_AGAIN_S)
        else:
            return
