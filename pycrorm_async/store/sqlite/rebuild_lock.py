"""Who makes tables anew says so with a lock on a file beside the database, which is gone when it is done."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pycrorm_async.errors import DatabaseUnavailable

__all__ = ["claim"]


@contextmanager
def claim(database: Path) -> Iterator[bool]:
    """Whether the file beside this database could be locked; it is until the context is left or the process dies.

    Its mode is the database's, so that a process of the same group can take over what a killed one left.

    Raises `DatabaseUnavailable` where no file can be made.
    """
    path = database.with_name(f"{database.name}-rebuild")
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        with suppress(PermissionError):  # another user made it
            os.fchmod(file, database.stat().st_mode & 0o666)
    except OSError as error:
        raise DatabaseUnavailable(f"{path} cannot be made: {error.strerror}") from error
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        if not (path.exists() and path.stat().st_ino == os.fstat(file).st_ino):
            yield False  # who had it took it away between our two steps
            return
        try:
            yield True
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(file)
