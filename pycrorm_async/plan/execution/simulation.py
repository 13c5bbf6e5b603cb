"""Thinking a plan through: performed in a copy of the world, it changes nothing, and shows what would come of it.

>>> with SimulatedTaskTree() as tree:
...     await TransportActionPerformable(milk, Arms.LEFT, there).perform()
>>> [node.status for node in tree if node.failure is not None]
[]

Designators mean the objects of the copy inside, and the real ones again outside, also those that were resolved
inside. A world `Object` itself stays what it is: act on it directly, and it really moves. What a memory
records of a thought is an episode of its own, which ordinary questions leave out.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from types import TracebackType
from typing import Any

from pycrorm_async.errors import CallerError
from pycrorm_async.plan.execution.observer import Thought, recorder, thinking
from pycrorm_async.plan.task_tree import CollectedTree, collecting, current_node
from pycrorm_async.world.observers import current_world
from pycrorm_async.world.world_copy import copied

__all__ = ["SimulatedTaskTree"]


class SimulatedTaskTree:
    """A thought, to be entered once with `with`; gives the tree of what is performed inside.

    Inside, the current world is a copy of the one there was (none, if there was none), and what is performed
    has no parent outside. However it is left, everything is as it was before; exceptions go through. Thoughts
    nest, and several tasks may think at once. Entering takes some 25 ms.

    The chosen robot is that of the context: one whose modules move something outside the world does so in a
    thought too. Think with `with SimulatedTaskTree() as tree, simulated_robot:` then.

    Args:
        description: what a memory calls it; left out, it says which node thinks.

    Raises:
        CallerError: the description is no text; on entering, that it was entered before.
    """

    def __init__(self, description: str | None = None) -> None:
        if description is not None and not isinstance(description, str):
            raise CallerError(f"the description of a thought is a str, not {description!r:.100}")
        self._description = description
        self._stack: ExitStack | None = None

    def __enter__(self) -> CollectedTree:
        if self._stack is not None:
            raise CallerError("a thought is entered once; make a new SimulatedTaskTree()")
        self._stack = ExitStack()
        with ExitStack() as entering:
            tree = entering.enter_context(_thought(self._description))
            self._stack = entering.pop_all()
        return tree

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        assert self._stack is not None
        self._stack.__exit__(kind, error, traceback)


@contextmanager
def _thought(description: str | None) -> Iterator[CollectedTree]:
    world, node, observer, tree = current_world.get(), current_node.get(), recorder.get(), CollectedTree()
    with ExitStack() as stack:
        copy = stack.enter_context(copied(world)) if world is not None else None
        thought = Thought(description, copy, node)
        _set(stack, thinking, thought)
        _set(stack, current_node, None)
        _set(stack, collecting, (tree,))
        if observer is not None:
            observer.thought_began(thought)
        failure: BaseException | None = None
        try:
            yield tree
        except BaseException as raised:
            failure = raised
            raise
        finally:
            if observer is not None:
                observer.thought_ended(thought, failure)
            del failure  # its traceback holds this frame


def _set(stack: ExitStack, variable: ContextVar[Any], value: object) -> None:
    """Until the stack is unwound. In another context, where a plan that nobody awaits is closed, nothing is ours."""
    token = variable.set(value)

    def reset() -> None:
        with suppress(ValueError):
            variable.reset(token)

    stack.callback(reset)
