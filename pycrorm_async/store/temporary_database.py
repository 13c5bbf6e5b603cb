"""The folder behind `sqlite://`: made for one process, in memory where the machine has such a place, gone afterwards.

A file and not SQLite's own `:memory:`, because the writer's thread, readers and the spool need one that several
connections share. The folder, which its owner alone can enter, holds a file `mark` locked by `flock` while the process
lives. The next process of the same user removes folders whose mark it can lock: killed processes left them.

Every user may write in such a place. So nothing there has a name that another user could take first, and what does not
belong to this user is not touched: no lock is shared. A process may sweep a folder between its making and its marking;
then the process that made it notices, and makes another.
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

__all__ = ["private_folder", "usual_place"]

_MARK = "mark"
_TRIES = 100
"""So many processes would have to sweep at the same moments for none of these to succeed."""


def usual_place() -> Path:
    """Memory that looks like a folder where the machine has it and it can be written, else the temporary folder."""
    shared_memory = Path("/dev/shm")  # noqa: S108 - folders in it are made by mkdtemp, for their owner alone
    return shared_memory if os.access(shared_memory, os.W_OK | os.X_OK) else Path(tempfile.gettempdir())


@contextmanager
def private_folder(place: Path) -> Iterator[Path]:
    """A new folder below `place` while the context lasts. Raises `DatabaseUnavailable` if it cannot be made."""
    prefix = f"pycrorm-{os.geteuid()}-"
    try:
        _sweep(place, prefix)
        folder, mark = _make_marked(place, prefix)
    except OSError as error:
        raise DatabaseUnavailable(f"sqlite:// needs a folder in {place}: {error.strerror}") from error
    owner = os.getpid()
    try:
        yield folder
    finally:
        if os.getpid() == owner:  # a forked child leaves its parent's folder alone
            shutil.rmtree(folder, ignore_errors=True)
        os.close(mark)


def _make_marked(place: Path, prefix: str) -> tuple[Path, int]:
    """A folder and the descriptor of its mark, which is locked."""
    for _ in range(_TRIES):
        folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
        with suppress(FileNotFoundError, BlockingIOError):
            mark = _locked(folder / _MARK, os.O_CREAT | os.O_EXCL)
            with suppress(FileNotFoundError):
                if (folder / _MARK).stat().st_ino == os.fstat(mark).st_ino:
                    return folder, mark
            os.close(mark)
    raise FileNotFoundError(None, f"{_TRIES} new folders were removed at once")


def _sweep(place: Path, prefix: str) -> None:
    for entry in [each for each in os.scandir(place) if each.name.startswith(prefix)]:
        folder = Path(entry.path)
        with suppress(OSError):  # its process lives, or another process sweeps it
            if not entry.is_dir(follow_symlinks=False) or entry.stat(follow_symlinks=False).st_uid != os.geteuid():
                continue
            try:
                mark = _locked(folder / _MARK)
            except FileNotFoundError:
                folder.rmdir()  # it fails where a process is just marking it
                continue
            shutil.rmtree(folder, ignore_errors=True)
            os.close(mark)


def _locked(path: Path, flags: int = 0) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC | flags, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor
