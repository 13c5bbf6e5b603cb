"""Wrap every `perform` of a designator class, so that each call creates a node and notifies the observer.

Theory of operation
-------------------

`wrap_perform` replaces `perform` when the class is defined. A call creates a coroutine; a node exists only while that
coroutine runs. Its steps have a fixed order:

1. yield to the event loop if the last yield was more than `YIELD_INTERVAL_NS` ago;
2. enter the execution context: check the monitors, wait for parts of the robot;
3. await the observer's admission, if it asks for one (the spool is full);
4. notify the observer of the start, and make the node current;
5. run `perform` and set result, status, failure and end;
6. make the parent current again and notify the same observer of the end;
7. release the claim on parts of the robot.

The steps 1 to 3 may suspend, fail or be cancelled; the node does not exist yet, and only the claim has to be released.
If `node_started` raises, `perform` does not run and no end is reported. After `node_started` has returned, `node_ended`
is called exactly once, also on cancellation, and always on the observer that got the start, even if another one is
current by then.

Concurrent plans cannot disturb each other: the current node, the execution context and the time of the last yield are
context variables, which every asyncio task copies when it is created. A suspended plan that is dropped is closed in
another context; `_restore_parent` then leaves that context's current node alone.

A call of `super().perform()` on the same designator belongs to the node of the outer call. It is recognised by two
facts: the current node's designator is this very object, and its class performs another function than this one.

This code runs for every node of every plan and costs a few µs, so it is one function; calls would cost more than most
of its steps.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import sys
from collections.abc import Callable, Coroutine
from contextvars import ContextVar, Token
from typing import Any
from weakref import ref

from pycrorm_async.clock import monotonic_ns
from pycrorm_async.plan.exceptions import is_plan_failure
from pycrorm_async.plan.execution.execution_context import ExecutionContext, execution_context
from pycrorm_async.plan.execution.observer import recorder
from pycrorm_async.plan.execution.unawaited_performs import Unstarted, called_performs
from pycrorm_async.plan.protocols import Performable
from pycrorm_async.plan.task_tree import TaskTreeNode, collecting, current_node
from pycrorm_async.task_status import TaskStatus

YIELD_INTERVAL_NS = 20_000_000
"""Longest time a plan runs without yielding to the event loop, 20 ms. A plan that never suspends would otherwise block
Ctrl-C and cancellation; a shorter interval would slow down kinematic plans."""

_last_yield_ns: ContextVar[int] = ContextVar("_last_yield_ns", default=0)
_MARK = "__makes_node__"
_RUNNING, _SUCCEEDED = TaskStatus.RUNNING, TaskStatus.SUCCEEDED  # an attribute lookup on the enum costs more


def is_wrapped(perform: Any) -> bool:
    """Return whether this `perform` is wrapped already."""
    return hasattr(perform, _MARK)


def wrap_perform(perform: Callable[[Any], Coroutine[Any, Any, Any]]) -> Callable[[Any], Coroutine[Any, Any, Any]]:
    """Wrap `perform` so that each call creates a node, except a `super().perform()` inside another call."""
    run = _with_node(perform)

    @functools.wraps(perform)
    def performed(self: Performable) -> Coroutine[Any, Any, Any]:
        calls = called_performs.get()
        if calls is None:
            return run(self, None)
        unstarted: Unstarted = [calls, None]
        coroutine = run(self, unstarted)
        unstarted[1] = ref(coroutine, calls.callbacks[type(self)])
        calls.waiting += 1
        return coroutine

    _mark_coroutine_function(performed)
    setattr(performed, _MARK, True)
    return performed


def _mark_coroutine_function(function: Any) -> None:
    """Make `inspect.iscoroutinefunction` true for a function that returns a coroutine."""
    if sys.version_info >= (3, 12):
        inspect.markcoroutinefunction(function)
    else:
        function.__code__ = function.__code__.replace(co_flags=function.__code__.co_flags | inspect.CO_COROUTINE)


def _with_node(  # noqa: C901  one function, because a call costs more than most of these steps
    perform: Callable[[Any], Coroutine[Any, Any, Any]],
) -> Callable[[Any, Unstarted | None], Coroutine[Any, Any, Any]]:
    """Return `perform` with the steps of a node around it."""

    @functools.wraps(perform)
    async def run(self: Performable, unstarted: Unstarted | None) -> Any:
        if unstarted:
            unstarted[0].waiting -= 1
            unstarted.clear()
        parent = current_node.get()
        if parent is not None and parent.designator is self and _is_overridden(self, perform):
            return await perform(self)
        now_ns = monotonic_ns()
        if now_ns - _last_yield_ns.get() > YIELD_INTERVAL_NS:
            now_ns = await _yield_to_loop()
        around, claim = execution_context.get(), None
        if around is not None:
            claim = await around.enter(self)
            now_ns = monotonic_ns()
        try:
            observer = recorder.get()
            if observer is not None and (admission := observer.admit()) is not None:
                await admission
                now_ns = monotonic_ns()

            node = TaskTreeNode(self, self.kind, parent, now_ns)
            if observer is not None:
                observer.node_started(node)
            for tree in collecting.get():
                tree.add(node)
            token = current_node.set(node)
            try:
                node.result = result = await perform(self)
                if node.status is _RUNNING:  # a monitor sets INTERRUPTED itself
                    node.status = _SUCCEEDED
            except BaseException as error:
                node.status, node.failure = _status(error, around), error
                raise
            finally:
                node.ended_ns = monotonic_ns()
                _restore_parent(token)
                if observer is not None:
                    observer.node_ended(node)
                # The failure's traceback holds this frame and the node holds the failure: break the reference cycle.
                del node, parent, token
        finally:
            if claim is not None:
                claim.release()
        try:
            return result
        finally:
            del result  # from Python 3.12 on a failure in it may hold this frame: break the reference cycle

    return run


def _is_overridden(designator: Performable, perform: Callable[..., Any]) -> bool:
    """Return whether the designator's class has another `perform`, which called this one through `super()`."""
    return getattr(type(designator).perform, "__wrapped__", None) is not perform


async def _yield_to_loop() -> int:
    """Yield to the event loop once and return the monotonic time afterwards, ns."""
    await asyncio.sleep(0)
    now_ns = monotonic_ns()
    _last_yield_ns.set(now_ns)
    return now_ns


def _status(error: BaseException, around: ExecutionContext | None) -> TaskStatus:
    """Return the status of a node that ended with this exception."""
    if isinstance(error, asyncio.CancelledError):
        interrupted = around is not None and around.interrupted
        return TaskStatus.INTERRUPTED if interrupted else TaskStatus.CANCELLED
    if isinstance(error, KeyboardInterrupt):
        return TaskStatus.CANCELLED
    return TaskStatus.FAILED if is_plan_failure(error) else TaskStatus.ERROR


def _restore_parent(token: Token[TaskTreeNode | None]) -> None:
    """Make the parent the current node again."""
    try:
        current_node.reset(token)
    except ValueError:
        # A suspended plan that was dropped is closed in another context, whose current node must not change.
        return
