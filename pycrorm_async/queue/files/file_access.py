"""Create the spool's folders and files for their owner alone, or for the group that shares the spool.

The parent folder decides, because recorders and a daemon of several users must agree: in a folder with the set-group-id
bit and group write permission, new folders get mode 2770 and new files 0660; in any other folder, 0700 and 0600. The
umask does not matter, and existing files and folders keep their modes.

`open_file` creates a file for its owner alone and then opens it to the group, so that no other user can open it first.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Final

from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.settings import FILE_MODES, FileAccess

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


def rewrite(path: Path) -> BinaryIO:
    """Open a file for writing, truncated. Raises `OSError`."""
    return os.fdopen(open_file(path, os.O_WRONLY | os.O_TRUNC), "wb")


def _make(path: Path, access: FileAccess) -> None:
    path.mkdir(0o700)
    path.chmod(_FOLDER_MODES[access])


def _access_below(folder: Path) -> FileAccess:
    return "group" if folder.stat().st_mode & _SHARED == _SHARED else "owner"
