"""Measure what cases cost where tables are folded, and how long a memory takes to load them and to answer a cue.

    python -m bench.cases            5,000 rollouts folded six times, 1,000,000 actions asked 300 times, both databases
    python -m bench.cases --quick    20 rollouts folded once, 2,000 actions asked five times
    python -m bench.cases --actions 10000000 --databases sqlite

`fold_cpu_us_an_action` is the CPU time of making all cases of the log again, which is what cases add to a fold: reading
and decoding the events, the cases, their blocks, the merges and the transactions. It is divided by the number of
actions; on PostgreSQL `server` is that of the server's processes, to 10 ms of the whole. Then blocks of the actions of
`bench.recall` are stored in another memory. `load_ms` is the time in which a new reader has read all of them.
`asked_ms` is the time of `await recall(...)` with a common cue while nothing changes; `search_ms` is the part that
`bench.recall` measures, and the rest asks the database if there is something new. The script prints one JSON line,
with medians, minima and maxima, or percentiles; `_cpu` is CPU time without that of the server.
"""

from __future__ import annotations

import asyncio
import gc
import json
import time
from typing import Any

from bench.material.actions import Actions
from bench.material.rollouts import spool_rollouts
from bench.material.runs import DATABASES, options, place, store_all
from bench.reporting.figures import console, cpu_s_of, percentiles, spread, with_children
from pycrorm_async import Reading
from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.projections.generations import PROJECTION, read_generation
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.rebuild import Rebuild, claimed, clear
from pycrorm_async.recall.answer import answer
from pycrorm_async.recall.cases import read_headings, rows_of
from pycrorm_async.recall.recall import Recall
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from tests.databases import Server

_SEED = 69
_LOADS = 5


async def fold(url: str, server: Server | None, rounds: int) -> dict[str, Any]:
    """Measure the CPU time of folding all cases of a memory again."""
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    took_us: list[float] = []
    server_us: list[float] = []
    for _ in range(rounds):
        async with claimed(log):
            rebuild = await Rebuild.begin(log, projection=own_projections()[0])
            gc.collect()
            began_s, server_began_s = time.process_time(), _cpu_s_of_server(server)
            while await rebuild.fold_next_batch() is not None:
                pass
            took_s, server_s = time.process_time() - began_s, _cpu_s_of_server(server) - server_began_s
            async with log.reading() as connection:
                cases = sum(each.cases for each in await read_headings(connection, rebuild.number))
            await rebuild.show()
            await clear(log)
        took_us.append(1e6 * took_s / cases)
        server_us.append(1e6 * server_s / cases)
    await log.close()
    figures = {"actions": cases, "fold_cpu_us_an_action": spread(took_us)}
    return {**figures, "server": spread(server_us)} if server is not None else figures


def _cpu_s_of_server(server: Server | None) -> float:
    if server is None:
        return 0.0
    postmaster = int((server.folder / "postmaster.pid").read_text().split()[0])
    return sum(map(cpu_s_of, with_children(postmaster)))


async def store(url: str, actions: Actions) -> None:
    """Store the actions as blocks of a new memory without events."""
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    await Projector(log, installed=own_projections()).open()
    async with log.reading() as connection:
        generation = await read_generation(connection, f"{PROJECTION}{own_projections()[0].name}")
    assert generation is not None
    dialect = dialect_of(log.engine)
    for block in actions.blocks():
        async with log.writing() as connection:
            await dialect.insert(connection, await dialect.insertion(rows_of(block, generation.number)))
    await log.close()


async def ask(url: str, actions: Actions, cues: int) -> dict[str, Any]:
    """Measure the time of loading all blocks, and that of an answer."""
    load_ms: list[float] = []
    load_cpu_ms: list[float] = []
    asked_ms: list[float] = []
    asked_cpu_ms: list[float] = []
    search_ms: list[float] = []
    async with Reading.open(url) as reading:
        await Recall.of(reading).types()  # opens the connections
        for _ in range(_LOADS):
            recall = Recall.of(reading)
            began_s, began_cpu_s = time.perf_counter(), time.process_time()
            await recall.types()
            load_cpu_ms.append(1_000 * (time.process_time() - began_cpu_s))
            load_ms.append(1_000 * (time.perf_counter() - began_s))
        library = await recall.reader.library()
        for dtype in library.types:
            await recall(dtype, has={"object_type": "CACTUS"})  # counts words
        gc.collect()
        for _ in range(cues):
            cue = actions.common()
            began_s, began_cpu_s = time.perf_counter(), time.process_time()
            await recall(cue.type, has=dict(cue.has), k=cue.k)
            asked_cpu_ms.append(1_000 * (time.process_time() - began_cpu_s))
            asked_ms.append(1_000 * (time.perf_counter() - began_s))
            began_s = time.perf_counter()
            answer(cue, library)
            search_ms.append(1_000 * (time.perf_counter() - began_s))
    return {
        "load_ms": spread(load_ms),
        "load_cpu_ms": spread(load_cpu_ms),
        "asked_ms": percentiles(asked_ms),
        "asked_cpu_ms": percentiles(asked_cpu_ms),
        "search_ms": percentiles(search_ms),
    }


def main() -> None:
    parser = options(__doc__, quick="few and small, to check that it works")
    parser.add_argument("--actions", type=int, default=1_000_000, help="actions in the memory that is asked")
    parser.add_argument("--rollouts", type=int, default=5_000, help="rollouts of five actions each that are folded")
    parser.add_argument("--databases", nargs="+", choices=DATABASES, default=DATABASES)
    arguments = parser.parse_args()
    count, rollouts, rounds, cues = arguments.actions, arguments.rollouts, 6, 300
    if arguments.quick:
        count, rollouts, rounds, cues = 2_000, 20, 1, 5
    collect_seldom()  # as in `pycrorm writer`
    result: dict[str, Any] = {"bench": "cases", "asked_actions": count, "cues": cues}
    actions = Actions(count, seed=_SEED)
    for database in arguments.databases:
        console().print(f"{database} …")
        with place(database) as here:
            folded, asked = here.new_url("folded"), here.new_url("asked")
            spool_rollouts(rollouts, here.folder / "spool", seed=_SEED)
            store_all(folded, here.folder / "spool")
            result[database] = asyncio.run(fold(folded, here.server, rounds))
            asyncio.run(store(asked, actions))
            result[database] |= asyncio.run(ask(asked, actions, cues))
    print(json.dumps(result))


if __name__ == "__main__":
    main()
