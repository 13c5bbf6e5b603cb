"""Unpack the memory that version 0.1.0 wrote, with the spool of a dead recorder beside it."""

from __future__ import annotations

import tarfile
from pathlib import Path

__all__ = ["unpack_memory_v1"]


def unpack_memory_v1(folder: Path) -> str:
    """Unpack the memory into the folder and return its URL."""
    with tarfile.open(Path(__file__).with_name("memory_v1.tar.gz")) as packed:
        # Python before 3.11.4 has no filters; from 3.12 on a call without one is a warning.
        packed.extraction_filter = getattr(tarfile, "data_filter", None)
        packed.extractall(folder)
    return f"sqlite:///{folder}/memory.db"
