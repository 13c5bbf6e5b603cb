"""Execute designators: create nodes, enter execution contexts, notify the observer, simulate plans.

**Node execution.** Wrap every `perform` of a designator class, so that each call creates a node and notifies the
observer.

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
another context, whose current node does not change.

A call of `super().perform()` on the same designator belongs to the node of the outer call. It is recognised by two
facts: the current node's designator is this very object, and its class performs another function than this one.

This code runs for every node of every plan and costs a few µs, so it is one function; calls would cost more than most
of its steps.
"""

from __future__ import annotations

import asyncio
import functools
import gc
import inspect
import sys
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from contextvars import ContextVar, Token
from dataclasses import dataclass, field
from types import CoroutineType
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias
from weakref import ref

from pycrorm_async import connected_var
from pycrorm_async.clock import monotonic_ns
from pycrorm_async.connected_var import ConnectedVar
from pycrorm_async.plan.failures import Resource, ResourceDeadlock, is_plan_failure
from pycrorm_async.plan.task import Performable, TaskTreeNode, collecting, current_node
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.bullet import BulletWorld, current_world
from pycrorm_async.world.pose import Arms, Grasp, ObjectType, Pose
from pycrorm_async.world.world_copy import acting_robot

if TYPE_CHECKING:
    from pycrorm_async.plan.objects import ObjectLike


# === node execution ===========================================================================================

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
    async def run(self: Performable, unstarted: Unstarted | None) -> Any:  # noqa: C901  see above
        if unstarted:
            unstarted[0].waiting -= 1
            unstarted.clear()
        parent = current_node.get()
        if parent is not None and parent.designator is self and _is_overridden(self, perform):
            return await perform(self)
        now_ns = monotonic_ns()
        if now_ns - _last_yield_ns.get() > YIELD_INTERVAL_NS:
            await asyncio.sleep(0)
            now_ns = monotonic_ns()
            _last_yield_ns.set(now_ns)
        around, claim = execution_context.get(), None
        if around is not None:
            claim = await around.enter(self)
            now_ns = monotonic_ns()
        try:
            observer = recorder.get()
            if observer is not None and (admission := observer.admit()) is not None:
                await admission
                now_ns = monotonic_ns()

            node = TaskTreeNode(self, self.__kind__, parent, now_ns)
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
                try:  # noqa: SIM105  `suppress` takes longer
                    current_node.reset(token)
                except ValueError:
                    pass  # a suspended plan that was dropped is closed in another context, whose node must not change
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


def _status(error: BaseException, around: ExecutionContext | None) -> TaskStatus:
    """Return the status of a node that ended with this exception."""
    if isinstance(error, asyncio.CancelledError):
        interrupted = around is not None and around.interrupted
        return TaskStatus.INTERRUPTED if interrupted else TaskStatus.CANCELLED
    if isinstance(error, KeyboardInterrupt):
        return TaskStatus.CANCELLED
    return TaskStatus.FAILED if is_plan_failure(error) else TaskStatus.ERROR


# === observer =================================================================================================
#
# Port through which the plan layer reports its execution to an observer, usually a memory; plans run without one too.
#
# `recorder` is the observer of the current context. It is called synchronously in the plan's task, so it must be quick.
# An exception of `node_started` refuses the perform before it runs; its other methods must not raise.


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place that a location designator offers: a pose, and the arms that reach the target from there.

    A place from experience also has the grasp and the torso height (m) of the past success.
    """

    pose: Pose
    arms: tuple[Arms, ...] = ()
    grasp: Grasp | None = None
    torso_height: float | None = None


@dataclass(frozen=True, slots=True)
class Refusal:
    """A place that a location designator tried and does not offer, and the reason."""

    pose: Pose
    reason: str


@dataclass(frozen=True, slots=True)
class Cells:
    """The numbers of places in the costmaps of a search.

    Attributes:
        occupied: places with an obstacle too near for any heading.
        hidden: further places from which the target is not visible.
        free: all others, the best of which the search tries.
    """

    occupied: int
    hidden: int
    free: int


@dataclass(slots=True)
class Search:
    """What a location designator found.

    Attributes:
        location: the designator's class name.
        node: the node that resolves it.
        offered: the first places it offered, and the last one.
        taken: index of the offered place that was taken; None if none was.
        considered: number of places it tried.
        refused: the first places that it tried in vain, in the order of the search.
        offered_beyond: number of further places that it offered.
        cells: the places in its costmaps; None if it has none, or ended before they were made.
    """

    location: str
    node: TaskTreeNode | None
    offered: list[Candidate] = field(default_factory=list)
    taken: int | None = None
    considered: int = 0
    refused: list[Refusal] = field(default_factory=list)
    offered_beyond: int = 0
    cells: Cells | None = None


@dataclass(frozen=True, slots=True)
class Seen:
    """A percept: an object that perception reports, whether or not the world has it.

    >>> Seen(milk, pose=Pose([1.31, 1, 0.9]), confidence=0.92, source="stereo")
    >>> Seen(BelieveObject("cup?", ObjectType.JEROEN_CUP, Pose([1.2, 0.4, 0.9])), confidence=0.31, source="stereo")

    Attributes:
        thing: the object of the world that the percept matches; a `BelieveObject` if it matches none, which may be a
            hypothesis or a false positive.
        visible: the visible share of the object, 0 to 1; None if it was not computed.
        pose: the perceived pose; None means the pose of `thing`.
        confidence: the confidence as the robot's perception computed it; None if it computed none.
        source: name of the sensor or method; None means the source of the whole detection.
    """

    thing: ObjectLike
    visible: float | None = None
    pose: Pose | None = None
    confidence: float | None = None
    source: str | None = None


class Simulation:
    """A running simulation: plans performed in a copy of the world (see `retry`).

    Attributes:
        description: in words; None if the caller passed none.
        world: the copy; None if there was no world to copy.
        by: the node that runs the simulation; None outside any node.
        record: reserved for the observer that records the plan.
    """

    __slots__ = ("by", "description", "record", "world")

    def __init__(self, description: str | None, world: BulletWorld | None, by: TaskTreeNode | None) -> None:
        self.description = description
        self.world = world
        self.by = by
        self.record: Any = None


class PlanObserver(Protocol):
    """Receives every node, resolved location, perception and simulation of the plans in its context."""

    def admit(self) -> Awaitable[None] | None:
        """Return None if a node may start at once, otherwise an awaitable to await before (it may raise)."""
        ...

    def node_started(self, node: TaskTreeNode) -> None:
        """Called before `perform` runs, with status RUNNING. May raise to refuse it. May set `node.record`."""
        ...

    def node_ended(self, node: TaskTreeNode) -> None:
        """Called exactly once for every started node, after its status, failure and result are set."""
        ...

    def location_resolved(self, search: Search) -> None:
        """Called once after a location designator was resolved or iterated.

        Called in another context if a loop over places was dropped.
        """
        ...

    def object_detected(
        self,
        *,
        source: Literal["camera", "world_state"],
        object_type: ObjectType | None,
        seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> None:
        """Called after a perception, with the perceived objects, the best visible first."""
        ...

    def simulation_started(self, simulation: Simulation) -> None:
        """Called when a simulation starts in this context. May set `simulation.record`."""
        ...

    def simulation_ended(self, simulation: Simulation, failure: BaseException | None) -> None:
        """Called exactly once at the end of every started simulation, before its world closes.

        `failure` is the exception that left the simulation, if any.
        """
        ...


recorder: ConnectedVar[PlanObserver] = connected_var.plan_observer

current_simulation: ContextVar[Simulation | None] = ContextVar("current_simulation", default=None)
"""The innermost simulation of this context; None outside a simulation."""


# === unawaited performs =======================================================================================
#
# Detect performs that were called and never awaited: `action.perform()` without `await` does nothing.
#
# Theory of operation -------------------
#
# The actors are the coroutine that a call of `perform` creates, its frame, and a `CalledPerforms` object per episode
# (or per memory outside any episode). A coroutine is in one of three states: not started, started, or ended without a
# start.
#
# A call creates a list and passes it to the coroutine as its argument `unstarted`, so that only the coroutine's frame
# holds it. The list contains the `CalledPerforms` and a weak reference to the coroutine, whose callback reports the
# designator's class. `CalledPerforms.waiting` counts the calls that have not started.
#
# When the frame starts, it decrements the count and empties the list, which removes the weak reference: its callback
# cannot run any more. A coroutine that is closed or cancelled before its start drops its frame while the coroutine
# itself still exists; the list and the reference vanish with the frame, and no callback runs. That is correct, because
# such a coroutine was awaited or handed to a task. Only a coroutine that is garbage collected without a start has its
# frame until the end; then the weak reference outlives the coroutine, and its callback reports the missing `await`.
# Python 3.12 and 3.13 keep the frame of a coroutine that is closed by `close()` before its start, so there that call is
# reported too.
#
# At the end of an episode some coroutines may still be referenced and not started. If `waiting` is not 0, `close`
# searches the objects of the process for coroutines that have not started and belong to this episode, and reports those
# that no task is about to run. It empties their lists, so that their collection does not report them again. Without
# such calls the search is skipped. A coroutine is reported by `close` or by its callback and never by both, because
# emptying the list removes the reference.

Unstarted: TypeAlias = list[Any]
"""The `CalledPerforms` and the weak reference, held by the frame of a coroutine that has not started.

Empty after the start, and after `close` has reported the coroutine.
"""


class CalledPerforms:
    """The performs of one context that were called and have not started.

    The execution of a node updates the count itself, because it does so at every call.

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


called_performs: ConnectedVar[CalledPerforms] = connected_var.called_performs
"""The calls of the context's episode, or of its memory outside an episode; None if there is no memory."""


# === execution context ========================================================================================
#
# The execution context of a node: the monitors around it, and the arbiter and claims of its parallel branches.
#
# Most plans have none; then a perform reads one ContextVar only. Otherwise `ExecutionContext.enter` runs before the
# node is created, so that a node that is interrupted or waits for a part of the robot has not started yet.


class Interrupter(Protocol):
    """Interrupts the plan inside it when a condition holds; the watch of a monitor."""

    @property
    def fired(self) -> bool:
        """True once it has interrupted the plan."""
        ...

    async def check(self) -> None:
        """Interrupt the plan and raise `CancelledError` if the condition holds."""
        ...


@dataclass(frozen=True, slots=True)
class ExecutionContext:
    """The monitors and claims that apply in a context; asyncio tasks inherit it.

    Attributes:
        watches: the watches of all enclosing monitors, the outermost first.
        arbiter: the arbiter of the outermost enclosing parallel expression.
        claim: the claim of the nearest ancestor that holds parts of the robot; its `parent` leads to the others.
    """

    watches: tuple[Interrupter, ...] = ()
    arbiter: Arbiter | None = None
    claim: Claim | None = None

    @property
    def interrupted(self) -> bool:
        """True if an enclosing monitor has interrupted its operand."""
        return any(watch.fired for watch in self.watches)

    async def enter(self, designator: Performable) -> Claim | None:
        """Check the monitors, then wait for the parts of the robot that the designator needs.

        The caller releases the returned claim, if there is one, when the node has ended.

        Raises:
            CancelledError: a monitor's condition holds.
            ResourceDeadlock: the wait for a part of the robot would never end.
        """
        if self.watches and not self.interrupted:
            for watch in self.watches:
                await watch.check()
        if self.arbiter is None:
            return None
        return await self.arbiter.claim(designator)


execution_context: ContextVar[ExecutionContext | None] = ContextVar("execution_context", default=None)


# === resource arbiter =========================================================================================
#
# Arbitrate the parts of the robot between the branches of a parallel expression.
#
# Theory of operation -------------------
#
# The outermost parallel expression creates an `Arbiter`; every node inside it that declares `resources` makes a `Claim`
# before it starts. A part is a pair of the acting robot (without a robot, the world) and resource, so branches in
# different worlds, or of different robots, do not compete. A claim is in one of three states: waiting, holding, or
# released. It gets all its parts together or none, and holds them until its node ends. Claims form a tree through
# `parent`, which is the claim of the nearest ancestor node.
#
# A claim can be granted if no claim other than its ancestors holds one of its parts: a node may use the parts of its
# ancestors, but two nodes that run in parallel inside one holder exclude each other. Grants follow the order of arrival
# for each part. There is one exception: a claim does not queue behind an earlier one that itself waits for the end of
# one of this claim's ancestors, because that earlier one cannot proceed before this claim has ended.
#
# A deadlock needs a holder that waits, directly or through the claims that wait inside it, for an ancestor of the new
# claim, while the new claim waits for that holder. `_check_deadlock` searches this chain before a claim waits and
# raises `ResourceDeadlock` instead of waiting forever. Every claim is checked once, when it arrives: a chain that
# closes later is closed by a later claim, which is checked in its turn.
#
# All methods run in the thread of one event loop, and only `await claim.granted` suspends, so the two lists change
# between awaits only and need no lock. A waiting task can be cancelled at any time, also after its claim was granted
# but before it resumed; `_withdraw` therefore removes the claim from whichever list holds it. A branch that runs in
# another event loop (a thread of the plan's own) makes no claim.

Part: TypeAlias = tuple[Any, Resource]
"""A part of one robot."""


class Claim:
    """The parts of the robot that a node waits for or holds."""

    __slots__ = ("_arbiter", "_token", "designator", "granted", "parent", "parts")

    def __init__(self, arbiter: Arbiter, designator: Performable, parts: frozenset[Part], parent: Claim | None) -> None:
        self.designator = designator
        self.parts = parts
        self.parent = parent
        self.granted: asyncio.Future[None] | None = None
        """Set while the claim waits; resolved when it is granted."""
        self._arbiter = arbiter
        self._token: Token[ExecutionContext | None] | None = None

    def above(self) -> Iterator[Claim]:
        """Yield the claims of the ancestor nodes, nearest first."""
        each = self.parent
        while each is not None:
            yield each
            each = each.parent

    def enter(self, context: ExecutionContext) -> None:
        """Make this claim the parent of claims made later in this context."""
        self._token = execution_context.set(ExecutionContext(context.watches, self._arbiter, self))

    def release(self) -> None:
        """Release the parts after the node has ended, and grant waiting claims."""
        self._arbiter.release(self)
        assert self._token is not None
        try:
            execution_context.reset(self._token)
        except ValueError:
            # A dropped plan is closed in another context, whose execution context must not change.
            return


class Arbiter:
    """Grants the claims of all nodes inside one parallel expression; belongs to one event loop."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self._holding: list[Claim] = []
        self._waiting: list[Claim] = []

    async def claim(self, designator: Performable) -> Claim | None:
        """Wait until the designator's parts are free and hold them in this context; None if it needs none.

        Raises `ResourceDeadlock` if the wait would never end.
        """
        resources = designator.resources()
        if not resources or asyncio.get_running_loop() is not self.loop:
            return None
        context = execution_context.get()
        assert context is not None, "an arbiter belongs to an execution context"
        world = current_world.get()
        robot = (acting_robot(world) or world) if world is not None else None
        claim = Claim(self, designator, frozenset((robot, resource) for resource in resources), context.claim)
        self._check_deadlock(claim)
        self._waiting.append(claim)
        self._grant()
        if claim not in self._holding:
            claim.granted = self.loop.create_future()
            try:
                await claim.granted
            except BaseException:
                self._withdraw(claim)
                raise
        claim.enter(context)
        return claim

    def release(self, claim: Claim) -> None:
        """Release the claim's parts; its ancestors may still hold them."""
        self._holding.remove(claim)
        self._grant()

    # --- granting and deadlock detection ----------------------------------------------------------------------

    def _withdraw(self, claim: Claim) -> None:
        """Remove a claim whose wait was cancelled, possibly just after it was granted."""
        (self._holding if claim in self._holding else self._waiting).remove(claim)
        self._grant()

    def _grant(self) -> None:
        """Grant every claim that can be granted, in the order of arrival.

        Repeat until nothing changes, because a grant may free an earlier claim from queueing behind another.
        """
        granted = True
        while granted:
            granted = False
            for claim in tuple(self._waiting):
                if not self._holders(claim) and not self._must_queue(claim):
                    granted = True
                    self._waiting.remove(claim)
                    self._holding.append(claim)
                    if claim.granted is not None and not claim.granted.done():
                        claim.granted.set_result(None)

    def _holders(self, claim: Claim) -> list[Claim]:
        """Return the claims that hold a part it needs, except its ancestors."""
        above = set(claim.above())
        return [each for each in self._holding if each not in above and each.parts & claim.parts]

    def _must_queue(self, claim: Claim) -> bool:
        """Return whether an earlier claim goes first."""
        above = set(claim.above())
        return any(not self._waits_for(earlier, above) for earlier in self._earlier_rivals(claim))

    def _earlier_rivals(self, claim: Claim) -> list[Claim]:
        """Return the earlier waiting claims that need some of the same parts."""
        earlier = self._waiting[: self._waiting.index(claim)]
        return [each for each in earlier if each.parts & claim.parts]

    def _waits_for(self, waiter: Claim, ends: set[Claim]) -> bool:
        """Return whether `waiter` can be granted, or may be, only after one of `ends` has ended."""
        ahead, seen = [waiter], set()
        while ahead:
            each = ahead.pop()
            if each in seen:
                continue
            seen.add(each)
            for holder in self._holders(each):
                if holder in ends:
                    return True
                ahead += self._waiting_in(holder)
            ahead += self._earlier_rivals(each)
        return False

    def _waiting_in(self, holder: Claim) -> list[Claim]:
        """Return the claims that wait inside the holder, which cannot end before they do."""
        return [each for each in self._waiting if holder in each.above()]

    def _check_deadlock(self, claim: Claim) -> None:
        """Raise `ResourceDeadlock` if a holder waits, directly or indirectly, for an ancestor of the claim."""
        ends = set(claim.above())
        for first in self._holders(claim):
            ahead, seen = [first], set()
            while ahead:
                holder = ahead.pop()
                if holder in ends:
                    resource = min((resource for _, resource in first.parts & claim.parts), key=lambda each: each.name)
                    raise ResourceDeadlock(
                        resource,
                        first.designator.__dtype__,
                        claim.designator.__dtype__,
                        holder.designator.__dtype__,
                    )
                if holder not in seen:
                    seen.add(holder)
                    for waiter in self._waiting_in(holder):
                        ahead += self._holders(waiter)
