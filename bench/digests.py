"""Measure the share of the digests of episodes in the CPU time from the spool to the log.

    python -m bench.digests            20 batches of 10,000 events with and 20 without digests; SQLite
    python -m bench.digests --quick    2 batches of 1,000 events each

A queue records an episode; then the script reads the batch and appends it, as the writer does. Batches with and without
digests take turns. The script prints one JSON line: the CPU time of an event in µs, the least of all turns, of reading
and appending and of appending alone, and the ratios between with and without digests.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import encode
from pycrorm_async.events.envelope import Heading
from pycrorm_async.events.ids import episode_id
from pycrorm_async.events.types import EpisodeStarted, NodeEnded, NodeStarted
from pycrorm_async.events.values import ObjectReference, PoseValue, RobotValue
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog

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


async def drain(log: EventLog, spool: Path) -> tuple[int, int]:
    """Record an episode and store it; return the CPU time of reading and appending, and of appending alone, in ns."""
    name = episode_id(time.time_ns(), os.urandom(10))
    queue = RecorderQueue.create(spool, settings=Settings(), clock=SYSTEM_CLOCK, recorder=name)
    try:
        record(queue)
        await queue.synced_to()
        began_ns = time.process_time_ns()
        records = await queue.get_batch(events_max=2 * EVENTS, bytes_max=2**30, age_s_max=0.01)
        read_ns = time.process_time_ns()
        await log.append(records)
        await queue.acknowledge(records[-1].position)
        ended_ns = time.process_time_ns()
        assert len(records) == EVENTS + 1, "one batch"
        return ended_ns - began_ns, ended_ns - read_ns
    finally:
        queue.release()


async def measure(folder: Path) -> dict[str, Any]:
    log = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{folder}/memory.db"), create=True)
    digests = log.digests
    took_ns: dict[bool, list[tuple[int, int]]] = {True: [], False: []}
    for turn in range(2 * TURNS):
        kept = turn % 2 == 0
        log.digests = digests if kept else None
        took_ns[kept].append(await drain(log, folder / "spool"))
    await log.close()
    least = {kept: [min(each) / EVENTS / 1e3 for each in zip(*values, strict=True)] for kept, values in took_ns.items()}
    result: dict[str, Any] = {"bench": "digests", "events": EVENTS, "turns": TURNS}
    for place, name in enumerate(("spool_to_log", "append")):
        result[name] = {
            "with_us": round(least[True][place], 2),
            "without_us": round(least[False][place], 2),
            "ratio": round(least[True][place] / least[False][place], 3),
        }
    return result


if __name__ == "__main__":
    collect_seldom()
    with tempfile.TemporaryDirectory(prefix="b") as place:
        print(json.dumps(asyncio.run(measure(Path(place)))))
