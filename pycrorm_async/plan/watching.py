"""When a monitor interrupts: its condition is asked every so often, and before every node that starts inside.

The second is for plans that never suspend, which no other task could interrupt. A watch fires once: what is
performed while the interrupted plan cleans up is left alone.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias

from pycrorm_async.plan.surroundings import Surroundings, surroundings
from pycrorm_async.plan.task_tree import current_node

__all__ = ["Condition", "Watch"]

Condition: TypeAlias = Callable[[], bool | Awaitable[bool]] | asyncio.Event


class Watch:
    """One monitor at work, from now on; made where the monitor's own node is current.

    Attributes:
        fired: whether it has interrupted the task that performs the monitor's operand.
        error: what the condition raised, if that is why.
    """

    def __init__(self, condition: Condition) -> None:
        self.fired = False
        self.error: BaseException | None = None
        self._condition = condition
        self._outside = surroundings.get()
        self._node = current_node.get()
        self._task: asyncio.Task[Any] | None = None

    def of(self, task: asyncio.Task[Any]) -> None:
        """This task is to be interrupted."""
        self._task = task

    def inside(self) -> Surroundings:
        """The surroundings of what it watches."""
        outside = self._outside or Surroundings()
        return Surroundings((*outside.watches, self), outside.arbiter, outside.claim)

    async def check(self) -> None:
        """Raise `CancelledError` if the condition holds, and interrupt the task that is watched."""
        error = None
        try:
            holds = await self._holds()
        except Exception as raised:  # noqa: BLE001  the monitor raises it
            holds, error = True, raised
        if holds and self._fire(error):
            raise asyncio.CancelledError("interrupted by a monitor")

    async def keep_asking(self, interval_s: float) -> None:
        """Interrupt the task as soon as the condition holds. Ends then, or when it is cancelled."""
        try:
            if isinstance(self._condition, asyncio.Event):
                await self._condition.wait()
            else:
                while not (self.fired or await self._holds()):  # noqa: ASYNC110  a callable tells nobody
                    await asyncio.sleep(interval_s)
        except Exception as error:  # noqa: BLE001  the monitor raises it
            self._fire(error)
        else:
            self._fire(None)

    async def _holds(self) -> bool:
        """Ask the condition. What it performs belongs to the monitor, and is not watched by it."""
        if isinstance(self._condition, asyncio.Event):
            return self._condition.is_set()
        around, node = surroundings.set(self._outside), current_node.set(self._node)
        try:
            answer = self._condition()
            return bool(await answer if inspect.isawaitable(answer) else answer)
        finally:
            current_node.reset(node)
            surroundings.reset(around)

    def _fire(self, error: BaseException | None) -> bool:
        """Whether it interrupts: only once, and not what is over already."""
        task = self._task
        if self.fired or task is None or task.done():
            return False
        self.fired, self.error = True, error
        if asyncio.get_running_loop() is not task.get_loop():  # a thread with a loop of its own, in this context
            task.get_loop().call_soon_threadsafe(task.cancel)
        elif asyncio.current_task() is not task:
            task.cancel()
        return True
