"""How long after a `perform` has returned it shows in the tables, when a daemon writes them.

    python -m bench.visible            at 100, 1,000 and 10,000 events a second, 10 s each; SQLite and PostgreSQL
    python -m bench.visible --quick    at 100 and 1,000, half a second each

Actions that do nothing are performed at an even rhythm with a memory for the daemon; a third process asks the database
every 2 ms how far the tables of the episode are, which commit together with that number. Of each perform it is the time
from its return to the first answer that has its end. Prints one JSON line: ms, and the rate that was reached.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sqlite3
import subprocess
import sys
import tempfile
import time
from bisect import bisect_left
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import asyncpg
from rich.table import Table

from bench.daemon import start_daemon, stop
from bench.reporting.figures import console, percentiles
from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract
from tests.databases import ask, server_in

_LOOK_S = 0.002
_RATES = (100, 1_000, 10_000)
_SHOWN = "SELECT folded, head, ended_wall_ns FROM episode ORDER BY number DESC LIMIT 1"


@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    weight: float

    async def perform(self) -> None: ...


async def recorded(url: str, spool: Path, rate: int, seconds: float) -> dict[str, Any]:
    """One rate: performs, and when each showed."""
    returned_ns: list[int] = []
    performs = max(1, round(rate / 2 * seconds))
    async with Memory.open(url, spool=spool, writer="daemon") as memory:
        async with memory.episode(description="bench"):
            await NoteActionPerformable("first", 0.0).perform()
            await memory.flush()  # the daemon has found this recorder
            first = ask(url, "SELECT head FROM episode ORDER BY number DESC LIMIT 1")[0][0]
            watching = _start_watching(url)
            began = time.perf_counter()
            for number in range(performs):
                due = began + number * 2 / rate
                if (ahead_s := due - time.perf_counter()) > 0:
                    await asyncio.sleep(ahead_s)
                await NoteActionPerformable(f"note {number}", number / 7).perform()
                returned_ns.append(time.monotonic_ns())
            took = time.perf_counter() - began
        await memory.flush()
        seen = json.loads((await asyncio.to_thread(watching.communicate))[0])
    moments, shown = [each[0] for each in seen], [each[1] for each in seen]
    last = first + 2 * performs
    assert shown[-1] == last + 2, f"{shown[-1]} events show, {last} and two ends were recorded"
    waited_ms = [
        (moments[bisect_left(shown, first + 2 * number)] - at) / 1e6 for number, at in enumerate(returned_ns, 1)
    ]
    return {"events_per_s": round(2 * performs / took), "performs": performs, "ms": percentiles(waited_ms)}


def _start_watching(url: str) -> subprocess.Popen[str]:
    """A process that watches already when this returns."""
    command = [sys.executable, "-m", "bench.visible", "--watch", url]
    watching = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert watching.stdout is not None
    assert watching.stdout.readline() == "watching\n"
    return watching


async def watch(url: str) -> None:
    """Says when more showed, until the episode has ended and all of it shows: pairs of a moment in ns and a number."""
    seen: list[tuple[int, int]] = []
    answer: Callable[[], Any]
    if url.startswith("postgresql:"):
        connection = await asyncpg.connect(url, server_settings={"search_path": "pycrorm"})
        asked = await connection.prepare(_SHOWN)
        answer = asked.fetchrow
    else:
        file = sqlite3.connect(f"file:{url.removeprefix('sqlite:///')}?mode=ro", uri=True, isolation_level=None)

        async def answer() -> Any:
            return file.execute(_SHOWN).fetchone()

    print("watching", flush=True)
    while True:
        folded, head, ended = await answer()
        if not seen or folded != seen[-1][1]:
            seen.append((time.monotonic_ns(), folded))
        if ended is not None and folded == head:
            break
        await asyncio.sleep(_LOOK_S)
    print(json.dumps(seen))


def measured(rates: tuple[int, ...], seconds: float, stack: ExitStack) -> dict[str, Any]:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
    server = stack.enter_context(server_in(folder / "pg"))
    answer: dict[str, Any] = {}
    for database in ("sqlite", "postgresql"):
        answer[database] = {}
        for rate in rates:
            console().print(f"{database}, {rate:,} events/s …")
            url = server.new_database() if database == "postgresql" else f"sqlite:///{folder}/{rate}.db"
            spool = folder / f"{database}{rate}.spool"
            daemon = start_daemon(url, spool)
            try:
                answer[database][str(rate)] = asyncio.run(recorded(url, spool, rate, seconds))
            finally:
                stop(daemon)
    return answer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two rates, half a second each")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long each rate is held")
    parser.add_argument("--watch", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.watch:
        asyncio.run(watch(asked.watch))
        return
    rates, seconds = (_RATES[:2], 0.5) if asked.quick else (_RATES, asked.seconds)
    with ExitStack() as stack:
        answer = {"bench": "visible", "seconds": seconds, **measured(rates, seconds, stack)}
    print(json.dumps(answer))
    table = Table(title="From the return of a perform to its rows, ms", title_justify="left")
    for name in ("database", "asked, events/s", "reached", "median", "p99", "p99.9", "max"):
        table.add_column(name, justify="left" if name == "database" else "right")
    for database in ("sqlite", "postgresql"):
        for rate, found in answer[database].items():
            table.add_row(database, rate, str(found["events_per_s"]), *(f"{each:,}" for each in found["ms"].values()))
    console().print(table)


if __name__ == "__main__":
    main()
