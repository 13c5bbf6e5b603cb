"""Run a writer in a thread or a daemon in the test's own loop, and wait for their effects."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any, Literal

from pycrorm_async import Memory
from pycrorm_async.operations.daemon import serve
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.writer.drain import Source
from pycrorm_async.writer.plan_writer import WriterThread
from tests.databases import ask
from tests.writer.fakes import KeptSource, opener

# === writer threads ===========================================================================================
#
# Run a writer in a thread, and wait for its effects.

QUICK = Settings(batch_events_max=1000, idle_ms=1)
NEVER_IDLE = Settings(batch_events_max=1000, idle_ms=10**9)


def writers_alive() -> list[str]:
    return [each.name for each in threading.enumerate() if each.name.startswith("pycrorm writer")]


def writer_for(
    source: Source,
    address: DatabaseAddress,
    *,
    settings: Settings = NEVER_IDLE,
    adopt: Iterable[Source] = (),
    **opening: Any,
) -> WriterThread:
    """Return a writer of this source; `opening` are further arguments of `opener`."""
    return WriterThread(
        source=source, open_destination=opener(address, **opening), adopt=lambda: adopt, settings=settings
    )


@asynccontextmanager
async def writing(source: KeptSource, address: DatabaseAddress, **options: Any) -> AsyncIterator[WriterThread]:
    """Start a writer, and close it with its source at the end; the options are those of `writer_for`."""
    writer = writer_for(source, address, **options)
    await writer.start()
    yield writer
    source.close()
    await writer.close()


async def until(holds: Callable[[], bool]) -> None:
    """Return when the condition holds; raise after a minute."""
    async with asyncio.timeout(60):
        while not holds():  # noqa: ASYNC110 - what is waited for happens in another thread
            await asyncio.sleep(0.005)


async def until_answer(path: Path, statement: str, expected: list[tuple[object, ...]]) -> None:
    """Return when the query returns this answer."""
    await until(lambda: ask(path, statement) == expected)


# === daemon in loop ===========================================================================================
#
# Run a daemon in the test's own loop, and keep its messages.

QUICKLY_SYNCED = Settings(sync_interval_ms=5, flush_timeout_s=60)


class Daemon:
    """A daemon in this loop, and the lines that it reported."""

    def __init__(self, url: str, spool: Path, settings: Settings = QUICKLY_SYNCED) -> None:
        self.lines: list[str] = []
        self.leave = asyncio.Event()
        serving = serve(url, spool=spool, stop=self.leave, report=self.lines.append, settings=settings)
        self.task = asyncio.create_task(serving)

    async def wait_for_line(self, pattern: str) -> None:
        async with asyncio.timeout(60):
            while not any(re.search(pattern, line) for line in self.lines):  # noqa: ASYNC110
                await asyncio.sleep(0.01)

    async def stop(self) -> None:
        self.leave.set()
        await self.task


Start = Callable[..., AbstractAsyncContextManager[Daemon]]


def memory_at(
    url: str, spool: Path, settings: Settings = QUICKLY_SYNCED, *, writer: Literal["daemon", "process"] = "daemon"
) -> Memory:
    return Memory.open(url, spool=spool, writer=writer, settings=settings)
