"""Tasks that run at once and end together: whatever happens, none of them outlives the one that waits for them.

Not an `asyncio.TaskGroup`, which takes a branch that was cancelled for one that ended well, and cancels its own
caller to wake up; cancellations from outside and from inside are to be told apart here.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

__all__ = ["join_tasks", "raise_errors"]


async def join_tasks(tasks: Sequence[asyncio.Task[Any]]) -> asyncio.CancelledError | None:
    """All have ended; as soon as one was cancelled or raised, the others are cancelled.

    They are cancelled as often as this is, and at least once if one broke: a branch that cleans up is left alone.

    Returns:
        The cancellation that came from outside meanwhile and was passed on to them, if one did. Raise it again.
    """
    outside: asyncio.CancelledError | None = None
    asked = told = 0
    pending = set(tasks)
    while pending:
        try:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError as cancelled:
            outside = cancelled
            asked += 1
        except BaseException:  # a dropped plan is closed: nothing can be awaited any more
            _cancel(pending)
            raise
        else:
            if any(each.cancelled() or each.exception() is not None for each in done):
                asked = max(asked, 1)
        if asked > told:
            told = asked
            _cancel(pending)
    try:
        return outside
    finally:
        del outside


def raise_errors(tasks: Sequence[asyncio.Task[Any]], outside: asyncio.CancelledError | None) -> None:
    """Raise what a task raised, all of it if there were several; else the cancellation, if there was one.

    An exception goes before a cancellation, as one that is raised while a plan is cleaned up does.
    """
    raised = [each.exception() for each in tasks if not each.cancelled()]
    errors = [each for each in raised if each is not None]
    cancelled = outside or (asyncio.CancelledError() if any(each.cancelled() for each in tasks) else None)
    error = BaseExceptionGroup("several branches raised", errors) if len(errors) > 1 else next(iter(errors), cancelled)
    try:
        if error is not None:
            raise error
    finally:
        # The traceback of an exception holds this frame: no cycle for the collector.
        del error, errors, raised, cancelled, outside, tasks


def _cancel(tasks: set[asyncio.Task[Any]]) -> None:
    for task in tasks:
        task.cancel()
