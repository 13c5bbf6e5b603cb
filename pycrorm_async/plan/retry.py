"""Retry an operand that failed: with the next alternative of a description, or the same designator again.

**Simulation.** Simulate plans: perform them in a copy of the world, without changing the original.

>>> with SimulatedTaskTree() as tree:
...     await TransportActionPerformable(milk, Arms.LEFT, target_location).perform()
>>> [node.status for node in tree if node.failure is not None]
[]

Inside a simulation designators refer to the objects of the copy, and outside to the original ones again, also those
resolved inside. A world `Object` used directly still belongs to the original world, and moving it changes that world.
A memory records a simulation as an episode of its own, which ordinary queries leave out.
"""

import functools
import itertools
import operator
from collections.abc import AsyncGenerator, AsyncIterable, Iterator
from contextlib import ExitStack, aclosing, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import failures as plan_failures
from pycrorm_async.plan.advice import advised, adviser
from pycrorm_async.plan.execution import Simulation, current_simulation, recorder
from pycrorm_async.plan.language import Composable, Designator, Expression, attempt, combine_failures, perform_operand
from pycrorm_async.plan.task import CollectedTree, collecting, current_node
from pycrorm_async.world.bullet import current_world
from pycrorm_async.world.world_copy import copied


@dataclass(init=False, repr=False, eq=False)
class Retry(Expression):
    """Performs the alternatives of a description in turn, or a designator repeatedly, until one succeeds.

    >>> await Retry(PickUpAction(milk, [Arms.LEFT, Arms.RIGHT], [Grasp.FRONT, Grasp.TOP]), max_tries=4).perform()

    Args:
        max_tries: greatest number of tries; a description may have fewer alternatives.

    Raises:
        NotALanguageExpression: the operand is not performable, or `max_tries` is not an integer >= 1.
    """

    max_tries: int

    def __init__(self, operand: Composable, max_tries: int = 3) -> None:
        try:
            self.max_tries = operator.index(max_tries)
        except TypeError:
            self.max_tries = 0
        if isinstance(max_tries, bool) or self.max_tries < 1:
            raise plan_failures.NotALanguageExpression(f"Retry needs an integer max_tries >= 1, got {max_tries!r}")
        self.hold([operand])

    async def perform(self) -> Any:
        """Return the result of the first success, or raise the last failure with the earlier ones as notes."""
        failures: list[Exception] = []
        notes: list[str] = []
        try:
            async with aclosing(self._alternatives()) as alternatives:
                async for performable in alternatives:
                    result, failure = await attempt(functools.partial(perform_operand, performable))
                    if failure is None:
                        return result
                    failures = [failure]
                    notes.append(f"try {len(notes) + 1}: {plan_failures.describe_error(failure)}")
                    del failure
                    if len(notes) == self.max_tries:
                        break
        except plan_failures.RefusedByPrediction as refused:  # of all alternatives that are left
            failures = [refused]
            notes.append("")
        if not failures:
            raise plan_failures.IllPosedGoalFailure(f"{self!r}: the description has no alternative")
        for note in notes[:-1]:
            failures[0].add_note(note)
        raise combine_failures(failures, "")

    async def _alternatives(self) -> AsyncGenerator[Any, None]:
        (operand,) = self.operands
        by = adviser.get()
        if by is not None and not isinstance(operand, Designator):
            async with aclosing(advised(operand, by)) as alternatives:
                async for each in alternatives:
                    yield each
        elif isinstance(operand, AsyncIterable):  # a description that asks a memory between two alternatives
            async for each in operand:
                yield each
        else:
            for each in itertools.repeat(operand) if isinstance(operand, Designator) else operand:
                yield each


# === simulation ===============================================================================================


class SimulatedTaskTree:
    """A simulation, entered once with `with`; yields the tree of the nodes performed inside.

    Inside, the current world is a copy of the former one (None if there was none), and nodes have no parent outside.
    At the end the former world and node are current again; exceptions propagate. Simulations nest, and several tasks
    may simulate at the same time. Entering takes about 25 ms.

    The chosen robot is that of the context. If its modules move a real robot, they do so in a simulation too: use
    `with SimulatedTaskTree() as tree, simulated_robot:` then.

    Args:
        description: its description in a memory; None means one that names the node that runs it.

    Raises:
        CallerError: the description is not a str, or the simulation is entered a second time.
    """

    def __init__(self, description: str | None = None) -> None:
        if description is not None and not isinstance(description, str):
            raise CallerError(f"the description of a simulation must be a str, not {description!r:.100}")
        self._description = description
        self._stack: ExitStack | None = None

    def __enter__(self) -> CollectedTree:
        if self._stack is not None:
            raise CallerError("a simulation can be entered once; make a new SimulatedTaskTree()")
        self._stack = ExitStack()
        with ExitStack() as entering:
            tree = entering.enter_context(_simulate(self._description))
            self._stack = entering.pop_all()
        return tree

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        assert self._stack is not None
        self._stack.__exit__(kind, error, traceback)


@contextmanager
def _simulate(description: str | None) -> Iterator[CollectedTree]:
    world, node, observer, tree = current_world.get(), current_node.get(), recorder.get(), CollectedTree()
    with ExitStack() as stack:
        copy = stack.enter_context(copied(world)) if world is not None else None
        simulation = Simulation(description, copy, node)
        _set(stack, current_simulation, simulation)
        _set(stack, current_node, None)
        _set(stack, collecting, (tree,))
        if observer is not None:
            observer.simulation_started(simulation)
        failure: BaseException | None = None
        try:
            yield tree
        except BaseException as raised:
            failure = raised
            raise
        finally:
            if observer is not None:
                observer.simulation_ended(simulation, failure)
            del failure  # its traceback holds this frame: break the reference cycle


def _set(stack: ExitStack, variable: ContextVar[Any], value: object) -> None:
    """Set a context variable until the stack unwinds; leave it alone if that happens in another context.

    A dropped plan is closed in another context.
    """
    token = variable.set(value)

    def reset() -> None:
        with suppress(ValueError):
            variable.reset(token)

    stack.callback(reset)
