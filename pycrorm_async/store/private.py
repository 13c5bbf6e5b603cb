"""The folder behind `sqlite://`: made for one process, in memory where the machine has such a place, gone afterwards.

A file and not SQLite's own `:memory:`, because the writer's thread, readers and the spool need one that several
connections share. The folder holds a file `mark` locked by `flock` while the process lives; whoever makes the next
folder removes those whose mark can be locked, which were left by killed processes.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pycrorm_async.errors import DatabaseUnavailable

__all__ = ["private_folder", "usual_place"]

_MARK = "mark"


def usual_place() -> Path:
    """Memory that looks like a folder where the machine has it and it can be written, else the temporary folder."""
    shared_memory = Path("/dev/shm")  # noqa: S108 - folders in it are made by mkdtemp, for their owner alone
    return shared_memory if os.access(shared_memory, os.W_OK | os.X_OK) else Path(tempfile.gettempdir())


@contextmanager
def private_folder(place: Path) -> Iterator[Path]:
    """A new folder below `place` while the context lasts. Raises `DatabaseUnavailable` if it cannot be made."""
    prefix = f"pycrorm-{os.getuid()}-"
    try:
        # Under one lock, so that nobody sweeps a folder between its making and its marking.
        with _locked(place / f"{prefix}lock"):
            _sweep(place, prefix)
            folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
            mark = _open_locked(folder / _MARK)
    except OSError as error:
        raise DatabaseUnavailable(f"sqlite:// needs a folder in {place}: {error.strerror}") from error
    owner = os.getpid()
    try:
        yield folder
    finally:
        if os.getpid() == owner:  # a forked child leaves its parent's folder alone
            shutil.rmtree(folder, ignore_errors=True)
        os.close(mark)


def _sweep(place: Path, prefix: str) -> None:
    for folder in place.glob(f"{prefix}*/"):
        try:
            mark = _open_locked(folder / _MARK, wait=False)
        except OSError:  # alive, or not ours to judge
            continue
        shutil.rmtree(folder, ignore_errors=True)
        os.close(mark)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    lock = _open_locked(path)
    try:
        yield
    finally:
        os.close(lock)


def _open_locked(path: Path, *, wait: bool = True) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor
