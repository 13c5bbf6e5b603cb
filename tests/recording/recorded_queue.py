"""A recording into a queue in files that nothing drains, without a database."""

from __future__ import annotations

import asyncio
import os
import threading
from collections import defaultdict
from pathlib import Path

from pycrorm_async import Settings
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import decode
from pycrorm_async.events.ids import episode_id
from pycrorm_async.events.types import Happening
from pycrorm_async.queue.recorder_queue import RecorderQueue
from pycrorm_async.record.declarations import KnownTypes
from pycrorm_async.record.episode_writer import Emitter, OpenEpisodes
from pycrorm_async.record.recording import Recording


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
