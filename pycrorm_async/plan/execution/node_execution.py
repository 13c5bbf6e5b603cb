"""What happens around a `perform`: a node starts before it, ends after it, and whoever records is told both.

The order is always the same: give the loop a turn if one is due, ask monitors and wait for parts of the robot
(`plan.surroundings`), wait for room if the recorder asks for it, tell it that the node starts (it may refuse;
then nothing has happened), perform, set status, failure, result and end, make the parent current again, tell
the recorder that it met at the start, give free what was claimed. This runs for every node of every plan: it
costs a few µs.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import Callable, Coroutine
from contextvars import ContextVar, Token
from typing import TYPE_CHECKING, Any
from weakref import ref

from pycrorm_async.clock import monotonic_ns
from pycrorm_async.plan.execution.execution_context import ExecutionContext, surroundings
from pycrorm_async.plan.execution.observer import recorder
from pycrorm_async.plan.execution.unawaited_performs import Unstarted, called_performs
from pycrorm_async.plan.failures import is_plan_failure
from pycrorm_async.plan.task_tree import TaskStatus, TaskTreeNode, collecting, current_node

if TYPE_CHECKING:
    from pycrorm_async.plan.designator import Designator

__all__ = ["as_node", "is_node"]

TURN_NS_MAX = 20_000_000
"""A plan that never suspends would hear neither Ctrl-C nor a cancellation: this often it lets the loop turn."""

_last_turn_ns: ContextVar[int] = ContextVar("_last_turn_ns", default=0)
_MARK = "__makes_node__"
_RUNNING, _SUCCEEDED = TaskStatus.RUNNING, TaskStatus.SUCCEEDED  # asking the enum costs more


def is_node(perform: Any) -> bool:
    """Whether this `perform` makes a node already."""
    return hasattr(perform, _MARK)


def as_node(perform: Callable[[Any], Coroutine[Any, Any, Any]]) -> Callable[[Any], Coroutine[Any, Any, Any]]:
    """The same `perform`, each call a node; `super().perform()` inside belongs to the node of the outer call."""
    run = _node_of(perform)

    @functools.wraps(perform)
    def performed(self: Designator) -> Coroutine[Any, Any, Any]:
        calls = called_performs.get()
        if calls is None:
            return run(self, None)
        unstarted: Unstarted = [calls]
        coroutine = run(self, unstarted)
        unstarted.append(ref(coroutine, calls.callbacks[type(self)]))
        calls.waiting += 1
        return coroutine

    # It is still a coroutine function for those who ask `inspect`, before Python 3.12 by this flag alone.
    plain: Any = performed
    plain.__code__ = plain.__code__.replace(co_flags=plain.__code__.co_flags | inspect.CO_COROUTINE)
    setattr(performed, _MARK, True)
    return performed


def _node_of(  # noqa: C901  one function, for a call costs more than most of these steps
    perform: Callable[[Any], Coroutine[Any, Any, Any]],
) -> Callable[[Any, Unstarted | None], Coroutine[Any, Any, Any]]:
    """`perform` with a node around it."""

    @functools.wraps(perform)
    async def run(self: Designator, unstarted: Unstarted | None) -> Any:
        if unstarted:
            unstarted[0].waiting -= 1
            unstarted.clear()
        parent = current_node.get()
        if parent is not None and parent.designator is self and _is_overridden(self, perform):
            return await perform(self)
        now_ns = monotonic_ns()
        if now_ns - _last_turn_ns.get() > TURN_NS_MAX:
            now_ns = await _turn()
        around, claim = surroundings.get(), None
        if around is not None:
            claim = await around.entered(self)
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
                if node.status is _RUNNING:  # a monitor may say otherwise
                    node.status = _SUCCEEDED
            except BaseException as error:
                node.status, node.failure = _status(error, around), error
                raise
            finally:
                node.ended_ns = monotonic_ns()
                _leave(token)
                if observer is not None:
                    observer.node_ended(node)
                # The traceback of a failure holds this frame, and the node holds the failure: no cycle for the
                # collector.
                del node, parent, token
        finally:
            if claim is not None:
                claim.release()
        return result

    return run


def _is_overridden(designator: Designator, perform: Callable[..., Any]) -> bool:
    """Whether the designator performs something else, which calls this one."""
    return getattr(type(designator).perform, "__wrapped__", None) is not perform


async def _turn() -> int:
    """Let the loop turn; the time after that, ns."""
    await asyncio.sleep(0)
    now_ns = monotonic_ns()
    _last_turn_ns.set(now_ns)
    return now_ns


def _status(error: BaseException, around: ExecutionContext | None) -> TaskStatus:
    """What it means for a node that this was raised in it."""
    if isinstance(error, asyncio.CancelledError):
        interrupted = around is not None and around.interrupted
        return TaskStatus.INTERRUPTED if interrupted else TaskStatus.CANCELLED
    return TaskStatus.FAILED if is_plan_failure(error) else TaskStatus.ERROR


def _leave(token: Token[TaskTreeNode | None]) -> None:
    """Make the parent current again."""
    try:
        current_node.reset(token)
    except ValueError:
        # A suspended plan that nobody awaits any more is closed by whoever drops it, in another context,
        # whose current node is not ours to change.
        return
