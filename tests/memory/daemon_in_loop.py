"""Run a daemon in the test's own loop, and keep its messages."""

import asyncio
import re
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path

from pycrorm_async import Memory, Settings
from pycrorm_async.operations.daemon import serve

QUICK = Settings(sync_interval_ms=5, flush_timeout_s=60)


class Daemon:
    """A daemon in this loop, and the lines that it reported."""

    def __init__(self, url: str, spool: Path, settings: Settings = QUICK) -> None:
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


def memory_at(url: str, spool: Path, settings: Settings = QUICK) -> Memory:
    return Memory.open(url, spool=spool, writer="daemon", settings=settings)
