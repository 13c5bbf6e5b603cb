"""Write a file in a thread, to the end of the call also when the task is cancelled."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

_T = TypeVar("_T")


async def in_thread(work: Callable[..., _T], *arguments: object) -> _T:
    """Call it in a thread and return its value.

    A cancelled task gets its `CancelledError` when the call has returned: a writer that was closed, or a file that was
    deleted, while a thread still wrote to it would crash the process, or leave a file.
    """
    thread = asyncio.ensure_future(asyncio.to_thread(work, *arguments))
    try:
        return await asyncio.shield(thread)
    except asyncio.CancelledError:
        while not thread.done():
            with suppress(asyncio.CancelledError):
                await asyncio.wait([thread])
        thread.exception()  # which otherwise would be logged as never read
        raise
