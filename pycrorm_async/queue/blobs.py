"""Keep the blobs of a recorder beside its segments until the database has them.

**Blob files.** Keep blobs as files beside a recorder's segments: contents too large for an event, named by their
SHA-256.

    spool/<recorder>/blobs/<sha256>                                    records of this recorder refer to it
    spool/stored/<log id>/<recorder>/00000001.segment.blobs/<sha256>   kept as long as this segment or an earlier one

A file gets its name when its content is complete, and is never changed. A kill therefore leaves whole blobs, but a
power cut may leave a file whose content is not on the disk: readers compare the content with the name.
"""

import itertools
import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Final

from pycrorm_async.errors import SpoolFull
from pycrorm_async.queue.appender import FULL
from pycrorm_async.queue.format import sync_path
from pycrorm_async.queue.gc_safe_lock import GcSafeLock, locked
from pycrorm_async.queue.locks import BLOBS, KEPT_BLOBS, MAKING, STORED, create_folder, open_file

# === blob files ===============================================================================================

_BLOCK_BYTES: Final = 4_096


def blob_files(folder: Path) -> list[Path]:
    """List the blobs in a recorder's folder. Raises `OSError`, but not for a missing folder."""
    try:
        return sorted(each for each in (folder / BLOBS).iterdir() if each.suffix != MAKING)
    except (FileNotFoundError, NotADirectoryError):
        return []


def file_bytes(files: Iterable[Path]) -> int:
    """Return the size of these files, without those deleted meanwhile."""
    size = 0
    for each in files:
        with suppress(FileNotFoundError):
            size += each.stat().st_size
    return size


def rounded(size: int) -> int:
    """Return the bytes that a file of this size takes on the disk."""
    return -(-size // _BLOCK_BYTES) * _BLOCK_BYTES


def read_blob(spool: Path, name: str) -> bytes | None:
    """Read a blob from any folder of a spool; None if none holds it whole. Raises `OSError`."""
    for place in (f"*/{BLOBS}/{name}", f"{STORED}/*/*/*{KEPT_BLOBS}/{name}"):
        for path in spool.glob(place):
            with suppress(FileNotFoundError):
                content = path.read_bytes()
                if sha256(content).hexdigest() == name:
                    return content
    return None


def is_whole(folder: Path, name: str) -> bool:
    """Return whether a recorder's folder holds this blob with the content of its name. Raises `OSError`."""
    try:
        with (folder / BLOBS / name).open("rb") as file:
            return file_digest(file, "sha256").hexdigest() == name
    except FileNotFoundError:
        return False


def kept_with(segment: Path) -> Path:
    """Return the folder with the blobs that are kept as long as this segment."""
    return segment.with_name(f"{segment.name}{KEPT_BLOBS}")


# === live blobs ===============================================================================================
#
# Keep the blobs of a living recorder: any thread puts them, the sync thread makes them durable and deletes them.
#
# **Theory of operation.** `put` writes the file in the caller's thread, without a sync, gives it its name and only then
# registers it. A record that refers to the blob is put later, so a sync that covers this record finds the blob
# registered: the sync thread calls `sync` before it appends the commit frame. A kill between the two leaves a blob
# without a record, which is deleted with the folder.
#
# Each put holds the blob until `release`, which the caller calls when no further record will refer to it; a
# declaration, which every segment repeats, is never released. A released blob is taken away when all segments up to the
# last record at its release are taken away. So a blob stays as long as any segment that refers to it.
#
# One lock protects the registry; no file is read or written under it.


@dataclass(slots=True)
class _Blob:
    """A blob in the folder. `released` is the position behind which no record refers to it, once `holders` is 0."""

    size: int
    holders: int = 0
    released: int = 0


class LiveBlobs:
    """The blobs of one recorder. `reserve` takes a number of bytes of the spool, or returns them if negative."""

    def __init__(self, folder: Path, *, reserve: Callable[[int], bool], make_room: Callable[[int], bool]) -> None:
        self._folder = folder
        self._reserve = reserve
        self._make_room = make_room
        self.owner = 0
        self._gc_lock = GcSafeLock(self)
        self._blobs: dict[str, _Blob] = {}
        self._unsynced: set[str] = set()
        self._names = itertools.count(1)

    # --- any thread -------------------------------------------------------------------------------------------

    def put(self, content: bytes) -> str:
        """Write a blob unless it is here; hold it until `release`; return its name. Raises `SpoolFull`, `OSError`."""
        name, size = sha256(content).hexdigest(), max(_BLOCK_BYTES, rounded(len(content)))
        if self._hold(name):
            return name
        if not self._reserve(size):
            raise SpoolFull(f"spool {self._folder.parent} is full: spool_bytes_max is reached")
        is_new = False
        try:
            self._write(self._folder / BLOBS, name, content)
            is_new = not self._hold(name, size)
        finally:
            if not is_new:  # another thread has put it meanwhile, or it could not be written
                self._reserve(-size)
        return name

    @property
    @locked
    def size(self) -> int:
        """The bytes that all blobs take on the disk."""
        return sum(each.size for each in self._blobs.values())

    def abandon(self) -> None:
        """Detach in a forked child."""
        self._gc_lock.abandon()
        self.owner = 0
        self._gc_lock, self._blobs = GcSafeLock(self), {}

    @locked
    def _hold(self, name: str, size: int = 0) -> bool:
        """Hold the blob; return False if it is not here, and register it if it has a size."""
        is_here = name in self._blobs
        if size and not is_here:
            self._blobs[name] = _Blob(size)
            self._unsynced.add(name)
        if name in self._blobs:
            self._blobs[name].holders += 1
        return is_here

    @locked
    def release(self, name: str, position: int) -> None:
        """State that no record behind this position will refer to the blob because of one put. Ignores other names."""
        blob = self._blobs.get(name)
        if blob is not None and blob.holders:
            blob.holders -= 1
            blob.released = max(blob.released, position)

    def _write(self, folder: Path, name: str, content: bytes) -> None:
        with suppress(FileExistsError):
            create_folder(folder)
        unfinished = folder / f"{name}.{next(self._names)}{MAKING}"
        try:
            while True:
                try:
                    _fill(unfinished, content)
                    break
                except OSError as error:
                    if error.errno not in FULL or not self._make_room(len(content)):
                        raise
            unfinished.replace(folder / name)
        except BaseException:
            with suppress(OSError):
                unfinished.unlink()
            raise

    # --- the sync thread ----------------------------------------------------------------------------------------

    def sync(self) -> None:
        """Write the new blobs to the disk. Raises `OSError`, also for one that another program has deleted."""
        new = tuple(self._unsynced)
        for name in new:
            sync_path(self._folder / BLOBS / name)
        if new:
            sync_path(self._folder / BLOBS)
            sync_path(self._folder)
            self._unsynced.difference_update(new)

    @locked
    def take_all(self) -> list[Path]:
        """Forget all blobs and return their files; call it when no more records are put."""
        return [self._forget(name) for name in list(self._blobs)]

    @locked
    def take(self, *, before: int) -> list[Path]:
        """Forget the blobs to which no record from this position on refers, and return their files."""
        free = [name for name, blob in self._blobs.items() if not blob.holders and blob.released < before]
        return [self._forget(name) for name in free]

    def _forget(self, name: str) -> Path:
        self._reserve(-self._blobs.pop(name).size)
        return self._folder / BLOBS / name


def _fill(path: Path, content: bytes) -> None:
    descriptor = open_file(path, os.O_WRONLY | os.O_TRUNC)
    try:
        if content:
            os.posix_fallocate(descriptor, 0, len(content))  # a full disk refuses here, not when the file is synced
        with os.fdopen(os.dup(descriptor), "wb") as file:
            file.write(content)
    finally:
        os.close(descriptor)
