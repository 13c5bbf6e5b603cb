"""When a monitor interrupts: its condition is asked every so often, and before every node that starts inside.

The second is for plans that never suspend, which no other task could interrupt. A watch fires once: what is
performed while the interrupted plan cleans up is left alone.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import Awaitable, Callable, Generator
from contextvars import Context, copy_context
from typing import Any, TypeAlias

from pycrorm_async.plan.execution.execution_context import ExecutionContext, execution_context

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
        self._context = copy_context()
        self._task: asyncio.Task[Any] | None = None

    def of(self, task: asyncio.Task[Any]) -> None:
        """This task is to be interrupted."""
        self._task = task

    def inside(self) -> ExecutionContext:
        """The surroundings of what it watches."""
        outside = self._context.get(execution_context) or ExecutionContext()
        return ExecutionContext((*outside.watches, self), outside.arbiter, outside.claim)

    async def check(self) -> None:
        """Raise `CancelledError` if the condition holds, and interrupt the task that is watched."""
        holds, error = await self._evaluate()
        if holds and self._fire(error):
            raise asyncio.CancelledError("interrupted by a monitor")

    async def poll(self, interval_s: float) -> None:
        """Interrupt the task as soon as the condition holds. Ends then, or when it is cancelled or the task is over."""
        assert self._task is not None
        if isinstance(self._condition, asyncio.Event):
            await self._condition.wait()
        # A condition may swallow the cancellation with which the monitor ends the asking.
        while not (self.fired or self._task.done()):
            holds, error = await self._evaluate()
            if holds:
                self._fire(error)
            else:
                await asyncio.sleep(interval_s)

    async def _evaluate(self) -> tuple[bool, BaseException | None]:
        """Whether to interrupt, and what the condition raised, if that is why: the monitor raises it."""
        try:
            return await self._holds(), None
        except asyncio.CancelledError as raised:
            asking = asyncio.current_task()
            if asking is None or asking.cancelling():
                raise
            return True, raised
        except Exception as raised:  # noqa: BLE001  the monitor raises it
            return True, raised

    async def _holds(self) -> bool:
        """Ask the condition, where the monitor is: what it performs belongs to that, and is not watched by it.

        What is asked while the plan only thinks is asked about what really happens.
        """
        if isinstance(self._condition, asyncio.Event):
            return self._condition.is_set()
        context = self._context.copy()
        answer = context.run(self._condition)
        if not inspect.isawaitable(answer):
            return bool(answer)
        return bool(await _InContext(context, answer))

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


class _InContext:
    """Awaits in the same task, but in another context."""

    def __init__(self, context: Context, awaitable: Awaitable[Any]) -> None:
        self._context = context
        self._awaitable = awaitable

    def __await__(self) -> Generator[Any, Any, Any]:
        steps = self._context.run(self._awaitable.__await__)
        step: Callable[[], Any] = functools.partial(next, steps)
        try:
            while True:
                wanted = self._context.run(step)
                try:
                    yield wanted
                    step = functools.partial(next, steps)
                except BaseException as raised:  # noqa: BLE001  a cancellation, say, is for the one that is awaited
                    step = functools.partial(_throw, steps, raised)
        except StopIteration as done:
            return done.value
        finally:
            # The traceback of what was thrown holds this frame: no cycle for the collector.
            del step


def _throw(steps: Generator[Any, Any, Any], raised: BaseException) -> Any:
    return steps.throw(raised)
