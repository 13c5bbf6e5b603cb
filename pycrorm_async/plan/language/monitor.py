"""A plan that is interrupted when something happens: `plan >> Monitor(condition)`.

>>> outcome = await (NavigateAction([there]) + look >> Monitor(milk_is_seen)).perform()
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
from pycrorm_async.plan.task_tree import TaskStatus, current_node

__all__ = ["Monitor", "watch_operand"]


@dataclass(init=False, repr=False, eq=False)
class Monitor(Expression):
    """Performs what it watches until that is done, or until its condition holds: then it is interrupted, all of it.

    Nodes that are interrupted have the status INTERRUPTED, so has the monitor's own. An interruption that was
    asked for is no failure: what comes after the monitor goes on. What a plan does in `finally` is performed.

    Args:
        condition: asked in the plan's own loop, so it must be quick; an async one is awaited before each node, so it
            must be quick too. What it raises interrupts, and is raised. An `asyncio.Event` interrupts when it is set.
        interval_s: how often it is asked; it is asked before each node that starts inside besides.

    Attributes:
        condition: its name.

    Raises:
        NotALanguageExpression: the condition cannot be asked, or the interval is no time.
    """

    condition: str
    interval_s: float

    def __init__(self, condition: Condition, interval_s: float = 0.1) -> None:
        given: object = condition
        if not (callable(given) or isinstance(given, asyncio.Event)):
            raise NotALanguageExpression(
                f"Monitor asks a callable or an asyncio.Event, not {type(given).__name__}: write a function that"
                " tells whether to interrupt",
                repr(given),
            )
        if isinstance(getattr(given, "__self__", None), asyncio.Event) and name_of(given).endswith("Event.wait"):
            raise NotALanguageExpression(
                "Monitor asks its condition before each node, so one that waits keeps the plan from starting: give it"
                " the Event itself, not its wait",
                repr(given),
            )
        if isinstance(interval_s, bool) or not isinstance(interval_s, Real) or not 0 < interval_s < math.inf:
            raise NotALanguageExpression(f"Monitor asks every so many seconds, not every {interval_s!r}", interval_s)
        self.condition = name_of(condition)
        self.interval_s = float(interval_s)
        self._condition: Condition = condition

    @property
    def is_complete(self) -> bool:
        return bool(self.operands)

    async def perform(self) -> Outcome:
        """Returns an `Outcome` with one result, or one that says `interrupted`. Raises what the operand raises."""
        if not self.operands:
            raise NotALanguageExpression("this Monitor watches nothing: write plan >> Monitor(condition)")
        watch = Watch(self._condition)
        task = asyncio.create_task(self._perform_watched(watch), name=f"watched by {self.condition}")
        watch.of(task)
        asking = asyncio.create_task(watch.poll(self.interval_s), name=f"asks {self.condition}")
        try:
            outside = await join_tasks([task])
        finally:
            asking.cancel()
        outside = await join_tasks([asking]) or outside
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
            # The traceback of an exception holds this frame: no cycle for the collector.
            del outside, task, watch, asking

    async def _perform_watched(self, watch: Watch) -> Any:
        execution_context.set(watch.inside())
        return await perform_operand(self.operands[0])


def watch_operand(operand: Composable, monitor: Composable) -> Monitor:
    """`operand >> monitor`: a monitor like this one, which watches the operand. Raises `NotALanguageExpression`."""
    if not isinstance(monitor, Monitor):
        raise NotALanguageExpression(
            f"only a Monitor can stand on the right of >>, not {name_of(monitor)}", name_of(monitor)
        )
    if monitor.operands:
        raise NotALanguageExpression("this Monitor watches something already: make one of its own for this plan")
    made = copy.copy(monitor)
    made.hold([operand])
    return made
