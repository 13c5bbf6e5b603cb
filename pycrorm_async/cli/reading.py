"""Open a memory for a verb that reads one answer from it, and warn about events that the answer cannot contain yet."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TypeVar

from pycrorm_async.cli.pending_events import note_pending_events
from pycrorm_async.operations.destination import shared_address
from pycrorm_async.query.reading import Reading

T = TypeVar("T")


def read_memory(url: str, spool: Path | None, read: Callable[[Reading], Awaitable[T]]) -> T:
    """Open the memory at the URL, call `read` with it, and return the result; then note pending events.

    Raises `CallerError` for `sqlite://`, as every verb that opens the memory of another process.
    """
    shared_address(url)

    async def run() -> T:
        async with Reading.open(url) as reading:
            return await read(reading)

    answer = asyncio.run(run())
    note_pending_events(url, spool)
    return answer
