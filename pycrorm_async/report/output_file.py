"""Write a file that is complete as soon as it has its name, and that replaces no other without `force`."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from pycrorm_async.errors import CallerError

__all__ = ["refuse_existing", "write_file"]


def refuse_existing(path: Path, *, force: bool) -> None:
    """Raise `CallerError` for a path that a file cannot have: that of a file, without `force`, or of a folder."""
    if path.is_dir():
        raise CallerError(f"{path} is a folder: give the name of a file in it")
    if path.exists() and not force:
        raise CallerError(f"{path} exists: add --force to replace it, or give another name")
    if not path.parent.is_dir():
        raise CallerError(f"the folder {path.parent} does not exist: create it first")


def write_file(content: bytes, path: Path, *, force: bool = False) -> None:
    """Write a file that is complete as soon as it has its name. Raises `CallerError`, `OSError`."""
    refuse_existing(path, force=force)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name[:100]}.", suffix=".part")
    written = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
        written.chmod(0o666 & ~_umask())
        if force:
            written.replace(path)
        else:
            path.hardlink_to(written)  # fails, unlike a renaming, if another process made the file meanwhile
    except FileExistsError:
        raise CallerError(f"{path} exists: add --force to replace it, or give another name") from None
    finally:
        written.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
