"""Take the folder of a live recorder, and read from it as another process does."""

import asyncio
from collections.abc import Callable

from pycrorm_async.queue import LiveSource, RecorderQueue


def take(queue: RecorderQueue) -> LiveSource:
    """Take the folder; again if the recorder deletes stored segments just then."""
    for _ in range(10):
        source = LiveSource.take(queue.folder)
        if source is not None:
            return source
    raise AssertionError("the folder is not offered")


async def next_positions(source: LiveSource, *, events_max: int = 10_000, bytes_max: int = 2**22) -> list[int]:
    """Return the positions of the next batch, which must arrive within a minute."""
    batch = await asyncio.wait_for(
        source.get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=0.05), timeout=60
    )
    return [each.position for each in batch]


async def eventually(condition: Callable[[], bool]) -> None:
    """Wait until the condition holds, for a minute at most."""
    async with asyncio.timeout(60):
        while not condition():  # noqa: ASYNC110 - what another thread or process does sets no event of ours
            await asyncio.sleep(0.005)
