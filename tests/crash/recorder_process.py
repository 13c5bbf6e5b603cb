"""Record in a process that the tests kill, and report on the output each call that has returned.

Every line is written at once, so that the pipe keeps it when the process dies: `put EPISODE SEQUENCE` when `put_nowait`
has returned, and `stored POSITION EPISODE SEQUENCE PAYLOAD` for each record of a batch before the batch is
acknowledged.
"""

from __future__ import annotations

import asyncio
import os
import random
import sys
import threading
import time
from pathlib import Path

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import Heading
from pycrorm_async.events.ids import episode_id, episode_text
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.settings import Settings

SETTINGS = Settings(
    sync_interval_ms=2, segment_bytes=2**14, spool_bytes_max=2**26, spool_reserve_bytes=1, record_bytes_max=2**12
)


def report(*words: object) -> None:
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def record_without_end(queue: RecorderQueue, rng: random.Random, events_max: int) -> None:
    put = 0
    while put < events_max:
        episode = episode_id(time.time_ns(), rng.randbytes(10))
        name = episode_text(episode)
        kinds = ["EpisodeStarted", *["NodeStarted"] * rng.randrange(1, 40), "EpisodeEnded"]
        for index, kind in enumerate(kinds, start=1):
            payload = f"{name}/{index}/".encode() + b"x" * rng.randrange(0, 1200)
            sequence = queue.put_nowait(Heading(episode, kind, 1), payload)
            report("put", name, sequence)
        put += len(kinds)


async def store_without_end(queue: RecorderQueue, rng: random.Random) -> None:
    while batch := await queue.get_batch(events_max=rng.randrange(1, 50), bytes_max=2**16, age_s_max=0.001):
        for each in batch:
            assert each.episode is not None
            lines = each.payload.rstrip(b"x").decode()
            report("stored", each.position, episode_text(each.episode), each.sequence, lines)
        await queue.acknowledge(batch[-1].position)


def record(spool: str, seed: int, threads: int, doing: str, events_max: int = sys.maxsize) -> None:
    """Record until the process is killed; `doing` is "recording" or "storing". Each thread puts a number of events and
    waits.
    """
    rng = random.Random(seed)
    queue = RecorderQueue.create(
        Path(spool),
        settings=SETTINGS,
        clock=SYSTEM_CLOCK,
        recorder=episode_id(time.time_ns(), rng.randbytes(10)),
    )
    for number in range(threads):
        own = random.Random(seed * 100 + number)
        threading.Thread(target=record_without_end, args=(queue, own, events_max), daemon=True).start()
    if doing == "storing":
        asyncio.run(store_without_end(queue, rng))
    threading.Event().wait()


def main() -> None:
    record(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])


if __name__ == "__main__":
    main()
