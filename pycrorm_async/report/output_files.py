"""Give a file or a folder its name only when it is complete and on the disk, so that no reader finds a part of it."""

import fcntl
import glob
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pycrorm_async.errors import CallerError

_SUFFIX = ".part"
_LOCKED_AFTER_S = 60.0
"""Bounds the time between the creation of a part and its lock, which a stopped machine can delay."""


def refuse_existing(path: Path, *, force: bool, folder: bool = False) -> None:
    """Raise `CallerError` if the file cannot be written: it exists and `force` is False, or its folder is missing.

    A folder is refused also with `force`, unless `folder` is True.
    """
    if path.is_dir() and not folder:
        raise CallerError(f"{path} is a folder: give the name of a file in it")
    file = next((each for each in path.parents if each.exists() and not each.is_dir()), None)
    if file is not None:
        raise CallerError(f"{file} is a file, so {path} cannot be written below it: give the name of a folder")
    if path.exists() and not force:
        raise CallerError(f"{path} exists: add --force to replace it, or give another name")
    if not path.absolute().parent.is_dir():
        raise CallerError(f"the folder {path.parent} does not exist: create it first")


def write_file(content: bytes, path: Path, *, force: bool = False) -> None:
    """Write a file that is complete as soon as it has its name. Raises `CallerError`, `OSError`."""
    with new_file(path, force=force) as written:
        written.write_bytes(content)


@contextmanager
def new_file(path: Path, *, force: bool) -> Iterator[Path]:
    """Yield the name of an empty file beside `path`, and rename it to `path` at the end unless an error occurred.

    Raises `CallerError` as `refuse_existing`, again at the end, and for a folder; `OSError` if the disk is full.
    """
    refuse_existing(path, force=force)
    _delete_parts(path)
    descriptor, name = tempfile.mkstemp(dir=path.absolute().parent, prefix=_prefix(path), suffix=_SUFFIX)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    written = Path(name)
    try:
        yield written
        written.chmod(0o666 & ~_umask())
        _sync(written)
        refuse_existing(path, force=force)  # another process may have made it meanwhile
        written.replace(path)
        _sync(path.absolute().parent)
    except OSError as error:
        raise _named_after(error, path, written) from error
    finally:
        written.unlink(missing_ok=True)
        os.close(descriptor)


@contextmanager
def new_folder(path: Path, *, force: bool, marker: str) -> Iterator[Path]:
    """Yield a folder beside `path`, and rename it to `path` at the end unless an error occurred.

    With `force` it replaces a folder that has the file `marker`, and no other one.
    """
    refuse_existing(path, force=force, folder=True)
    if path.exists() and not (path / marker).is_file():
        raise CallerError(f"{path} exists and is not such a data set ({marker} is not in it): give another name")
    _delete_parts(path)
    written = Path(tempfile.mkdtemp(dir=path.absolute().parent, prefix=_prefix(path), suffix=_SUFFIX))
    descriptor = os.open(written, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    replaced = written.with_suffix(".replaced")
    try:
        yield written
        written.chmod(0o777 & ~_umask())
        for each in sorted(written.rglob("*")):
            _sync(each)
        _sync(written)
        if path.exists():
            path.rename(replaced)
        written.rename(path)
        _sync(path.absolute().parent)
    except BaseException as error:
        if replaced.exists() and not path.exists():
            replaced.rename(path)
        if isinstance(error, OSError):
            raise _named_after(error, path, written) from error
        raise
    finally:
        shutil.rmtree(written, ignore_errors=True)
        shutil.rmtree(replaced, ignore_errors=True)
        os.close(descriptor)


def _named_after(error: OSError, path: Path, part: Path) -> OSError:
    """Return the error with the name that the user gave, unless it is of another file; the user knows no part."""
    name = error.filename
    is_of_part = name is None or Path(os.fsdecode(name)).is_relative_to(part)
    return OSError(error.errno, error.strerror, str(path)) if is_of_part else error


def _prefix(path: Path) -> str:
    return f".{path.name[:100]}."


def _delete_parts(path: Path) -> None:
    """Delete the parts that killed processes left of files of this name. A process locks its part while it writes."""
    for each in path.absolute().parent.glob(f"{glob.escape(_prefix(path))}????????{_SUFFIX}"):
        with suppress(OSError):  # another process, or another user's
            descriptor = os.open(each, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if time.time() - each.stat().st_mtime > _LOCKED_AFTER_S:
                    shutil.rmtree(each) if each.is_dir() else each.unlink()
            finally:
                os.close(descriptor)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
