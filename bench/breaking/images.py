"""File systems of one's own, in a file each, for faults that need a disk."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["DiskImage", "NOT_MADE"]

NOT_MADE = "not made: there is no right to mount a loop image here"
_MAKE = {"ext4": ["mkfs.ext4", "-q", "-F"], "xfs": ["mkfs.xfs", "-q", "-f"], "btrfs": ["mkfs.btrfs", "-q", "-f"]}


class DiskImage:
    """A file system of this kind in a file; `root` is where it is mounted. Raises `OSError`, `CalledProcessError`."""

    def __init__(self, folder: Path, *, kind: str = "ext4", size: str = "64M") -> None:
        self._image = folder / "disk.img"
        self.root = folder / "disk"
        self.root.mkdir()
        subprocess.run(["truncate", "-s", size, self._image], check=True)
        subprocess.run([*_MAKE[kind], self._image], check=True, capture_output=True)

    @staticmethod
    def can_make(kind: str) -> bool:
        """Whether the program that makes such a file system is installed."""
        return shutil.which(_MAKE[kind][0]) is not None

    @contextmanager
    def mounted(self) -> Iterator[None]:
        """Mounting replays the journal."""
        subprocess.run(["mount", "-o", "loop", self._image, self.root], check=True, capture_output=True)
        try:
            yield
        finally:
            subprocess.run(["umount", self.root], check=True)
