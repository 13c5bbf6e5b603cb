"""A watch evaluates the condition of a monitor, at intervals and before each node, and interrupts the monitored task.

A plan that never waits lets other tasks run every 20 ms at most, so that polling alone would interrupt it late: the
condition is also evaluated before each node. A watch fires once, so that it does not interrupt the cleanup of the
interrupted plan.
"""

import asyncio
import functools
import inspect
from collections.abc import Awaitable, Callable, Generator
from contextvars import Context, copy_context
from typing import Any, TypeAlias

from pycrorm_async.plan.execution import ExecutionContext, execution_context

Condition: TypeAlias = Callable[[], bool | Awaitable[bool]] | asyncio.Event


class Watch:
    """The watch of one running monitor; create it while the monitor's own node is current.

    Attributes:
        fired: whether it has interrupted the task that performs the monitor's operand.
        error: the exception of the condition, if that caused the interruption.
    """

    def __init__(self, condition: Condition) -> None:
        self.fired = False
        self.error: BaseException | None = None
        self._condition = condition
        self._context = copy_context()
        self._task: asyncio.Task[Any] | None = None

    def set_task(self, task: asyncio.Task[Any]) -> None:
        """Set the task to interrupt."""
        self._task = task

    def inner_context(self) -> ExecutionContext:
        """Return the execution context for the monitor's operand."""
        outside = self._context.get(execution_context) or ExecutionContext()
        return ExecutionContext((*outside.watches, self), outside.arbiter, outside.claim)

    async def check(self) -> None:
        """Interrupt the watched task and raise `CancelledError` if the condition holds or raises.

        Do nothing if the watch has fired or the task has ended.
        """
        holds, error = await self._evaluate()
        if holds and self._fire(error):
            raise asyncio.CancelledError("interrupted by a monitor")

    async def poll(self, interval_s: float) -> None:
        """Interrupt the watched task as soon as the condition holds; end then, or after the end of that task.

        An `Event` is awaited; any other condition is evaluated at intervals.
        """
        assert self._task is not None
        if isinstance(self._condition, asyncio.Event):
            await self._condition.wait()
        # The monitor cancels this polling task at the end, which a condition may swallow: look at the watched task too.
        while not (self.fired or self._task.done()):
            holds, error = await self._evaluate()
            if holds:
                self._fire(error)
            else:
                await asyncio.sleep(interval_s)

    async def _evaluate(self) -> tuple[bool, BaseException | None]:
        """Return whether to interrupt, and the exception that the condition raised, which the monitor raises later."""
        try:
            return await self._holds(), None
        except asyncio.CancelledError as raised:
            task = asyncio.current_task()
            if task is None or task.cancelling():
                raise
            return True, raised
        except Exception as raised:  # noqa: BLE001  the monitor raises it
            return True, raised

    async def _holds(self) -> bool:
        """Evaluate the condition in the monitor's own context.

        Nodes that the condition performs belong to the monitor's node and are not watched by it. If the operand
        contains a simulation, the condition sees the world outside of it, even before a node inside it.
        """
        if isinstance(self._condition, asyncio.Event):
            return self._condition.is_set()
        context = self._context.copy()
        answer = context.run(self._condition)
        if not inspect.isawaitable(answer):
            return bool(answer)
        return bool(await _InContext(context, answer))

    def _fire(self, error: BaseException | None) -> bool:
        """Interrupt the task and return True; return False if the watch has fired or the task has ended."""
        task = self._task
        if self.fired or task is None or task.done():
            return False
        self.fired, self.error = True, error
        if asyncio.get_running_loop() is not task.get_loop():  # called from another thread's loop
            task.get_loop().call_soon_threadsafe(task.cancel)
        elif asyncio.current_task() is not task:
            task.cancel()
        return True


class _InContext:
    """Awaits an awaitable in the same task, but in another context."""

    def __init__(self, context: Context, awaitable: Awaitable[Any]) -> None:
        self._context = context
        self._awaitable = awaitable

    def __await__(self) -> Generator[Any, Any, Any]:
        steps = self._context.run(self._awaitable.__await__)
        step: Callable[[], Any] = functools.partial(next, steps)
        try:
            while True:
                future = self._context.run(step)
                try:
                    yield future
                    step = functools.partial(next, steps)
                except BaseException as raised:  # noqa: BLE001  passed to the awaitable, for example a cancellation
                    step = functools.partial(_throw, steps, raised)
        except StopIteration as done:
            return done.value
        finally:
            # The traceback of a thrown exception holds this frame: break the reference cycle.
            del step


def _throw(steps: Generator[Any, Any, Any], raised: BaseException) -> Any:
    return steps.throw(raised)
