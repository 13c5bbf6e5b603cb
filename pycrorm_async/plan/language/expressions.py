"""Expressions combine actions and motions to plans: in sequence, as alternatives, in parallel, repeatedly.

    plan = NavigateAction([place]) + (PickUpAction(milk, [Arms.LEFT], [Grasp.FRONT]) - call_operator)
    outcome = await plan.perform()

An expression is performed like an action: it is a node of the task tree, and its operands' nodes are its children. It
returns an `Outcome`, or raises when it fails, so that a failure is visible at every level. Only plan failures count as
outcomes; any other exception ends the whole expression. A description is resolved immediately before it is performed.
Parallel branches that need the same part of the robot (`Designator.resources`) take turns. `Monitor` is in
`language.monitor`, `Retry` in `language.retry`.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeAlias

from pycrorm_async.plan.actions.action_description import ActionDescription
from pycrorm_async.plan.designator import Designator
from pycrorm_async.plan.exceptions import describe_error
from pycrorm_async.plan.execution.execution_context import ExecutionContext, execution_context
from pycrorm_async.plan.failures import NotALanguageExpression
from pycrorm_async.plan.language.operators import Composable
from pycrorm_async.plan.language.outcome import Attempt, Outcome, attempt, combine_failures
from pycrorm_async.plan.language.resource_arbiter import Arbiter
from pycrorm_async.plan.language.task_branches import join_tasks, raise_errors
from pycrorm_async.plan.protocols import NodeKind

Operand: TypeAlias = Designator | ActionDescription[Any]


class Expression(Designator):
    """Base of expressions. Operands are never modified, so one operand may occur in several places.

    Attributes:
        operands: in the order in which they were written; descriptions stay unresolved until they are performed.

    Raises:
        NotALanguageExpression: an operand is not performable, or there is no operand.
    """

    kind: ClassVar[NodeKind] = "language"
    operands: tuple[Operand, ...] = ()

    def __init__(self, *operands: Composable) -> None:
        self.hold(self._flat(operands))

    def hold(self, operands: Iterable[Composable]) -> None:
        """Check the operands and store them."""
        self.operands = tuple(_check_operand(each, type(self).__name__) for each in operands)
        if not self.operands:
            raise NotALanguageExpression(f"{type(self).__name__} needs something to perform")

    @property
    def is_complete(self) -> bool:
        """True if it can be an operand; False for a `Monitor` without an operand."""
        return True

    def simplify(self) -> Self:
        """Return the expression itself, for plans written for PyCRAM, which call it.

        Nested expressions such as `a + (b + c)` are flattened when they are built.
        """
        return self

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(name_of(each) for each in self.operands)})"

    def _flat(self, operands: Iterable[Composable]) -> Iterable[Composable]:
        for each in operands:
            if isinstance(each, Expression) and type(each) is type(self):
                yield from each.operands
            else:
                yield each


class Sequential(Expression):
    """`a + b`: performs the operands in sequence. Raises the first failure and skips the operands after it."""

    async def perform(self) -> Outcome:
        results = [await perform_operand(operand) for operand in self.operands]
        return Outcome(tuple(results), tuple(range(len(results))))


class TryInOrder(Expression):
    """`a - b`: performs the operands in sequence until one succeeds. If none does, raises all failures as a group."""

    async def perform(self) -> Outcome:
        failures: list[Exception] = []
        for position, operand in enumerate(self.operands):
            result, failure = await attempt(functools.partial(perform_operand, operand))
            if failure is None:
                before, after = (None,) * position, (None,) * (len(self.operands) - position - 1)
                return Outcome((*before, result, *after), (position,), tuple(failures))
            failures.append(failure)
            del failure
        raise combine_failures(failures, f"none of {len(failures)} alternatives succeeded")


class Parallel(Expression):
    """`a | b`: performs the operands in parallel tasks and waits for all. Raises the failures, if any, as a group."""

    async def perform(self) -> Outcome:
        attempts = await _run_branches(self)
        failures = [each.failure for each in attempts if each.failure is not None]
        if failures:
            count = len(attempts)
            del attempts
            raise combine_failures(failures, f"{len(failures)} of {count} branches failed")
        return Outcome(tuple(each.result for each in attempts), tuple(range(len(attempts))))


class TryAll(Expression):
    """`a ^ b`: performs the operands in parallel, waits for all. If none succeeds, raises all failures as a group."""

    async def perform(self) -> Outcome:
        attempts = await _run_branches(self)
        succeeded = tuple(position for position, each in enumerate(attempts) if each.failure is None)
        failures = [each.failure for each in attempts if each.failure is not None]
        if not succeeded:
            del attempts
            raise combine_failures(failures, f"none of {len(failures)} branches succeeded")
        return Outcome(tuple(each.result for each in attempts), succeeded, tuple(failures))


@dataclass(init=False, repr=False, eq=False)
class Repeat(Expression):
    """`a * 3`: performs the operand `times` times, also after a round that failed.

    Raises the failures, if any, as a group after the last round. The message names the failed rounds; a single failure
    is raised itself, with its round as a note.

    Raises:
        NotALanguageExpression: `times` is not an integer >= 0.
    """

    times: int

    def __init__(self, operand: Composable, times: int) -> None:
        try:
            self.times = operator.index(times)
        except TypeError:
            self.times = -1
        if isinstance(times, bool) or self.times < 0:
            raise NotALanguageExpression(f"Repeat needs an integer times >= 0, got {times!r}", repr(times))
        self.hold([operand])

    async def perform(self) -> Outcome:
        (operand,) = self.operands
        results: list[Any] = []
        failures: list[Exception] = []
        failed: list[int] = []
        for number in range(1, self.times + 1):
            result, failure = await attempt(functools.partial(perform_operand, operand))
            results.append(result)
            if failure is not None:
                failures.append(failure)
                failed.append(number)
            del failure
        if failures:
            raise self._failed(failures, failed)
        return Outcome(tuple(results), tuple(range(self.times)), rounds=self.times)

    def _failed(self, failures: list[Exception], failed: list[int]) -> Exception:
        if len(failures) == 1:
            failures[0].add_note(f"this was round {failed[0]} of {self.times}; the others succeeded")
        rounds = f"{', '.join(map(str, failed[:10]))}{', …' if len(failed) > 10 else ''}"
        return combine_failures(failures, f"{len(failed)} of {self.times} rounds failed ({rounds})")


@dataclass(init=False, repr=False, eq=False)
class Code(Designator):
    """Calls a sync or async function as a node of its own and returns its result.

    A sync function runs in the plan's event loop, so it must be quick.

    Attributes:
        function: the function's qualified name.
        arguments: its arguments, each as a short repr of the moment when the `Code` was built.

    Raises:
        NotALanguageExpression: the function is not callable.
    """

    kind: ClassVar[NodeKind] = "language"

    function: str
    arguments: dict[str, str]

    def __init__(self, function: Callable[..., Any], /, **arguments: Any) -> None:
        if not callable(function):
            raise NotALanguageExpression(f"Code needs a function, got {_short(function)}", _short(function))
        self.function = name_of(function)
        self.arguments = {name: _short(value) for name, value in arguments.items()}
        self._call = functools.partial(function, **arguments)

    def __repr__(self) -> str:
        return f"Code({self.function})"

    async def perform(self) -> Any:
        result = self._call()
        return await result if inspect.isawaitable(result) else result


async def perform_operand(operand: Operand) -> Any:
    """Perform an operand; resolve it first if it is a description."""
    designator = operand if isinstance(operand, Designator) else operand.resolve()
    if inspect.isawaitable(designator):
        designator = await designator
    return await _check_operand(designator, "an expression").perform()


def name_of(value: Any) -> str:
    """Return the name of an operand, a function or a condition."""
    if isinstance(value, functools.partial):
        return name_of(value.func)
    if isinstance(value, Designator):
        return value.dtype
    if isinstance(value, ActionDescription):
        return type(value).__name__
    named = value if hasattr(value, "__qualname__") else type(value)
    module = getattr(named, "__module__", None)
    return f"{module}.{named.__qualname__}" if module not in (None, "builtins") else str(named.__qualname__)


async def _run_branches(expression: Expression) -> list[Attempt]:
    """Perform all operands in tasks of their own and return the attempts in the order of the operands.

    Nested parallel expressions share the arbiter of the outermost one, so that all branches take turns with each other.
    """
    context = execution_context.get() or ExecutionContext()
    if context.arbiter is None or context.arbiter.loop is not asyncio.get_running_loop():
        context = ExecutionContext(context.watches, Arbiter())

    async def branch(operand: Operand) -> Attempt:
        execution_context.set(context)
        return await attempt(functools.partial(perform_operand, operand))

    tasks = [
        asyncio.create_task(branch(operand), name=f"{expression.dtype} {number}: {name_of(operand)}")
        for number, operand in enumerate(expression.operands)
    ]
    outside = await join_tasks(tasks)
    try:
        raise_errors(tasks, outside)
        return [task.result() for task in tasks]
    finally:
        # The traceback of a raised exception holds this frame: break the reference cycle.
        del tasks, outside


def _check_operand(operand: Any, where: str) -> Any:
    """Return the operand. Raises `NotALanguageExpression` if it is not performable."""
    if isinstance(operand, Expression) and not operand.is_complete:
        raise NotALanguageExpression(
            f"this Monitor has no operand, so {where} cannot perform it: write plan >> Monitor(condition)"
        )
    if isinstance(operand, Designator | ActionDescription):
        return operand
    advice = ""
    if callable(operand):
        advice = ": make an instance" if isinstance(operand, type) else ": wrap it in Code(…)"
    raise NotALanguageExpression(
        f"{where} needs designators or descriptions of actions, got {_short(operand)}{advice}", _short(operand)
    )


def _short(value: Any) -> str:
    """Return a repr of at most 100 characters. Never raises."""
    try:
        text = repr(value)
    except Exception as error:  # noqa: BLE001  a user's __repr__ may raise anything
        text = f"<{type(value).__name__}: {describe_error(error)}>"
    return text if len(text) <= 100 else f"{text[:99]}…"
