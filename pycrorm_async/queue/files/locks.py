"""Lock files with `flock`: `alive` shows that a recorder lives, `drain` that a process drains its folder.

The kernel releases a lock when its holder dies, and not before. A lock belongs to the open file description, which a
forked child shares. Therefore a child closes its copy right after the fork, and `release` unlocks explicitly
(`LOCK_UN`) instead of relying on the last copy being closed.
"""

from __future__ import annotations

import errno
import fcntl
import os
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import Struct
from typing import NamedTuple
from zlib import crc32

from pycrorm_async.queue.files.file_access import open_file

_ATTEMPTS = 5
"""Attempts at a lock that a concurrent `is_locked` may hold, and at a note that is being written: 5 ms in total."""
_FOLDER_ATTEMPTS = 10_000
"""Attempts at a folder's lock: ten seconds in total."""
_RETRY_S = 0.001
"""The pause in s between two attempts."""
_NOTE = Struct("=II")
"""The length and the checksum that precede the holder's note."""


def call_in_forked_child(method: Callable[[], None]) -> None:
    """Call this bound method in every forked child, as long as its object lives."""
    reference = weakref.WeakMethod(method)

    def call() -> None:
        live_method = reference()
        if live_method is not None:
            live_method()

    os.register_at_fork(after_in_child=call)


def is_locked(path: Path) -> bool:
    """Return whether any process holds this lock; a missing file is not locked. Raises `OSError`."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    else:
        return False
    finally:
        os.close(descriptor)


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder: at most one thread of one process at a time is inside the `with` block.

    Operations inside must be short, because others wait: after ten seconds they raise `TimeoutError`. Raises other
    `OSError`.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for _ in range(_FOLDER_ATTEMPTS):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(_RETRY_S)
        else:
            raise TimeoutError(errno.ETIMEDOUT, "another process holds its lock for more than 10 s", str(folder))
        try:
            yield
        finally:
            fcntl.flock(descriptor, fcntl.LOCK_UN)
    finally:
        os.close(descriptor)


class FileIdentity(NamedTuple):
    """The identity of a file, independent of its name."""

    device: int
    inode: int

    @classmethod
    def of(cls, status: os.stat_result) -> FileIdentity:
        return cls(status.st_dev, status.st_ino)

    def is_at(self, path: Path) -> bool:
        """Return whether this path names the file; False if the path cannot be examined."""
        try:
            return FileIdentity.of(path.stat()) == self
        except OSError:
            return False


def read_note(path: Path) -> bytes | None:
    """Read the last note of this lock's holder; None without a note or a file. Raises other `OSError`.

    Retries a few times, because the holder may be writing: the checksum shows whether the note is complete.
    """
    for _ in range(_ATTEMPTS):
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        if len(content) >= _NOTE.size:
            length, checksum = _NOTE.unpack_from(content)
            note = content[_NOTE.size : _NOTE.size + length]
            if len(note) == length and crc32(note) == checksum:
                return note
        time.sleep(_RETRY_S)
    return None


class FileLock:
    """An exclusive lock, held until `release` or the death of this process."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.identity = FileIdentity.of(os.fstat(descriptor))
        call_in_forked_child(self._close)

    @classmethod
    def take(cls, path: Path, *, create: bool = True) -> FileLock | None:
        """Take the lock; None if another process holds it or its folder is missing. Raises other `OSError`.

        Retries for a few milliseconds, because `is_locked` takes the lock itself while it tests.
        """
        try:
            descriptor = open_file(path, os.O_RDWR) if create else os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except FileNotFoundError:
            return None
        for _ in range(_ATTEMPTS):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                time.sleep(_RETRY_S)
            else:
                break
        else:
            os.close(descriptor)
            return None
        # The previous holder may have deleted the file after it was opened here: then this lock protects nothing.
        if not FileIdentity.of(os.fstat(descriptor)).is_at(path):
            os.close(descriptor)
            return None
        return cls(descriptor)

    def write_note(self, note: bytes) -> None:
        """Replace the holder's note in the lock file, for `read_note`. Raises `OSError`."""
        if self._descriptor >= 0:
            os.pwrite(self._descriptor, _NOTE.pack(len(note), crc32(note)) + note, 0)

    def release(self) -> None:
        """Release the lock, also where a forked child still shares it. Idempotent."""
        if self._descriptor >= 0:
            fcntl.flock(self._descriptor, fcntl.LOCK_UN)
            self._close()

    def _close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
