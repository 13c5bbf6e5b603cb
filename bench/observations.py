"""Measure what an observation costs its caller, back to back and at 1 kHz, while the writer stores and folds it.

    python -m bench.observations            10 windows of each kind, half a minute
    python -m bench.observations --quick    two short windows

A thread observes three numbers, as the driver of a sensor does. At 1 kHz it sleeps between two observations, which
evicts the code of the hook from the processor's caches. The figures are those of the window of the least median, which
other programs disturbed least: percentiles of a call in µs, and the CPU time of the whole process in that window, with
the writer thread, as a share of one core. The script prints one JSON line.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from bench.reporting.figures import percentiles
from pycrorm_async import Memory

_INTERVALS_NS = {"back to back": 0, "1 kHz": 1_000_000}


def observe(memory: Memory, count: int, interval_ns: int) -> dict[str, float]:
    """Return the percentiles of the calls of one window, and the share of a core that the process used in it."""
    durations_us: list[float] = []
    began_ns, cpu_ns = time.perf_counter_ns(), time.process_time_ns()
    for number in range(count):
        if (early_ns := began_ns + number * interval_ns - time.perf_counter_ns()) > 0:
            time.sleep(early_ns / 1e9)
        call_ns = time.perf_counter_ns()
        memory.observe("force", {"x": 1.5, "y": -0.25, "z": 9.81})
        durations_us.append((time.perf_counter_ns() - call_ns) / 1e3)
    share = (time.process_time_ns() - cpu_ns) / (time.perf_counter_ns() - began_ns)
    return percentiles(durations_us) | {"cores": round(share, 3)}


async def measure(url: str, *, windows: int, count: int) -> dict[str, Any]:
    taken: dict[str, list[dict[str, float]]] = {name: [] for name in _INTERVALS_NS}
    async with Memory.open(url) as memory, memory.episode(description="bench"):
        for _ in range(windows):
            for name, interval_ns in _INTERVALS_NS.items():
                taken[name].append(await asyncio.to_thread(observe, memory, count, interval_ns))
                await memory.flush()
        missing = memory.status.missing.total
    assert missing == 0, f"{missing} observations were not recorded"
    return {name: min(each, key=lambda window: window["median"]) for name, each in taken.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two short windows of each kind")
    windows, count = (2, 200) if parser.parse_args().quick else (10, 2_000)
    with tempfile.TemporaryDirectory(prefix="b") as folder:
        figures = asyncio.run(measure(f"sqlite:///{Path(folder) / 'memory.db'}", windows=windows, count=count))
    print(json.dumps({"bench": "observations", "windows": windows, "observations_a_window": count, **figures}))


if __name__ == "__main__":
    main()
