"""Lock out a second rebuild with a lock on a file beside the database, which is deleted at the end."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pycrorm_async.errors import DatabaseUnavailable


@contextmanager
def claim(database: Path) -> Iterator[bool]:
    """Lock the file beside this database until the context ends or the process dies; yields False if it is locked.

    The file gets the database's mode, so that a process of the same group can reuse one that a killed process left.
    Raises `DatabaseUnavailable` if the file cannot be created.
    """
    path = database.with_name(f"{database.name}-rebuild")
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        with suppress(PermissionError):  # another user created it
            os.fchmod(file, database.stat().st_mode & 0o666)
    except OSError as error:
        raise DatabaseUnavailable(f"{path} cannot be created: {error.strerror}") from error
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        if not (path.exists() and path.stat().st_ino == os.fstat(file).st_ino):
            yield False  # its last holder deleted it after we had opened it
            return
        try:
            yield True
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(file)
