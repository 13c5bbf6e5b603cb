"""Name, open, lock and sync the files of a spool."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import stat
import sys
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from struct import Struct
from types import MappingProxyType
from typing import Final, NamedTuple
from zlib import crc32

from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.settings import FILE_MODES, FileAccess

#
# Lock files with `flock`: `alive` shows that a recorder lives, `drain` that a process drains its folder.
#
# The kernel releases a lock when its holder dies, and not before. A lock belongs to the open file description, which a
# forked child shares. Therefore a child closes its copy right after the fork, and `release` unlocks explicitly
# (`LOCK_UN`) instead of relying on the last copy being closed.

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
    """Read the last note of this lock's holder; None if there is no note or no file. Raises other `OSError`.

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
        lock = None
        try:
            for _ in range(_ATTEMPTS):
                with suppress(BlockingIOError):
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    # The previous holder may have deleted the file after it was opened here: then this lock protects
                    # nothing.
                    if FileIdentity.of(os.fstat(descriptor)).is_at(path):
                        lock = cls(descriptor)
                    break
                time.sleep(_RETRY_S)
        finally:
            if lock is None:  # also after an error, which would otherwise leave the lock to this process
                os.close(descriptor)
        return lock

    def write_note(self, note: bytes) -> None:
        """Replace the holder's note in the lock file, for `read_note`. Raises `OSError`."""
        if self._descriptor >= 0:
            os.pwrite(self._descriptor, _NOTE.pack(len(note), crc32(note)) + note, 0)

    def release(self) -> None:
        """Release the lock, also where a forked child still shares it. Idempotent. Ignores a failing disk."""
        if self._descriptor >= 0:
            with suppress(OSError):
                fcntl.flock(self._descriptor, fcntl.LOCK_UN)
            self._close()

    def _close(self) -> None:
        if self._descriptor >= 0:
            with suppress(OSError):  # Linux closes the descriptor nevertheless
                os.close(self._descriptor)
            self._descriptor = -1


# === file access ==============================================================================================
#
# Create the spool's folders and files for their owner alone, or for the group that shares the spool.
#
# The parent folder decides, because recorders and a daemon of several users must agree: in a folder with the
# set-group-id bit and group write permission, new folders get mode 2770 and new files 0660; in any other folder, 0700
# and 0600. The umask does not matter, and existing files and folders keep their modes.
#
# `open_file` creates a file for its owner alone and then opens it to the group, so that no other user can open it
# first.

_FOLDER_MODES: Final = {"owner": 0o700, "group": 0o2770}
_SHARED: Final = stat.S_ISGID | stat.S_IWGRP


def create_spool(path: Path, access: FileAccess) -> None:
    """Make the spool and its parents unless they exist; with "group", open an existing spool to its group.

    Raises `SpoolUnavailable` if it cannot be created, and `OSError`.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _make(path, access)
    except OSError as error:
        if not os.path.lexists(path):
            reason = f"cannot be created: {error.strerror}; name another folder with --spool"
            raise SpoolUnavailable(path, reason) from error
        if not isinstance(error, FileExistsError) or not path.is_dir():
            raise
        if access == "group" and _access_below(path) == "owner":
            path.chmod(_FOLDER_MODES["group"])


def create_folder(path: Path) -> None:
    """Make a folder with the access of the folder that holds it. Raises `OSError`, also if it exists."""
    _make(path, _access_below(path.parent))


def create_folders(spool: Path, path: Path) -> None:
    """Make every folder on the way from the spool to `path` that does not exist. Raises `OSError`."""
    for folder in (*reversed(path.relative_to(spool).parents[:-1]), path.relative_to(spool)):
        with suppress(FileExistsError):
            create_folder(spool / folder)


def open_file(path: Path, flags: int) -> int:
    """Open a file, and create it first with the access of its folder if it does not exist. Raises `OSError`."""
    try:
        descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        return os.open(path, flags | os.O_CLOEXEC)
    os.fchmod(descriptor, FILE_MODES[_access_below(path.parent)])
    return descriptor


def _make(path: Path, access: FileAccess) -> None:
    path.mkdir(0o700)
    path.chmod(_FOLDER_MODES[access])


def _access_below(folder: Path) -> FileAccess:
    return "group" if folder.stat().st_mode & _SHARED == _SHARED else "owner"


# === file system ==============================================================================================
#
# Refuse file systems on which a spool is not durable, before creating any file there.
#
# A segment gets all its blocks before it is mapped, so that a full disk raises an error during allocation and never a
# SIGBUS during a write. A copy-on-write file system breaks this: rewriting a page takes a new block, and when none is
# free the kernel kills the process. This was observed on btrfs, with allocated files and with files of zeros. Files
# with copy-on-write disabled (`chattr +C`) keep their blocks only until a snapshot, and mapped ones only since Linux
# 6.17. On a network file system a lock may be lost while its holder lives, and a full disk shows only when pages are
# written back; no network file system was tested.

_COPIES: Final = "a full disk kills the process that records there"
_NETWORK: Final = "a lock or a record may be lost there with the connection"
_REFUSED: Final[Mapping[int, tuple[str, str]]] = MappingProxyType(
    {
        0x9123683E: ("btrfs", _COPIES),
        0xCA451A4E: ("bcachefs", _COPIES),
        0x2FC12FC1: ("ZFS", _COPIES),
        0x3434: ("NILFS", _COPIES),
        0x6969: ("NFS", _NETWORK),
        0x517B: ("SMB", _NETWORK),
        0xFF534D42: ("CIFS", _NETWORK),
        0xFE534D42: ("SMB", _NETWORK),
        0x00C36400: ("Ceph", _NETWORK),
        0x5346414F: ("AFS", _NETWORK),
    }
)
"""Name of the file system and the reason for refusing it, by the `f_type` of statfs(2)."""


def check_file_system(spool: Path) -> None:
    """Raise `SpoolUnavailable` if the spool is, or would be created, on a refused file system."""
    ancestor = spool.absolute()
    while not ancestor.exists() and ancestor != ancestor.parent:
        ancestor = ancestor.parent
    name, reason = _REFUSED.get(file_system_type(ancestor), ("", ""))
    if name:
        raise SpoolUnavailable(
            spool,
            f"lies on {name}, where {reason}: name a folder on ext4, XFS or tmpfs with `--spool` (in a program:"
            " `Memory.open(url, spool=...)`)",
        )


def file_system_type(path: Path) -> int:
    """Return the `f_type` of the file system that holds this path; 0 if statfs fails."""
    buffer = ctypes.create_string_buffer(512)  # larger than struct statfs on any machine
    if ctypes.CDLL(None).statfs(os.fsencode(path), buffer) != 0:
        return 0
    return int.from_bytes(buffer.raw[: ctypes.sizeof(ctypes.c_long)], sys.byteorder) & 0xFFFFFFFF


# === names ====================================================================================================
#
# Name the files and folders of a spool.

ALIVE: Final = "alive"
"""The recorder holds the lock of this file as long as it lives."""
BLOBS: Final = "blobs"
"""Folder of a recorder with its blobs (`blobs.py`)."""
DRAIN: Final = "drain"
"""The process that drains the folder holds the lock of this file."""
PROGRESS: Final = "progress"
"""The file with the progress of another process that drains the folder (`spool.py`)."""
KEPT_BLOBS: Final = ".blobs"
"""Ends the name of the folder with the blobs that go with a kept segment."""
MAKING: Final = ".making"
"""Ends the name of a file or folder until it is complete."""
NUMBERS: Final = "numbers"
"""The file with the numbers that a log gave to the episodes of the spool (`stored_segments.py`)."""
MENDED: Final = f".mended{MAKING}"
"""Ends the name of the folder that `repair` makes, until it is complete."""
REFUSED: Final = ".refused"
"""Ends the name of a folder of dead letters (`sources.py`)."""
TAIL: Final = ".tail"
"""Ends the name of a file that holds the bytes cut off a torn segment."""
STORED: Final = "stored"
"""Folder of the spool that keeps segments whose records are all stored (`stored_segments.py`)."""
