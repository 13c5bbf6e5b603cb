"""Open a new log in several processes at once."""

from __future__ import annotations

import asyncio
import os

from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.crash.forked_processes import ForkedProcess

__all__ = ["open_at_once"]


def open_at_once(url: str, processes: int, *, tables: bool) -> list[str]:
    """Return the id of the log that each process opened, with its tables or without."""
    openers = [ForkedProcess(_open, url, tables) for _ in range(processes)]
    for each in openers:
        each.send_byte()
    assert [each.wait() for each in openers] == [0] * processes
    return [line for each in openers for line in each.lines]


def _open(url: str, tables: bool) -> None:
    os.dup2(1, 2)  # a message would be a line among the ids
    os.read(0, 1)
    asyncio.run(_open_log(url, tables))


async def _open_log(url: str, tables: bool) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    if tables:
        await Projector(log).open()
    print(log.log_id)
    await log.close()
