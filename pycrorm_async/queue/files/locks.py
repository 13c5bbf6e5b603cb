"""Who is alive and who drains, told by `flock`: the kernel lets go when the holder dies, and not before.

A lock belongs to the open file, which a forked child shares. So a child closes its copy the moment it is forked, and
letting go is said aloud (`LOCK_UN`) rather than left to the last copy being closed.
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

__all__ = ["FileIdentity", "FileLock", "is_locked", "note_in", "in_forked_child", "one_at_a_time"]

_TRIES = 5
_TRIES_IN_TURN = 10_000
_TRY_AGAIN_S = 0.001
_NOTE = Struct("=II")
"""Length and checksum before the holder's note."""


def in_forked_child(method: Callable[[], None]) -> None:
    """Calls this bound method in every forked child, as long as its object lives."""
    reference = weakref.WeakMethod(method)

    def call() -> None:
        alive = reference()
        if alive is not None:
            alive()

    os.register_at_fork(after_in_child=call)


def is_locked(path: Path) -> bool:
    """Whether somebody holds this lock now. Raises `OSError`; no such file is not locked."""
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
def one_at_a_time(folder: Path) -> Iterator[None]:
    """What is done inside, no other process and no other thread does at the same time in this folder.

    For moments: waits ten seconds for others, then raises `TimeoutError`. Raises other `OSError`.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for _ in range(_TRIES_IN_TURN):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(_TRY_AGAIN_S)
        else:
            raise TimeoutError(errno.ETIMEDOUT, "another process does not let go of it", str(folder))
        try:
            yield
        finally:
            fcntl.flock(descriptor, fcntl.LOCK_UN)
    finally:
        os.close(descriptor)


class FileIdentity(NamedTuple):
    """Which file it is, whatever its name."""

    device: int
    inode: int

    @classmethod
    def of(cls, status: os.stat_result) -> FileIdentity:
        return cls(status.st_dev, status.st_ino)

    def is_at(self, path: Path) -> bool:
        """Whether this name leads to it; not if that cannot be looked up."""
        try:
            return FileIdentity.of(path.stat()) == self
        except OSError:
            return False


def note_in(path: Path) -> bytes | None:
    """The note that the holder of this lock wrote last; None for none. Raises `OSError` other than a missing file.

    Read a few times, because the holder may write while this reads: the checksum shows that it is whole.
    """
    for _ in range(_TRIES):
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        if len(content) >= _NOTE.size:
            length, checksum = _NOTE.unpack_from(content)
            note = content[_NOTE.size : _NOTE.size + length]
            if len(note) == length and crc32(note) == checksum:
                return note
        time.sleep(_TRY_AGAIN_S)
    return None


class FileLock:
    """An exclusive lock, held until `release` or the death of this process."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.identity = FileIdentity.of(os.fstat(descriptor))
        in_forked_child(self._close)

    @classmethod
    def take(cls, path: Path, *, create: bool = True) -> FileLock | None:
        """The lock, or None if somebody else holds it or its folder is gone. Raises other `OSError`.

        Tried a few times within milliseconds: `is_locked` holds a lock for the moment it looks.
        """
        try:
            descriptor = open_file(path, os.O_RDWR) if create else os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except FileNotFoundError:
            return None
        for _ in range(_TRIES):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                time.sleep(_TRY_AGAIN_S)
            else:
                break
        else:
            os.close(descriptor)
            return None
        # The holder before may have deleted the file while this one was being opened: then this locks nothing.
        if not FileIdentity.of(os.fstat(descriptor)).is_at(path):
            os.close(descriptor)
            return None
        return cls(descriptor)

    def write_note(self, note: bytes) -> None:
        """Replaces the holder's note in the lock's file, for `note_in`. Raises `OSError`."""
        if self._descriptor >= 0:
            os.pwrite(self._descriptor, _NOTE.pack(len(note), crc32(note)) + note, 0)

    def release(self) -> None:
        """Lets go, also of what a child that was not told still shares. Twice is once."""
        if self._descriptor >= 0:
            fcntl.flock(self._descriptor, fcntl.LOCK_UN)
            self._close()

    def _close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
