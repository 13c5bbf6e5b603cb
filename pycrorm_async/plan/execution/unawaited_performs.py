"""Detect performs that were called and never awaited: `action.perform()` without `await` does nothing.

Theory of operation
-------------------

The actors are the coroutine that a call of `perform` creates, its frame, and a `CalledPerforms` object per episode (or
per memory outside any episode). A coroutine is in one of three states: not started, started, or ended without a start.

A call creates a list and passes it to the coroutine as its argument `unstarted`, so that only the coroutine's frame
holds it. The list contains the `CalledPerforms` and a weak reference to the coroutine, whose callback reports the
designator's class. `CalledPerforms.waiting` counts the calls that have not started.

When the frame starts, it decrements the count and empties the list, which removes the weak reference: its callback
cannot run any more. A coroutine that is closed or cancelled before its start drops its frame while the coroutine itself
still exists; the list and the reference vanish with the frame, and no callback runs. That is correct, because such a
coroutine was awaited or handed to a task. Only a coroutine that is garbage collected without a start has its frame
until the end; then the weak reference outlives the coroutine, and its callback reports the missing `await`. Python 3.12
and 3.13 keep the frame of a coroutine that is closed by `close()` before its start, so there that call is reported too.

At the end of an episode some coroutines may still be referenced and not started. If `waiting` is not 0, `close`
searches the objects of the process for coroutines that have not started and belong to this episode, and reports those
that no task is about to run. It empties their lists, so that their collection does not report them again. Without
such calls the search is skipped. A coroutine is reported by `close` or by its callback and never by both, because
emptying the list removes the reference.
"""

from __future__ import annotations

import asyncio
import gc
import inspect
from collections.abc import Callable
from types import CoroutineType
from typing import Any, TypeAlias

from pycrorm_async.connected_var import ConnectedVar

Unstarted: TypeAlias = list[Any]
"""The `CalledPerforms` and the weak reference, held by the frame of a coroutine that has not started.

Empty after the start, and after `close` has reported the coroutine.
"""


class CalledPerforms:
    """The performs of one context that were called and have not started.

    `node_execution` updates the count itself, because it does so at every call.

    Attributes:
        waiting: number of calls that have not started, including those closed before their start.
        callbacks: the callback of a coroutine's weak reference, by the designator's class.
    """

    def __init__(self, on_unawaited: Callable[[type], None]) -> None:
        self.waiting = 0
        self.callbacks = _Callbacks(self._collected)
        self._on_unawaited = on_unawaited

    def close(self) -> None:
        """Report the coroutines that have not started and belong to no task; later collections still report theirs."""
        if not self.waiting:
            return
        in_tasks = _coroutines_of_tasks()
        for each in gc.get_objects():
            if type(each) is CoroutineType and inspect.getcoroutinestate(each) == inspect.CORO_CREATED:
                variables = inspect.getcoroutinelocals(each)
                unstarted = variables.get("unstarted")
                if unstarted and unstarted[0] is self and id(each) not in in_tasks:
                    unstarted.clear()
                    self._collected(type(variables["self"]))

    def _collected(self, designator: type) -> None:
        self.waiting -= 1
        self._on_unawaited(designator)


class _Callbacks(dict[type, Callable[[object], None]]):
    """One callback per designator class, created at the first call."""

    def __init__(self, collected: Callable[[type], None]) -> None:
        super().__init__()
        self._collected = collected

    def __missing__(self, designator: type) -> Callable[[object], None]:
        callback = self[designator] = lambda _: self._collected(designator)
        return callback


def _coroutines_of_tasks() -> set[int]:
    try:
        return {id(task.get_coro()) for task in asyncio.all_tasks()}
    except RuntimeError:  # no event loop runs in this thread
        return set()


called_performs: ConnectedVar[CalledPerforms] = ConnectedVar("called_performs")
"""The calls of the context's episode, or of its memory outside an episode; None without a memory."""
