"""Run a writer in a thread, and wait for its effects."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.writer.drain import Source
from pycrorm_async.writer.plan_writer import WriterThread
from tests.databases import ask
from tests.writer.fakes import opener

QUICK = Settings(batch_events_max=1000, idle_ms=1)
NEVER_IDLE = Settings(batch_events_max=1000, idle_ms=10**9)


def writers_alive() -> list[str]:
    return [each.name for each in threading.enumerate() if each.name.startswith("pycrorm writer")]


def no_writer_alive() -> Iterable[Source]:
    return ()


def writer_for(
    source: Source,
    address: DatabaseAddress,
    *,
    settings: Settings = NEVER_IDLE,
    adopt: Iterable[Source] = (),
    busy_timeout_s: float = 5.0,
) -> WriterThread:
    return WriterThread(
        source=source,
        open_destination=opener(address, busy_timeout_s=busy_timeout_s),
        adopt=lambda: adopt,
        settings=settings,
    )


async def until(holds: Callable[[], bool]) -> None:
    """Return when the condition holds; raise after a minute."""
    async with asyncio.timeout(60):
        while not holds():  # noqa: ASYNC110 - what is waited for happens in another thread
            await asyncio.sleep(0.005)


async def until_answer(path: Path, statement: str, expected: list[tuple[object, ...]]) -> None:
    """Return when the query returns this answer."""
    await until(lambda: ask(path, statement) == expected)
