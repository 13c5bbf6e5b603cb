"""Measure the rate at which the daemon drains the spools of one and of four running recorders, and several daemons.

    python -m bench.daemon               200,000 events on SQLite; --postgresql on a new server
    python -m bench.daemon --quick       2,000 events

The recorders record everything before the daemon starts, so the daemon runs at its full rate. The script prints one
JSON line: events a second until the last one is stored, and until the last one is visible in the tables.

On PostgreSQL 1, 4 and 8 daemons, each with a recorder and a spool of its own, then drain as many events into one
database, in turn for `ROUNDS` rounds. Of the best rounds the line has the time until all is visible and the processor
time of the daemons, as multiples of those of one daemon, and how often an event was read from the log.
"""

import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, ExitStack
from dataclasses import dataclass
from pathlib import Path

from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract
from tests.databases import Server, ask, server_in

EVENTS = 2_000 if "--quick" in sys.argv else 200_000
DAEMONS = (1, 4, 8)
WARM_UP = 5_000
ROUNDS = 1 if "--quick" in sys.argv else 4
READ = "SELECT idx_tup_fetch + seq_tup_read FROM pg_stat_user_tables WHERE relname = 'event'"


@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    weight: float

    async def perform(self) -> None: ...


async def record(memory: Memory, events: int) -> None:
    """Record episodes of a thousand events each."""
    while memory.status.written < events:
        async with memory.episode(description="bench"):
            for index in range(499):
                await NoteActionPerformable(f"note {index}", index / 7).perform()


def start_daemon(url: str, spool: Path) -> subprocess.Popen[str]:
    """Start the daemon, and return it when it is ready to drain."""
    command = [sys.executable, "-m", "pycrorm_async", "writer", "--url", url, "--spool", str(spool)]
    daemon = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert daemon.stderr is not None
    assert daemon.stderr.readline().startswith("draining")
    return daemon


def stop(daemon: subprocess.Popen[str]) -> None:
    daemon.terminate()
    daemon.communicate()


async def drain(url: str, spool: Path, recorders: int) -> dict[str, int]:
    async with AsyncExitStack() as stack:
        memories = [
            await stack.enter_async_context(Memory.open(url, spool=spool, writer="daemon")) for _ in range(recorders)
        ]
        for memory in memories:
            await record(memory, EVENTS // recorders)
            await memory.synced()
        total = sum(memory.status.written for memory in memories)
        daemon = start_daemon(url, spool)
        began = time.perf_counter()
        stored_s = visible_s = 0.0
        while not visible_s:
            await asyncio.sleep(0.01)
            now_s = time.perf_counter() - began
            if not stored_s and sum(memory.status.stored for memory in memories) == total:
                stored_s = now_s
            if sum(memory.status.folded or 0 for memory in memories) == total:
                visible_s = now_s
    stop(daemon)
    return {"stored_per_s": round(total / stored_s), "shown_per_s": round(total / visible_s)}


async def drain_by(url: str, folder: Path, daemons: int) -> tuple[float, float, float]:
    """Return wall and processor seconds of several daemons on one database, and reads of an event in the log."""
    spools = [folder / f"{each}.spool" for each in range(daemons)]
    started = [start_daemon(url, each) for each in spools]
    async with AsyncExitStack() as stack:
        memories = [await stack.enter_async_context(Memory.open(url, spool=each, writer="daemon")) for each in spools]
        for memory in memories:
            await record(memory, WARM_UP)
            await memory.flush()  # starts all fold workers and makes the tables, which are not measured
        for each in started:
            each.send_signal(signal.SIGSTOP)
        before, reads = sum(memory.status.written for memory in memories), await counted_reads(url)
        for memory in memories:
            await record(memory, EVENTS // daemons)
            await memory.synced()
        total = sum(memory.status.written for memory in memories)
        began_s, before_s = time.perf_counter(), sum(map(processor_s, started))
        for each in started:
            each.send_signal(signal.SIGCONT)
        wall_s = 0.0
        while not wall_s:
            await asyncio.sleep(0.01)
            if sum(memory.status.folded or 0 for memory in memories) == total:
                wall_s = time.perf_counter() - began_s
        cpu_s = sum(map(processor_s, started)) - before_s
    for each in started:
        stop(each)
    return wall_s, cpu_s, (await counted_reads(url) - reads) / (total - before)


async def counted_reads(url: str) -> int:
    await asyncio.sleep(1.0)  # the server publishes its counters at intervals
    [(count,)] = ask(url, READ)
    return int(count)


def processor_s(daemon: subprocess.Popen[str]) -> float:
    """Return the processor time of a daemon and its fold workers."""
    children = Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").read_text().split()
    fields = [Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split() for each in (daemon.pid, *children)]
    return sum(int(each[11]) + int(each[12]) for each in fields) / os.sysconf("SC_CLK_TCK")


async def compare(server: Server, folder: Path) -> dict[str, object]:
    rounds: dict[int, list[tuple[float, float, float]]] = {each: [] for each in DAEMONS}
    for index in range(ROUNDS):
        for daemons, results in rounds.items():
            results.append(await drain_by(server.new_memory(), folder / f"{index}.{daemons}", daemons))
    best = {daemons: [min(each) for each in zip(*results, strict=True)] for daemons, results in rounds.items()}
    return {
        f"by_{daemons}": {
            "wall": round(wall_s / best[1][0], 2),
            "cpu": round(cpu_s / best[1][1], 2),
            "reads_per_event": round(reads, 2),
        }
        for daemons, (wall_s, cpu_s, reads) in best.items()
    }


async def measure(stack: ExitStack, *, postgresql: bool) -> dict[str, object]:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
    server = stack.enter_context(server_in(folder / "pg")) if postgresql else None
    result: dict[str, object] = {"bench": "daemon", "database": "postgresql" if postgresql else "sqlite"}
    for recorders in (1, 4):
        url = server.new_database() if server else f"sqlite:///{folder}/{recorders}.db"
        result[f"from_{recorders}"] = await drain(url, folder / f"{recorders}.spool", recorders)
    if server:
        result |= await compare(server, folder)
    return result | {"events": EVENTS}


if __name__ == "__main__":
    with ExitStack() as stack:
        print(json.dumps(asyncio.run(measure(stack, postgresql="--postgresql" in sys.argv))))
