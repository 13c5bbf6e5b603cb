"""Measure the rate at which the daemon drains the spools of one and of four running recorders, and several daemons.

    python -m bench.daemon               200,000 events on SQLite; --postgresql on a new server
    python -m bench.daemon --quick       2,000 events
    python -m bench.daemon --daemons 1 2 8     several daemons alone

The recorders record everything before the daemon starts, so the daemon runs at its full rate. The script prints one
JSON line: events a second until the last one is stored, and until the last one is visible in the tables.

On PostgreSQL 1, 2 and 8 daemons, each with a recorder and a spool of its own, then drain as many events into one
database, in turn for `--rounds` rounds. Each daemon has drained 25,000 events before: its fold workers have opened the
database and folded a large batch, as those of a daemon that has run for a while. The line has, for each number of
daemons, the processor time of an event in µs in the daemons with their fold workers and in the server, the time until
all is visible, and the reads of an event in the log: the least of the rounds. `rate_by_cpu` and `rate_by_wall` are the
rates as multiples of that of the first number. Where other programs use the machine, only the processor time says how
the rates would be on an idle one, on which the daemons and the server use all cores.
"""

import argparse
import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import NamedTuple

from bench.material.runs import Place, options, place, record_notes
from bench.reporting.figures import console
from pycrorm_async import Memory
from tests.databases import Server, ask

WARM_UP = 25_000
"""Events of each daemon that are not measured: a batch of 10,000 for each of its two fold workers, and some more."""
READ = "SELECT idx_tup_fetch + seq_tup_read FROM pg_stat_user_tables WHERE relname = 'event'"


async def record(memory: Memory, events: int) -> None:
    """Record episodes of a thousand events each."""
    while memory.status.written < events:
        await record_notes(memory, 499)


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


async def drain(url: str, spool: Path, recorders: int, events: int) -> dict[str, int]:
    async with AsyncExitStack() as stack:
        memories = [
            await stack.enter_async_context(Memory.open(url, spool=spool, writer="daemon")) for _ in range(recorders)
        ]
        for memory in memories:
            await record(memory, events // recorders)
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


class Cost(NamedTuple):
    """The cost of an event: processor time in µs of the daemons and of the server, wall time in µs, and reads."""

    daemons_us: float
    server_us: float
    wall_us: float
    reads: float


async def drain_by(server: Server, folder: Path, daemons: int, events: int) -> Cost:
    """Drain the spools of so many recorders by so many daemons into one new memory."""
    url = server.new_memory()
    spools = [folder / f"{each}.spool" for each in range(daemons)]
    started = [start_daemon(url, each) for each in spools]
    async with AsyncExitStack() as stack:
        memories = [await stack.enter_async_context(Memory.open(url, spool=each, writer="daemon")) for each in spools]
        await fill(started, memories, WARM_UP)
        await drained(started, memories)
        before, reads = sum(memory.status.written for memory in memories), await counted_reads(url)
        await fill(started, memories, events // daemons)
        total = sum(memory.status.written for memory in memories)
        began_s, daemons_s = time.perf_counter(), sum(processor_s(each.pid) for each in started)
        server_s = processor_s(server.postmaster.pid)
        await drained(started, memories)
        wall_s = time.perf_counter() - began_s
        daemons_s = sum(processor_s(each.pid) for each in started) - daemons_s
        server_s = processor_s(server.postmaster.pid) - server_s
    for each in started:
        stop(each)
    count = total - before
    read = await counted_reads(url) - reads
    return Cost(daemons_s / count * 1e6, server_s / count * 1e6, wall_s / count * 1e6, read / count)


async def fill(daemons: Sequence[subprocess.Popen[str]], memories: Sequence[Memory], events: int) -> None:
    """Stop the daemons and record these events into each spool."""
    for each in daemons:
        each.send_signal(signal.SIGSTOP)
    for memory in memories:
        await record(memory, memory.status.written + events)
        await memory.synced()


async def drained(daemons: Sequence[subprocess.Popen[str]], memories: Sequence[Memory]) -> None:
    """Let the daemons continue, and wait until all events are visible in the tables."""
    for each in daemons:
        each.send_signal(signal.SIGCONT)
    while any((memory.status.folded or 0) < memory.status.written for memory in memories):  # noqa: ASYNC110  as a plan
        await asyncio.sleep(0.02)


async def counted_reads(url: str) -> int:
    await asyncio.sleep(1.0)  # the server publishes its counters at intervals
    [(count,)] = ask(url, READ)
    return int(count)


def processor_s(pid: int) -> float:
    """Return the processor time of a process and its children, also of those that have ended."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    ticks = 0
    for each in (str(pid), *children):
        fields = Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split()
        ticks += sum(map(int, fields[11:15] if each == str(pid) else fields[11:13]))
    return ticks / os.sysconf("SC_CLK_TCK")


async def compare(server: Server, folder: Path, numbers: Sequence[int], rounds: int, events: int) -> dict[str, object]:
    costs: dict[int, list[Cost]] = {each: [] for each in numbers}
    for index in range(rounds):
        for daemons in numbers if index % 2 == 0 else numbers[::-1]:
            costs[daemons].append(await drain_by(server, folder / f"{index}.{daemons}", daemons, events))
            console().print(f"{daemons} daemons: {costs[daemons][-1]}, load {os.getloadavg()[0]:.1f}")
    cpu_us = {each: min(cost.daemons_us + cost.server_us for cost in costs[each]) for each in numbers}
    best = {each: Cost(*map(min, zip(*costs[each], strict=True))) for each in numbers}
    return {
        f"by_{each}": {
            **{name: round(value, 2) for name, value in best[each]._asdict().items()},
            "rate_by_cpu": round(cpu_us[numbers[0]] / cpu_us[each], 3),
            "rate_by_wall": round(best[numbers[0]].wall_us / best[each].wall_us, 3),
        }
        for each in numbers
    }


async def measure(here: Place, arguments: argparse.Namespace) -> dict[str, object]:
    result: dict[str, object] = {"bench": "daemon", "database": here.database}
    for recorders in () if arguments.daemons else (1, 4):
        spool = here.folder / f"{recorders}.spool"
        result[f"from_{recorders}"] = await drain(here.new_url(f"{recorders}"), spool, recorders, arguments.events)
    if here.server:
        numbers = arguments.daemons or [1, 2, 8]
        result |= await compare(here.server, here.folder, numbers, arguments.rounds, arguments.events)
    return result | {"events": arguments.events}


def main() -> None:
    parser = options(__doc__, quick="2,000 events and one round")
    parser.add_argument("--postgresql", action="store_true", help="on a new server, and several daemons too")
    parser.add_argument("--daemons", type=int, nargs="+", help="only these numbers of daemons, on a new server")
    parser.add_argument("--events", type=int, default=200_000)
    parser.add_argument("--rounds", type=int, default=4)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.events, arguments.rounds = 2_000, 1
    with place("postgresql" if arguments.postgresql or arguments.daemons else "sqlite") as here:
        print(json.dumps(asyncio.run(measure(here, arguments))))


if __name__ == "__main__":
    main()
