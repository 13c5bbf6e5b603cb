"""Recordings without asyncio: into a memory whose tables are read, and into a queue that nothing drains."""

from __future__ import annotations

import asyncio
import json
import os
import threading
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pycrorm_async import Memory, Settings
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import decode
from pycrorm_async.events.ids import episode_id
from pycrorm_async.events.types import Happening
from pycrorm_async.memory import SyncMemory
from pycrorm_async.projections.verify import verify
from pycrorm_async.queue.recorder_queue import RecorderQueue
from pycrorm_async.record.declarations import KnownTypes
from pycrorm_async.record.episode_writer import Emitter, OpenEpisodes
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.world.pose import Pose
from tests.databases import ask, put_memory

# === recorded memory ==========================================================================================
#
# A memory of an executive without asyncio, and what its tables and log hold afterwards.

HERE = Pose([1, 2, 3])
AT_END = Settings(fold="at_end")


def url_of(folder: Path) -> str:
    """Return the URL of the memory in this folder. The first call makes it."""
    return put_memory(folder / "memory.db")


def nodes(folder: Path) -> list[tuple[Any, ...]]:
    """Return (dtype, dtype of the parent, status, failure message) of each node but the roots, in order."""
    return [
        tuple(row)
        for row in ask(
            folder / "memory.db",
            "SELECT node.dtype, parent.dtype, node.status, node.failure_message FROM task_tree_node AS node"
            " JOIN task_tree_node AS parent ON parent.id = node.parent_id ORDER BY node.id",
        )
    ]


def events(folder: Path, kind: str) -> list[dict[str, Any]]:
    """Return the payloads of the events of one type, in order."""
    rows = ask(folder / "memory.db", f"SELECT payload FROM event WHERE type = '{kind}' ORDER BY episode, sequence")
    return [json.loads(payload) for (payload,) in rows]


def problems(url: str) -> list[str]:
    """Return what `verify` finds in a memory."""

    async def found() -> list[str]:
        log = await EventLog.open(DatabaseAddress.parse(url), create=False)
        try:
            result = await verify(log)
            return [str(each) for each in (*result.damages, *result.differences, *result.stopped)]
        finally:
            await log.close()

    return asyncio.run(found())


def assert_verified(folder: Path) -> None:
    assert problems(url_of(folder)) == []


def record(folder: Path, write: Callable[[Recording, RecordedEpisode], None], settings: Settings = AT_END) -> Any:
    """Let `write` record one episode; check that nothing was parked, and return the status of the memory."""
    with Memory.sync(url_of(folder), settings=settings) as memory:
        with memory.recording.episode(description="d") as episode:
            write(memory.recording, episode)
        memory.flush()
        status = memory.status
    assert_verified(folder)
    return status


def opened(folder: Path, settings: Settings = AT_END) -> SyncMemory:
    return Memory.sync(url_of(folder), settings=settings)


def faults_of(folder: Path, write: Callable[[Recording, RecordedEpisode], None]) -> tuple[int, str | None]:
    """Return how many faults were counted while `write` ran in an episode, and the last one."""
    with opened(folder) as memory:
        with memory.recording.episode(description="d") as episode:
            write(memory.recording, episode)
        return memory.status.faults


# === recorded queue ===========================================================================================
#
# A recording into a queue in files that nothing drains, without a database.


class Recorded:
    """A recording without a database, and what is in its queue."""

    def __init__(self, folder: Path, settings: Settings) -> None:
        name = episode_id(SYSTEM_CLOCK.wall_ns(), os.urandom(10))
        self.queue = RecorderQueue.create(folder, settings=settings, clock=SYSTEM_CLOCK, recorder=name)
        self.emitter = Emitter(self.queue, settings)
        self.episodes = OpenEpisodes(self.emitter, SYSTEM_CLOCK)
        self.hangs = False
        self.recording = Recording(self.emitter, self.episodes, KnownTypes(lambda _dtype: None), (), software="test")

    def close(self) -> None:
        self.queue.release()

    def end_open_episodes(self) -> None:
        """End the episodes as closing a memory does, in another thread, which a lock that was left taken stops."""

        def end() -> None:
            for each in self.episodes.all:
                self.episodes.close(each, asyncio.CancelledError("the memory was closed"))

        if self.episodes.all:
            thread = threading.Thread(target=end, daemon=True)
            thread.start()
            thread.join()

    def logs(self) -> list[list[tuple[int, Happening]]]:
        """Return the events of each episode, with their sequences."""
        events: defaultdict[bytes, list[tuple[int, Happening]]] = defaultdict(list)

        async def read() -> None:
            await self.queue.synced_to()
            left = self.queue.written
            while left:
                batch = await self.queue.get_batch(events_max=10_000, bytes_max=2**26, age_s_max=0)
                left -= len(batch)
                for each in batch:
                    if each.episode is not None:
                        events[each.episode].append((each.sequence, decode(each.type, each.payload)))

        asyncio.run(read())
        return list(events.values())
