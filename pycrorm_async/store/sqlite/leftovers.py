"""Move away the files that SQLite left beside a removed database, before a new one of the same name is created.

A write-ahead log and its index belong to one file, but SQLite finds them by name. A process that still has the removed
file open would share the index with every process that opens the new one, and both would read each other's pages.
SQLite also deletes a write-ahead log beside an empty database, with transactions that a crash kept out of the old file;
here it is kept.
"""

from __future__ import annotations

import fcntl
import logging
import os
import time
from pathlib import Path
from typing import Final

_INDEX: Final = "-shm"
_WITH_CONTENT: Final = ("-wal", "-journal")
_ORPHANED: Final = ".orphaned"
"""Suffix of a kept file; the next one replaces it, so that at most one is kept."""
_LOCK_WAIT_S: Final = 10.0
"""Bounds the wait for another process that does the same, which takes milliseconds. Another user, who can read the
folder, can hold its lock for ever: after this time the leftovers are moved without it."""
_RETRY_S: Final = 0.001
"""The pause in s between two attempts."""

_log = logging.getLogger("pycrorm_async")


def move_leftovers(database: Path) -> None:
    """Move or delete the leftovers of a database that does not exist. Raises `OSError`.

    Processes that create the same database take turns. A leftover is moved only while the database does not exist, so
    it never belongs to one that another process has created and opened meanwhile.
    """
    leftovers = [database.with_name(database.name + suffix) for suffix in (*_WITH_CONTENT, _INDEX)]
    if not any(each.exists() for each in leftovers):
        return
    folder = os.open(database.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        _lock_folder(folder)
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


def _lock_folder(folder: int) -> None:
    until_s = time.monotonic() + _LOCK_WAIT_S
    while time.monotonic() < until_s:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_RETRY_S)
        else:
            return
