"""Give a file or a folder its name only when it is complete and on the disk, so that no reader finds a part of it."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pycrorm_async.errors import CallerError

__all__ = ["checksums", "new_file", "new_folder", "refuse_existing"]

_PIECE_BYTES = 1 << 20
"""Bytes that are read at once."""


def refuse_existing(path: Path, *, force: bool) -> None:
    """Raise `CallerError` for a name that cannot be written: one that exists, without `force`, or has no folder."""
    if path.exists() and not force:
        raise CallerError(f"{path} exists: add --force (force=True) to replace it, or give another name")
    if not path.absolute().parent.is_dir():
        raise CallerError(f"the folder {path.parent} does not exist: create it first")


@contextmanager
def new_file(path: Path, *, force: bool) -> Iterator[Path]:
    """Yield the name of an empty file beside `path`, which takes the name `path` at the end, and not on an error.

    Raises `CallerError` as `refuse_existing`, also if another process made the file meanwhile, and for a folder;
    `OSError` where the disk is full.
    """
    refuse_existing(path, force=force)
    if path.is_dir():
        raise CallerError(f"{path} is a folder: give the name of a file in it, for example {path / 'export.parquet'}")
    descriptor, name = tempfile.mkstemp(dir=path.absolute().parent, prefix=f".{path.name[:100]}.", suffix=".part")
    os.close(descriptor)
    written = Path(name)
    try:
        yield written
        written.chmod(0o666 & ~_umask())
        _sync(written)
        if force:
            written.replace(path)
        else:
            path.hardlink_to(written)  # fails, unlike a renaming, if another process made the file meanwhile
        _sync(path.absolute().parent)
    except FileExistsError:
        raise CallerError(f"{path} exists: add --force (force=True) to replace it, or give another name") from None
    finally:
        written.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path, *, force: bool, marker: str) -> Iterator[Path]:
    """Yield a folder beside `path`, which takes the name `path` at the end, and not on an error.

    With `force` it replaces a folder that has the file `marker`, and no other one.
    """
    refuse_existing(path, force=force)
    if path.exists() and not (path / marker).is_file():
        raise CallerError(f"{path} exists and is not such a data set ({marker} is not in it): give another name")
    written = Path(tempfile.mkdtemp(dir=path.absolute().parent, prefix=f".{path.name[:100]}.", suffix=".part"))
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
    except BaseException:
        if replaced.exists() and not path.exists():
            replaced.rename(path)
        raise
    finally:
        shutil.rmtree(written, ignore_errors=True)
        shutil.rmtree(replaced, ignore_errors=True)


def checksums(path: Path) -> dict[str, str]:
    """Return the SHA-256 of a file, or of each file in a folder, by name inside it."""
    files = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    root = path if path.is_dir() else path.parent
    return {str(each.relative_to(root)): _sha256(each) for each in files}


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(_PIECE_BYTES):
            digest.update(piece)
    return digest.hexdigest()


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
