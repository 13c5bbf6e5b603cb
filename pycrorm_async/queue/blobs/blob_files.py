"""Keep blobs as files beside a recorder's segments: contents too large for an event, named by their SHA-256.

    spool/<recorder>/blobs/<sha256>                                    records of this recorder refer to it
    spool/stored/<log id>/<recorder>/00000001.segment.blobs/<sha256>   kept as long as this segment or an earlier one

A file gets its name when its content is complete, and is never changed. A kill therefore leaves whole blobs, but a
power cut may leave a file whose content is not on the disk: readers compare the content with the name.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

from pycrorm_async.queue.files.file_access import create_folder, create_folders
from pycrorm_async.queue.files.names import BLOBS, KEPT_BLOBS, MAKING, STORED
from pycrorm_async.queue.files.segment import sync_folder


def blob_files(folder: Path) -> list[Path]:
    """List the blobs in a recorder's folder. Raises `OSError`, but not for a missing folder."""
    try:
        return sorted(each for each in (folder / BLOBS).iterdir() if each.suffix != MAKING)
    except (FileNotFoundError, NotADirectoryError):
        return []


def blob_bytes(blobs: Iterable[Path]) -> int:
    """Return the size of these files, without those deleted meanwhile."""
    size = 0
    for each in blobs:
        with suppress(FileNotFoundError):
            size += each.stat().st_size
    return size


def read_blob(spool: Path, name: str) -> bytes | None:
    """Read a blob from any folder of a spool; None if none holds it whole. Raises `OSError`."""
    for path in _places(spool, name):
        with suppress(FileNotFoundError, NotADirectoryError):
            content = path.read_bytes()
            if sha256(content).hexdigest() == name:
                return content
    return None


def is_whole(folder: Path, name: str) -> bool:
    """Return whether a recorder's folder holds this blob with the content of its name. Raises `OSError`."""
    try:
        with (folder / BLOBS / name).open("rb") as file:
            digest = sha256()
            while part := file.read(2**20):
                digest.update(part)
    except FileNotFoundError:
        return False
    return digest.hexdigest() == name


def carry_blobs(source: Path, target: Path) -> None:
    """Link the blobs of a recorder's folder into another one, or copy them. Durable on return. Raises `OSError`."""
    blobs = blob_files(source)
    if not blobs:
        return
    with suppress(FileExistsError):
        create_folder(target / BLOBS)
    for blob in blobs:
        with suppress(FileExistsError, FileNotFoundError):
            try:
                (target / BLOBS / blob.name).hardlink_to(blob)
            except PermissionError:  # the file system has no hard links
                shutil.copyfile(blob, target / BLOBS / blob.name)
    sync_folder(target / BLOBS)


def kept_with(segment: Path) -> Path:
    """Return the folder with the blobs that are kept as long as this segment."""
    return segment.with_name(f"{segment.name}{KEPT_BLOBS}")


def keep_blobs(spool: Path, blobs: Iterable[Path], segment: Path) -> None:
    """Move blobs to those kept with this segment. Raises `OSError`."""
    target = kept_with(segment)
    for blob in blobs:
        create_folders(spool, target)
        with suppress(FileNotFoundError):
            blob.replace(target / blob.name)


def _places(spool: Path, name: str) -> Iterator[Path]:
    """Yield the paths at which a blob of this name may be: first those of recorders, then the kept ones."""
    for recorder in _folders(spool):
        yield recorder / BLOBS / name
    for log in _folders(spool / STORED):
        for recorder in _folders(log):
            for segment in _folders(recorder):
                if segment.suffix == KEPT_BLOBS:
                    yield segment / name


def _folders(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return [Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False)]
    except (FileNotFoundError, NotADirectoryError):
        return []
