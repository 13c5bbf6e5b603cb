"""Create and mount file systems in image files, for faults that need a disk."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["DiskImage", "NOT_MADE"]

NOT_MADE = "skipped: no permission to mount a loop image"
_MAKE = {"ext4": ["mkfs.ext4", "-q", "-F"], "xfs": ["mkfs.xfs", "-q", "-f"], "btrfs": ["mkfs.btrfs", "-q", "-f"]}


class DiskImage:
    """A file system in an image file, mounted at `root`.

    Raises:
        OSError, CalledProcessError: a program is missing, or failed.
    """

    def __init__(self, folder: Path, *, kind: str = "ext4", size: str = "64M") -> None:
        self._image = folder / "disk.img"
        self.root = folder / "disk"
        self.root.mkdir()
        subprocess.run(["truncate", "-s", size, self._image], check=True)
        subprocess.run([*_MAKE[kind], self._image], check=True, capture_output=True)

    @staticmethod
    def can_make(kind: str) -> bool:
        """Return True if the program that creates this kind of file system is installed."""
        return shutil.which(_MAKE[kind][0]) is not None

    @contextmanager
    def mounted(self) -> Iterator[None]:
        """Mount the image; this replays the journal of the file system."""
        subprocess.run(["mount", "-o", "loop", self._image, self.root], check=True, capture_output=True)
        try:
            yield
        finally:
            subprocess.run(["umount", self.root], check=True)
