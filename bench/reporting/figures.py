"""What every script does with what it measured: a spread, the peak of a process, where people read."""

from __future__ import annotations

import os
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rich.console import Console

__all__ = [
    "MISSING",
    "console",
    "cpu_s_of",
    "held_mb",
    "memory_free_gb",
    "peak_mb",
    "percentiles",
    "spread",
    "with_children",
]

MISSING: Final = "missing: pip install '.[bench]'"
"""In the place of a figure, where a library to compare with is not installed."""


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, least and most, to four digits."""
    return {"median": _short(statistics.median(values)), "least": _short(min(values)), "most": _short(max(values))}


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """Median, p99, p99.9 and the largest, to four digits."""
    ordered = sorted(values)
    at = {"median": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    return {name: _short(ordered[round(share * (len(ordered) - 1))]) for name, share in at.items()}


def _short(value: float) -> float:
    rounded = float(f"{value:.4g}")
    return int(rounded) if rounded.is_integer() else rounded


def peak_mb() -> float:
    """The most memory this process held so far, of its own image: not of the one it was started from."""
    return held_mb("VmHWM")


def held_mb(what: str, process: int | None = None) -> float:
    """A figure of a process' memory, by the name that `proc(5)` gives it; of this one by default."""
    lines = Path(f"/proc/{process or 'self'}/status").read_text().splitlines()
    return next(round(int(line.split()[1]) / 1024, 1) for line in lines if line.startswith(f"{what}:"))


def cpu_s_of(process: int) -> float:
    """How long all threads of a running process were on a processor."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def with_children(process: int) -> list[int]:
    """A running process and those it has started."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [process, *map(int, children)]


def memory_free_gb() -> float:
    """What a process can still have without anything being thrown out."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    return next(int(line.split()[1]) / 2**20 for line in lines if line.startswith("MemAvailable"))


def console() -> Console:
    """For progress and tables: what is printed elsewhere is for programs."""
    return Console(stderr=True, width=None if sys.stderr.isatty() else 140)
