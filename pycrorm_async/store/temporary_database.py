"""Create the folder behind `sqlite://`: private to one process, in shared memory if possible, removed at the end.

The database is a file and not SQLite's `:memory:`, because the writer thread and the readers need one that several
connections share. Only the owner can enter the folder. It contains a file `mark`, locked by `flock` while the process
lives. The next process of the same user removes folders whose mark it can lock, which killed processes left.

Every user may write to the parent folder. So no name there is predictable, and a process touches only folders of its
own user. A process may remove a folder between its creation and its marking; the creator detects that and creates
another.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pycrorm_async.errors import DatabaseUnavailable

_MARK = "mark"
_ATTEMPTS = 100
"""Bounds the attempts to create a folder; each fails only if another process sweeps at that moment."""


def usual_place() -> Path:
    """Return `/dev/shm` if it is writable, else the temporary folder."""
    shared_memory = Path("/dev/shm")  # noqa: S108 - mkdtemp creates the folders for their owner alone
    return shared_memory if os.access(shared_memory, os.W_OK | os.X_OK) else Path(tempfile.gettempdir())


@contextmanager
def private_folder(parent: Path) -> Iterator[Path]:
    """Create a folder below `parent` for the duration of the context. Raises `DatabaseUnavailable`."""
    prefix = f"pycrorm-{os.geteuid()}-"
    try:
        _sweep(parent, prefix)
        folder, mark = _make_marked(parent, prefix)
    except OSError as error:
        raise DatabaseUnavailable(f"sqlite:// needs a folder in {parent}: {error.strerror}") from error
    owner = os.getpid()
    try:
        yield folder
    finally:
        if os.getpid() == owner:  # a forked child must not remove its parent's folder
            shutil.rmtree(folder, ignore_errors=True)
        os.close(mark)


def _make_marked(parent: Path, prefix: str) -> tuple[Path, int]:
    """Create a folder; return it with the descriptor of its locked mark."""
    for _ in range(_ATTEMPTS):
        folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        with suppress(FileNotFoundError, BlockingIOError):
            mark = _lock(folder / _MARK, os.O_CREAT | os.O_EXCL)
            with suppress(FileNotFoundError):
                if (folder / _MARK).stat().st_ino == os.fstat(mark).st_ino:
                    return folder, mark
            os.close(mark)
    raise FileNotFoundError(None, f"{_ATTEMPTS} new folders were removed at once")


def _sweep(parent: Path, prefix: str) -> None:
    for entry in [each for each in os.scandir(parent) if each.name.startswith(prefix)]:
        folder = Path(entry.path)
        with suppress(OSError):  # its process lives, or another process sweeps it
            if not entry.is_dir(follow_symlinks=False) or entry.stat(follow_symlinks=False).st_uid != os.geteuid():
                continue
            try:
                mark = _lock(folder / _MARK)
            except FileNotFoundError:
                folder.rmdir()  # fails if a process is just marking it
                continue
            shutil.rmtree(folder, ignore_errors=True)
            os.close(mark)


def _lock(path: Path, flags: int = 0) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC | flags, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor
