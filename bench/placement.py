"""Compare what appending and folding cost in a partitioned memory on PostgreSQL with the same in plain tables.

    python -m bench.placement             two minutes
    python -m bench.placement --quick     seconds

An episode of pick-up rollouts is appended to a memory of each placement in turns, and then folded, each time as a new
episode. The cost is the CPU time of this process and of the memory's server processes; each is the least of all turns.
The script prints one JSON line: µs an event, and the ratio to plain tables.
"""

from __future__ import annotations

import asyncio
import json
import os
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Final, NamedTuple

from bench.material.rollouts import spool_rollouts
from bench.material.runs import options, read_all
from pycrorm_async.events.ids import episode_id
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.placement import Placement
from tests.databases import Server, server_in_memory

PLACEMENTS: Final = (0, 4, 16)
_PROCESSES = "SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND application_name = 'pycrorm'"


class _Memory(NamedTuple):
    log: EventLog
    projector: Projector
    processes: list[int]

    def cpu_ns(self) -> int:
        """Return the CPU time of this process and of the server's processes for this memory."""
        served = (Path(f"/proc/{pid}/schedstat").read_text().split()[0] for pid in self.processes)
        return time.process_time_ns() + sum(map(int, served))


async def _open(server: Server, partitions: int) -> _Memory:
    address = DatabaseAddress.parse(server.new_database())
    log = await EventLog.open(address, create=True, placement=Placement(partitions))
    projector = Projector(log)
    await projector.open()
    return _Memory(log, projector, [])


async def measure(server: Server, folder: Path, rollouts: int, turns: int) -> dict[str, dict[str, float]]:
    """Return the least CPU time of each placement, in µs an event."""
    await asyncio.to_thread(spool_rollouts, rollouts, folder / "spool", seed=69, an_episode=rollouts)
    records = await read_all(folder / "spool")
    memories = {each: await _open(server, each) for each in PLACEMENTS}
    least: dict[str, dict[int, float]] = {part: dict.fromkeys(PLACEMENTS, float("inf")) for part in ("append", "fold")}
    for turn in range(turns + 1):
        for partitions, memory in memories.items():
            name = episode_id(time.time_ns(), os.urandom(10))
            batch = [each if each.episode is None else each._replace(episode=name) for each in records]
            async with memory.log.reading() as connection:
                memory.processes[:] = (await connection.exec_driver_sql(_PROCESSES)).scalars()
            works: dict[str, Callable[[], Awaitable[object]]] = {
                "append": lambda log=memory.log, batch=batch: log.append(batch),  # type: ignore[misc]
                "fold": memory.projector.catch_up,
            }
            for part, work in works.items():
                began_ns = memory.cpu_ns()
                await work()
                took_us = (memory.cpu_ns() - began_ns) / len(batch) / 1e3
                if turn:
                    least[part][partitions] = min(least[part][partitions], took_us)
    for memory in memories.values():
        await memory.log.close()
    return {
        part: {f"{each}": round(took, 2) for each, took in costs.items()}
        | {f"{each} / plain": round(costs[each] / costs[0], 3) for each in PLACEMENTS[1:]}
        for part, costs in least.items()
    }


def main() -> None:
    parser = options(__doc__, quick="few events and two turns")
    quick = parser.parse_args().quick
    with server_in_memory() as server, tempfile.TemporaryDirectory(prefix="b") as folder:
        costs = asyncio.run(measure(server, Path(folder), 50 if quick else 500, 2 if quick else 12))
    print(json.dumps({"bench": "placement", **costs}))


if __name__ == "__main__":
    main()
