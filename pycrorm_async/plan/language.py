"""Combine designators to plans: expressions, outcomes, monitors, retries and resources.

**Action description.** Descriptions of actions hold alternatives for each property; `resolve()` uses the first
alternative of each.

A property with one value needs no list: `ParkArmsAction(Arms.LEFT)`. Iterating a description yields every combination,
the last property varying fastest; those in which the arm is too weak for the object come last:

>>> [each.motion.name for each in SetGripperAction([Arms.LEFT], [GripperState.OPEN, GripperState.CLOSE])]
['OPEN', 'CLOSE']

**Designator.** Designators are the performable parts of a plan: dataclasses with parameters as fields and an async
`perform`.

A user's own designator needs nothing else; every call of its `perform` creates a node of the task tree:

>>> @dataclass
... class SayingActionPerformable(ActionAbstract):
...     text: str
...     async def perform(self) -> None:
...         print(self.text)
>>> SayingActionPerformable.dtype
'SayingAction'

**Expressions.** Expressions combine actions and motions to plans: in sequence, as alternatives, in parallel,
repeatedly.

    plan = NavigateAction([place]) + (PickUpAction(milk, [Arms.LEFT], [Grasp.FRONT]) - call_operator)
    outcome = await plan.perform()

An expression is performed like an action: it is a node of the task tree, and its operands' nodes are its children. It
returns an `Outcome`, or raises when it fails, so that a failure is visible at every level. Only plan failures count as
outcomes; any other exception ends the whole expression. A description is resolved immediately before it is performed.
Parallel branches that need the same part of the robot (`Designator.resources`) take turns. `Monitor` is in
`language`, `Retry` in `retry`.

**Monitor.** Monitors interrupt a plan as soon as a condition holds: `plan >> Monitor(condition)`.

>>> outcome = await (NavigateAction([place]) + look >> Monitor(milk_is_visible)).perform()
>>> outcome.interrupted
True
"""

from __future__ import annotations

import asyncio
import copy
import functools
import inspect
import itertools
import math
import operator
from abc import ABCMeta, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import aclosing
from dataclasses import dataclass, field, fields
from numbers import Real
from types import FunctionType
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple, NoReturn, Self, TypeAlias, TypeVar

from pycrorm_async.plan import failures as plan_failures
from pycrorm_async.plan.advice import Adviser, advised, adviser
from pycrorm_async.plan.execution import Arbiter, ExecutionContext, execution_context, is_wrapped, wrap_perform
from pycrorm_async.plan.field_types import check_properties, record_arguments
from pycrorm_async.plan.geometry import lifting_arms
from pycrorm_async.plan.objects import ObjectDesignatorDescription, ObjectLike, require_robot
from pycrorm_async.plan.task import NodeKind, current_node, join_tasks, raise_errors
from pycrorm_async.plan.watch import Condition, Watch
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, NoWorld

# === operators ================================================================================================
#
# Operators that combine plans: `a + b`, `a - b`, `a | b`, `a ^ b`, `a * 3`, `a >> Monitor(…)`.
#
# Designators and descriptions have them. Each operator creates an expression, which refuses an operand that is not
# performable immediately and names it.


class Composable:
    """Base of everything that can be an operand.

    At run time the other operand may be any object; one that is not performable raises `NotALanguageExpression`.
    """

    __slots__ = ()
    __array_ufunc__ = None  # numpy would otherwise turn an array times a plan into an array of plans

    def __add__(self, other: Composable) -> Sequential:
        """Perform this one, then the other."""
        return Sequential(self, other)

    def __sub__(self, other: Composable) -> TryInOrder:
        """Perform this one, and the other only if it fails."""
        return TryInOrder(self, other)

    def __or__(self, other: Composable) -> Parallel:
        """Perform both in parallel; both must succeed."""
        return Parallel(self, other)

    def __xor__(self, other: Composable) -> TryAll:
        """Perform both in parallel; one must succeed."""
        return TryAll(self, other)

    def __mul__(self, times: int) -> Repeat:
        """Perform this one `times` times."""
        return Repeat(self, times)

    __rmul__ = __mul__

    def __rshift__(self, monitor: Monitor) -> Monitor:
        """Perform this one until it ends or the monitor's condition holds."""
        return watch_operand(self, monitor)

    # Python calls these only if the left operand lacks the operator, so it is not performable: the constructors raise.

    def __radd__(self, other: Composable) -> Sequential:
        return Composable.__add__(other, self)

    def __rsub__(self, other: Composable) -> TryInOrder:
        return Composable.__sub__(other, self)

    def __ror__(self, other: Composable) -> Parallel:
        return Composable.__or__(other, self)

    def __rxor__(self, other: Composable) -> TryAll:
        return Composable.__xor__(other, self)

    def __rrshift__(self, other: Composable) -> Monitor:
        return watch_operand(other, self)


# === action description =======================================================================================

P = TypeVar("P")


class ActionDescription(Composable, Generic[P]):
    """Base of descriptions; takes the alternatives by name, in the order of the performable's fields.

    Object descriptions among the alternatives are matched against the world at each resolution or iteration.
    """

    _lifting: ClassVar[tuple[str, str] | None] = None
    """The properties that name the arm and the object that it lifts."""

    def __init__(self, performable: Callable[..., P], **alternatives: Any) -> None:
        self._performable = performable
        self._alternatives = {name: _as_alternatives(each) for name, each in alternatives.items()}

    if not TYPE_CHECKING:  # hidden from type checkers, which report the fault themselves

        def __getattr__(self, name: str) -> NoReturn:
            if name == "perform" or name in self.__dict__.get("_alternatives", ()):
                raise plan_failures.NotResolved(type(self).__name__, name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def resolve(self) -> P:
        """Return the performable with the first alternative of each property.

        Of several arms it is the first one that lifts the object (`ArmDescription.payload_kg`), if one does.

        Raises:
            IllPosedGoalFailure: a property has no alternative.
            ObjectNotFound: no object in the world matches the description.
        """
        return next(iter(self))

    def __iter__(self) -> Iterator[P]:
        """Yield every combination, the last property varying fastest. Raises what `resolve` raises."""
        choices = [self._choices(name, among) for name, among in self._alternatives.items()]
        too_weak: list[dict[str, Any]] = []
        for combination in itertools.product(*choices):
            properties = dict(zip(self._alternatives, combination, strict=True))
            if self._is_too_weak(properties):
                too_weak.append(properties)
            else:
                yield self._performable(**properties)
        for properties in too_weak:
            yield self._performable(**properties)

    def _is_too_weak(self, properties: Mapping[str, Any]) -> bool:
        """Return whether another arm of the alternatives lifts the object and this one does not."""
        if self._lifting is None:
            return False
        arm, load = self._lifting
        arms = self._alternatives[arm]
        return isinstance(arms, tuple) and len(arms) > 1 and properties[arm] not in _arms_for(properties[load], arms)

    def _choices(self, name: str, among: ObjectDesignatorDescription | tuple[Any, ...]) -> tuple[Any, ...]:
        if isinstance(among, ObjectDesignatorDescription):
            return tuple(among) or (among.resolve(),)
        if not among:
            raise plan_failures.IllPosedGoalFailure(f"{type(self).__name__} has no alternative for {name}", name)
        return among


def _arms_for(load: ObjectLike, arms: tuple[Arms, ...]) -> tuple[Arms, ...]:
    """Return the arms that lift the object; all of them outside a world with a robot."""
    try:
        return lifting_arms(require_robot(), arms, load)
    except (NoWorld, plan_failures.NoRobotHere):
        return arms


def _as_alternatives(value: Any) -> ObjectDesignatorDescription | tuple[Any, ...]:
    """Return the alternatives; a value that is not iterable is the only one, and so is a str."""
    if isinstance(value, ObjectDesignatorDescription):
        return value
    if isinstance(value, str):
        return (value,)
    try:
        alternatives = iter(value)
    except TypeError:
        return (value,)
    return tuple(alternatives)


# === designator ===============================================================================================


if TYPE_CHECKING:

    class DescribedClass(ABCMeta):
        """Declares what describes a class where no annotation of a field, such as `kind: str`, contradicts it."""

        kind: NodeKind
        dtype: str
        concept: str | None
        orm_class: type | None
else:
    DescribedClass = ABCMeta


class Designator(Composable, metaclass=DescribedClass):
    """Base of everything performable; derive from `ActionAbstract` or `BaseMotion`.

    Class attributes:
        kind: the kind of its nodes.
        dtype: its name in a memory, by default derived from the class name, also for a subclass of a class that sets
            it, so that two types never share a name by accident. Set it to keep the name when the class is renamed.
        aliases: a tuple of former names; queries for this type include records under them. Not inherited.
        concept: the SOMA concept it corresponds to, if there is one.
        orm_class: a mapped class of the user's own for queries. Not inherited.

    A field of a designator may have such a name too. Therefore the definition of the class keeps these attributes as
    `__kind__`, `__dtype__` and so on, and all code reads them there; type checkers know them of classes only.

    Raises:
        FieldHidesMethod: at class definition, if a field has the name of a method, such as `perform`.
        PerformNotAsync: at class definition, if `perform` is not a coroutine function.
        ResourcesNotAMethod: at class definition, if `resources` is a field or a value.
    """

    __kind__: ClassVar[NodeKind]
    __dtype__: ClassVar[str]
    __aliases__: ClassVar[Any] = ()
    __concept__: ClassVar[str | None] = None
    __orm_class__: ClassVar[type | None] = None

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        own, parameters = vars(cls), _annotated(cls)
        if "resources" in parameters or not callable(own.get("resources", len)):
            raise plan_failures.ResourcesNotAMethod(cls.__qualname__)
        if (hidden := next((name for name in parameters if _is_method(cls, name)), None)) is not None:
            raise plan_failures.FieldHidesMethod(cls.__qualname__, hidden)
        _describe(cls, {name: value for name, value in own.items() if name not in parameters})
        for name in ("kind", "dtype", "concept", "orm_class"):
            owner = next((each for each in cls.__mro__ if name in vars(each)), Designator)
            set_here = owner is Designator or vars(owner)[name] == getattr(owner, f"__{name}__", inspect)
            if set_here and name not in own and name not in parameters:
                setattr(cls, name, getattr(cls, f"__{name}__"))
        for name in own.get("__annotations__", {}):
            if name in parameters and name not in own and hasattr(ActionAbstract, name):
                setattr(cls, name, field())  # otherwise `@dataclass` would take the inherited attribute as its default
        initialise = own.get("__init__")
        if inspect.isfunction(initialise) and "__dataclass_fields__" not in own and not _is_built_in(cls):
            cls.__init__ = record_arguments(initialise)  # type: ignore[method-assign]  # as `perform` below
        perform = own.get("perform")
        if perform is None or is_wrapped(perform):  # dataclass(slots=True) copies a class whose `perform` is wrapped
            return
        if not inspect.iscoroutinefunction(perform):
            raise plan_failures.PerformNotAsync(cls.__qualname__)
        cls.perform = wrap_perform(perform)  # type: ignore[assignment]  # the wrapper replaces the method

    @classmethod
    def _name_in_memory(cls) -> str:
        return cls.__name__

    @abstractmethod
    async def perform(self) -> Any:
        """Perform the designator and return when it has ended. Raises a `PlanFailure` if it fails."""

    def resources(self) -> frozenset[plan_failures.Resource]:
        """Return the parts of the robot it uses exclusively from start to end; nested designators declare their own."""
        return plan_failures.NOTHING


def _is_built_in(designator: type) -> bool:
    return designator.__module__.startswith("pycrorm_async.")


def _annotated(designator: type) -> frozenset[str]:
    """Return the annotated attributes of the user's classes that this one consists of, except those of the class."""
    return frozenset(
        name
        for each in designator.__mro__
        if not _is_built_in(each)
        for name, kind in vars(each).get("__annotations__", {}).items()
        if "ClassVar" not in str(kind)
    )


def _is_method(designator: type, name: str) -> bool:
    """Return whether one of our classes that this one derives from has a method or property of this name."""
    if name == "resolve":  # that of descriptions, which plans call on what may be resolved already
        return True
    kinds = (FunctionType, classmethod, staticmethod, property)
    return any(isinstance(vars(each).get(name), kinds) for each in designator.__mro__ if _is_built_in(each))


def _describe(designator: type[Designator], own: Mapping[str, Any]) -> None:
    """Keep the attributes that describe a class, from its own ones without fields; ignore a value of another type."""
    kind, dtype = own.get("kind"), own.get("dtype")
    if isinstance(kind, str) and kind in ("action", "motion", "language"):
        designator.__kind__ = kind  # type: ignore[assignment]  # just checked
    designator.__dtype__ = dtype if isinstance(dtype, str) else designator._name_in_memory()  # noqa: SLF001  below it
    designator.__aliases__ = own.get("aliases", ())
    if isinstance(own.get("concept", 0), str | None):
        designator.__concept__ = own["concept"]
    orm_class = own.get("orm_class")
    designator.__orm_class__ = orm_class if isinstance(orm_class, type) else None


class ActionAbstract(Designator):
    """A goal of a plan, achieved by performing motions and other actions."""

    __kind__: ClassVar[NodeKind] = "action"

    @classmethod
    def _name_in_memory(cls) -> str:
        """Derive the name: both `FaceAtPerformable` and `FaceAtActionPerformable` give `FaceAtAction`."""
        stem = cls.__name__.removesuffix("Performable")
        return stem if stem.endswith("Action") else f"{stem}Action"


class BaseMotion(Designator):
    """A single command to a robot's controllers. Its fields are checked when it is built.

    Raises:
        ResolutionError: names the fields that are missing or have another type than declared.
    """

    __kind__: ClassVar[NodeKind] = "motion"

    def __post_init__(self) -> None:
        check_properties(self)


# === expressions ==============================================================================================

Operand: TypeAlias = Designator | ActionDescription[Any]


class Expression(Designator):
    """Base of expressions. Operands are never modified, so one operand may occur in several places.

    Attributes:
        operands: in the order in which they were written; descriptions stay unresolved until they are performed.

    Raises:
        NotALanguageExpression: an operand is not performable, or there is no operand.
    """

    __kind__: ClassVar[NodeKind] = "language"
    operands: tuple[Operand, ...] = ()

    def __init__(self, *operands: Composable) -> None:
        self.hold(self._flat(operands))

    def hold(self, operands: Iterable[Composable]) -> None:
        """Check the operands and store them."""
        self.operands = tuple(_check_operand(each, type(self).__name__) for each in operands)
        if not self.operands:
            raise plan_failures.NotALanguageExpression(f"{type(self).__name__} needs something to perform")

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
            raise plan_failures.NotALanguageExpression(
                f"Repeat needs an integer times >= 0, got {times!r}", repr(times)
            )
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

    __kind__: ClassVar[NodeKind] = "language"

    function: str
    arguments: dict[str, str]

    def __init__(self, function: Callable[..., Any], /, **arguments: Any) -> None:
        if not callable(function):
            raise plan_failures.NotALanguageExpression(
                f"Code needs a function, got {_short(function)}", _short(function)
            )
        self.function = name_of(function)
        self.arguments = {name: _short(value) for name, value in arguments.items()}
        self._call = functools.partial(function, **arguments)

    def __repr__(self) -> str:
        return f"Code({self.function})"

    async def perform(self) -> Any:
        result = self._call()
        return await result if inspect.isawaitable(result) else result


async def perform_operand(operand: Operand) -> Any:
    """Perform an operand; resolve it first if it is a description, to its best alternative where plans are advised."""
    designator: Any = operand
    if not isinstance(operand, Designator):
        by = adviser.get()
        designator = await _best_alternative(operand, by) if by is not None else operand.resolve()
    if inspect.isawaitable(designator):
        designator = await designator
    return await _check_operand(designator, "an expression").perform()


async def _best_alternative(description: ActionDescription[Any], by: Adviser) -> Any:
    async with aclosing(advised(description, by)) as alternatives:
        async for each in alternatives:
            return each
    return description.resolve()  # raises the reason why there is no alternative


def name_of(value: Any) -> str:
    """Return the name of an operand, a function or a condition."""
    if isinstance(value, functools.partial):
        return name_of(value.func)
    if isinstance(value, Designator):
        return value.__dtype__
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
        asyncio.create_task(branch(operand), name=f"{expression.__dtype__} {number}: {name_of(operand)}")
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
        raise plan_failures.NotALanguageExpression(
            f"this Monitor has no operand, so {where} cannot perform it: write plan >> Monitor(condition)"
        )
    if isinstance(operand, Designator | ActionDescription):
        return operand
    advice = ""
    if callable(operand):
        advice = ": make an instance" if isinstance(operand, type) else ": wrap it in Code(…)"
    raise plan_failures.NotALanguageExpression(
        f"{where} needs designators or descriptions of actions, got {_short(operand)}{advice}", _short(operand)
    )


def _short(value: Any) -> str:
    """Return a repr of at most 100 characters. Never raises."""
    try:
        text = repr(value)
    except Exception as error:  # noqa: BLE001  a user's __repr__ may raise anything
        text = f"<{type(value).__name__}: {plan_failures.describe_error(error)}>"
    return text if len(text) <= 100 else f"{text[:99]}…"


# === outcome ==================================================================================================
#
# The result of an expression of the plan language, and functions that try operands and combine their failures.


@dataclass(frozen=True, slots=True, repr=False)
class Outcome:
    """The outcome of an expression; a memory records `in_brief()` as the result of its node.

    Attributes:
        results: the operands' results in the order of the operands, for `Repeat` the rounds' results. None for one that
            failed, was not tried, or was interrupted.
        succeeded: positions, from 0, of the operands or rounds that succeeded.
        failures: failures of the others, in the order in which they occurred.
        rounds: number of rounds of a `Repeat`.
        interrupted: for a `Monitor`, whether its condition held before the operand ended.
    """

    results: tuple[Any, ...] = ()
    succeeded: tuple[int, ...] = ()
    failures: tuple[Exception, ...] = ()
    rounds: int | None = None
    interrupted: bool | None = None

    def __repr__(self) -> str:
        values = ((each.name, getattr(self, each.name)) for each in fields(self))
        return f"Outcome({', '.join(f'{name}={value!r}' for name, value in values if value not in ((), None))})"

    def in_brief(self) -> dict[str, Any]:
        """Return the outcome as plain values, without the operands' results, which are at their own nodes.

        >>> Outcome(results=(None, 3), succeeded=(1,), failures=(ObjectLost("gone"),)).in_brief()
        {'succeeded': [1], 'failures': ['ObjectLost: gone']}
        """
        if self.interrupted is not None:
            return {"interrupted": self.interrupted}
        if self.rounds is not None:
            return {"rounds": self.rounds}
        brief: dict[str, Any] = {"succeeded": list(self.succeeded)}
        if self.failures:
            brief["failures"] = [plan_failures.describe_error(each) for each in self.failures]
        return brief


class Attempt(NamedTuple):
    """A result, or the plan failure that was raised instead."""

    result: Any = None
    failure: Exception | None = None


async def attempt(perform: Callable[[], Any]) -> Attempt:
    """Perform and return the result or the plan failure; any other exception propagates."""
    try:
        return Attempt(await perform())
    except Exception as error:
        if not plan_failures.is_plan_failure(error):
            raise
        return Attempt(failure=error)


def combine_failures(failures: list[Exception], summary: str) -> Exception:
    """Return a single failure itself, or several as `PlanFailures`, for the caller to raise.

    Empties the list, because the failure's traceback holds the caller's frame and its variables: this breaks the
    reference cycle.
    """
    error = (
        failures[0]
        if len(failures) == 1
        else plan_failures.PlanFailures(f"{summary}: {_list_failures(failures)}", tuple(failures))
    )
    failures.clear()
    return error


def _list_failures(failures: list[Exception]) -> str:
    named = [plan_failures.describe_error(each) for each in failures[:_NAMED_MAX]]
    more = len(failures) - len(named)
    return "; ".join([*named, f"and {more} more"] if more else named)


_NAMED_MAX = 10
"""Bounds the failures that a message describes."""


# === monitor ==================================================================================================


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
            raise plan_failures.NotALanguageExpression(
                f"Monitor needs a callable or an asyncio.Event, got {type(checked).__name__}: write a function that"
                " returns whether to interrupt",
                repr(checked),
            )
        if isinstance(getattr(checked, "__self__", None), asyncio.Event) and name_of(checked).endswith("Event.wait"):
            raise plan_failures.NotALanguageExpression(
                "Monitor evaluates its condition before each node, so one that waits keeps the plan from starting: pass"
                " the Event itself, not its wait",
                repr(checked),
            )
        if isinstance(interval_s, bool) or not isinstance(interval_s, Real) or not 0 < interval_s < math.inf:
            raise plan_failures.NotALanguageExpression(
                f"Monitor needs a finite interval_s > 0, got {interval_s!r}", interval_s
            )
        self.condition = name_of(condition)
        self.interval_s = float(interval_s)
        self._condition: Condition = condition

    @property
    def is_complete(self) -> bool:
        return bool(self.operands)

    async def perform(self) -> Outcome:
        """Return an `Outcome` with one result, or one with `interrupted` set. Raises the operand's exceptions."""
        if not self.operands:
            raise plan_failures.NotALanguageExpression("this Monitor has no operand: write plan >> Monitor(condition)")
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
        raise plan_failures.NotALanguageExpression(
            f"the right operand of >> must be a Monitor, got {name_of(monitor)}", name_of(monitor)
        )
    if monitor.operands:
        raise plan_failures.NotALanguageExpression(
            "this Monitor has an operand already: create another Monitor for this plan"
        )
    monitor_copy = copy.copy(monitor)
    monitor_copy.hold([operand])
    return monitor_copy
