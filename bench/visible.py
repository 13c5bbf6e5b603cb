"""Measure the time from the return of a `perform` until its rows are visible, when a process of its own writes them.

    python -m bench.visible            at 100, 1,000 and 10,000 events a second, 10 s each; SQLite and PostgreSQL
    python -m bench.visible --quick    at 100 and 1,000, half a second each

Actions that do nothing are performed at a fixed rate. A third process reads the episode's checkpoint every 2 ms; the
checkpoint commits together with the rows. The latency of a perform is the time from its return to the first reading
that includes its end. The script prints one JSON line: latencies in ms, and the rate that was reached.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sqlite3
import subprocess
import sys
import time
from bisect import bisect_left
from collections.abc import Callable
from pathlib import Path
from typing import Any

import asyncpg

from bench.material.runs import DATABASES, NoteActionPerformable, options, place
from bench.reporting.figures import console, percentiles, table_of
from pycrorm_async import Memory
from tests.databases import ask

_POLL_S = 0.002
_RATES = (100, 1_000, 10_000)
_CHECKPOINT = "SELECT folded, head, ended_wall_ns FROM episode ORDER BY number DESC LIMIT 1"


async def record(url: str, spool: Path, rate: int, seconds: float) -> dict[str, Any]:
    """Record at one rate, and return the latencies of the performs."""
    returned_ns: list[int] = []
    performs = max(1, round(rate / 2 * seconds))
    async with Memory.open(url, spool=spool, writer="process") as memory:
        async with memory.episode(description="bench"):
            await NoteActionPerformable("first", 0.0).perform()
            await memory.flush()  # the writer process is ready
            first = ask(url, "SELECT head FROM episode ORDER BY number DESC LIMIT 1")[0][0]
            watcher = _start_watching(url)
            begin_s = time.perf_counter()
            for number in range(performs):
                due_s = begin_s + number * 2 / rate
                if (ahead_s := due_s - time.perf_counter()) > 0:
                    await asyncio.sleep(ahead_s)
                await NoteActionPerformable(f"note {number}", number / 7).perform()
                returned_ns.append(time.monotonic_ns())
            elapsed_s = time.perf_counter() - begin_s
        await memory.flush()
        readings = json.loads((await asyncio.to_thread(watcher.communicate))[0])
    times_ns, checkpoints = [each[0] for each in readings], [each[1] for each in readings]
    last = first + 2 * performs
    assert checkpoints[-1] == last + 2, (
        f"{checkpoints[-1]} events are visible, but {last} events and two ends were recorded"
    )
    latencies_ms = [
        (times_ns[bisect_left(checkpoints, first + 2 * number)] - returned) / 1e6
        for number, returned in enumerate(returned_ns, 1)
    ]
    return {"events_per_s": round(2 * performs / elapsed_s), "performs": performs, "ms": percentiles(latencies_ms)}


def _start_watching(url: str) -> subprocess.Popen[str]:
    """Start the watching process, and wait until it polls."""
    command = [sys.executable, "-m", "bench.visible", "--watch", url]
    watcher = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert watcher.stdout is not None
    assert watcher.stdout.readline() == "watching\n"
    return watcher


async def watch(url: str) -> None:
    """Poll the checkpoint until the ended episode is fully visible; print pairs of a time in ns and a checkpoint."""
    readings: list[tuple[int, int]] = []
    read_checkpoint: Callable[[], Any]
    if url.startswith("postgresql:"):
        connection = await asyncpg.connect(url, server_settings={"search_path": "pycrorm"})
        statement = await connection.prepare(_CHECKPOINT)
        read_checkpoint = statement.fetchrow
    else:
        file = sqlite3.connect(f"file:{url.removeprefix('sqlite:///')}?mode=ro", uri=True, isolation_level=None)

        async def read_checkpoint() -> Any:
            return file.execute(_CHECKPOINT).fetchone()

    print("watching", flush=True)
    while True:
        folded, head, ended = await read_checkpoint()
        if not readings or folded != readings[-1][1]:
            readings.append((time.monotonic_ns(), folded))
        if ended is not None and folded == head:
            break
        await asyncio.sleep(_POLL_S)
    print(json.dumps(readings))


def measure(rates: tuple[int, ...], seconds: float) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for database in DATABASES:
        with place(database) as here:
            result[database] = {}
            for rate in rates:
                console().print(f"{database}, {rate:,} events/s …")
                spool = here.folder / f"{rate}.spool"
                result[database][str(rate)] = asyncio.run(record(here.new_url(f"{rate}"), spool, rate, seconds))
    return result


def main() -> None:
    parser = options(__doc__, quick="two rates, half a second each")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of each rate")
    parser.add_argument("--watch", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.watch:
        asyncio.run(watch(arguments.watch))
        return
    rates, seconds = (_RATES[:2], 0.5) if arguments.quick else (_RATES, arguments.seconds)
    result = {"bench": "visible", "seconds": seconds, **measure(rates, seconds)}
    print(json.dumps(result))
    header = "database: | requested, events/s | reached | median | p99 | p99.9 | max"
    table = table_of("From the return of a perform to its rows, ms", header)
    for database in ("sqlite", "postgresql"):
        for rate, figures in result[database].items():
            table.add_row(
                database, rate, str(figures["events_per_s"]), *(f"{each:,}" for each in figures["ms"].values())
            )
    console().print(table)


if __name__ == "__main__":
    main()
