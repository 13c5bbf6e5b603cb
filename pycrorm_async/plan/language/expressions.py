"""How actions and motions make a plan: one after the other, one instead of the other, at once, again.

    plan = NavigateAction([there]) + (PickUpAction(milk, [Arms.LEFT], [Grasp.FRONT]) - tell_somebody)
    outcome = await plan.perform()

An expression is performed like an action: it is a node of the task tree, with its operands' nodes below. It
raises when it fails, so that failures are seen at every level, and returns an `Outcome` otherwise. Only plan
failures count as outcomes: any other exception ends the whole expression. Descriptions are resolved when it is
their turn. Branches that run at once take turns where they need the same part of the robot (`Designator.resources`).
`Monitor` is in `plan.monitoring`, `Retry` in `plan.retrying`.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeAlias

from pycrorm_async.plan.actions.descriptions import ActionDescription
from pycrorm_async.plan.designator import Designator
from pycrorm_async.plan.execution.execution_context import ExecutionContext, execution_context
from pycrorm_async.plan.failures import NotALanguageExpression, describe_error
from pycrorm_async.plan.language.operators import Composable
from pycrorm_async.plan.language.outcome import Attempt, Outcome, attempt, combine_failures
from pycrorm_async.plan.language.resource_arbiter import Arbiter
from pycrorm_async.plan.language.task_branches import join_tasks, raise_errors
from pycrorm_async.plan.task_tree import NodeKind

__all__ = ["Code", "Expression", "Operand", "Parallel", "Repeat", "Sequential", "TryAll", "TryInOrder"]

Operand: TypeAlias = Designator | ActionDescription[Any]


class Expression(Designator):
    """What expressions have in common. Operands are never changed: the same one may stand in several places.

    Attributes:
        operands: in the order they were written, as they were given: descriptions are resolved when performed.

    Raises:
        NotALanguageExpression: an operand is none, or there is none.
    """

    kind: ClassVar[NodeKind] = "language"
    operands: tuple[Operand, ...] = ()

    def __init__(self, *operands: Composable) -> None:
        self.hold(self._flat(operands))

    def hold(self, operands: Iterable[Composable]) -> None:
        """These are its operands, once they are checked."""
        self.operands = tuple(_check_operand(each, type(self).__name__) for each in operands)
        if not self.operands:
            raise NotALanguageExpression(f"{type(self).__name__} needs something to perform")

    @property
    def is_complete(self) -> bool:
        """Whether it can be an operand: a `Monitor` that watches nothing is not."""
        return True

    def simplify(self) -> Self:
        """The same: `a + (b + c)` is `Sequential(a, b, c)` from the start."""
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
    """`a + b`: one after the other. Raises the first failure; what would come after it is not performed."""

    async def perform(self) -> Outcome:
        results = [await perform_operand(operand) for operand in self.operands]
        return Outcome(tuple(results), tuple(range(len(results))))


class TryInOrder(Expression):
    """`a - b`: one after the other, until one succeeds. If none does, raises all failures together."""

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
    """`a | b`: all at once, each in a task of its own, all to their end. Raises the failures together, if any."""

    async def perform(self) -> Outcome:
        attempts = await _run_branches(self)
        failures = [each.failure for each in attempts if each.failure is not None]
        if failures:
            count = len(attempts)
            del attempts
            raise combine_failures(failures, f"{len(failures)} of {count} branches failed")
        return Outcome(tuple(each.result for each in attempts), tuple(range(len(attempts))))


class TryAll(Expression):
    """`a ^ b`: all at once, all to their end; one must succeed. If none does, raises all failures together."""

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
    """`a * 3`: so many times. A round that fails does not keep the others from being tried.

    Raises the failures together in the end, if any; which rounds they were is in the message, or if there is one
    failure alone in its notes.

    Raises:
        NotALanguageExpression: `times` is no whole number from 0.
    """

    times: int

    def __init__(self, operand: Composable, times: int) -> None:
        try:
            self.times = operator.index(times)
        except TypeError:
            self.times = -1
        if isinstance(times, bool) or self.times < 0:
            raise NotALanguageExpression(f"a plan is repeated a whole number of times, not {times!r}", repr(times))
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
    """Calls a function, sync or async, when it is its turn; returns what that returns, and is a node of its own.

    A sync function runs in the plan's own loop, so it must be quick.

    Attributes:
        function: its qualified name.
        arguments: what it is called with, each as a short text of when it was written down.

    Raises:
        NotALanguageExpression: it cannot be called.
    """

    kind: ClassVar[NodeKind] = "language"

    function: str
    arguments: dict[str, str]

    def __init__(self, function: Callable[..., Any], /, **arguments: Any) -> None:
        if not callable(function):
            raise NotALanguageExpression(f"Code calls a function, not {_short(function)}", _short(function))
        self.function = name_of(function)
        self.arguments = {name: _short(value) for name, value in arguments.items()}
        self._call = functools.partial(function, **arguments)

    def __repr__(self) -> str:
        return f"Code({self.function})"

    async def perform(self) -> Any:
        result = self._call()
        return await result if inspect.isawaitable(result) else result


async def perform_operand(operand: Operand) -> Any:
    """Perform it; a description is resolved now."""
    designator = operand if isinstance(operand, Designator) else operand.resolve()
    return await _check_operand(designator, "an expression").perform()


def name_of(value: Any) -> str:
    """What an operand, a function or a condition is called."""
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
    """All operands as tasks, in order of the operands; what needs the same part of the robot takes turns."""
    around = execution_context.get() or ExecutionContext()
    if around.arbiter is None or around.arbiter.loop is not asyncio.get_running_loop():
        around = ExecutionContext(around.watches, Arbiter())

    async def branch(operand: Operand) -> Attempt:
        execution_context.set(around)
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
        # The traceback of an exception holds this frame: no cycle for the collector.
        del tasks, outside


def _check_operand(operand: Any, where: str) -> Any:
    """The operand. Raises `NotALanguageExpression` if it is none."""
    if isinstance(operand, Expression) and not operand.is_complete:
        raise NotALanguageExpression(
            f"this Monitor watches nothing, so {where} cannot perform it: write plan >> Monitor(condition)"
        )
    if isinstance(operand, Designator | ActionDescription):
        return operand
    advice = ""
    if callable(operand):
        advice = ": make an instance" if isinstance(operand, type) else ": wrap it in Code(…)"
    raise NotALanguageExpression(
        f"{where} performs designators and descriptions of actions, not {_short(operand)}{advice}", _short(operand)
    )


def _short(value: Any) -> str:
    """A cut repr. Never raises."""
    try:
        text = repr(value)
    except Exception as error:  # noqa: BLE001  a user's __repr__ may raise anything
        text = f"<{type(value).__name__}: {describe_error(error)}>"
    return text if len(text) <= 100 else f"{text[:99]}…"
