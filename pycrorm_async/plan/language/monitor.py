"""Monitors interrupt a plan as soon as a condition holds: `plan >> Monitor(condition)`.

>>> outcome = await (NavigateAction([place]) + look >> Monitor(milk_is_visible)).perform()
>>> outcome.interrupted
True
"""

from __future__ import annotations

import asyncio
import copy
import math
from dataclasses import dataclass
from numbers import Real
from typing import Any

from pycrorm_async.plan.execution.execution_context import execution_context
from pycrorm_async.plan.failures import NotALanguageExpression
from pycrorm_async.plan.language.expressions import Expression, name_of, perform_operand
from pycrorm_async.plan.language.monitor_watch import Condition, Watch
from pycrorm_async.plan.language.operators import Composable
from pycrorm_async.plan.language.outcome import Outcome
from pycrorm_async.plan.language.task_branches import join_tasks, raise_errors
from pycrorm_async.plan.task_tree import current_node
from pycrorm_async.task_status import TaskStatus


@dataclass(init=False, repr=False, eq=False)
class Monitor(Expression):
    """Performs its operand until that ends, or interrupts it as soon as the condition holds.

    Interrupted nodes and the monitor's own node end with the status INTERRUPTED. An interruption is not a failure: the
    plan continues after the monitor. The operand's `finally` blocks run.

    Args:
        condition: evaluated in the plan's event loop, so it must be quick; an async one is awaited before each node, so
            it must be quick too. An exception of the condition interrupts the operand, and the monitor raises it. An
            `asyncio.Event` interrupts when it is set.
        interval_s: time between evaluations, s; the condition is also evaluated before each node inside starts.

    Attributes:
        condition: the condition's name.

    Raises:
        NotALanguageExpression: the condition is neither callable nor an Event, or the interval is not finite and > 0.
    """

    condition: str
    interval_s: float

    def __init__(self, condition: Condition, interval_s: float = 0.1) -> None:
        checked: object = condition
        if not (callable(checked) or isinstance(checked, asyncio.Event)):
            raise NotALanguageExpression(
                f"Monitor needs a callable or an asyncio.Event, got {type(checked).__name__}: write a function that"
                " returns whether to interrupt",
                repr(checked),
            )
        if isinstance(getattr(checked, "__self__", None), asyncio.Event) and name_of(checked).endswith("Event.wait"):
            raise NotALanguageExpression(
                "Monitor evaluates its condition before each node, so one that waits keeps the plan from starting: pass"
                " the Event itself, not its wait",
                repr(checked),
            )
        if isinstance(interval_s, bool) or not isinstance(interval_s, Real) or not 0 < interval_s < math.inf:
            raise NotALanguageExpression(f"Monitor needs a finite interval_s > 0, got {interval_s!r}", interval_s)
        self.condition = name_of(condition)
        self.interval_s = float(interval_s)
        self._condition: Condition = condition

    @property
    def is_complete(self) -> bool:
        return bool(self.operands)

    async def perform(self) -> Outcome:
        """Return an `Outcome` with one result, or one with `interrupted` set. Raises the operand's exceptions."""
        if not self.operands:
            raise NotALanguageExpression("this Monitor has no operand: write plan >> Monitor(condition)")
        watch = Watch(self._condition)
        task = asyncio.create_task(self._perform_watched(watch), name=f"watched by {self.condition}")
        watch.set_task(task)
        polling = asyncio.create_task(watch.poll(self.interval_s), name=f"asks {self.condition}")
        try:
            outside = await join_tasks([task])
        finally:
            polling.cancel()
        outside = await join_tasks([polling]) or outside
        try:
            if outside is None and watch.error is not None:
                raise watch.error
            if outside is not None or not watch.fired or not (task.cancelled() or task.exception() is None):
                raise_errors([task], outside)
            if not watch.fired:
                return Outcome(results=(task.result(),), succeeded=(0,), interrupted=False)
            node = current_node.get()
            assert node is not None
            node.status = TaskStatus.INTERRUPTED
            return Outcome(results=(None,), interrupted=True)
        finally:
            # The traceback of a raised exception holds this frame: break the reference cycle.
            del outside, task, watch, polling

    async def _perform_watched(self, watch: Watch) -> Any:
        execution_context.set(watch.inner_context())
        return await perform_operand(self.operands[0])


def watch_operand(operand: Composable, monitor: Composable) -> Monitor:
    """Implement `operand >> monitor`: copy the monitor and give it this operand. Raises `NotALanguageExpression`."""
    if not isinstance(monitor, Monitor):
        raise NotALanguageExpression(
            f"the right operand of >> must be a Monitor, got {name_of(monitor)}", name_of(monitor)
        )
    if monitor.operands:
        raise NotALanguageExpression("this Monitor has an operand already: create another Monitor for this plan")
    monitor_copy = copy.copy(monitor)
    monitor_copy.hold([operand])
    return monitor_copy
