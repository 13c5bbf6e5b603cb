"""Unpack memories that earlier versions wrote, each with the spool of a dead recorder beside it."""

from __future__ import annotations

import tarfile
from pathlib import Path

__all__ = ["unpack_memory", "unpack_memory_v1"]


def unpack_memory_v1(folder: Path) -> str:
    """Unpack the memory of version 0.1.0 into the folder and return its URL."""
    return unpack_memory(Path(__file__).with_name("memory_v1.tar.gz"), folder)


def unpack_memory(archive: Path, folder: Path) -> str:
    """Unpack a memory into the folder and return its URL."""
    with tarfile.open(archive) as packed:
        # Python before 3.11.4 has no filters; from 3.12 on a call without one is a warning.
        packed.extraction_filter = getattr(tarfile, "data_filter", None)
        packed.extractall(folder)
    return f"sqlite:///{folder}/memory.db"
