"""Wait for parallel tasks, so that none of them outlives its caller.

An `asyncio.TaskGroup` is not suitable: it treats a cancelled branch as one that ended normally, and it cancels its own
caller to wake it up, whereas the plan language must distinguish cancellations from outside and from inside.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any


async def join_tasks(tasks: Sequence[asyncio.Task[Any]]) -> asyncio.CancelledError | None:
    """Wait until all tasks have ended; cancel the others as soon as one was cancelled or raised.

    The tasks are cancelled once for each cancellation of the caller, and at least once if one of them broke. A branch
    is not cancelled again while it cleans up, unless the caller is.

    Returns:
        The last cancellation of the caller, which was passed on to the tasks; the caller must raise it again.
    """
    outside: asyncio.CancelledError | None = None
    cancellations_due = cancellations_sent = 0
    pending = set(tasks)
    while pending:
        try:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError as cancelled:
            outside = cancelled
            cancellations_due += 1
        except BaseException:  # the coroutine of a dropped plan is closed and cannot await any more
            _cancel(pending)
            raise
        else:
            if any(each.cancelled() or each.exception() is not None for each in done):
                cancellations_due = max(cancellations_due, 1)
        if cancellations_due > cancellations_sent:
            cancellations_sent = cancellations_due
            _cancel(pending)
    try:
        return outside
    finally:
        del outside


def raise_errors(tasks: Sequence[asyncio.Task[Any]], outside: asyncio.CancelledError | None) -> None:
    """Raise the exceptions of the tasks, several as a group; without one, raise the cancellation, if there was one.

    An exception takes precedence over a cancellation, like one that is raised while a plan cleans up.
    """
    raised = [each.exception() for each in tasks if not each.cancelled()]
    errors = [each for each in raised if each is not None]
    cancelled = outside or (asyncio.CancelledError() if any(each.cancelled() for each in tasks) else None)
    error = BaseExceptionGroup("several branches raised", errors) if len(errors) > 1 else next(iter(errors), cancelled)
    try:
        if error is not None:
            raise error
    finally:
        # The traceback of a raised exception holds this frame: break the reference cycle.
        del error, errors, raised, cancelled, outside, tasks


def _cancel(tasks: set[asyncio.Task[Any]]) -> None:
    for task in tasks:
        task.cancel()
