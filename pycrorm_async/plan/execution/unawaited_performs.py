"""Notices performs that were called and never awaited: `action.perform()` alone makes a coroutine and does nothing.

Theory of operation. A call puts a weak reference to its coroutine into a list that only the frame of that coroutine
holds. A frame that starts empties the list. A coroutine that is closed or cancelled before it starts drops its frame,
and with it the list and the reference, while the coroutine still exists: that await was not forgotten. Only when a
coroutine is collected with its frame untouched does the reference outlive it, and its callback reports the designator.
An episode counts its calls that have not started. Only where some are left at its end are the objects of the process
searched for their coroutines, and those reported that no task holds and is about to run.
"""

from __future__ import annotations

import asyncio
import gc
import inspect
from collections.abc import Callable
from types import CoroutineType
from typing import Any, TypeAlias

from pycrorm_async.connected_var import ConnectedVar

__all__ = ["CalledPerforms", "Unstarted", "called_performs"]

Unstarted: TypeAlias = list[Any]
"""The calls it is counted among and the weak reference, held by the frame of a coroutine that has not started.

Empty once it has started, and once it was reported.
"""


class CalledPerforms:
    """The performs that were called in one context and have not started.

    `plan.performing` counts them, in a few steps of its own, for this is done at every call.

    Attributes:
        waiting: how many have not started; those that were closed before they started are among them.
        callbacks: by the class of a designator, what its coroutine's weak reference calls.
    """

    def __init__(self, on_unawaited: Callable[[type], None]) -> None:
        self.waiting = 0
        self.callbacks = _Callbacks(self._collected)
        self._on_unawaited = on_unawaited

    def close(self) -> None:
        """Report those that exist and that no task runs. What is collected later is still reported."""
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
    """One for each class, made when the first of it is called."""

    def __init__(self, collected: Callable[[type], None]) -> None:
        super().__init__()
        self._collected = collected

    def __missing__(self, designator: type) -> Callable[[object], None]:
        callback = self[designator] = lambda _: self._collected(designator)
        return callback


def _coroutines_of_tasks() -> set[int]:
    try:
        return {id(task.get_coro()) for task in asyncio.all_tasks()}
    except RuntimeError:  # no loop runs here, and none of its tasks
        return set()


called_performs: ConnectedVar[CalledPerforms] = ConnectedVar("called_performs")
"""Those of this context's episode, or of its memory outside any; None without a memory."""
