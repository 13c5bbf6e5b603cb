"""Inject faults into an append."""

from __future__ import annotations

import asyncio
from typing import Any

__all__ = ["cancel_at_await"]


async def cancel_at_await(task: asyncio.Task[Any], count: int) -> None:
    """Cancel the task at its await number `count`, or when it has ended, and wait for its end."""
    awaited: list[object] = []
    while len(awaited) < count and not task.done():
        waiter = getattr(task, "_fut_waiter", None)
        if waiter is not None and waiter not in awaited[-1:]:
            awaited.append(waiter)
        await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait([task])
