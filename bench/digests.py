"""Measure the share of the digests of episodes in storing events, on SQLite and PostgreSQL.

    python -m bench.digests            20 batches of 10,000 events with and 20 without digests on each database
    python -m bench.digests --quick    2 batches of 1,000 events each

A queue records an episode; then the script reads the batch and appends it, as the writer does. Batches with and without
digests are in random order. The script prints one JSON line: the time of an event in µs with and without digests, and
the ratio. `spool_to_log_cpu` is the mean CPU time of reading and appending, with that of the server, `append_cpu` of
appending alone, and `append_wall` the median of the turns' wall times.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any, NamedTuple

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import Heading, encode
from pycrorm_async.events.ids import episode_id
from pycrorm_async.events.types import EpisodeStarted, NodeEnded, NodeStarted, ObjectReference, PoseValue, RobotValue
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import ask, server_in

BACKENDS = """
SELECT pid FROM pg_catalog.pg_stat_activity
WHERE datname = pg_catalog.current_database() AND pid <> pg_catalog.pg_backend_pid()"""
TURNS, EVENTS = (2, 1_000) if "--quick" in sys.argv else (20, 10_000)


def record(queue: RecorderQueue) -> None:
    """Record an episode of starts and ends of pick-ups."""
    episode = episode_id(time.time_ns(), os.urandom(10))
    pose = PoseValue((1.25, -0.5, 0.9), (0.0, 0.0, 0.7071, 0.7071), "map", 1_795_416_560_556_237_149)
    robot = RobotValue(pose, "ROBOT", 0.3, ObjectReference(3, 30))
    parameters = {"object_designator": ObjectReference(4, 4), "arm": "LEFT", "grasp": "FRONT"}
    started = encode(NodeStarted("action", 2, "20f08df38cd07afb47cf1aec69c519f4", parameters, robot))
    ended = encode(NodeEnded(1_234, "SUCCEEDED"))
    queue.put_nowait(Heading(episode, "EpisodeStarted", 1), encode(EpisodeStarted("bench", "", "", "", "")))
    for _ in range(EVENTS // 2):
        queue.put_nowait(Heading(episode, "NodeStarted", 1), started, reserved=True)
        queue.put_nowait(Heading(episode, "NodeEnded", 1), ended, reserved=True)


class Took(NamedTuple):
    """Times of one batch in ns."""

    spool_to_log_cpu: int
    append_cpu: int
    append_wall: int


def cpu_ns(server_pids: Sequence[int]) -> int:
    """Return the CPU time of this process and of the server's."""
    fields = [Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split() for pid in server_pids]
    ticks = sum(int(each[11]) + int(each[12]) for each in fields)
    return time.process_time_ns() + ticks * 10**9 // os.sysconf("SC_CLK_TCK")


async def drain(log: EventLog, spool: Path, server_pids: Sequence[int]) -> Took:
    """Record an episode, and store it in one batch."""
    name = episode_id(time.time_ns(), os.urandom(10))
    queue = RecorderQueue.create(spool, settings=Settings(), clock=SYSTEM_CLOCK, recorder=name)
    try:
        record(queue)
        await queue.synced_to()
        began_ns = cpu_ns(server_pids)
        records = await queue.get_batch(events_max=2 * EVENTS, bytes_max=2**30, age_s_max=0.01)
        read_ns, read_wall_ns = cpu_ns(server_pids), time.perf_counter_ns()
        await log.append(records)
        wall_ns = time.perf_counter_ns() - read_wall_ns
        await queue.acknowledge(records[-1].position)
        ended_ns = cpu_ns(server_pids)
        assert len(records) == EVENTS + 1, "one batch"
        return Took(ended_ns - began_ns, ended_ns - read_ns, wall_ns)
    finally:
        queue.release()


async def measure(url: str, spool: Path) -> dict[str, Any]:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    digests = log.digests
    await drain(log, spool, [])
    server_pids = [] if log.address.is_sqlite else [pid for (pid,) in await asyncio.to_thread(ask, url, BACKENDS)]
    took_ns: dict[bool, list[Took]] = {True: [], False: []}
    order = random.Random(1)  # in turns, each second batch would pay for the checkpoints of SQLite
    for _ in range(TURNS):
        for with_digests in order.sample((True, False), 2):
            log.digests = digests if with_digests else None
            took_ns[with_digests].append(await drain(log, spool, server_pids))
    await log.close()
    return {name: compared(name, took_ns) for name in Took._fields}


def compared(name: str, took_ns: Mapping[bool, Sequence[Took]]) -> dict[str, float]:
    middle = median if name.endswith("wall") else mean
    us = {each: middle([getattr(took, name) for took in turns]) / EVENTS / 1e3 for each, turns in took_ns.items()}
    return {"with_us": round(us[True], 2), "without_us": round(us[False], 2), "ratio": round(us[True] / us[False], 3)}


if __name__ == "__main__":
    collect_seldom()
    result: dict[str, Any] = {"bench": "digests", "events": EVENTS, "turns": TURNS}
    with tempfile.TemporaryDirectory(prefix="b") as place:
        folder = Path(place)
        result["sqlite"] = asyncio.run(measure(f"sqlite:///{folder}/memory.db", folder / "spool"))
        with server_in(folder / "pg") as server:
            result["postgresql"] = asyncio.run(measure(server.new_database(), folder / "spools"))
    print(json.dumps(result))
